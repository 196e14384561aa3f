"""The bench: rows of small scenes, their table, JSON and chart; no test asserts a time."""

import dataclasses

import pytest

from torchvts.evaluation import rows, speed
from torchvts.evaluation.figures import speed_figure
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
    monkeypatch.setattr(speed, "time_ms", lambda call: (call(), speed.Timing(2.0, 0.5))[1])
    made = list(speed._scenes(speed.Bench("a command", lambda name: None)))
    methods = [r.method for r in made if "press 1 mm" in r.data]
    assert {*speed.TIMED, *speed.TIMED_ONCE} - {*methods} <= {"fast, SciPy's DCT"}
    by_name = {r.method: r for r in made if "press 1 mm" in r.data}
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
    walls = [
        row(m, k + 1.0, k + 1.0, "wall", 240, "stamp, upright walls") for k, m in enumerate(("precise", "precise, discontinuities"))
    ]
    sensor = [row("response, fast", 1.0, 3.0, "sensor", 240), row(speed.GS_SDK, 9.0, 2.5, "sensor", 240)]
    for given, panels in (([*ROWS, *walls], 3), ([*ROWS, *walls, *sensor], 4)):
        axes = speed_figure(given).axes
        assert len(axes) == panels
        texts = [text.get_text() for text in axes[0].texts]
        assert {"fast", "precise", "auto"} <= {*texts} and "not drawn:\nflat: 500 at 0.1 ms" in texts
