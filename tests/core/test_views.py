"""Other views of a background are told from other colours of it."""

import numpy as np
import pytest

import torchvts as vts
from torchvts.core.arrays import array_of
from torchvts.core.views import Views

LIGHTS = vts.PointLights([[-14, 1, 7], [8, -12, 7], [7, 13, 7]], [60, 60, 60])  # mm, beside a skin of 24 x 18 mm


@pytest.fixture(scope="module")
def skin():
    """Image value of a smooth skin whose light fades from three sides, (3, 180, 240)."""
    flat = vts.scenes.undeformed(vts.scenes.sphere_press(3.0, 0.5, (0.0, 0.0), 180, 240, 0.1))
    light = array_of(vts.scenes.render(flat, LIGHTS)[0])
    return (0.05 + 0.8 * light / light.max()) ** (1 / 2.2)


def cropped(image, share):
    top, left = round(share * image.shape[1]), round(share * image.shape[2])
    rows = np.linspace(top, image.shape[1] - 1 - top, image.shape[1]).round().astype(int)
    columns = np.linspace(left, image.shape[2] - 1 - left, image.shape[2]).round().astype(int)
    return image[:, rows][:, :, columns]


def with_stray_light(image):
    return (image**2.2 + 0.1) ** (1 / 2.2)


def less_saturated(image):
    return 0.6 * image + 0.4 * image.mean(0)


def of_another_gamma(image):
    return image**0.7


@pytest.mark.parametrize("change", [with_stray_light, less_saturated, of_another_gamma])
def test_other_colours_of_the_same_view_are_no_crop(skin, change):
    views = Views(skin)
    image = change(skin).astype(np.float32)
    assert views.difference(views.cells(image)) > 0.05  # else no other view is looked for
    assert views.other(views.cells(image)) is None


@pytest.mark.parametrize("share", [1 / 7, 0.2])
@pytest.mark.parametrize("gain", [1.0, 0.8])
def test_crops_are_named_in_both_directions(skin, share, gain):
    less, more = Views(skin), Views(cropped(skin, share))
    assert f"shows less than the background, by {share:.0%}" in less.other(less.cells(gain * cropped(skin, share))).what
    assert f"shows more than the background, by {share:.0%}" in more.other(more.cells(gain * skin)).what
