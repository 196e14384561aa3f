"""How the objects of the tracking bench move."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchvts.scenes import objects


@dataclass(frozen=True)
class Motion:
    """How an object moves.

    Attributes:
        frames: number of frames, the reference among them.
        pose: T_sensor_object (4, 4) of a frame, from its number and a seed.
        lost: frames that must be reported as lost.
        again: frames that are the one before once more, as of a camera that stands still for a while.
    """

    frames: int
    pose: Callable[[int, int], Tensor]
    lost: tuple[int, ...] = ()
    again: tuple[int, ...] = ()


def _phases(seed: int) -> list[float]:
    return (2.0 * math.pi * torch.rand(5, generator=torch.Generator().manual_seed(seed))).tolist()


def _sweep(turn_deg: float, frames: int, shift_mm: float = 1.0, tilt_deg: float = 2.5) -> Callable[[int, int], Tensor]:
    """Yaw at an even rate, with shifts and tilts of such amplitudes on the way."""

    def pose(k: int, seed: int) -> Tensor:
        a, b, c, d, e = _phases(seed)
        s = 2.0 * math.pi * k / (frames - 1)
        shift = (shift_mm * (math.sin(s + a) - math.sin(a)), shift_mm * (math.sin(1.5 * s + b) - math.sin(b)))
        tilt = (tilt_deg * math.sin(2.0 * s + c), tilt_deg * math.cos(1.5 * s + d))
        return objects.pose(turn_deg * k / (frames - 1), shift, 0.45 + 0.1 * math.sin(s + e), tilt)

    return pose


def _partial(k: int, seed: int) -> Tensor:
    """From the middle to beyond the edge of the image and back, tilted so that a part of the object touches."""
    a, b = _phases(seed)[:2]
    out = 7.0 * math.sin(math.pi * k / 39)
    return objects.pose(1.0 * k, (out * math.cos(a), out * math.sin(a)), 0.4, (3.5 * math.sin(b + 0.1 * k), 3.5 * math.cos(b)))


def _slip(k: int, seed: int) -> Tensor:
    """Still, then 0.5 mm and 2 degrees from frame to frame for six frames, then still."""
    a = _phases(seed)[0]
    gone = float(min(max(k - 8, 0), 6))
    return objects.pose(2.0 * gone, (0.5 * gone * math.cos(a), 0.5 * gone * math.sin(a)), 0.45, (1.0, 0.5))


def _lift_off(k: int, seed: int) -> Tensor:
    """Lifted off in five frames, away for four, put back elsewhere in five."""
    a = _phases(seed)[0]
    deep = 0.5 - 0.2 * min(max(k - 4, 0), max(18 - k, 0), 5)
    back = k >= 11
    return objects.pose(25.0 * back, (1.5 * math.cos(a) * back, 1.5 * math.sin(a) * back), deep)


def _jump(k: int, seed: int) -> Tensor:
    """Slow, then 3 mm and 40 degrees at once, then slow."""
    a, jumped = _phases(seed)[0], float(k >= 10)
    return objects.pose(0.5 * k + 40.0 * jumped, (3.0 * jumped * math.cos(a), 3.0 * jumped * math.sin(a)), 0.45, (1.0, 1.0))


_AGAIN = (1, 2, 3, *range(14, 24))


def _paused(k: int, seed: int) -> Tensor:
    """As slow, but for frames that come again: three after the reference, and ten later on."""
    return _sweep(90.0, 40)(k - sum(frame <= k for frame in _AGAIN), seed)


MOTIONS = {
    "slow": Motion(40, _sweep(90.0, 40)),
    "fast": Motion(14, _sweep(90.0, 14)),
    "full turn": Motion(120, _sweep(360.0, 120)),
    "partial contact": Motion(40, _partial),
    "slip": Motion(20, _slip),
    "lift-off": Motion(24, _lift_off, (9, 10, 11, 12, 13)),
    "jump": Motion(20, _jump, (10,)),
    "paused": Motion(34, _paused, again=_AGAIN),
}
