"""What the skin does: the weight of moved skin, the zero of depth, contact by pressure."""

import math

import pytest
import torch
from conftest import LONG
from torch import Tensor

from torchvts import Calibration, ContactFromDepth, ContactMask, DepthPipeline, PointLights, Sensor, near_field_shading
from torchvts.scenes import hanging_skin, letters_depth, render, sphere_press, surface
from torchvts.skin import ZeroBackground, moved
from torchvts.skin.weight import spread_of

FLAT = torch.full((3, 96, 128), 0.5)
GREEN, RED = torch.tensor([0.0, 1.0, 0.0])[:, None, None], torch.tensor([1.0, 0.0, 0.0])[:, None, None]


def noisy(image: Tensor, std: float = 0.004, seed: int = 0) -> Tensor:
    return image + std * torch.randn(image.shape, generator=torch.Generator().manual_seed(seed))


def square(change: float, colour: Tensor) -> Tensor:
    image = FLAT.clone()
    image[:, 30:60, 40:90] += change * colour
    return image


def test_a_coloured_change_has_moved_and_a_grey_one_has_not():
    mask = ContactMask(FLAT)
    weight = mask(noisy(square(0.1, RED))[None])
    assert weight[0, 0, 33:57, 43:87].min() == 1.0
    assert weight[0, 0, :20].mean() < 0.01
    assert mask(noisy(square(-0.1, torch.ones(3, 1, 1)))[None]).max() == 0.0


def test_a_coloured_change_without_slopes_has_not_moved():
    image, slopes = noisy(square(0.1, GREEN))[None], 0.01 * torch.randn(1, 2, 96, 128)
    assert ContactMask(FLAT)(image, slopes).max() == 0.0
    slopes[:, :, 30:60, 40:90] += 0.3
    assert ContactMask(FLAT)(image, slopes)[0, 0, 33:57, 43:87].min() == 1.0


@pytest.mark.parametrize("std", [0.0, 0.002, 0.02])
def test_noise_has_no_weight(std):
    assert ContactMask(FLAT)(noisy(FLAT, std)[None]).max() == 0.0


@pytest.mark.parametrize("share", [0.1, 0.2, 0.5, 1.0])
def test_the_spread_is_that_of_undeformed_skin_whatever_its_share(share):
    generator = torch.Generator().manual_seed(0)
    values = torch.rand(1, 1, 4000, generator=generator, dtype=torch.float64)  # slopes of an object
    free = int(share * 4000)
    values[..., :free] = 0.01 * torch.randn(free, generator=generator, dtype=torch.float64).abs()
    assert float(spread_of(values, 0.002)) == pytest.approx(0.01, rel=0.5)  # a few of the object lie near zero


@pytest.mark.parametrize("press_mm", [1.6, 2.0, 2.5])
def test_a_contact_on_nine_tenths_of_the_skin_has_its_depth(press_mm):
    lights = PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900, 900, 900])
    scene = sphere_press(20.0, press_mm, height=240, width=320, mm_per_pixel=0.06)
    image = render(scene, lights, noise_std=0.003, bits=8)
    calibration = Calibration.from_lights(lights, Sensor("rig", 240, 320, 0.06))
    out = DepthPipeline.from_calibration(calibration, "precise")(image)
    assert float(out.depth_mm.detach().max()) == pytest.approx(press_mm, rel=0.02)


def test_noise_of_a_dark_corner_has_no_weight():
    light = FLAT.clone()
    light[:, :, 100:] = 0.02
    noise = torch.full_like(light, 0.004)
    assert ContactMask(light, noise_std=noise)(noisy(light)[None]).max() == 0.0


def test_a_press_in_a_pedestal_of_light_is_relative_to_what_the_lights_give():
    light = torch.stack((torch.full((96, 128), 0.5), torch.full((96, 128), 0.1), torch.full((96, 128), 0.5)))
    flat = light + 0.1
    shade = flat - 0.12 * light  # grey, but for the pedestal
    shade[:, :, 64:] = flat[:, :, 64:]
    assert ContactMask(flat, light)(noisy(shade, 0.0005)[None]).max() == 0.0


