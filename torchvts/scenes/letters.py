"""Capital letters as strokes: segments in mm, and the distance of points to them."""

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor

from ..core.checks import check_float_tensor, check_numbers, check_positive, check_sequence, check_shape

Segment = tuple[tuple[float, float], tuple[float, float]]
"""Start and end of a stroke, (x, y) in mm."""


def letter_segments(text: str, size_mm: float) -> list[Segment]:
    """Strokes of capital letters as segments in mm; the middle of the text is at zero, y points down.

    Args:
        text: capital letters A-Z and spaces.
        size_mm: height of a letter, mm.
    Raises:
        ValueError: a character that is not a capital letter, or an empty text.
    """
    if not isinstance(text, str):
        raise TypeError(f"text: expected capital letters A-Z and spaces, got {type(text).__name__}")
    size_mm = check_positive("size_mm", size_mm)
    unknown = sorted({letter for letter in text if letter != " " and letter not in _STROKES})
    if unknown or not text.strip():
        raise ValueError(f"text: expected capital letters A-Z and spaces, got {text!r}")
    unit = size_mm / 6.0
    left = -0.5 * unit * (6.0 * len(text) - 2.0)
    segments: list[Segment] = []
    for index, letter in enumerate(text):
        for line in _STROKES.get(letter, "").split():
            corners = [
                (left + unit * (int(x) + 6.0 * index), unit * (3.0 - int(y))) for x, y in zip(line[::2], line[1::2], strict=True)
            ]
            segments += list(itertools.pairwise(corners))
    return segments


def distance_to_segments(x: Tensor, y: Tensor, segments: Sequence[Segment]) -> Tensor:
    """Distance of each point (x, y) to the nearest segment, mm."""
    check_float_tensor("x", x)
    check_float_tensor("y", y)
    check_sequence("segments", segments, "segments")
    check_shape("y", y, x.shape, "x")
    check_numbers("segments", list(segments), (max(1, len(segments)), 2, 2))
    distance = torch.full_like(x, torch.inf)
    for start, end in segments:
        dx, dy = end[0] - start[0], end[1] - start[1]
        along = (((x - start[0]) * dx + (y - start[1]) * dy) / (dx * dx + dy * dy)).clamp(0.0, 1.0)
        away = torch.sqrt((x - start[0] - along * dx) ** 2 + (y - start[1] - along * dy) ** 2 + 1e-18)
        distance = torch.minimum(distance, away)
    return distance


# Strokes of capital letters on a grid 4 wide and 6 high, y up: pairs of digits are corners; a space starts a new stroke.
_BOWL, _RING = "00063645443303", "103041453616050110"
_STROKES = {
    "A": "002640 1232", "B": _BOWL + " 3342413000", "C": "4536160501103041", "D": "00062644422000", "E": "46060040 0333",
    "F": "000646 0333", "G": "45361605011030414323", "H": "0006 4046 0343", "I": "2026 1030 1636", "J": "4641301001",
    "K": "0006 4603 0340", "L": "060040", "M": "0006234640", "N": "00064046", "O": _RING, "P": _BOWL, "Q": _RING + " 2240",
    "R": _BOWL + " 2340", "S": "453616050413334241301001", "T": "2026 0646", "U": "060110304146", "V": "062046",
    "W": "0610243046", "X": "0046 0640", "Y": "2023 062346", "Z": "06460040",
}  # fmt: skip
