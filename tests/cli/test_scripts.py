"""The scripts do their job from the command line, and refuse bad input in a sentence."""

import re

import pytest
import torch

import torchvts as vts
from torchvts.core.files import make_folder, read_depth_png


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    folder = tmp_path_factory.mktemp("images")
    scene = vts.scenes.sphere_press(10.0, 1.0, height=120, width=160, mm_per_pixel=0.25)
    lights = vts.PointLights([[20.0, 9.0, 25.0], [-18.0, 13.0, 25.0], [-2.0, -22.0, 25.0]], [600.0, 600.0, 600.0])
    (folder / "presses").mkdir()
    vts.write_image(folder / "background.png", vts.scenes.render(vts.scenes.undeformed(scene), lights, noise_std=0.002)[0])
    for k in range(3):
        vts.write_image(folder / "presses" / f"{k}.png", vts.scenes.render(scene, lights, noise_std=0.002, seed=k)[0])
    return folder, scene


@pytest.fixture(scope="module")
def calibration(run_script, images):
    folder, _ = images
    out = folder / "unit.safetensors"
    done = run_script("calibrate", folder / "background.png", "--mm-per-pixel", "0.25", "--out", out)
    assert done.returncode == 0, done.stderr
    assert "wrote" in done.stdout and "chosen: point lights" in done.stdout
    return out


def test_reconstruct_writes_depth_pictures_and_table(run_script, images, calibration, tmp_path):
    folder, scene = images
    options = ("--out", tmp_path, "--mode", "precise", "--format", "png16")
    done = run_script("reconstruct", calibration, folder / "presses" / "1.png", *options)
    assert done.returncode == 0, done.stderr
    assert len((tmp_path / "frames.csv").read_text().splitlines()) == 2
    assert (tmp_path / "1_picture.png").stat().st_size > 10_000
    assert (read_depth_png(tmp_path / "1_depth.png") - scene.depth_mm).abs().max() < 0.25 * 0.25


def test_reconstruct_names_what_is_wrong_with_frames(run_script, images, calibration, tmp_path):
    folder, _ = images
    options = ("--no-pictures", "--format", "none")
    valid = run_script("reconstruct", calibration, folder / "presses", "--out", tmp_path / "valid", *options)
    image = vts.read_image(folder / "presses" / "0.png")
    vts.write_image(make_folder(tmp_path / "in" / "a") / "good.png", image)
    dark = image * torch.tensor([1.0, 0.0, 1.0])[:, None, None]
    for name in ("dark", "later"):
        vts.write_image(make_folder(tmp_path / "in" / "b") / f"{name}.png", dark)
    dark = run_script("reconstruct", calibration, tmp_path / "in", "--out", tmp_path / "out", *options)
    assert (valid.returncode, dark.returncode) == (0, 1), valid.stderr + dark.stderr
    assert ": fault: " not in valid.stdout and dark.stdout.count(": fault: ") == 1
    assert "b/dark.png and 1 more: fault: the green LED has failed" in dark.stdout


@pytest.mark.long
def test_reproduce_paper_prints_its_figures_beside_the_papers(run_script, tmp_path):
    done = run_script("reproduce_paper", "--out", tmp_path, "--data", tmp_path / "none")
    assert done.returncode == 0, done.stderr
    assert len(list(tmp_path.glob("table_3*.png"))) == 3
    assert "| paper, three targets | 0.64, 2.35, 2.59 | below 1 | 6 to 8 |" in done.stdout


def test_demo_draws_a_film_and_says_how_far_depth_is_off(run_script, tmp_path):
    done = run_script("demo", "--out", tmp_path, "--frames", 2)
    assert done.returncode == 0, done.stderr
    assert float(re.search(r"off by (\d+) um RMS", done.stdout).group(1)) < 40
    assert {"film.webp", "press.png"} <= {path.name for path in tmp_path.iterdir()} <= {"film.webp", "press.png", "real.png"}
