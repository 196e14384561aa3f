"""Tracking with printed dots: a cylinder rolls on a drawn skin that sticks to it, and its contact shows neither roll nor shift."""

import math
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from torchvts.core.geometry import gradient_of_depth
from torchvts.model.markers import FillMarkers, find_dots
from torchvts.pose import PoseTracker
from torchvts.pose.dots import carried, fused
from torchvts.pose.rigid import rigid_motion
from torchvts.scenes import DottedSkin
from torchvts.skin import SkinMotion

PITCH, RADIUS, PRESS, HALF = 0.1, 4.0, 0.8, 2.0
AXIS_Z = PRESS - RADIUS
SKIN = DottedSkin(96, 144, PITCH, spacing_mm=1.8, diameter_mm=0.7)


@dataclass(frozen=True)
class Roll:
    """A cylinder along y, ``x`` mm along its way, that rolls without slip and drags the skin along y."""

    x: float
    drag: float = 0.25

    def displacement_mm(self, points_mm):
        u = points_mm[..., 0] - self.x
        inside, beyond = u.clamp(-HALF, HALF), (u.abs() - HALF).clamp_min(0.0)
        rim = PRESS - RADIUS * (1.0 - math.cos(HALF / RADIUS))
        depth = PRESS - RADIUS * (1.0 - torch.cos(inside / RADIUS))
        depth = torch.where(beyond > 0.0, rim * torch.exp(-beyond * math.tan(HALF / RADIUS) / rim), depth)
        across = (RADIUS * torch.sin(inside / RADIUS) - inside) / (1.0 + (beyond / 2.5) ** 2)
        down = self.drag * (HALF - inside) / (1.0 + ((-u - HALF).clamp_min(0.0) / 2.5) ** 2)
        return torch.stack((across, down, depth), dim=-1)

    def frame(self, skin, seed):
        """Image, and depth as the tracker takes it."""
        depth = skin.depth_mm(self)
        contact = ((skin.rest_mm(self)[..., 0] - self.x).abs() < HALF)[None, None]
        out = SimpleNamespace(depth_mm=depth.float(), gradient=gradient_of_depth(depth, PITCH).float(), contact=contact)
        return skin.image(self, seed)[None], out

    def pose(self, start):
        """T_frame_reference: x right, y up, z towards the camera."""
        way = self.x - start.x
        turn = rigid_motion(np.array([0.0, -way / RADIUS, 0.0, 0.0, 0.0, 0.0]), np.zeros(3))
        before, after = np.eye(4), np.eye(4)
        before[:3, 3], after[:3, 3] = (-start.x, 0.0, -AXIS_Z), (self.x, -self.drag * way, AXIS_Z)
        return after @ turn @ before


def errors(found, true, start):
    """Degrees, and mm at the axis."""
    off = found.T_target_source.numpy() @ np.linalg.inv(true)
    axis = np.array([start.x, 0.0, AXIS_Z, 1.0])
    degrees = math.degrees(math.acos(min(1.0, 0.5 * (np.trace(off[:3, :3]) - 1.0))))
    return degrees, float(np.linalg.norm(found.T_target_source.numpy() @ axis - true @ axis))


def test_dots_tell_how_a_cylinder_rolls_and_slides_along_its_axis():
    background = torch.stack([SKIN.image(seed=100 + k) for k in range(4)]).mean(0)
    markers = FillMarkers.from_background(background)
    motion = SkinMotion(background, find_dots(background, markers), markers.diameter_px, PITCH, (0.0, 0.0, math.inf)).eval()
    rolls = [Roll(-0.6 + 0.2 * k) for k in range(7)]
    image, reference = rolls[0].frame(SKIN, 0)
    moved = motion(image, reference.depth_mm)
    plain, by_dots = PoseTracker(reference, PITCH), PoseTracker(reference, PITCH, moved)
    for k, roll in enumerate(rolls[1:], 1):
        image, frame = roll.frame(SKIN, k)
        moved = motion(image, frame.depth_mm, moved)
        found, without, true = by_dots(frame, moved), plain(frame), roll.pose(rolls[0])
        degrees, mm = errors(found, true, rolls[0])
        assert found.ambiguous == without.ambiguous == ["translation along y", "rotation about y"]
        assert degrees < 0.3 and mm < 0.01
        assert degrees < 3.0 * float(found.covariance.diagonal()[:3].sum().sqrt().rad2deg()) + 0.02
    assert min(a / b for a, b in zip(errors(without, true, rolls[0]), (degrees, mm))) > 10.0
    assert "by the dots" in found.message and float(without.covariance.diagonal()[4]) > 1.0
    assert "kept" in by_dots(frame).message  # without dots the measurement ends
    with pytest.raises(TypeError, match="moved: expected a DotMotion"):
        by_dots(frame, "dots")


def test_the_motion_of_points_is_found_and_too_few_are_refused():
    draw = np.random.default_rng(0)
    before = draw.uniform(-2.0, 2.0, (12, 3)) * (1.0, 1.0, 0.2) + (0.0, 0.0, 0.5)
    true = rigid_motion(np.array([0.02, -0.03, 0.05, 0.1, -0.2, 0.01]), np.zeros(3))
    after = before @ true[:3, :3].T + true[:3, 3]
    after[3] = np.nan
    after[5] += (0.5, 0.0, 0.0)  # one dot slips
    motion, covariance = carried(before, after)
    np.testing.assert_allclose(motion, true, atol=5e-3)
    assert covariance.shape == (6, 6) and float(np.linalg.eigvalsh(covariance)[0]) > 0.0
    assert carried(before[:3], after[:3]) is None and carried(np.full((9, 3), 1.0), np.full((9, 3), 1.0)) is None


def test_two_poses_are_fused_by_their_covariances():
    other = rigid_motion(np.array([0.0, 0.0, 0.01, 0.3, 0.0, 0.0]), np.zeros(3))
    pose, covariance = fused(np.eye(4), np.diag([1e-6] * 3 + [3.0] * 3), other, np.diag([1e-6] * 3 + [1.0] * 3))
    assert pose[0, 3] == pytest.approx(0.225, rel=1e-3) and pose[1, 0] == pytest.approx(0.005, rel=1e-3)
    np.testing.assert_allclose(np.diag(covariance), [5e-7] * 3 + [0.75] * 3)
