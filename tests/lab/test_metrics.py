"""The metrics that score results, by hand."""

import math

import pytest
import torch

import torchvts as vts
from lab import metrics


def test_depth_error_by_hand():
    truth, depth = torch.zeros(1, 1, 2, 2), torch.tensor([[3.0, 0.0], [-4.0, 0.0]]).reshape(1, 1, 2, 2)
    assert metrics.depth_error(depth, truth, 0.5) == pytest.approx((4.0, 2.5, 8.0, 5.0))
    region = torch.tensor([[True, True], [False, False]]).reshape(1, 1, 2, 2)
    assert metrics.depth_error(depth, truth, 0.5, region) == pytest.approx((3.0, math.sqrt(4.5), 6.0, math.sqrt(18)))


@pytest.mark.parametrize("angle_deg", [0.0, 1e-5, 1.0, 60.0, 90.0, 180.0])
def test_the_angle_between_normals(angle_deg):
    a = math.radians(angle_deg)
    one, two = (
        torch.tensor(v, dtype=torch.float64).reshape(1, 3, 1, 1) for v in ([0.0, 0.0, 1.0], [math.sin(a), 0.0, math.cos(a)])
    )
    assert float(metrics.normal_angle_deg(one, two)) == pytest.approx(angle_deg, rel=1e-9, abs=1e-12)
    assert metrics.normal_angle_deg(one, two, torch.ones(1, 1, 1, 1, dtype=torch.bool)).shape == (1,)


def square(left, size=4):
    mask = torch.zeros(1, 1, 20, 20, dtype=torch.bool)
    mask[..., 5 : 5 + size, left : left + size] = True
    return mask


def test_overlap_by_hand():
    nothing = torch.zeros_like(square(5))
    assert metrics.mask_iou(square(5), square(7)) == pytest.approx(8 / 24)
    assert metrics.mask_iou(square(5), square(5)) == 1.0 and metrics.mask_iou(square(5), nothing) == 0.0
    assert metrics.mask_iou(nothing, nothing) == 1.0


@pytest.mark.parametrize("radius_mm, press_mm, center_mm", [(10.0, 0.2, (0.0, 0.0)), (3.0, 1.0, (5.0, -4.0))])
def test_the_sphere_of_exact_points_is_exact(radius_mm, press_mm, center_mm):
    scene = vts.scenes.sphere_press(radius_mm, press_mm, center_mm, 241, 321, 0.125, torch.float64)
    fit = metrics.fit_sphere(scene.depth_mm, 0.125, scene.contact)
    assert fit.center_mm == pytest.approx((center_mm[0], -center_mm[1], press_mm - radius_mm), abs=1e-8)
    assert fit.radius_mm == pytest.approx(radius_mm, abs=1e-8) and fit.rms_mm < 1e-9
    assert metrics.fit_sphere(scene.depth_mm, 0.125, scene.contact, 2**31 - 1).radius_mm == pytest.approx(radius_mm, abs=1e-8)


def test_a_sphere_needs_four_points_of_a_size_that_can_be():
    one, none = torch.zeros(1, 1, 4, 4), torch.zeros(1, 1, 4, 4, dtype=torch.bool)
    with pytest.raises(ValueError, match="contact: expected at least 4 pixels, got 0: no contact, no sphere"):
        metrics.fit_sphere(one, 1.0, none)
    with pytest.raises(ValueError, match="depth_mm: expected finite values of at most 1e6 mm"):
        metrics.fit_sphere(one.double() + 1e300, 1.0, ~none)
