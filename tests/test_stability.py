"""The sweep over hard scenes: what it measures, that it goes on where it stopped, and that no breaking point has moved."""

import json
import math
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import torch

from torchvts.evaluation import stability
from torchvts.evaluation.gallery import DIALS, undisturbed
from torchvts.evaluation.stability import MASK, METHODS, Breaking, Row

ROOT = Path(__file__).resolve().parents[1]
POINTS, SEEDS = stability.from_json((ROOT / "tests" / "breaking_points.json").read_text())


def test_every_method_and_dial_has_a_kept_breaking_point():
    assert {(p.method, p.dial) for p in POINTS} == {(m, d) for m in (*METHODS, MASK) for d in DIALS}


@pytest.mark.parametrize("name", DIALS)
def test_no_breaking_point_has_moved(name):
    """Measured again with the same seeds at the two severities around it; further off only where that says it moved there."""
    dial, kept = DIALS[name], [p for p in POINTS if p.dial == name and p.method in ("fast", "auto", "precise, cliffs", MASK)]
    cases = {(s, seed): dial.make(s, seed) for s in {s for p in kept for s in p.between} for seed in range(SEEDS)}
    for point in kept:
        method, error = (point.method, lambda row: row.limits) if point.method != MASK else ("fast", lambda row: row.mask_limits)
        rows = [
            stability.measure(method, name, s, seed, cases[s, seed])
            for s in dial.severities
            if s in point.between
            for seed in range(SEEDS)
        ]
        found = stability.breaking_point(point.method, dial, rows, error)
        said = (
            f"{name}, {point.method}: broke at {point.at}, now {found.at}; run python scripts/stability.py --keep if that is meant"
        )
        if isinstance(point.at, str):
            assert found.at == point.at, said
        else:
            assert not isinstance(found.at, str) and abs(found.at - point.at) <= point.tolerance, said


def test_the_page_tells_what_the_json_says():
    page = (ROOT / "docs" / "where_methods_fail.md").read_text(encoding="utf-8")
    assert stability.told_in(page, POINTS) == page
    for name in DIALS:
        assert f"<!-- dial: {name} -->" in page and f"failures/{name.replace(' ', '_')}.png" in page
        assert (ROOT / "docs" / "failures" / f"{name.replace(' ', '_')}.png").stat().st_size < 60_000
    assert (ROOT / "docs" / "failures" / "overview.png").stat().st_size < 80_000
    assert stability.LIMITS in page.replace("\n", " ")


def test_a_row_is_the_metrics_of_the_method():
    case = undisturbed(3)
    row = stability.measure("precise", "noise", 0.002, 3, case)
    assert row.press_um == pytest.approx(1000 * float(case.truth.depth_mm.max())) and row.iou > 0.98
    assert row.depth_share == pytest.approx(row.rms_um / row.press_um)
    assert row.limits == pytest.approx(max(row.normal_deg / 3.0, row.depth_share / 0.05)) and row.limits < 0.5
    flat = stability.measure("flat", "noise", 0.002, 3, case)
    z = case.truth.depth_mm[case.truth.contact]
    assert flat.rms_um == pytest.approx(1000 * float(z.square().mean().sqrt()), rel=1e-4) and flat.iou == 0.0
    assert flat.largest_px == pytest.approx(float(z.max()) / 0.125, rel=1e-4)


def test_without_contact_the_whole_image_counts():
    case = DIALS["faint contact"].make(0.0, 0)
    row = stability.measure("fast", "faint contact", 0.0, 0, case)
    assert row.press_um == 0.0 and row.depth_share == row.rms_um / 100.0 and row.iou == 1.0


def test_the_plain_inverse_is_the_method_where_nothing_is_dark_and_worse_where_something_is():
    plain, lit = (
        stability.METHODS[m](undisturbed().calibration)(undisturbed().image) for m in ("precise, plain inverse", "precise")
    )
    assert (plain.depth_mm - lit.depth_mm).abs().max() < 1e-4
    dark = DIALS["attached shadows"].make(40.0, 0)
    row, plain_row = (stability.measure(m, "attached shadows", 40.0, 0, dark) for m in ("precise", "precise, plain inverse"))
    assert plain_row.limits > 3 * row.limits


