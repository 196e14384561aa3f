"""Azimuths of a sensor file that an image contradicts, in words."""

import itertools
import math
from collections.abc import Sequence

from torch import Tensor

CHANNELS = ("red", "green", "blue")


def azimuths_deg(position_mm: Tensor) -> list[float]:
    """Azimuth of each light (3, 3) around the image centre, degrees in [0, 360), from x (right) towards y (down)."""
    return [math.degrees(math.atan2(y, x)) % 360.0 for x, y in position_mm[:, :2].tolist()]


def wrong_azimuths(position_mm: Tensor, given_deg: Sequence[float], slack_deg: float) -> str:
    """What the image shows in place of the azimuths of the sensor file, and the usual cause.

    Args:
        position_mm: (3, 3), lights that the image gives.
        given_deg: azimuths of the sensor file.
        slack_deg: a difference that is none.
    Example:
        >>> import torch
        >>> lights = torch.tensor([[1.0, 0.0, 1.0], [-0.5, 0.866, 1.0], [-0.5, -0.866, 1.0]])
        >>> wrong_azimuths(lights, (240.0, 120.0, 0.0), 10.0)
        'wrong azimuths: light_azimuth_deg says 240, 120, 0 for R, G, B, the image shows 0, 120, 240: red and blue are swapped'
    """
    found = azimuths_deg(position_mm)
    text = f"wrong azimuths: light_azimuth_deg says {_listed(given_deg)} for R, G, B, the image shows {_listed(found)}"
    return f"{text}: {_cause(found, given_deg, slack_deg)}"


def _cause(found: Sequence[float], given: Sequence[float], slack_deg: float) -> str:
    for order in itertools.permutations(range(3)):
        if all(_off(found[k], given[order[k]]) <= slack_deg for k in range(3)):
            moved = [CHANNELS[k] for k in range(3) if order[k] != k]
            return f"{' and '.join(moved)} are swapped" if len(moved) == 2 else "the channels are in another order"
    if all(_off(a, -b) <= slack_deg for a, b in zip(found, given)):
        return "they are counted from x towards y, which points down"
    turn = (found[0] - given[0] + 180.0) % 360.0 - 180.0
    if all(_off(a, b + turn) <= slack_deg for a, b in zip(found, given)):
        return f"all are turned by {turn:.0f}: is the image rotated or flipped?"
    return "correct them in the sensor file, or leave them out"


def _off(a: float, b: float) -> float:
    return abs((a - b + 180.0) % 360.0 - 180.0)


def _listed(angles: Sequence[float]) -> str:
    return ", ".join(f"{round(angle) % 360}" for angle in angles)
