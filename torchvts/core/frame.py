"""What the blocks of the online path hand to each other: a frame and its solution."""

from typing import NamedTuple

from torch import Tensor


class Frame(NamedTuple):
    """Compensated images (B, 3, H, W), and the weight (B, 1, H, W) in [0, 1], how surely the skin has moved."""

    image: Tensor
    weight: Tensor


class Solution(NamedTuple):
    """gradient (B, 2, H, W), mm per mm, times the weight; depth_mm (B, 1, H, W), from the undeformed skin."""

    gradient: Tensor
    depth_mm: Tensor


class DepthOutput(NamedTuple):
    """Depth, its slopes and two masks of each frame.

    Attributes:
        depth_mm: (B, 1, H, W), positive where the skin is pressed in.
        gradient: (B, 2, H, W), mm per mm.
        normal: (B, 3, H, W), unit.
        contact: (B, 1, H, W) bool, where the object touches the skin.
        deformed: (B, 1, H, W) bool, where the skin has moved: the contact and the skin that hangs free around it.
    """

    depth_mm: Tensor
    gradient: Tensor
    normal: Tensor
    contact: Tensor
    deformed: Tensor


class Conditions(NamedTuple):
    """What frames were seen under.

    Attributes:
        light: (B, 3, 6), the light over the background's, a surface in each channel: coefficients of 1, x, y, P2(x), x y, P2(y),
            Legendre polynomials over the image, each of mean square 1. 1, 0, 0, 0, 0, 0 where nothing has changed.
        lost: (B, 3), share of each channel that is black or saturated where the background is not.
        unseen_deg: (B,), slope below which skin looks like the undeformed skin of the frame, degrees.
    """

    light: Tensor
    lost: Tensor
    unseen_deg: Tensor
