"""A smooth change of the light is divided out of a frame, and contact is not."""

import pytest
import torch

import torchvts as vts
from torchvts.compensate import SmoothDrift
from torchvts.core.smooth import MOST, over_smooth, smooth_basis, smooth_change
from torchvts.model import DepthBrightness, ResponseField
from torchvts.model.response_field import ResponseModel

SIZES = ((240, 320), (45, 63), (24, 30), (71, 99), (23, 40))


def light(height, width, size, seed=0):
    """A change of the light, (1, 3, H, W), of degree 2, a different one of each channel, whose largest value is ``size``."""
    some = torch.randn(3, 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    surface = (some @ smooth_basis(height, width, 1).flatten(1)).reshape(1, 3, height, width)
    return (1.0 + size * surface / surface.abs().amax(dim=(2, 3), keepdim=True)).float()


def pressed(height, width):
    """Image / background, (1, 3, H, W), of a ball in one corner: brighter on one side, darker on the other."""
    y, x = torch.meshgrid(torch.arange(height) - 0.3 * height, torch.arange(width) - 0.35 * width, indexing="ij")
    radius = 0.2 * height
    inside = (x * x + y * y < radius * radius).float()
    return 1.0 + 0.4 * torch.stack((x, y, -x))[None] / radius * inside


@pytest.mark.parametrize("size", [0.02, 0.05])
def test_smooth_light_is_divided_out_of_undeformed_and_of_pressed_skin(size):
    changed = light(240, 320, size)
    assert float((SmoothDrift()(changed) - 1.0).abs().max()) < 0.01 * size
    image = pressed(240, 320)
    assert float((SmoothDrift()(image * changed) - image).abs().max()) < 0.1 * size


def test_a_contact_that_fills_the_image_is_not_explained_away():
    image = 1.0 + 0.6 * (torch.arange(320) / 319.0 - 0.5).expand(1, 3, 240, 320)
    assert float((SmoothDrift()(image) - image).abs().max()) < MOST * float(image.max())
    far = light(240, 320, 0.9)
    assert float((far / over_smooth(far, smooth_change(far)) - 1.0).abs().max()) < MOST + 1e-5


def test_smooth_light_moves_no_skin():
    flat, smooth = torch.ones(3, 240, 320), SmoothDrift()
    changed = light(240, 320, 0.04, 2) + 0.004 * torch.randn(1, 3, 240, 320, generator=torch.Generator().manual_seed(2))
    mask, image = vts.ContactMask(flat), pressed(240, 320)
    assert bool((mask(changed) > 0.5).any()) and not bool((mask(smooth(changed)) > 0.0).any())
    moved = mask(smooth(image * changed)) > 0.5
    assert float((moved ^ (mask(image) > 0.5)).double().mean()) < 0.01 < float(moved.double().mean())


@pytest.mark.parametrize("size", SIZES)
def test_a_scripted_fit_is_the_same_and_frames_are_independent(size):
    noise = 0.01 * torch.randn(2, 3, *size, generator=torch.Generator().manual_seed(1))
    image = torch.cat((light(*size, 0.06), pressed(*size) * light(*size, 0.05, 1))) + noise
    plain = SmoothDrift()
    assert torch.allclose(torch.jit.script(plain)(image), plain(image), atol=1e-6)
    assert torch.allclose(plain(image)[1:], plain(image[1:]), atol=1e-6)
    assert (min(size) < 24) == torch.equal(plain(image), image)


def test_depth_of_a_response_unit_hardly_follows_the_light():
    """Frozen and plain the same; units that lights explain have no such block."""
    field = ResponseField(0, -1, 10.0, ((-0.1, 0.0, 0.1), (0.0, -0.2, 0.0)))
    model = ResponseModel(field, DepthBrightness(0, 10.0, ((0.0,), (0.0,), (0.0,))))
    unit = vts.Calibration.from_response(model, vts.Sensor("rig", 120, 160, 0.1), torch.full((3, 120, 160), 0.5))
    pipe, image = vts.DepthPipeline.from_calibration(unit, "precise"), 0.5 * pressed(120, 160)
    changed = image * light(120, 160, 0.05)
    after, moved_by = pipe(changed), largest(pipe(changed).depth_mm - pipe(image).depth_mm)
    assert float(after.depth_mm.max()) > 0.2
    other = pipe.freeze()(changed)
    assert torch.allclose(other.depth_mm, after.depth_mm, atol=1e-6) and torch.equal(other.contact, after.contact)
    pipe.smooth = torch.nn.Identity()
    assert moved_by < 0.004 < 0.01 < largest(pipe(changed).depth_mm - pipe(image).depth_mm)


def largest(difference):
    return float(difference.abs().max())


def test_a_shadow_is_no_contact_and_a_slope_is():
    """A soft shadow darkens all channels alike; slopes change the colour, also where such a shadow lies in the frame."""
    y, x = torch.linspace(-1.0, 1.0, 120)[:, None], torch.linspace(-1.0, 1.0, 160)[None]
    spot = torch.exp(-((x - 0.3) ** 2 + (y + 0.2) ** 2) / 0.1)
    shadow = (1.0 - 0.06 * spot).expand(1, 3, 120, 160)
    ball = torch.exp(-((x + 0.5) ** 2 + (y - 0.4) ** 2) / 0.02)
    slopes = torch.stack([20.0 * x + 10.0 + 0.0 * y, 20.0 * y - 8.0 + 0.0 * x, -20.0 * (x + y) - 2.0]).clamp(-1.0, 1.0)
    slope = 1.0 + 0.3 * ball * slopes[None]
    noise = 0.004 * torch.randn(1, 3, 120, 160, generator=torch.Generator().manual_seed(0))
    mask = vts.ContactMask()
    for image, moved in ((shadow, False), (shadow * slope, True), (slope, True)):
        assert bool((mask(image + noise) > 0.0).any()) is moved
