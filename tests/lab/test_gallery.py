"""The gallery of hard scenes: valid and repeatable at every severity, and each fault has its physical effect."""

import math
from dataclasses import replace

import pytest
import torch

import torchvts as vts
from lab import faults, gallery
from lab.gallery import CORRUPTIONS, HEIGHT, MM_PER_PIXEL, USUAL, WIDTH
from torchvts.core.geometry import normal_from_gradient
from torchvts.model.lights import cast_shadows

# corruptions that begin with another shape or camera than the undisturbed case
OTHER_START = {"steep walls", "cut ends", "cut by the border", "covers the image", "two contacts", "few bits", "JPEG"}


def _same(one, other):
    return (
        torch.equal(one.image, other.image)
        and torch.equal(one.background, other.background)
        and all(torch.equal(a, b) for a, b in zip(one.truth[:4], other.truth[:4]))
        and one.truth.mm_per_pixel == other.truth.mm_per_pixel
    )


@pytest.mark.parametrize("corruption", CORRUPTIONS.values(), ids=lambda corruption: corruption.name)
def test_every_severity_makes_a_valid_case(corruption):
    assert 5 <= len(corruption.severities) <= 7
    rises = [b > a for a, b in zip(corruption.severities, corruption.severities[1:])]
    assert all(rises) or not any(rises)
    for severity in corruption.severities:
        case = corruption.make(severity, 3)
        truth = case.truth
        assert case.background.shape == (3, HEIGHT, WIDTH) and case.image.shape == (1, 3, HEIGHT, WIDTH)
        for image in (case.background, case.image):
            assert image.dtype == torch.float32 and float(image.min()) >= 0.0 and float(image.max()) <= 1.0
        assert case.calibration.measured and case.calibration.lights is not None
        assert [t.shape[1] for t in truth[:4]] == [1, 2, 3, 1] and all(t.shape[2:] == (HEIGHT, WIDTH) for t in truth[:4])
        assert all(torch.isfinite(t).all() for t in truth[:3])
        assert (normal_from_gradient(truth.gradient) - truth.normal).abs().max() < 1e-6
        assert float(truth.depth_mm.min()) >= 0.0 and bool((truth.depth_mm[truth.contact] > 0).all())