def test_what_fails_or_warns_keeps_its_note(monkeypatch):
    def breaks(calibration):
        raise RuntimeError("the lamp is broken")

    def complains(calibration):
        warnings.warn("not sure", UserWarning, stacklevel=1)
        return METHODS["fast"](calibration)

    def invents(calibration):
        good = METHODS["flat"](calibration)
        return lambda image: good(image)._replace(depth_mm=torch.full((1, 1, 120, 160), math.nan))

    monkeypatch.setitem(METHODS, "breaks", breaks)
    monkeypatch.setitem(METHODS, "complains", complains)
    monkeypatch.setitem(METHODS, "invents", invents)
    case = undisturbed()
    rows = {m: stability.measure(m, "noise", 0.002, 0, case) for m in ("breaks", "complains", "invents")}
    assert rows["breaks"].note == "RuntimeError: the lamp is broken" and rows["breaks"].limits == stability.WORST
    assert rows["breaks"].normal_deg is None and rows["breaks"].mask_limits == stability.WORST
    assert rows["complains"].warned and rows["complains"].note == "UserWarning: not sure" and rows["complains"].limits < 1
    assert rows["invents"].rms_um is None and rows["invents"].note == "the result is not finite"
    lines = stability.row_table(list(rows.values())).splitlines()
    assert len(lines) == 5 and all(line.count("|") == lines[0].count("|") for line in lines)
    assert "failed | failed | failed | failed | 10.00 | 1 of 1 failed: RuntimeError: the lamp is broken" in lines[2]
    assert "nan" not in "\n".join(lines)


def _rows(errors, seeds=2):
    """Rows on the dial "noise" whose error is so many limits."""
    severities = DIALS["noise"].severities
    return [
        Row("fast", "noise", s, seed, 3.0 * e, 0.0, 1000.0, 0.0, 1.0) for s, e in zip(severities, errors) for seed in range(seeds)
    ]


def test_breaking_points_are_interpolated():
    dial = DIALS["noise"]  # 0.002, 0.005, 0.01, 0.02, 0.05, 0.1

    def at(errors):
        return stability.breaking_point("fast", dial, _rows(errors), lambda row: row.limits)

    point = at([0.1, 0.2, 0.5, 1.5, 3.0, 9.0])
    assert point.at == pytest.approx(0.015) and point.between == (0.01, 0.02) and point.held == pytest.approx(2.5 / 5)
    assert point.tolerance == pytest.approx(stability.TOLERANCE * 0.01)
    assert (at([0.1] * 6).at, at([0.1] * 6).held, at([0.1] * 6).between) == ("never", 1.0, (0.1,))
    assert (at([1.1] + [0.1] * 5).at, at([1.1] * 6).held) == ("always", 0.0)
    assert at([0.1, 0.1, 2.0, 0.1, 0.1, 0.1]).between == (0.005, 0.01)  # the first break counts
    two = [row for row in _rows([0.1, 0.2, 0.5, 1.5, 3.0, 9.0]) if row.severity in (0.01, 0.02)]
    assert stability.breaking_point("fast", dial, two, lambda row: row.limits) == point


def test_breaking_points_of_a_falling_dial():
    dial = DIALS["few bits"]  # 12, 8, 6, 5, ...
    errors = dict(zip(dial.severities, (0.1, 0.1, 0.5, 1.5, 2.0, 3.0, 4.0)))
    rows = [Row("fast", dial.name, s, 0, 3.0 * e, 0.0, 1000.0, 0.0, 1.0) for s, e in errors.items()]
    point = stability.breaking_point("fast", dial, rows, lambda row: row.limits)
    assert point.at == pytest.approx(5.5) and point.tolerance > 0 and point.held == pytest.approx(2.5 / 6)


def test_the_table_has_a_line_for_each_dial_and_no_blank():
    lines = stability.table(POINTS).splitlines()
    assert len(lines) == 2 + len(DIALS) and len({line.count("|") for line in lines}) == 1
    assert all(cell.strip() for line in lines for cell in line.split("|")[1:-1])
    without = [p for p in POINTS if not (p.method == "auto" and p.dial == "noise")]
    assert stability.table(without).count("not measured") == 1


def test_json_comes_back_as_it_was():
    text = stability.to_json(POINTS, "a command", 3)
    assert stability.from_json(text) == (POINTS, 3) and json.loads(text)["limits"] == stability.LIMITS


