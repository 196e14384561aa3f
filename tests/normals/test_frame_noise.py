"""Shadows by the noise of the frame: lights that are known without an image of the unit, which says nothing of the camera."""

import dataclasses

import pytest
import torch

import torchvts as vts
from lab import metrics

scenes = vts.scenes
SIZE = (120, 160, 0.125)


@pytest.fixture(scope="module")
def low(ring):
    """Lights 15 mm high, their calibration without a background, and a ball whose far sides lie in shadow."""
    lights = ring(22.0, 15.0, level=0.3)
    return lights, vts.Calibration.from_lights(lights, vts.Sensor("rig", *SIZE)), scenes.sphere_press(6.0, 1.8, (0.4, -0.3), *SIZE)


def told(calibration, noise_std):
    return dataclasses.replace(calibration, noise_std=torch.full((3,), noise_std))


def seen(low, noise_std, seed=1, bits=8):
    lights, _, scene = low
    return scenes.render(scene, lights, noise_std=noise_std, bits=bits, seed=seed).detach()


@pytest.mark.parametrize("noise_std", [0.005, 0.01])
def test_a_unit_that_was_not_told_its_noise_is_as_exact_as_one_that_was(low, noise_std):
    """Before, noise in a shadow passed for light: three to eight times the error."""
    _, calibration, scene = low
    image = seen(low, noise_std)

    def error(unit):
        out = vts.DepthPipeline.from_calibration(unit, "precise")(image)
        return metrics.depth_error(out.depth_mm, scene.depth_mm, SIZE[2]).rms_px

    ours, theirs = error(calibration), error(told(calibration, noise_std))
    assert ours < 1.1 * theirs and ours < 0.09


def test_the_noise_of_a_frame_is_its_own_but_never_less_than_that_of_the_calibration(low):
    normals = vts.NormalFromIntensity.from_calibration(told(low[1], 0.004))
    frames = torch.cat([seen(low, noise, bits=None) for noise in (0.0, 0.002, 0.008, 0.02)])
    found = normals.noise_of(frames)
    expected = torch.tensor([0.004, 0.004, 0.008, 0.02])[:, None].expand(4, 3)
    assert float((found / expected - 1.0).abs().max()) < 0.1 and bool((found[:2] == normals.shadowed.noise_std).all())
    assert torch.equal(found[1:2], normals.noise_of(frames[1:2]))
    assert torch.equal(normals.noise_of(frames[..., :2]), normals.shadowed.noise_std.expand(4, 3))  # no second differences


@pytest.mark.parametrize("mode", ["fast", "precise", "auto"])
def test_frozen_and_plain_agree_and_frames_of_a_batch_are_independent(low, mode):
    pipe = vts.DepthPipeline.from_calibration(low[1], mode)
    frames = torch.cat([seen(low, noise) for noise in (0.0, 0.005, 0.01)])
    out, frozen = pipe(frames), pipe.freeze()
    # where both slopes of a shadowed pixel fit alike, rounding decides
    for k in range(3):
        assert float((pipe(frames[k : k + 1]).depth_mm[0] - out.depth_mm[k]).abs().max()) < 1e-3
    assert float((frozen(frames).depth_mm - out.depth_mm).abs().max()) < 1e-3


@pytest.mark.long
def test_a_script_goes_by_the_noise_of_each_frame_too(low):
    pipe = vts.DepthPipeline.from_calibration(low[1], "precise")
    frames = torch.cat([seen(low, noise) for noise in (0.0, 0.005, 0.01)])
    # rounding decides as above
    assert float((torch.jit.script(pipe)(frames).depth_mm - pipe(frames).depth_mm).abs().max()) < 1e-3


def test_mode_fast_goes_by_the_noise_of_the_calibration(low):
    """A frame with noise in its shadows stays one call."""
    _, calibration, _ = low
    pipe, frame = vts.DepthPipeline.from_calibration(calibration, "fast"), seen(low, 0.005)
    assert pipe.noise_of(frame) is None and pipe.solve.takes_noise
    expected = pipe.solve.normals(frame, None, torch.full((1, 3), 0.005))
    found = vts.DepthPipeline.from_calibration(told(calibration, 0.005), "fast").solve.normals(frame)
    assert float((found - expected).abs().max()) < 1e-5 and float((pipe.solve.normals(frame) - expected).abs().max()) > 0.1
