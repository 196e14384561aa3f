"""The metrics that score results, by hand."""

import math

import pytest
import torch

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
