"""The scripts do their job from the command line, and refuse bad input in a sentence."""

import re

import pytest
import torch
from conftest import half_drawn

import torchvts as vts
from torchvts.core.files import make_folder, read_depth_png


def test_calibrated_frames_become_depth_and_what_is_wrong_with_others_is_named(run_script, tmp_path):
    scene = vts.scenes.sphere_press(10.0, 1.0, height=120, width=160, mm_per_pixel=0.25)
    lights = vts.PointLights([[20.0, 9.0, 25.0], [-18.0, 13.0, 25.0], [-2.0, -22.0, 25.0]], [600.0, 600.0, 600.0])
    scenes = (vts.scenes.undeformed(scene), scene)
    rest, image = (vts.scenes.render(one, lights, noise_std=0.002, seed=k)[0] for k, one in enumerate(scenes))
    vts.write_image(tmp_path / "background.png", rest)
    unit, out = tmp_path / "unit.safetensors", tmp_path / "out"
    done = run_script("calibrate", tmp_path / "background.png", "--mm-per-pixel", "0.25", "--out", unit)
    assert done.returncode == 0, done.stderr
    assert "wrote" in done.stdout and "chosen: point lights" in done.stdout
    vts.write_image(make_folder(tmp_path / "in" / "a") / "good.png", image)
    dark = image * torch.tensor([1.0, 0.0, 1.0])[:, None, None]
    for name in ("dark", "later"):
        vts.write_image(make_folder(tmp_path / "in" / "b") / f"{name}.png", dark)
    options = ("--no-pictures", "--format", "png16", "--mode", "precise")
    done = run_script("reconstruct", unit, tmp_path / "in", "--out", out, *options)
    assert done.returncode == 1 and done.stdout.count(": fault: ") == 1, done.stderr
    assert "b/dark.png and 1 more: fault: the green LED has failed" in done.stdout
    assert len((out / "frames.csv").read_text().splitlines()) == 4
    assert (read_depth_png(out / "a" / "good_depth.png") - scene.depth_mm).abs().max() < 0.25 * 0.25


@pytest.mark.long
def test_reproduce_paper_prints_its_figures_beside_the_papers(run_script, tmp_path):
    done = run_script("reproduce_paper", "--out", tmp_path, "--data", tmp_path / "none")
    assert done.returncode == 0, done.stderr
    assert len(list(tmp_path.glob("table_3*.png"))) == 3
    assert "| paper, three targets | 0.64, 2.35, 2.59 | below 1 | 6 to 8 |" in done.stdout


def test_demo_draws_a_film_and_says_how_far_depth_is_off(run_script, tmp_path, monkeypatch):
    monkeypatch.setattr("lab.drawn_sensors.drawn_sensor", half_drawn)
    done = run_script("demo", "--out", tmp_path, "--frames", 2)
    assert done.returncode == 0, done.stderr
    assert float(re.search(r"off by (\d+) um RMS", done.stdout).group(1)) < 40
    assert {"film.webp", "press.png"} <= {path.name for path in tmp_path.iterdir()} <= {"film.webp", "press.png", "real.png"}
