"""The light of a frame is found on its undeformed skin and divided out; contact is not."""

import math

import pytest
import torch
from conftest import ring_lights

import torchvts as vts
from torchvts import scenes
from torchvts.compensate import Relight
from torchvts.compensate.light import surface_terms, unchanged_light
from torchvts.model import DepthBrightness, ResponseField
from torchvts.model.response_field import ResponseModel

SIZES = ((240, 320), (45, 63), (24, 30), (71, 99), (23, 40))
GAINS = [(g, g, g) for g in (0.5, 0.7, 0.85, 1.15, 1.3, 1.6)] + [
    tuple(g if k == c else 1.0 for k in range(3)) for c in range(3) for g in (0.6, 1.5)
]
FIELD = {"height": 120, "width": 160, "mm_per_pixel": 0.125}


def change_of_light(height, width, size, seed=0):
    """A change of the light, (1, 3, H, W), of degree 2, a different one of each channel, whose largest value is ``size``."""
    some = torch.randn(3, 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    surface = (some @ surface_terms(height, width, 1).flatten(1)).reshape(1, 3, height, width)
    return (1.0 + size * surface / surface.abs().amax(dim=(2, 3), keepdim=True)).float()


def skin(height, width, seed=0):
    """Light of an undeformed skin, (1, 3, H, W), bright on another side in each channel."""
    return 0.4 * change_of_light(height, width, 0.5, seed + 10)


def pressed(height, width):
    """Image / background, (1, 3, H, W), of a ball in one corner: brighter on one side, darker on the other."""
    y, x = torch.meshgrid(torch.arange(height) - 0.3 * height, torch.arange(width) - 0.35 * width, indexing="ij")
    radius = 0.2 * height
    inside = (x * x + y * y < radius * radius).float()
    return 1.0 + 0.4 * torch.stack((x, y, -x))[None] / radius * inside


def as_seen(light, noise_std=0.004, seed=3):
    """Light as a camera of 8 bits gives it."""
    noise = noise_std * torch.randn(light.shape, generator=torch.Generator().manual_seed(seed))
    return torch.round((light + noise).clamp(0, 1) * 255.0) / 255.0


def largest(difference):
    return float(difference.abs().max())


@pytest.mark.parametrize("level", [0.3, 0.7, 1.0, 1.5])
@pytest.mark.parametrize("size", [0.0, 0.05, 0.25])
def test_level_and_smooth_change_are_divided_out_of_free_and_of_pressed_skin(level, size):
    background, change = skin(240, 320), level * change_of_light(240, 320, size)
    relight = Relight(background[0])
    assert largest(relight(background * change) / background - 1.0) < 2e-3
    image = background * pressed(240, 320)
    assert largest(relight(image * change) - image) < 3e-3
    terms = relight.terms(background * change)[0]
    assert torch.allclose(relight.surface(terms[None].float())[0], change[0], atol=2e-3)


def test_light_that_has_not_changed_is_left_as_it_is():
    background = skin(240, 320)
    image = background * pressed(240, 320)
    relight = Relight(background[0])
    assert torch.equal(relight(image), image)
    assert torch.equal(relight.terms(image).float(), unchanged_light(image))


@pytest.mark.parametrize("gain, mode", [(gain, ("fast", "precise")[k % 2]) for k, gain in enumerate(GAINS)])
def test_depth_is_the_same_at_any_gain_and_free_skin_reads_zero(gain, mode):
    """Exposure and white balance, clipped as a camera does; exact lights."""
    lights, press = ring_lights(level=0.4), scenes.sphere_press(4.0, 1.0, (1.5, -1.0), **FIELD)
    rest = scenes.undeformed(press)
    unit = vts.Calibration.from_lights(lights, vts.Sensor("rig", **FIELD), as_seen(scenes.render(rest, lights))[0])
    pipe, factor = vts.DepthPipeline.from_calibration(unit, mode), torch.tensor(gain)[:, None, None]
    usual = pipe(as_seen(scenes.render(press, lights))).depth_mm
    image = as_seen(scenes.render(press, lights) * factor)
    found, inside = pipe(image).depth_mm, usual > 0.3
    assert float(((image >= 0.99).any(dim=1, keepdim=True) & inside).sum()) < 0.34 * float(inside.sum())
    assert float(found[inside].mean() / usual[inside].mean()) == pytest.approx(1.0, abs=0.03)
    free = pipe(as_seen(scenes.render(rest, lights) * factor, seed=4))
    assert float(free.depth_mm.abs().max()) == 0.0


def test_a_channel_that_is_saturated_or_dead_gets_the_light_of_the_others():
    background = skin(240, 320)
    factor = torch.tensor([1.3, 1.3, 9.0])[:, None, None]
    image = (background * pressed(240, 320) * factor).clamp(0, 1)
    terms = Relight(background[0]).terms(image)[0]
    assert torch.allclose(terms[:, 0], torch.full((3,), 1.3, dtype=torch.float64), atol=0.01)
    dead = background * pressed(240, 320) * torch.tensor([1.0, 0.0, 1.0])[:, None, None]
    assert torch.equal(Relight(background[0])(dead), dead)


def test_a_saturated_pixel_is_no_darker_than_the_background():
    background = torch.full((3, 48, 64), 0.5)
    background[0, :, 30:] = 0.8
    image = (1.4 * background[None]).clamp(0, 1)
    assert torch.allclose(Relight(background)(image), background[None], atol=1e-4)


@pytest.mark.parametrize("share", [0.5, 0.6])
def test_half_of_the_skin_in_the_shade_or_in_contact_leaves_the_light_as_it_is(share):
    """A shade, and a tilted face: both have one light everywhere."""
    background = skin(240, 320)
    inside = (torch.arange(320) < share * 320).float()
    noise = 0.004 * torch.randn(1, 3, 240, 320, generator=torch.Generator().manual_seed(0))
    for factor in ((0.8, 0.8, 0.8), (1.2, 0.95, 0.85)):
        image = background * (1.0 + (torch.tensor(factor)[:, None, None] - 1.0) * inside) + noise
        terms = Relight(background[0]).terms(image)[0]
        kept = share < 0.55 or torch.allclose(terms[:, 0], torch.tensor(factor).double(), atol=0.05)
        assert kept or torch.allclose(terms[:, 0], torch.ones(3).double(), atol=0.05)


def test_a_ball_that_fills_the_image_may_pass_for_a_change_of_light_but_not_in_silence():
    """Without free skin nothing tells a bowl from LEDs that fade each on its side."""
    lights = ring_lights(level=0.4)
    press = scenes.sphere_press(60.0, 1.4, **FIELD)
    unit = vts.Calibration.from_lights(lights, vts.Sensor("rig", **FIELD), scenes.render(scenes.undeformed(press), lights)[0])
    sure, image = vts.ConfidentPipeline.from_calibration(unit), scenes.render(press, lights)
    out = sure(image)
    assert float(out.depth_mm.max()) > 1.0 or float(out.frame_confidence) < 0.5
    assert "contact over all of the skin" in vts.pipeline.doubts_of(sure.pipe.conditions(image), 1.0)[0]


@pytest.mark.parametrize("size", SIZES)
def test_a_scripted_fit_is_the_same_and_frames_are_independent(size):
    background = skin(*size)
    noise = 0.004 * torch.randn(2, 3, *size, generator=torch.Generator().manual_seed(1))
    image = torch.cat((change_of_light(*size, 0.06), pressed(*size) * 0.8 * change_of_light(*size, 0.05, 1))) * background + noise
    plain = Relight(background[0])
    assert torch.allclose(torch.jit.script(plain)(image), plain(image), atol=1e-6)
    assert torch.allclose(plain(image)[1:], plain(image[1:]), atol=1e-6)
    assert (min(size) < 24) == torch.equal(plain(image), image)


@pytest.mark.parametrize("gain", [0.5, 0.9, 1.0, 1.4])
def test_depth_of_a_response_unit_hardly_follows_the_light(gain):
    """Frozen and plain the same, with what they say of the conditions."""
    field = ResponseField(0, -1, 10.0, ((-0.1, 0.0, 0.1), (0.0, -0.2, 0.0)))
    model = ResponseModel(field, DepthBrightness(0, 10.0, ((0.0,), (0.0,), (0.0,))))
    unit = vts.Calibration.from_response(model, vts.Sensor("rig", 120, 160, 0.1), torch.full((3, 120, 160), 0.5))
    pipe, image = vts.DepthPipeline.from_calibration(unit, "precise"), 0.5 * pressed(120, 160)
    changed = (image * change_of_light(120, 160, 0.05) * gain).clamp(0, 1)
    after, moved_by = pipe(changed), largest(pipe(changed).depth_mm - pipe(image).depth_mm)
    assert float(after.depth_mm.max()) > 0.2
    other, conditions = pipe.freeze().with_conditions(changed)
    assert torch.allclose(other.depth_mm, after.depth_mm, atol=1e-6) and torch.equal(other.contact, after.contact)
    expected = pipe.conditions(changed)
    assert torch.allclose(conditions.light, expected.light, atol=1e-5)
    assert torch.allclose(conditions.unseen_deg, expected.unseen_deg, atol=1e-4)
    assert moved_by < 0.004


def test_what_a_frame_hides_grows_with_the_scatter_of_its_skin():
    """Gamma is no smooth change of light: the frame says that less could be seen, and its confidence falls."""
    lights, press = ring_lights(level=0.4), scenes.sphere_press(4.0, 1.0, **FIELD)
    spots = scenes.skin_spots(120, 160, 60, 0, seed=1)
    worn = scenes.render(scenes.undeformed(press), lights, spots=spots)
    unit = vts.Calibration.from_lights(lights, vts.Sensor("rig", **FIELD), as_seen(worn)[0])
    sure = vts.ConfidentPipeline.from_calibration(unit)
    frames = torch.cat([as_seen(scenes.render(press, lights, spots=spots) ** power) for power in (1.0, 1.5)])
    swapped = frames[:1, [2, 1, 0]]
    unseen = [float(v) for v in sure.pipe.conditions(torch.cat((frames, swapped))).unseen_deg]
    assert unseen[0] < 3.0 < unseen[2] and unseen[0] < unseen[1]
    assert float(sure(swapped).frame_confidence) < float(sure(frames[:1]).frame_confidence) - 0.1
    usual = vts.pipeline.usual_unseen_deg(unit, sure.pipe)
    assert vts.pipeline.doubts_of(sure.pipe.conditions(frames[:1]), usual) == [""]
    assert "the light is not that of the background" in vts.pipeline.doubts_of(sure.pipe.conditions(swapped), usual)[0]
    hidden = frames[:1] * (
        1.0
        + 0.2
        * torch.randn(1, 3, 30, 40, generator=torch.Generator().manual_seed(0)).repeat_interleave(4, 2).repeat_interleave(4, 3)
    )
    doubtful = vts.pipeline.doubts_of(sure.pipe.conditions(hidden.clamp(0, 1)), usual)[0]
    assert "times as rough as at calibration: slopes below" in doubtful and "are in doubt" in doubtful
    assert math.isfinite(usual) and usual < 3.0


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
