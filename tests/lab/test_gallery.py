"""The gallery of hard scenes: valid and repeatable at every severity, and each fault has its physical effect."""

import math

import pytest
import torch

import torchvts as vts
from lab import faults, gallery
from lab.gallery import CORRUPTIONS, HEIGHT, WIDTH
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


@pytest.mark.parametrize(
    "corruption", [pytest.param(c, id=c.name, marks=[pytest.mark.long] * (k % 3 > 0)) for k, c in enumerate(CORRUPTIONS.values())]
)
def test_a_corruption_makes_valid_cases_that_repeat_by_seed_and_differ_by_severity(corruption):
    assert 5 <= len(corruption.severities) <= 7
    rises = [b > a for a, b in zip(corruption.severities, corruption.severities[1:])]
    assert all(rises) or not any(rises)
    first, middle, last = (corruption.severities[k] for k in (0, len(corruption.severities) // 2, -1))
    cases = {severity: corruption.make(severity, 3) for severity in (first, middle, last)}
    for case in cases.values():
        truth = case.truth
        assert case.background.shape == (3, HEIGHT, WIDTH) and case.image.shape == (1, 3, HEIGHT, WIDTH)
        for image in (case.background, case.image):
            assert image.dtype == torch.float32 and float(image.min()) >= 0.0 and float(image.max()) <= 1.0
        assert case.calibration.measured and case.calibration.lights is not None
        assert [t.shape[1] for t in truth[:4]] == [1, 2, 3, 1] and all(t.shape[2:] == (HEIGHT, WIDTH) for t in truth[:4])
        assert all(torch.isfinite(t).all() for t in truth[:3])
        assert (normal_from_gradient(truth.gradient) - truth.normal).abs().max() < 1e-6
        assert float(truth.depth_mm.min()) >= 0.0 and bool((truth.depth_mm[truth.contact] > 0).all())
    assert _same(cases[middle], corruption.make(middle, 3))
    assert not torch.equal(cases[middle].image, corruption.make(middle, 2).image)
    assert not torch.equal(cases[middle].image, cases[last].image)
    assert corruption.name in OTHER_START or _same(cases[first], gallery.undisturbed(3))


def test_an_image_without_faults_is_the_renderers(ring):
    scene = vts.scenes.sphere_press(6.0, 1.0, (0.5, 0.2), 60, 80, 0.25)
    lights = ring()
    plain = faults.photograph(scene, faults.Conditions(lights))
    assert (plain - vts.scenes.render(scene, lights)).abs().max() < 1e-6
    other = vts.scenes.render(scene, lights, noise_std=0.01, bits=8, gamma=2.2, vignetting=0.3, shadows=True, seed=4)
    same = faults.Conditions(lights, noise_std=0.01, bits=8, gamma=2.2, vignetting=0.3, shadows=True)
    assert (faults.photograph(scene, same, 4) - other).abs().max() < 1.01 / 255


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
