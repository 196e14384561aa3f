"""The tutorials run as they stand, and come to what they promise."""

import shutil

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


def test_coming_from_gs_sdk(data, empty_folder):
    shutil.copy(data / "gelsight_mini_a" / "background.png", "background.png")
    shutil.copy(data / "gelsight_mini_a" / "6.310mm" / "10" / "gelsight.png", "press.png")
    shutil.copy(data / "gelsight_mini_a" / "model" / "nnmodel.pth", "nnmodel.pth")
    keys = {"device_name": "GelSight Mini", "ppmm": 0.0634, "imgh": 240, "imgw": 320, "raw_imgh": 2464, "raw_imgw": 3280}
    (empty_folder / "gsmini.yaml").write_text("".join(f"{key}: {value}\n" for key, value in keys.items()))
    names = run(ROOT / "docs" / "from_gs_sdk.md")
    assert names["height_map"].min() == pytest.approx(-float(names["out"].depth_mm.max()) / 0.0634)
    assert 0.5 < float(names["out"].depth_mm.max()) < 1.2


def test_own_sensor(empty_folder):
    names = run(ROOT / "docs" / "own_sensor.md")
    assert float(names["out"].depth_mm.max()) == pytest.approx(0.4, abs=0.02)
    assert names["sensor"].field_mm == pytest.approx((12.0, 16.0))


def test_the_page_on_motion_runs_and_finds_the_drag():
    names = run(ROOT / "docs" / "motion.md")
    assert names["field"].shape == (1, 3, 120, 160) and int(names["moved"].seen.sum()) > 50
    assert abs(float(names["slip"].turn_deg) - 4.0) < 0.5
    assert abs(float(names["slip"].shift_mm[0, 0]) - 0.3) < 0.03
