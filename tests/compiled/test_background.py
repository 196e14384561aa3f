"""A plan that meets another image without contact in C: the depth of the plan that Python makes of the calibration and that."""

import dataclasses

import pytest
import torch
from test_frozen import MODES, lights_unit, long, marked_unit, response_unit

import torchvts as vts
from torchvts.compiled import library
from torchvts.core.files import read_image
from torchvts.stream import with_background

pytestmark = pytest.mark.skipif(library() is None, reason="no compiled library")
REAL = {
    "gelsight_mini_a": ("gelsight_mini", "*/*/gelsight.png"),
    "gelsight_mini_b": ("gelsight_mini", "bead.png"),
    "digit_a": ("digit", "ball_00*7.png"),
    "digit_b": ("digit", "ball_00*3.png"),
}
"""Sensor and presses of each real set."""


def differs(found, expected, images, depth_mm=1e-6):
    """Compare two frozen pipelines; returns the deepest depth."""
    (one, seen), (other, told) = found.with_conditions(images), expected.with_conditions(images)
    assert float((one.depth_mm - other.depth_mm).abs().max()) <= depth_mm
    assert torch.allclose(seen.light, told.light, atol=1e-5)
    for mask, same in ((one.deformed, other.deformed), (one.contact, other.contact)):
        assert int((mask ^ same).sum()) <= 2  # a depth or pressure that rounding moves over its threshold
    return float(one.depth_mm.max())


def frozen(calibration, mode="precise"):
    return vts.DepthPipeline.from_calibration(calibration, mode).freeze()


def worn(background):
    """An image of the same skin on another day: darker, noisier, with a spot, a dead corner, and a pixel that is saturated."""
    generator = torch.Generator().manual_seed(5)
    image = 0.9 * background + 0.02 * torch.rand(background.shape, generator=generator)
    row, column = (size // 2 for size in background.shape[1:])
    image[:, row, column : column + 2] = image[:, 0, 0] = 0.0
    image[1, -1, 3] = 1.0
    return image


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("size", [(22, 32), (99, 131)], ids=str)
def test_a_drawn_unit_on_another_day(mode, size):
    calibration, images = response_unit(size, 20.0 / size[1])
    image = worn(calibration.background)
    found = frozen(calibration, mode).with_background(image)
    assert differs(found, frozen(with_background(calibration, image), mode), images) > 0.2


@pytest.mark.parametrize("mode", MODES)
def test_a_skin_with_markers_on_another_day(mode):
    calibration, images = marked_unit((120, 160), 0.125)
    image = (0.9 * calibration.printed).clamp(0.0, 1.0)
    expected = with_background(calibration, image)
    found = frozen(calibration, mode).with_background(image)
    assert expected.markers.to_dict() == pytest.approx(calibration.markers.to_dict(), rel=0.05)  # Python measures them again
    assert differs(found, frozen(dataclasses.replace(expected, markers=calibration.markers), mode), images, 1e-5) > 0.2


def test_the_camera_has_a_gamma():
    calibration, images = response_unit((99, 131), 0.15)
    response = dataclasses.replace(calibration.response, gamma=2.2)
    calibration = dataclasses.replace(calibration, sensor=dataclasses.replace(calibration.sensor, gamma=2.2), response=response)
    image = worn(calibration.background)
    found, expected = frozen(calibration).with_background(image), frozen(with_background(calibration, image))
    assert differs(found, expected, images, 2e-5) > 2.0  # a power in single precision is good to 6e-8, and 2 mm follow


@pytest.mark.parametrize("name", ["gelsight_mini_b", "digit_a", *(long(name) for name in ("gelsight_mini_a", "digit_b"))])
def test_the_prior_of_a_type_meets_a_real_unit(data, name):
    kind, presses = REAL[name]
    sensor = vts.Sensor.load(kind)
    usual = sensor.prior.background(sensor.height, sensor.width, sensor.mm_per_pixel).float().clamp(0.0, 1.0)
    background = read_image(data / name / "background.png")
    images = torch.stack([read_image(path) for path in sorted((data / name).glob(presses))[:5]])
    found = frozen(vts.calibrate(usual, sensor)).with_background(background)
    assert differs(found, frozen(vts.calibrate(background, sensor)), images) > 0.1


def test_what_it_makes_is_a_plan_and_the_old_one_stays(tmp_path):
    calibration, images = response_unit((24, 32), 0.5)
    old = frozen(calibration)
    before = old(images).depth_mm
    new = old.with_background(worn(calibration.background))
    new.save(tmp_path / "new.plan")
    again = vts.FrozenPipeline.load(tmp_path / "new.plan")
    assert torch.equal(again(images).depth_mm, new(images).depth_mm) and torch.equal(old(images).depth_mm, before)
    assert (again.mode, again.mm_per_pixel) == ("precise", 0.5)
    back = new.with_background(calibration.background)
    assert differs(back, old.with_background(calibration.background), images, 0.0) > 0.1


def test_what_no_background_is_is_refused():
    calibration, _ = response_unit((24, 32), 0.5)
    good, found = calibration.background, frozen(calibration)
    slow = vts.DepthPipeline.from_calibration(calibration, integrate=vts.PoissonDST(0.5)).freeze()
    for unit, image, reason in (
        (found, good[:, :20], r"background: expected \(3, 24, 32\) for sensor 'soft', got \(3, 20, 32\)"),
        (found, 255.0 * good, r"background: expected values in \[0, 1\]"),
        (found, torch.zeros_like(good), "background: image: expected light above the noise, got none: black image"),
        (frozen(lights_unit((24, 32), 0.5)[0]), good, "background: the plan is one of point lights"),
        (slow, good, "pipe: expected one that is compiled, got one in PyTorch, because integrate is PoissonDST"),
    ):
        with pytest.raises(ValueError, match=reason):
            unit.with_background(image)


def test_no_valid_pixel_beside_a_defect():
    calibration, _ = response_unit((24, 32), 0.5)
    image = torch.full_like(calibration.background, 0.5)
    image[:, 12], image[:, :, 16] = 0.0, 0.0  # a row and a column: each pixel has the other's, but for where they cross
    with pytest.raises(ValueError, match="expected valid pixels in the row or column of each defect, got none"):
        frozen(calibration).with_background(image)
