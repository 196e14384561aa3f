"""Defects found by an attack on the library: wrong answers without a word, and what PyTorch's own tools could not do."""

import pytest
import torch
from torch import Tensor

import torchvts as vts

HEIGHT, WIDTH, PITCH = 96, 128, 0.25


def rig(**kinds: object) -> vts.Calibration:
    """A unit by lights."""
    lights = vts.PointLights([[20, 9, 30], [-18, 13, 30], [-2, -22, 30]], [900, 900, 900])
    return vts.Calibration.from_lights(lights, vts.Sensor("rig", HEIGHT, WIDTH, PITCH, **kinds))


def press(center_mm: tuple[float, float] = (0.0, 0.0), press_mm: float = 1.0) -> Tensor:
    """An image of a ball on that unit."""
    scene = vts.scenes.sphere_press(8.0, press_mm, center_mm, HEIGHT, WIDTH, PITCH)
    lights = rig().lights
    assert lights is not None
    return vts.scenes.render(scene, lights).detach()


@pytest.mark.parametrize("mode", ["fast", "precise", "auto"])
@pytest.mark.parametrize("without_gradients", [torch.no_grad, torch.inference_mode])
def test_trained_lights_count_without_gradients(mode: str, without_gradients: type) -> None:
    pipe, image = vts.DepthPipeline.from_calibration(rig(), mode), press()
    before = pipe(image).depth_mm
    pipe.requires_grad_(True)
    optimiser = torch.optim.SGD(pipe.parameters(), lr=50.0)
    pipe(image).depth_mm.square().mean().backward()
    optimiser.step()
    with without_gradients():
        found = pipe(image).depth_mm.clone()
    recorded = pipe(image).depth_mm.detach()
    assert float((recorded - before).abs().max()) > 1e-3  # the step moved the lights
    assert float((found - recorded).abs().max()) < 1e-5
    assert float((pipe.requires_grad_(False)(image).depth_mm - recorded).abs().max()) < 1e-5
    assert float((torch.jit.script(pipe)(image).depth_mm - recorded).abs().max()) < 1e-5


@pytest.mark.long
@pytest.mark.parametrize("mode", ["fast", "precise", "auto"])
def test_compiles_with_inductor(mode: str) -> None:
    pipe, image = vts.DepthPipeline.from_calibration(rig(), mode), press()
    with torch.no_grad():
        compiled = torch.compile(pipe, fullgraph=mode == "fast")(image)
        for found, expected in zip(compiled, pipe(image), strict=True):
            assert float((found.double() - expected.double()).abs().max()) < 1e-5
