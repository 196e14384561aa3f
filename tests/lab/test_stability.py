"""The sweep over hard scenes: what it measures, that it goes on where it stopped, and that no breaking point has moved."""

import itertools

import pytest
from conftest import ROOT

from lab import stability
from lab.gallery import CORRUPTIONS, undisturbed
from lab.rows import Row
from lab.stability import MASK, SWEPT

POINTS, SEEDS = stability.points_from_json((ROOT / "tests" / "breaking_points.json").read_text())


def test_every_method_and_corruption_has_a_kept_breaking_point():
    assert {(p.method, p.corruption) for p in POINTS} == {(m, c) for m in (*SWEPT, MASK) for c in CORRUPTIONS}


ROBUST = "precise, discontinuities"
KINDS = ("noise", "attached shadows")
"""Of camera and light, one corruption each; the others are measured again by make test-long."""
QUICK = [
    pytest.param(name, ("fast", "precise"), id=f"{name}, fast and precise", marks=[] if name in KINDS else [pytest.mark.long])
    for name in CORRUPTIONS
]
ROBUSTLY = [
    pytest.param(name, (ROBUST,), id=f"{name}, {ROBUST}", marks=[] if name == "cut ends" else [pytest.mark.long])
    for name in CORRUPTIONS
]


@pytest.mark.parametrize("name, methods", [*QUICK, *ROBUSTLY])
def test_no_breaking_point_has_moved(name, methods):
    """Measured again with the same seeds at the two severities around it; the rows of fast give the mask's too."""
    corruption, cases = CORRUPTIONS[name], {}
    for method in methods:
        kept = [p for p in POINTS if p.corruption == name and p.method in (method, MASK if method == "fast" else method)]
        rows = []
        for severity, seed in itertools.product(corruption.severities, range(SEEDS)):
            if any(severity in point.between for point in kept):
                if (severity, seed) not in cases:
                    cases[severity, seed] = corruption.make(severity, seed)
                rows.append(stability.measure(method, name, severity, seed, cases[severity, seed]))
        for point in kept:
            error = stability.mask_limits if point.method == MASK else stability.limits
            around = [row for row in rows if row.severity in point.between]
            found = stability.breaking_point(point.method, corruption, around, error)
            text = f"{name}, {point.method}: broke at {point.at}, now {found.at}; run scripts/stability.py --keep if that is meant"
            if isinstance(point.at, str):
                assert found.at == point.at, text
            else:
                assert not isinstance(found.at, str) and abs(found.at - point.at) <= point.tolerance, text


def test_the_page_says_what_the_json_says():
    page = (ROOT / "docs" / "where_methods_fail.md").read_text(encoding="utf-8")
    assert stability.updated_page(page, POINTS) == page
    assert stability.LIMITS in page.replace("\n", " ")


def test_a_row_is_the_metrics_of_the_method():
    case = undisturbed(3)
    row = stability.measure("precise", "noise", 0.002, 3, case)
    error, share, limits = row.errors, stability.depth_share(row), stability.limits(row)
    assert error["press_um"] == pytest.approx(1000 * float(case.truth.depth_mm.max())) and error["iou"] > 0.98
    assert share == pytest.approx(error["rms_um"] / error["press_um"])
    assert limits == pytest.approx(max(error["normal_deg"] / 3.0, share / 0.05)) and limits < 0.5
    assert row.parameters == 12
    flat = stability.measure("flat", "noise", 0.002, 3, case).errors
    z = case.truth.depth_mm[case.truth.contact]
    assert flat["rms_um"] == pytest.approx(1000 * float(z.square().mean().sqrt()), rel=1e-4) and flat["iou"] == 0.0
    assert flat["largest_px"] == pytest.approx(float(z.max()) / 0.125, rel=1e-4)


def _rows(errors, name="noise", seeds=2):
    """Rows under a corruption whose error is so many limits."""
    return [
        Row("corruption", "fast", name, {"normal_deg": 3.0 * e, "rms_um": 0.0, "press_um": 1000.0}, severity=s, seed=seed)
        for s, e in zip(CORRUPTIONS[name].severities, errors)
        for seed in range(seeds)
    ]


def test_breaking_points_are_interpolated():
    noise = CORRUPTIONS["noise"]  # 0.002, 0.005, 0.01, 0.02, 0.05, 0.1

    def at(errors):
        return stability.breaking_point("fast", noise, _rows(errors), stability.limits)

    point = at([0.1, 0.2, 0.5, 1.5, 3.0, 9.0])
    assert point.at == pytest.approx(0.015) and point.between == (0.01, 0.02) and point.held == pytest.approx(2.5 / 5)
    assert point.tolerance == pytest.approx(stability.TOLERANCE * 0.01)
    assert (at([0.1] * 6).at, at([0.1] * 6).held, at([0.1] * 6).between) == ("never", 1.0, (0.1,))
    assert (at([1.1] + [0.1] * 5).at, at([1.1] * 6).held) == ("always", 0.0)
    assert at([0.1, 0.1, 2.0, 0.1, 0.1, 0.1]).between == (0.005, 0.01)  # the first break counts
    two = [row for row in _rows([0.1, 0.2, 0.5, 1.5, 3.0, 9.0]) if row.severity in (0.01, 0.02)]
    assert stability.breaking_point("fast", noise, two, stability.limits) == point


def test_the_script_writes_table_rows_and_pictures(run_script, monkeypatch, tmp_path):
    monkeypatch.setattr(stability, "SWEPT", ("flat", "fast"))
    arguments = ["--out", tmp_path, "--seeds", 1, "--workers", 0, "--only", "vignetting"]
    done = run_script("stability", *arguments)
    assert done.returncode == 0, done.stderr
    assert "| vignetting, 0 to 0.9 share | always | never | never |" in done.stdout and stability.LIMITS in done.stdout
    assert {path.name for path in tmp_path.iterdir()} == {
        "breaking_points.json", "breaking_points.md", "overview.png", "vignetting.png"
    }  # fmt: skip
    points, seeds = stability.points_from_json((tmp_path / "breaking_points.json").read_text())
    assert seeds == 1 and [point.method for point in points] == ["flat", "fast", MASK]
    refused = run_script("stability", *arguments, "--keep")
    assert refused.returncode == 2 and "--keep: expected all corruptions, got --only" in refused.stderr