def test_depth_counts_from_free_skin_whose_offset_is_smooth():
    y, x = torch.meshgrid(torch.linspace(-6, 6, 120), torch.linspace(-8, 8, 160), indexing="ij")
    r = torch.hypot(x, y)
    depth = torch.where(r < 2.0, 1.0 - 0.1 * r * r, 0.6 * torch.exp(-(r - 2.0) / 0.7))[None, None]
    weight = (r < 4.0).float()[None, None]
    drift = (0.05 + 0.01 * x - 0.02 * y)[None, None]
    found = ZeroBackground(0.1)(depth + drift, weight)
    assert (found - depth)[0, 0][r < 2.0].abs().max() < 0.08
    assert found[0, 0][r > 5.5].abs().max() < 0.06


def test_without_free_skin_the_lowest_depth_is_zero():
    depth = torch.rand(2, 1, 48, 64)
    depth = torch.nn.functional.avg_pool2d(depth, 9, 1, 4)
    found = ZeroBackground(0.1)(depth, torch.ones(2, 1, 48, 64))
    assert found.amin(dim=(1, 2, 3)).abs().max() < 0.1 * (depth.amax() - depth.amin())


def test_a_flat_face_without_change_is_deep_and_has_moved():
    depth, weight = torch.zeros(1, 1, 90, 120), torch.zeros(1, 1, 90, 120)
    depth[..., 30:60, 40:80] = 0.5
    weight[..., 27:63, 37:83] = 1.0
    weight[..., 35:55, 45:75] = 0.0
    found = ZeroBackground(0.1)(depth - 0.2, weight)
    assert found[0, 0, 45, 60] > 0.4
    assert bool(moved(weight, found)[0, 0, 45, 60])


@pytest.mark.parametrize("press_mm", [0.5, 1.0, 2.0])
def test_contact_of_a_ball_without_a_skirt_is_its_circle(press_mm):
    ball = sphere_press(10.0, press_mm, height=160, width=200, mm_per_pixel=0.1)
    found = ContactFromDepth(0.1, 0.1)(ball.depth_mm, ball.contact)
    assert int((found ^ ball.contact).sum()) < 0.16 * int(ball.contact.sum())


def test_contact_in_a_free_skirt_ends_at_the_rim():
    y, x = torch.meshgrid(torch.linspace(-6, 6, 240), torch.linspace(-6, 6, 240), indexing="ij")
    r = torch.hypot(x, y)
    ball = 0.8 - (4.0 - torch.sqrt((16.0 - r * r).clamp_min(0.0)))
    edge = 1.5
    rim = 0.8 - (4.0 - math.sqrt(16.0 - edge**2))
    depth = torch.where(r < edge, ball, rim * torch.exp(-(r - edge) / 0.4))[None, None]
    found = ContactFromDepth(12.0 / 239)(depth, depth > 0.001)
    radius = math.sqrt(float(found.sum()) * (12.0 / 239) ** 2 / math.pi)
    assert abs(radius - edge) < 0.15


@pytest.mark.parametrize("reach_mm", [0.2, 0.28, 0.45])
@pytest.mark.parametrize("press_mm", [0.1, 0.3, 0.8])
@pytest.mark.parametrize("known", [True, False])
def test_contact_of_a_ball_in_skin_of_a_short_decay_is_its_circle(press_mm, reach_mm, known):
    """A rule for objects without skin had taken such skin for contact: areas 1.3 to 5 times too large."""
    ball = sphere_press(3.0, press_mm, height=160, width=200, mm_per_pixel=0.0625)
    skin = hanging_skin(torch.where(ball.contact, ball.depth_mm, -1.0), reach_mm, 0.0625)
    block = ContactFromDepth(0.0625, 0.2, reach_mm) if known else ContactFromDepth(0.0625)
    ratio = float(block(skin.depth_mm, skin.depth_mm > 0.02 * press_mm).sum() / skin.contact.sum())
    guessed_worst = not known and (press_mm, reach_mm) == (0.1, 0.2)  # only presses show that so little skin is free
    assert (1.3 < ratio < 1.45) if guessed_worst else (0.8 < ratio < 1.3)


