"""The bench: rows of small scenes, their table, JSON and chart; no test asserts a time."""

import dataclasses
from pathlib import Path

import pytest

from torchvts.evaluation import rows, speed, user_speed
from torchvts.evaluation.figures import learning_figure, speed_figure
from torchvts.evaluation.methods import METHODS
from torchvts.evaluation.rows import Row, Size, Time


def row(method, ms, rms_um, kind="scene", height=480, data="sphere R 10 mm, press 1 mm, noise 0.003"):
    time = Time(ms, 0.1, 1000.0 / ms, 1.0, 1, "a machine")
    size = Size(height, height * 4 // 3)
    ours = method in METHODS and METHODS[method].ours
    return Row(kind, method, data, {"rms_um": rms_um, "normal_deg": rms_um}, size, time, ours=ours)


ROWS = [
    row("fast", 1.0, 3.0),
    row("precise", 2.0, 1.0),
    row("auto", 3.0, 2.0),
    row("flat", 0.1, 500.0),
    row(speed.GS_SDK, 9.0, None),
]


def test_scenes_are_timed_and_scored(monkeypatch):
    monkeypatch.setattr(speed, "SIZES", ((48, 64),))
    monkeypatch.setattr(speed, "time_ms", lambda call: (call(), (2.0, 0.5))[1])
    by_name = {r.method: r for r in speed._scenes(speed.Bench("a command", lambda name: None))}
    assert {*speed.TIMED} - {*by_name} <= {"fast, SciPy's DCT"}
    assert by_name["fast"].errors["rms_um"] < 0.1 * by_name["flat"].errors["rms_um"]
    assert by_name["fast"].parameters == 12 and by_name["flat"].parameters == 0 and not by_name["look-up table"].ours
    assert by_name["fast"].time.frames_per_second == 500.0 and by_name["fast"].command == "a command"


def test_the_front_holds_what_no_row_beats():
    assert [r.method for r in speed.front(ROWS, "rms_um")] == ["flat", "fast", "precise"]


def test_rows_come_back_from_json():
    without = dataclasses.replace(ROWS[0], time=None, size=None, note="failed", severity=0.1, seed=2)
    assert rows.from_json(rows.to_json([*ROWS, without])) == [*ROWS, without]


def test_the_table_has_a_line_for_each_row():
    lines = speed.table(ROWS).splitlines()
    assert len(lines) == 2 + len(ROWS) and len({line.count("|") for line in lines}) == 1
    assert "| 640x480 | 1.00 (0.10) | 1000 | 1 | 3.000 | 3.000 |" in lines[2]
    assert speed.peer_ratios(ROWS)[0].startswith("640x480: fast 1.00 ms, 9.0 times as fast as gs_sdk's pipeline (9.0 ms)")
    with pytest.raises(ValueError, match="row: expected one with a time"):
        speed.ms(dataclasses.replace(ROWS[0], time=None))


def test_the_chart_names_its_points():
    sensor = [row("response, fast", 1.0, 3.0, "sensor", 240, "GelSight Mini, balls"), row(speed.GS_SDK, 9.0, 2.5, "sensor", 240)]
    for given, panels in ((ROWS, 2), ([*ROWS, *sensor], 3)):
        figure = speed_figure(given)
        assert len(figure.axes) == panels and not any(axes.get_legend() for axes in figure.axes)
        scene = figure.axes[-2]
        assert {"fast", "precise", "auto"} <= {text.get_text() for text in scene.texts}
        assert "not drawn: flat, 500 at 0.1 ms" in scene.get_xlabel()
    assert "GelSight Mini, 320x240" in figure.axes[0].get_title()  # the real sensor comes first
    boxes = [text.get_window_extent() for text in figure.legends[0].get_texts()]
    assert all(not box.overlaps(axes.get_window_extent()) for box in boxes for axes in figure.axes)  # it covers no point
    wide = row("a prior that has seen all of them, precise", 1.1, 2.4, "sensor", 240, "GelSight Mini, balls")
    panel = speed_figure([*ROWS, *sensor, wide]).axes[0]
    panel.figure.draw_without_rendering()
    boxes = [text.get_window_extent() for text in panel.texts]
    assert len(boxes) == 3 and all(panel.bbox.x0 <= box.x0 and box.x1 <= panel.bbox.x1 for box in boxes)


def test_a_chart_is_drawn_again_from_its_table(run_script, tmp_path):
    (tmp_path / "bench.json").write_text(rows.to_json(ROWS))
    done = run_script("figures", "speed", tmp_path / "bench.json", tmp_path / "chart.png")
    assert done.returncode == 0 and (tmp_path / "chart.png").stat().st_size > 10_000
    points = Path(__file__).parent / "breaking_points.json"
    done = run_script("figures", "overview", points, tmp_path / "overview.png")
    assert done.returncode == 0 and (tmp_path / "overview.png").stat().st_size > 10_000
    done = run_script("figures", "speed", tmp_path / "none.json", tmp_path / "chart.png")
    assert done.returncode == 1 and done.stderr.startswith("error: ") and "none.json" in done.stderr


def test_the_learning_curve_shows_every_draw():
    drawn = [Row("presses", m, "a set", {"count": c, "normal_deg": c + k, "relief_um": 3.0}, seed=k)
             for m in ("presses", "MLP") for c in (1.0, 5.0) for k in range(3)]  # fmt: skip
    level = Row("presses", "a network", "a set", {"count": None, "normal_deg": 2.5, "relief_um": 3.0})
    figure = learning_figure([*drawn, level])
    assert list(figure.axes[0].get_lines()[-1].get_ydata()) == [2.5, 2.5]
    line = figure.axes[0].get_lines()[0]
    assert list(line.get_ydata()) == [2.0, 6.0] and "3 draws" in figure.get_suptitle()
    bars = figure.axes[0].collections[0].get_segments()
    assert [[end[1] for end in bar] for bar in bars] == [[1.0, 3.0], [5.0, 7.0]]


def test_frames_are_timed_as_a_user_runs_them(monkeypatch):
    """Every pace, batches, one thread, what is paid once: the rows and their table."""
    monkeypatch.setattr(user_speed, "SIZES", ((24, 32), (48, 64)))
    monkeypatch.setattr(user_speed, "BATCHES", (1, 3))
    monkeypatch.setattr(user_speed, "CAMERA_FRAMES", 12)
    monkeypatch.setattr(user_speed, "_import_s", lambda: 0.4)
    monkeypatch.setattr(user_speed.time, "sleep", lambda seconds, sleep=user_speed.time.sleep: sleep(min(seconds, 0.005)))
    measured = user_speed.run(None, lambda name: None, calls=20)
    found = {(row.size.width, row.method, row.pace, row.threads) for row in measured.frames}
    for mode in user_speed.MODES:
        for pace in user_speed.PACES:
            assert {(32, mode, pace, user_speed.OWN), (64, mode, pace, user_speed.OWN), (64, mode, pace, "1")} <= found
    assert {row.size.batch for row in measured.frames} == {1, 3} and all(row.median_ms <= row.p90_ms for row in measured.frames)
    assert any("dropped of 12" in cost.name for cost in measured.costs) and measured.costs[0].value == 0.4
    text = user_speed.table(measured)
    assert "drawn rig, 64x48, threads: own choice: fast" in text and "times as fast as gs_sdk's pipeline" in text


def test_many_calls_have_a_99th_percentile():
    times = [1.0] * 985 + [9.0] * 15
    few, many = (user_speed.summary("rig", "fast", Size(48, 64), "tight loop", "1", some) for some in (times[:100], times))
    assert few.p99_ms is None and many.p99_ms == 9.0 and many.median_ms == 1.0
