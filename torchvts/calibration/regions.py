"""Where in a frame a contact lies, by a floor that comes from the frame itself: a pressed skin changes its light everywhere."""

import functools
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..core.robust import TUKEY, tukey_weight
from ..model.response_field import position_basis

FAR_DEGREE = 2
"""Degree of the polynomial in position that stands for the change of the undeformed skin, in each channel."""

FLOOR = 5.0
"""A contact stands out of that polynomial by so many spreads of the undeformed skin."""

SETTLED = 1e-5
"""Change of its weights from which the fit of the polynomial has converged."""

LEAST_SPREAD = 0.003
"""Least spread, relative to the background: rounding to 8 bits."""

SECOND = 0.3
"""A blob with so much of the largest blob's change may be a second contact."""

SAME_BALL = 1.5
"""Blobs whose centroids lie within so many radii of the ball are lobes of one: two equal balls cannot come nearer than two."""

OTHER_LIGHT = 0.1
"""Undeformed skin changes by at most 6 % under presses of five real sensors, brightness aside. Other exposure, lights or units
change it by 13 to 30 %."""


class FarField(NamedTuple):
    """The change of the undeformed skin in one frame.

    Attributes:
        rms: length of its smooth part over the three channels, root mean square over the image.
        above: (H, W), change that is left, in spreads of the undeformed skin.
    """

    rms: float
    above: Tensor

    def is_other_light(self) -> bool:
        """Whether the light of the whole frame differs from the background's more than a contact explains."""
        return self.rms > OTHER_LIGHT


def far_field(change: Tensor) -> FarField:
    """Fit the change of the undeformed skin: a robust polynomial in position, started from the less changed half of the image.

    Args:
        change: (3, H, W), image / background - 1.
    """
    height, width = change.shape[1:]
    smooth = _mean_of_49(change)  # grain of JPEG and demosaicing
    basis = _basis(height, width, change.dtype)
    step = max(1, min(height, width) // 60)
    columns = basis[:, step // 2 :: step, step // 2 :: step].flatten(1).t()
    values = smooth[:, step // 2 :: step, step // 2 :: step].flatten(1).t()
    length = values.square().sum(1).sqrt()
    weight = (length <= length.median()).to(change.dtype)
    coefficient, spread = torch.zeros(basis.shape[0], 3, dtype=change.dtype), torch.ones(3, dtype=change.dtype)
    for _ in range(15):
        weighted = columns * weight[:, None]
        coefficient = torch.linalg.lstsq(weighted.t() @ columns, weighted.t() @ values, driver="gelsd").solution
        residual = values - columns @ coefficient
        spread = (residual[weight > 0].abs().median(dim=0).values / 0.6745).clamp_min(LEAST_SPREAD)
        before, weight = weight, tukey_weight((residual / spread).square().sum(1).sqrt() / (3**0.5 * TUKEY))
        if torch.allclose(weight, before, rtol=0.0, atol=SETTLED):
            break
        if int((weight > 0).sum()) < 2 * len(coefficient):  # nothing is alike: no far field
            coefficient = torch.zeros_like(coefficient)
            break
    field = torch.einsum("khw,kc->chw", basis, coefficient)
    above = ((smooth - field) / spread[:, None, None]).square().sum(0).sqrt()  # a hundred times as fast as norm(dim=0)
    return FarField(float(field.square().sum(0).mean().sqrt()), above)


@functools.lru_cache(maxsize=2)
def _basis(height: int, width: int, dtype: torch.dtype) -> Tensor:
    """Polynomials in position, (terms, H, W); all frames of a calibration share them."""
    y, x = torch.meshgrid(torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij")
    return position_basis(x.to(dtype), y.to(dtype), 1.0, FAR_DEGREE)


def _mean_of_49(image: Tensor) -> Tensor:
    """Mean of 7 x 7 pixels of (C, H, W), of those that lie in the image: a sixth of the time of ``avg_pool2d``."""
    for dim in (1, 2):
        reach, length = 3, image.shape[dim]
        total, place = image.clone(), torch.arange(length)
        for k in range(1, min(reach, length - 1) + 1):
            total.narrow(dim, k, length - k).add_(image.narrow(dim, 0, length - k))
            total.narrow(dim, 0, length - k).add_(image.narrow(dim, k, length - k))
        count = (place + reach).clamp_max(length - 1) - (place - reach).clamp_min(0) + 1
        image = total / (count[:, None] if dim == 1 else count)
    return image


def contact_region(far: FarField, mask: Tensor, ball_radius_px: float) -> Tensor:
    """The part of a mask that a contact takes, with the transition zone around it, bool (H, W).

    Blobs that stand out of the far field: the largest one, and others that are as strong. Of a ball, lobes are joined by their
    convex hull, because its contact is convex. Where nothing stands out, the mask itself.

    Args:
        far: of the frame.
        mask: (H, W), bool, what differs from the background by the noise of calibration.
        ball_radius_px: 0 for an unknown object.
    """
    blobs = strong_blobs(mask & (far.above > FLOOR), far.above)
    if not blobs:
        return mask
    if ball_radius_px > 0:
        parts = [_hull(blobs)] if one_ball(blobs, ball_radius_px) else [_hull([blob]) for blob in blobs]
    else:
        parts = [blob.mask for blob in blobs]
    return torch.from_numpy(np.maximum.reduce([_grown(part) for part in parts])) > 0


class Blob(NamedTuple):
    """A connected part of a mask.

    Attributes:
        mask: (H, W), uint8.
        centroid: (x, y), pixels.
        weight: sum of the strength of its pixels.
    """

    mask: Any
    centroid: tuple[float, float]
    weight: float


def strong_blobs(mask: Tensor, strength: Tensor, share: float = SECOND) -> list[Blob]:
    """Connected blobs of an (H, W) mask that hold at least this share of the largest one's strength, the strongest first."""
    import cv2

    count, labels, _, centroids = cv2.connectedComponentsWithStats(mask.numpy().astype(np.uint8))
    weights = np.bincount(labels.ravel(), weights=(strength * mask).numpy().ravel(), minlength=count)[1:]
    if count < 2 or weights.max() <= 0:
        return []
    chosen = [k for k in np.argsort(-weights) if weights[k] >= share * weights.max()]
    return [Blob((labels == k + 1).astype(np.uint8), tuple(centroids[k + 1]), float(weights[k])) for k in chosen]


def one_ball(blobs: list[Blob], ball_radius_px: float) -> bool:
    """Whether blobs can be lobes of one ball's contact."""
    places = torch.tensor([blob.centroid for blob in blobs], dtype=torch.float64)
    return float(torch.cdist(places, places).max()) < SAME_BALL * ball_radius_px


def _hull(blobs: list[Blob]) -> Any:
    """(H, W) uint8: the convex hull of blobs."""
    import cv2

    joint = np.maximum.reduce([blob.mask for blob in blobs])
    return cv2.fillConvexPoly(joint.copy(), cv2.convexHull(cv2.findNonZero(joint)), 1)


def _grown(mask: Any) -> Any:
    """A uint8 mask grown by a fifth of its radius: the transition zone fades below the floor."""
    import cv2

    reach = max(1, round(0.2 * (float(mask.sum()) / np.pi) ** 0.5))
    return cv2.dilate(mask, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1)))
