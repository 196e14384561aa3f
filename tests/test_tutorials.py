"""The tutorials run as they stand, and come to what they promise."""

import pytest
from documents import ROOT, run

from torchvts.samples import fetch_sample


@pytest.fixture
def empty_folder(tmp_path, monkeypatch):
    """A reader's working folder, and a cache of samples of its own."""
    monkeypatch.setenv("TORCHVTS_CACHE", str(tmp_path / "cache"))
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path / "work"


def test_first_depth(data, empty_folder):
    fetch_sample("gelsight_mini", data / "gelsight_mini_a")
    names = run(ROOT / "docs" / "quickstart.md")
    assert float(names["height"]) == pytest.approx(float(names["expected"]), rel=0.15)
    assert len(names["points"]) == int(names["out"].contact.sum())
    assert (empty_folder / "out" / "press" / "frames.csv").is_file()


def test_own_sensor(empty_folder):
    names = run(ROOT / "docs" / "own_sensor.md")
    assert float(names["out"].depth_mm.max()) == pytest.approx(0.4, abs=0.02)
    assert names["sensor"].field_mm == pytest.approx((12.0, 16.0))


def test_training_through_depth(empty_folder):
    names = run(ROOT / "docs" / "training.md")
    assert names["losses"][-1] < 0.4 * names["losses"][0]
    assert names["lights"].albedo.grad is not None