@pytest.mark.parametrize("corruption", CORRUPTIONS.values(), ids=lambda corruption: corruption.name)
def test_cases_repeat_by_seed_and_severities_differ(corruption):
    middle, last = corruption.severities[len(corruption.severities) // 2], corruption.severities[-1]
    case = corruption.make(middle, 1)
    assert _same(case, corruption.make(middle, 1))
    assert not torch.equal(case.image, corruption.make(middle, 2).image)
    assert not torch.equal(case.image, corruption.make(last, 1).image)


@pytest.mark.parametrize("name", sorted(set(CORRUPTIONS) - OTHER_START))
def test_the_first_severity_is_the_undisturbed_case(name):
    assert _same(CORRUPTIONS[name].make(CORRUPTIONS[name].severities[0], 5), gallery.undisturbed(5))


def test_eight_bits_are_the_undisturbed_case():
    assert _same(CORRUPTIONS["few bits"].make(8.0, 5), gallery.undisturbed(5))


SMOOTH = {"deeper press", "covers the image", "gel sag", "faint contact"}


@pytest.mark.parametrize("name", sorted(SMOOTH))
def test_true_gradients_are_the_slopes_of_the_true_depth(name):
    """Central differences err by a sixth of the third derivative, which the middle of a ball hardly has."""
    truth = CORRUPTIONS[name].make(CORRUPTIONS[name].severities[1], 0).truth
    z, pitch = truth.depth_mm.double(), truth.mm_per_pixel
    slope = (z[..., 2:] - z[..., :-2]) / (2 * pitch)
    steep = truth.gradient.norm(dim=1)[:, :, 1:-1]
    inner = -torch.nn.functional.max_pool2d(-truth.contact.float(), 5, 1, 2)[:, 0, :, 1:-1] > 0
    assert (slope[:, 0] - truth.gradient[:, 0, :, 1:-1])[inner & (steep < 0.6)].abs().max() < 2e-3


def test_an_image_without_faults_is_the_renderers(ring):
    scene = vts.scenes.sphere_press(6.0, 1.0, (0.5, 0.2), 60, 80, 0.25)
    lights = ring()
    plain = faults.photograph(scene, faults.Conditions(lights))
    assert (plain - vts.scenes.render(scene, lights)).abs().max() < 1e-6
    other = vts.scenes.render(scene, lights, noise_std=0.01, bits=8, gamma=2.2, vignetting=0.3, shadows=True, seed=4)
    same = faults.Conditions(lights, noise_std=0.01, bits=8, gamma=2.2, vignetting=0.3, shadows=True)
    assert (faults.photograph(scene, same, 4) - other).abs().max() < 1.01 / 255


def _light(**conditions):
    return faults.radiance(gallery.undisturbed().truth, replace(USUAL, **conditions))


def test_cast_shadows_only_darken_and_need_relief():
    for elevation in (50.0, 20.0, 8.0):
        lights = gallery.rig_lights(elevation)
        with_shadows, without = _light(lights=lights, shadows=True), _light(lights=lights)
        assert bool((with_shadows <= without).all())
        assert elevation > 30.0 or bool((with_shadows < without).any())
    assert bool(cast_shadows(torch.zeros(1, 1, 40, 50), gallery.LIGHTS, 0.1).all())


def test_a_cast_shadow_is_as_long_as_the_light_is_low():
    """A thin wall of height h under a light at elevation e shades h / tan(e) of flat skin, and only on the far side."""
    depth = torch.zeros(1, 1, 64, 320)
    depth[..., 200] = 1.0
    for elevation_deg in (15.0, 30.0, 45.0):
        angle = math.radians(elevation_deg)
        far = [1e4 * math.cos(angle), 0.0, 1e4 * math.sin(angle)]
        lights = vts.PointLights([far, [-far[0], 0.0, far[2]], [0.0, 0.0, 1e4]], [1.0, 1.0, 1.0])
        dark = cast_shadows(depth, lights, 0.05)[0, :, 32] == 0
        assert int(dark[0, :200].sum()) * 0.05 == pytest.approx(1.0 / math.tan(angle), abs=0.11)
        assert not dark[0, 201:].any() and not dark[1, :200].any() and not dark[2].any()
        assert int(dark[1].sum()) == int(dark[0].sum())


def test_a_ball_casts_no_shadow_on_its_lit_side():
    truth, lights = gallery.undisturbed().truth, gallery.rig_lights(25.0)
    facing = faults.radiance(truth, replace(USUAL, lights=lights)) > 0.02
    assert bool(cast_shadows(truth.depth_mm, lights, MM_PER_PIXEL).bool()[facing & truth.contact].all())


def test_shine_adds_light_and_none_is_matt():
    matt = _light()
    assert torch.equal(_light(specular=0.0), matt)
    faint, strong = _light(specular=0.1), _light(specular=0.4)
    assert bool((faint >= matt).all()) and torch.allclose(strong - matt, 4 * (faint - matt), atol=1e-6)


def test_ambient_and_bounced_light_flatten_the_shading():
    matt = _light()
    for condition in ("ambient", "bounce"):
        spread = [float(_light(**{condition: share}).std(dim=(2, 3)).mean()) for share in (0.0, 0.2, 0.5)]
        assert spread[0] > spread[1] > spread[2]
    level = matt.mean(dim=(2, 3))
    assert (_light(bounce=0.5).mean(dim=(2, 3)) / level - 1).abs().max() < 0.02  # it moves light, and adds none


def test_a_far_pinhole_looks_straight_down():
    """The error of calling it so is in proportion to one over the distance: half the angle, half the error."""
    plain = gallery.undisturbed(2)
    change = [
        float((gallery.CORRUPTIONS["perspective"].make(angle, 2).truth.depth_mm - plain.truth.depth_mm).abs().max())
        for angle in (0.05, 4.0, 8.0)
    ]
    assert change[0] < 2e-3
    assert change[2] / change[1] == pytest.approx(2.0, rel=0.1)


def test_blurs_keep_the_light_and_spread_a_point_as_far_as_asked():
    point = torch.zeros(1, 1, 41, 41, dtype=torch.float64)
    point[..., 20, 20] = 1.0
    place = torch.arange(41, dtype=torch.float64) - 20
    for std in (0.7, 3.0):
        row = faults.gaussian_blur(point, std).sum(dim=2).flatten()
        assert float(row.sum()) == pytest.approx(1.0) and float((row * place**2).sum().sqrt()) == pytest.approx(std, rel=0.05)
    for length in (0.3, 1.0, 2.0, 4.5, 9.0):
        row = faults.smear(point, length).sum(dim=2).flatten()
        assert float(row.sum()) == pytest.approx(1.0) and float(row.max()) == pytest.approx(1.0 / max(1.0, length))
    assert torch.equal(faults.smear(point, 1.0), point)


def test_crosstalk_ends_with_red_and_blue_swapped():
    scene, plain = gallery.undisturbed().truth, faults.Conditions(gallery.LIGHTS)
    swapped = faults.photograph(scene, replace(plain, crosstalk=1.0))
    assert torch.equal(swapped, faults.photograph(scene, plain).flip(1))


def test_levels_clip_as_cameras_do():
    scene = gallery.undisturbed().truth
    light = _light()
    bright = faults.photograph(scene, faults.Conditions(gallery.LIGHTS, exposure=2.5))
    assert bool((bright[light > 0.4] == 1.0).all()) and bool((bright[light < 0.39] < 1.0).all())
    dark = faults.photograph(scene, faults.Conditions(gallery.LIGHTS, black=0.3))
    assert bool((dark[light < 0.3] == 0.0).all()) and bool((dark[light > 0.31] > 0.0).all())


def test_jpeg_loses_more_the_lower_its_quality():
    image = gallery.undisturbed().image
    loss = [float((faults.jpeg(image, quality) - image).square().mean()) for quality in (100, 85, 50, 10)]
    assert 0.0 < loss[0] < loss[1] < loss[2] < loss[3]


def test_spots_dim_the_skin_and_dead_pixels_read_zero():
    case, plain = CORRUPTIONS["spots and dead pixels"].make(30.0, 0), gallery.undisturbed()
    factor = vts.scenes.skin_spots(HEIGHT, WIDTH, 30, 30, 0).expand(1, 3, -1, -1)
    assert bool((case.image[factor == 0] == 0).all())
    clean = factor == 1
    assert torch.equal(case.image[clean], plain.image[clean])
    assert float((case.image - plain.image)[(factor > 0) & (factor < 1)].mean()) < -0.05


def test_the_transition_zone_of_sagging_gel_joins_the_ball_without_a_kink():
    truth = CORRUPTIONS["gel sag"].make(1.0, 0).truth
    beyond = ~truth.contact
    assert float(truth.gradient.norm(dim=1, keepdim=True)[beyond].max()) > 0.1  # truth goes on outside the contact
    step = (truth.gradient[..., 1:] - truth.gradient[..., :-1]).abs().max()
    assert step < 0.1 < (gallery.undisturbed().truth.gradient[..., 1:] - gallery.undisturbed().truth.gradient[..., :-1]).abs().max()
    press = gallery.undisturbed().truth
    assert int(truth.contact.sum()) < int(press.contact.sum())
    assert bool((truth.depth_mm >= press.depth_mm - 1e-6).all())


def test_positions_and_cast_shadows_do_not_go_together():
    case = gallery.undisturbed()
    with pytest.raises(ValueError, match="shadows: expected a camera that looks straight down"):
        faults.radiance(case.truth, replace(USUAL, shadows=True), gallery._grid())
