"""The bright rim of a contact is found where it is, whatever the label says within its reach."""

import pytest
import torch

from lab.rims import visible_rim


def with_ring(center, radius, noise=0.004, height=80, width=100):
    """A background, and the same with a bright line 2 px wide along a circle, a coloured slope inside of it, and noise."""
    torch.manual_seed(3)
    y, x = torch.meshgrid(torch.arange(float(height)), torch.arange(float(width)), indexing="ij")
    away = torch.hypot(x - center[0], y - center[1])
    across = 0.004 * (x - center[0]) * (away < radius)
    slope = torch.stack((across, torch.zeros_like(x), -across))
    background = torch.full((3, height, width), 0.5)
    image = background + 0.03 * torch.exp(-0.5 * (away - radius).square()) + slope + noise * torch.randn(3, height, width)
    return image.clamp(0.0, 1.0), background


@pytest.mark.parametrize("off", [(4.0, -3.0, 2.0), pytest.param((-5.0, 5.0, -3.0), marks=pytest.mark.long)])
def test_the_rim_is_found_from_labels_that_are_off(off):
    image, background = with_ring((52.0, 38.5), 24.0)
    rim = visible_rim(image, background, (52.0 + off[0], 38.5 + off[1]), 24.0 + off[2])
    assert rim.center_px == pytest.approx((52.0, 38.5), abs=0.75) and rim.radius_px == pytest.approx(24.0, abs=0.75)
    assert rim.strength > 2.0
