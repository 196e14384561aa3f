"""The bench: rows of small scenes, their table and chart; no test asserts a time."""

import dataclasses

import pytest

from lab import figures, rows, speed
from lab.methods import METHODS
from lab.rows import Row, Size, Time


def row(method, ms, rms_um, kind="scene", height=480, data="sphere R 10 mm, press 1 mm, noise 0.003"):
    time = Time(ms, 0.1, ms, 40, 1, "a machine", speed.PACES[0])
    size = Size(height, height * 4 // 3)
    ours = method in METHODS and METHODS[method].ours
    return Row(kind, method, data, {"rms_um": rms_um, "normal_deg": rms_um}, size, time, ours=ours)


ROWS = [row("fast", 1.0, 3.0), row("precise", 2.0, 1.0), row("flat", 0.1, 500.0), row(speed.GS_SDK, 9.0, None)]


def test_scenes_are_timed_and_scored(monkeypatch):
    monkeypatch.setattr(speed, "SIZES", ((48, 64),))
    monkeypatch.setattr(speed, "in_turn", lambda calls, rounds: [[1.5, 2.0, 2.5] for call in calls if call() is not None])
    by_name = {r.method: r for r in speed.methods(lambda name: None, None)}
    assert {*speed.TIMED} <= {*by_name}
    assert by_name["fast"].errors["rms_um"] < 0.1 * by_name["flat"].errors["rms_um"]
    assert by_name["fast"].parameters == 12 and by_name["flat"].parameters == 0 and not by_name["look-up table"].ours
    assert speed.ms(by_name["fast"]) == 2.0


def test_the_table_has_a_line_for_each_row():
    lines = rows.table(ROWS, speed.COLUMNS).splitlines()
    assert len(lines) == 2 + len(ROWS) and len({line.count("|") for line in lines}) == 1
    assert "| 640x480 | 1.00 (0.10) | 1000 | 3.000 | 3.000 |" in lines[2]
    with pytest.raises(ValueError, match="row: expected one with a time"):
        speed.ms(dataclasses.replace(ROWS[0], time=None))


def test_the_chart_is_drawn(tmp_path):
    figures.save_small(figures.speed_figure(ROWS), tmp_path / "chart.png")
    assert (tmp_path / "chart.png").stat().st_size > 10_000
