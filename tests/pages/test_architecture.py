"""docs/architecture.md: the files that it names are there, and its model of normals works as it says."""

import re
from pathlib import Path

import pytest
import torch

import torchvts as vts

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", sorted(set(re.findall(r"`(?:torchvts/)?((?:\w+/)+(?:\w+\.\w+)?|viz\.py)`", PAGE))))
def test_a_file_or_folder_that_is_named_is_there(name):
    assert any((ROOT / folder / name).exists() for folder in ("", "torchvts", "torchvts/compiled"))


def test_the_subpackages_are_those_of_the_package():
    found = {path.parent.name for path in (ROOT / "torchvts").glob("*/__init__.py")}
    table = PAGE[PAGE.index("| from top to bottom") :].split("\n\n")[0]
    assert found == set(re.findall(r"`(\w+)/`", table)) - {"csrc"}


def test_the_example_is_a_model_of_normals():
    code = re.search(r"```python\n(.*?)```", PAGE, re.DOTALL).group(1)
    names = {"__package__": "torchvts.normals", "__name__": "torchvts.normals.change"}
    exec(code, names)
    scene = vts.scenes.sphere_press(10.0, 1.0, (0.0, 0.0), 48, 64, 0.6)
    lights = vts.PointLights([[20.0, 9.0, 30.0], [-18.0, 13.0, 30.0], [-2.0, -22.0, 30.0]], [900.0, 900.0, 900.0])
    background = vts.scenes.render(vts.scenes.undeformed(scene), lights).detach()
    calibration = vts.Calibration.from_lights(lights, vts.Sensor("rig", 48, 64, 0.6), background[0])
    model = names["NormalFromChange"](calibration.flat, torch.tensor([[-2.0, 2.0, 0.0], [0.0, -1.0, 1.0]]))
    pipe = vts.DepthPipeline.from_calibration(calibration, normals=model)
    assert pipe(vts.scenes.render(scene, lights).detach()).depth_mm.isfinite().all()
    assert torch.equal(model(calibration.flat[None])[0, 2], torch.ones(48, 64))
