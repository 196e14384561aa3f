"""The tutorials run as they stand, and come to what they promise."""

import shutil

import numpy as np
import pytest
import torch
from conftest import ROOT
from documents import run

import torchvts as vts
from torchvts import scenes
from torchvts.dataset import reconstruct_dataset
from torchvts.samples import fetch_sample
from torchvts.stream import VideoFile


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
    assert (empty_folder / "out" / "press" / "gelsight_picture.png").stat().st_size > 10_000


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


def test_the_page_on_data_sets(empty_folder, ring):
    scene = scenes.sphere_press(3.0, 0.5, (0.0, 0.0), 60, 80, 0.2)
    lights = ring(radius_mm=16.0, height_mm=20.0)
    press, rest = (scenes.render(one, lights, noise_std=0.003, bits=8)[0] for one in (scene, scenes.undeformed(scene)))
    vts.Calibration.from_lights(lights, vts.Sensor("rig", 60, 80, 0.2), rest).save("unit.safetensors")
    (empty_folder / "out" / "frames").mkdir(parents=True)
    vts.write_image("out/frames/0.png", press)
    pixels = (255.0 * rest).round().byte().permute(1, 2, 0).numpy()[..., ::-1]
    with VideoFile("film.avi", 30.0) as film:
        for _ in range(15):
            film.write(np.ascontiguousarray(pixels))
    reconstruct_dataset("unit.safetensors", "out/frames/0.png", "out/press", pictures=False)
    (empty_folder / "out" / "press" / "0.npz").rename("out/press/press.npz")
    reconstruct_dataset("unit.safetensors", "film.avi", "out/film", format="video-npz", pictures=False)
    names = run(ROOT / "docs" / "datasets.md")
    assert len(names["deepest_mm"]) == 15 and float(names["result"].depth_mm.max()) == pytest.approx(0.5, rel=0.1)
    assert torch.allclose(next(iter(names["pairs"]))[1], names["result"].depth_mm[0], atol=1e-6)
    assert sum(len(image) for image, _ in names["loader"]) == 16


def test_the_page_on_motion_runs_and_finds_the_drag():
    names = run(ROOT / "docs" / "motion.md")
    assert names["field"].shape == (1, 3, 120, 160) and int(names["moved"].seen.sum()) > 50
    assert abs(float(names["slip"].turn_deg) - 4.0) < 0.5
    assert abs(float(names["slip"].shift_mm[0, 0]) - 0.3) < 0.03
