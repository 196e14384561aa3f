"""Spheres fitted to depth."""

import pytest
import torch

import torchvts as vts
from torchvts.training.balls import fit_sphere


@pytest.mark.parametrize("radius_mm, press_mm, center_mm", [(10.0, 0.2, (0.0, 0.0)), (3.0, 1.0, (5.0, -4.0))])
def test_the_sphere_of_exact_points_is_exact(radius_mm, press_mm, center_mm):
    scene = vts.scenes.sphere_press(radius_mm, press_mm, center_mm, 241, 321, 0.125, torch.float64)
    fit = fit_sphere(scene.depth_mm, 0.125, scene.contact)
    assert fit.center_mm == pytest.approx((center_mm[0], -center_mm[1], press_mm - radius_mm), abs=1e-8)
    assert fit.radius_mm == pytest.approx(radius_mm, abs=1e-8) and fit.rms_mm < 1e-9
    assert fit_sphere(scene.depth_mm, 0.125, scene.contact, 2**31 - 1).radius_mm == pytest.approx(radius_mm, abs=1e-8)


def test_a_sphere_needs_four_points_of_a_size_that_can_be():
    one, none = torch.zeros(1, 1, 4, 4), torch.zeros(1, 1, 4, 4, dtype=torch.bool)
    with pytest.raises(ValueError, match="contact: expected at least 4 pixels, got 0: no contact, no sphere"):
        fit_sphere(one, 1.0, none)
    with pytest.raises(ValueError, match="depth_mm: expected finite values of at most 1e6 mm"):
        fit_sphere(one.double() + 1e300, 1.0, ~none)
