"""Every example runs as it stands, in an empty folder, and comes to what it promises."""

import runpy

import pytest
from conftest import ROOT
from documents import run as run_document

import torchvts as vts

EXAMPLES = sorted(path.stem for path in (ROOT / "examples").glob("*.py"))


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Runs an example in an empty folder; returns its names."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["example"])
    return lambda name: runpy.run_path(str(ROOT / "examples" / f"{name}.py"), run_name="__main__")


def test_every_example_has_a_test_and_a_row_in_the_readme():
    assert set(EXAMPLES) == {name.removeprefix("test_example_") for name in globals() if name.startswith("test_example_")}
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert [name for name in EXAMPLES if f"(examples/{name}.py)" not in readme] == []


def test_example_first_depth(run, tmp_path):
    names = run("first_depth")
    assert float(names["out"].depth_mm.max()) == pytest.approx(0.4, rel=0.1)
    assert len(names["points"]) > 1000 and (tmp_path / "out" / "first_depth.png").is_file()


def test_example_own_sensor(run, tmp_path):
    names = run("own_sensor")
    assert float(names["out"].depth_mm.max()) == pytest.approx(0.4, rel=0.1)
    assert vts.Calibration.load(tmp_path / "out" / "own_sensor" / "my_unit.safetensors").sensor.roi_px == (20, 20, 160, 120)


def test_example_own_network(run):
    """And the page that goes on from it."""
    names = run("own_network")
    assert names["losses"][-1] < 0.1 * names["losses"][0]
    assert run_document(ROOT / "docs" / "training.md", names)["lights"].albedo.grad is not None


def test_example_pose(run, tmp_path):
    names = run("pose")
    assert names["reg"].converged and names["angle_deg"] < 0.1 and names["shift_mm"] < 0.05
    assert (tmp_path / "out" / "pose.png").is_file()


def test_example_camera(run):
    deepest_mm = run("camera")["deepest_mm"]
    assert len(deepest_mm) == 40 and max(deepest_mm) == pytest.approx(0.5, rel=0.05)
    assert max(deepest_mm[:12] + deepest_mm[-4:]) < 0.01


def test_example_dataset(run, tmp_path):
    run("dataset")
    assert float(vts.read_result(tmp_path / "out" / "dataset" / "depth" / "005.npz").depth_mm.max()) == pytest.approx(
        0.45, rel=0.05
    )
    assert (tmp_path / "out" / "dataset" / "depth" / "frames.csv").is_file()


def test_example_export_cpp(run, tmp_path):
    names = run("export_cpp")
    assert float(names["found"].max()) == pytest.approx(1.0, rel=0.2)
    assert (names["found"] - names["expected"]).abs().max() < 1e-5 and (tmp_path / "out" / "camera.pt").is_file()


def test_example_confidence(run, tmp_path):
    assert run("confidence")["share"] > 0.9
    assert (tmp_path / "out" / "confidence.png").is_file()


@pytest.mark.long
def test_example_paper(run, tmp_path):
    """Figure 3 of the paper, which test_pipeline has too: 0.31 and 1.21 px by eq. 9, 0.09 and 0.16 px by eq. 10."""
    errors = run("paper")["found_px"]
    assert errors[16][:2] == pytest.approx((0.33, 0.12), abs=0.02) and errors[32][:2] == pytest.approx((1.24, 0.19), abs=0.02)
    assert all(filled < 0.4 * unfilled for *_, filled, unfilled in errors.values())  # eq. 8
    assert (tmp_path / "out" / "figure_3.png").is_file()