@pytest.mark.parametrize("reach_mm", [0.0, 0.2, 0.28, 0.4])
def test_frames_show_how_their_skin_decays(reach_mm):
    ball = sphere_press(3.0, 0.5, height=160, width=200, mm_per_pixel=0.0625)
    depth = hanging_skin(torch.where(ball.contact, ball.depth_mm, -1.0), reach_mm, 0.0625).depth_mm if reach_mm else ball.depth_mm
    assert float(ContactFromDepth(0.0625).decays_mm(depth)) == pytest.approx(reach_mm, abs=0.05)


def test_where_nothing_decays_all_depth_is_contact():
    """Any L takes the rims of letters off."""
    letters = surface(letters_depth("XO", 4.0, 0.3), height=120, width=160, mm_per_pixel=0.0625)
    assert torch.equal(ContactFromDepth(0.0625, 0.9, 0.0)(letters.depth_mm, letters.contact), letters.contact)


def test_flat_depth_has_no_contact():
    flat = torch.zeros(1, 1, 60, 80)
    assert not ContactFromDepth(0.1)(flat, flat == 0).any()


@pytest.mark.parametrize("block", ["mask", "zero"])
def test_gradients_are_exact(block):
    torch.manual_seed(0)
    if block == "mask":
        y, x = torch.meshgrid(torch.linspace(-1, 1, 16), torch.linspace(-1, 1, 20), indexing="ij")
        bump = 0.02 * torch.exp(-8 * (x * x + y * y)).double()
        image = (0.5 + torch.stack((bump, -bump, 0.3 * bump)) + 0.002 * torch.randn(3, 16, 20).double())[None].requires_grad_(True)
        assert torch.autograd.gradcheck(ContactMask(torch.full((3, 16, 20), 0.5).double()), (image,), atol=1e-4, fast_mode=not LONG)
    else:
        weight = torch.full((1, 1, 12, 16), 0.05).double()
        weight[..., 3:9, 4:12] = 0.9
        weight += 0.05 * torch.rand(weight.shape).double()
        depth = (weight + 0.1 * torch.rand(1, 1, 12, 16)).double().requires_grad_(True)
        assert torch.autograd.gradcheck(ZeroBackground(0.2), (depth, weight.requires_grad_(True)), atol=1e-4, fast_mode=not LONG)


def test_specks_beside_a_press_change_little(ring):
    """30 dark specks beside a press: area and depth stay."""
    scene = sphere_press(10.0, 1.0, height=120, width=160, mm_per_pixel=0.1)
    sensor = Sensor("rig", 120, 160, 0.1)
    lights = ring(50.0, 60.0)
    pipe = DepthPipeline.from_calibration(Calibration.from_lights(lights, sensor))
    image = near_field_shading(scene.depth_mm, scene.normal, lights, 0.1).clamp(0, 1)
    specked, generator = image.clone(), torch.Generator().manual_seed(1)
    for _ in range(30):
        top, left = int(torch.randint(2, 116, (1,), generator=generator)), int(torch.randint(2, 30, (1,), generator=generator))
        specked[..., top : top + 2, left : left + 2] *= 0.3
    clean, dirty = pipe(image), pipe(specked)
    assert abs(int(dirty.contact.sum()) / int(clean.contact.sum()) - 1.0) < 0.1
    assert abs(float(dirty.depth_mm.max() / clean.depth_mm.max()) - 1.0) < 0.1