def test_pages_tell_of_breaking_points():
    points = [
        Breaking("flat", "noise", "value", "always", 0.0, (0.002,), 0.0),
        Breaking("fast", "noise", "value", 0.01234, 0.1, (0.01, 0.02), 0.4),
        Breaking("auto", "noise", "value", 0.01234, 0.1, (0.01, 0.02), 0.4),
        Breaking("precise", "noise", "value", "never", 0.0, (0.1,), 1.0),
    ]
    page = "# a page\n<!-- dial: noise -->\nold\nrest"
    told = "# a page\n<!-- dial: noise -->\nBreaks at 0.0123 value: *fast*, *auto*; holds to the end: *precise*.\nrest"
    assert stability.told_in(page, points) == told
    with pytest.raises(ValueError, match="page: <!-- dial: flood -->: no such dial was measured"):
        stability.told_in("<!-- dial: flood -->\n", points)


SMALL = {"methods": ["flat", "fast"], "dials": ["noise"], "seeds": 1}


def test_a_sweep_goes_on_where_it_was_stopped(tmp_path, monkeypatch):
    path, count = tmp_path / "rows.jsonl", []
    rows = stability.sweep(path, **SMALL, progress=lambda: count.append(1))
    assert len(rows) == len(count) == 12 == len(path.read_text().splitlines()) - 1
    whole = path.read_text()
    lines = whole.splitlines(keepends=True)
    path.write_text("".join(lines[:6]) + lines[6][:20])  # killed while it wrote
    made = []
    original = stability.measure
    monkeypatch.setattr(stability, "measure", lambda *a: made.append(a[:4]) or original(*a))
    assert stability.sweep(path, **SMALL) == rows and len(made) == 7
    assert path.read_text() == whole
    stability.sweep(path, ["flat", "fast"], ["noise"], 2)
    assert len(made) == 7 + 12  # only the second seed


def test_processes_measure_the_same(tmp_path):
    alone, shared = (stability.sweep(tmp_path / f"{workers}.jsonl", **SMALL, workers=workers) for workers in (0, 2))
    assert [row.method for row in alone] == [row.method for row in shared]
    for one, other in zip(alone, shared):
        assert (one.dial, one.severity, one.seed) == (other.dial, other.severity, other.seed)
        assert other.normal_deg == pytest.approx(one.normal_deg, rel=1e-4) and other.rms_um == pytest.approx(one.rms_um, rel=1e-3)


def test_rows_of_another_state_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "rows.jsonl"
    stability.sweep(path, ["flat"], ["noise"], 1)
    monkeypatch.setattr(stability, "fingerprint", lambda: "another")
    with pytest.raises(ValueError, match=r"rows.jsonl: of another state of this package: give another file"):
        stability.sweep(path, ["flat"], ["noise"], 1)
    path.write_text("dial,severity\n")
    with pytest.raises(ValueError, match="not a file of rows"):
        stability.sweep(path, ["flat"], ["noise"], 1)
    for names, message in (
        ({"methods": ["best"]}, "methods: expected some of flat, fast"),
        ({"dials": ["fire"]}, "dials: expected"),
    ):
        with pytest.raises(ValueError, match=message):
            stability.sweep(tmp_path / "new.jsonl", **names)


def test_errors_grow_along_a_dial_of_noise():
    cases = [DIALS["noise"].make(severity, 0) for severity in (0.002, 0.01, 0.05)]
    errors = [stability.measure("fast", "noise", 0.0, 0, case).limits for case in cases]
    assert errors[0] < errors[1] < errors[2]


def test_the_script_writes_table_rows_and_pictures(tmp_path):
    command = [sys.executable, "scripts/stability.py", "--out", tmp_path, "--seeds", "1", "--workers", "0", "--only", "vignetting"]
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True, cwd=ROOT, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "| vignetting, 0 to 0.9 share | always | never |" in done.stdout and stability.LIMITS in done.stdout
    assert {path.name for path in tmp_path.iterdir()} == {
        "breaking_points.json", "breaking_points.md", "overview.png", "rows.jsonl", "rows.md", "vignetting.png"
    }  # fmt: skip
    points, seeds = stability.from_json((tmp_path / "breaking_points.json").read_text())
    assert seeds == 1 and len(points) == len(METHODS) + 1
    refused = subprocess.run([*map(str, command), "--keep"], capture_output=True, text=True, cwd=ROOT, timeout=300)
    assert refused.returncode == 2 and "--keep: expected all dials, got --only" in refused.stderr
