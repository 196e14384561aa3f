"""Keyframes: frames that others are registered to, with everything that is computed once of them."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.linalg import inv

from .ambiguity import unknown_motions
from .grids import Grids, Resolution, Surface, checked_grids, resolution_of
from .height_errors import HeightErrors, height_errors
from .inverse import FINE_WINDOW, Points, center_and_units, points_of
from .rigid import Array, moved_covariance, orthonormal, rotation_vector
from .uncertainty import PARTS, in_parts, shared_error

SOME, MANY = 2000, 8000
"""Pixels of a reference for all steps of a refinement but the last, and for the last. They are evenly spread: pixels chosen by what
they say of the motion lie on steep flanks, where slopes err most; with 4,000 of these the median rotation error of six objects was
0.024 to 0.071 degrees, with 4,000 spread ones 0.018 to 0.036, with the two stages 0.012 to 0.024."""

CELL = 2
"""Pixels of the coarse grid a side of a cell of :mod:`.height_errors`, 0.5 mm of 20."""


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A frame that others are registered to.

    Attributes:
        grids: its grids, which new frames are compared with backwards.
        resolution: of all frames that are registered to it.
        coarse: pixels of the coarse grid.
        some: pixels of the fine grid for most steps, and
        many: for the last one; part after part.
        heights: cells of ``some``, and how their heights err.
        spread: (4, 4), mean of the products of points (x, y, z, 1) of the contact, mm.
        held: (6, k) scaled twists that the whole contact does not determine.
        shared_error: how many times larger the variance of a pose is than its parts show.
    """

    grids: Grids
    resolution: Resolution
    coarse: Points
    some: Points
    many: Points
    heights: HeightErrors
    spread: Array
    held: Array
    shared_error: float

    @cached_property
    def known(self) -> Array:
        """Orthonormal scaled twists (6, k) that slopes may show: neither those held, nor the shift along z, which heights show."""
        beside = np.hstack((self.held, np.eye(6)[:, 5:]))
        return np.linalg.qr(beside, mode="complete")[0][:, beside.shape[1] :]


def make_keyframe(surface: Surface, mm_per_pixel: float, name: str = "reference") -> Keyframe:
    """Everything that is computed once of a reference.

    Raises:
        ValueError: a contact too small or too faint.
    """
    resolution = resolution_of(surface, mm_per_pixel, name)
    made = checked_grids(surface, mm_per_pixel, resolution, name)
    row, column = made.fine.pixels()
    whole = made.fine.points(row, column)
    center, units = center_and_units(whole)

    def thinned(most: int) -> Points:
        """At most so many of the pixels, evenly spread, those of each of PARTS compact parts in a run."""
        number = max(1, min(most, len(row)) // PARTS) * PARTS  # so that parts are the same number exactly
        chosen = np.linspace(0, len(row) - 1, number).astype(int)
        chosen = chosen[in_parts(whole[:2, chosen].T)]
        return points_of(made.fine, row[chosen], column[chosen], center, units, FINE_WINDOW)

    some, many = thinned(SOME), thinned(MANY)
    coarse = points_of(made.coarse, *made.coarse.pixels(), center, units)
    few = np.vstack((whole[:3, :: max(1, whole.shape[1] // 64)].astype(float), np.ones(len(row[:: max(1, whole.shape[1] // 64)]))))
    return Keyframe(
        grids=made,
        resolution=resolution,
        coarse=coarse,
        some=some,
        many=many,
        heights=height_errors(surface.gradient, surface.skin, mm_per_pixel, CELL * resolution.times[1], some),
        spread=few @ few.T / few.shape[1],
        held=unknown_motions(made.coarse, coarse, resolution.noise),
        shared_error=shared_error(many.columns[:2].double().numpy().T, PARTS),
    )


class KeyframeGraph:
    """Keyframes, the first of which is the reference, and the best known way to each.

    Attributes:
        keyframes: the keyframes.
        poses: T_keyframe_reference (4, 4) of each.
        covariances: (6, 6) of a small motion after each of these poses, rad and mm.
    """

    def __init__(self, reference: Keyframe) -> None:
        self.keyframes = [reference]
        self.poses = [np.eye(4)]
        self.covariances = [np.zeros((6, 6))]

    def add(self, keyframe: Keyframe, source: int, pose: Array, covariance: Array) -> int:
        """Add a keyframe with its registration T_new_source; returns its index."""
        self.keyframes.append(keyframe)
        self.poses.append(orthonormal(pose @ self.poses[source]))
        self.covariances.append(covariance + moved_covariance(pose, self.covariances[source]))
        return len(self.poses) - 1

    def close(self, index: int, source: int, pose: Array, covariance: Array) -> Array:
        """Close a loop by a registration T_index_source; a keyframe whose pose it knows better is there from now on.

        Returns:
            The contradiction between both ways, a twist (6,).
        """
        by_loop = orthonormal(pose @ self.poses[source])
        spread = covariance + moved_covariance(pose, self.covariances[source])
        off = self.poses[index] @ inv(by_loop)
        if np.trace(spread) < np.trace(self.covariances[index]):
            self.poses[index], self.covariances[index] = by_loop, spread
        return np.concatenate((rotation_vector(off[:3, :3]), off[:3, 3]))
