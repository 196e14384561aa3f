"""The bench of moving dots: ours is as exact as the rivals on an easy pair, and sees no dot that is gone."""

from lab import motion


def test_a_pair_beside_the_rivals():
    rows = {row.way: row for row in motion.run_pairs(["half of the dots gone"], 1)}
    ours = rows[motion.OURS]
    assert ours.rms_px < 1.1 * rows["Farneback"].rms_px and ours.rms_px < rows["Lucas-Kanade"].rms_px
    assert ours.wrong == 0 and ours.false == 0 < rows["Farneback"].false
    assert "| half of the dots gone |" in motion.table("pairs", list(rows.values()))
