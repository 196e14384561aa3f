"""Where in a frame a contact lies, by a floor that comes from the frame itself."""

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..skin.weight import spread_of

FLOOR = 5.0
"""Threshold of a contact, in standard deviations of the undeformed skin's change."""

LIGHT_DRIFT = 0.008
"""Least noise and spread by which a press differs from the background, relative: the LEDs of real sensors drift by 1 to 2 %."""

SECOND = 0.3
"""A blob with so much of the largest blob's change may be a second contact."""

SAME_BALL = 1.5
"""Blobs whose centroids lie within so many radii of the ball are lobes of one: two equal balls cannot come nearer than two."""


def above_skin(change: Tensor) -> tuple[Tensor, float]:
    """How far the change of each pixel stands out of that of the undeformed skin, (H, W), in standard deviations; and these, RMS.

    Args:
        change: (3, H, W), image / background - 1, relit.
    """
    smooth = torch.nn.functional.avg_pool2d(change[None], 7, 1, 3, count_include_pad=False)[0]  # grain of JPEG and demosaicing
    step = max(1, min(change.shape[1:]) // 60)
    spread = spread_of(smooth[:, step // 2 :: step, step // 2 :: step].abs().flatten(1)[None], LIGHT_DRIFT)[0]  # (3, 1)
    # a hundred times as fast as norm(dim=0)
    return (smooth / spread[..., None]).square().sum(0).sqrt(), float(spread.square().mean().sqrt())


def contact_region(above: Tensor, mask: Tensor, ball_radius_px: float) -> Tensor:
    """The part of a mask that a contact takes, with the transition zone around it, bool (H, W).

    Blobs that stand out of the undeformed skin: the largest one, and others that are as strong. Lobes of a ball are joined by
    their convex hull, because its contact is convex. Where nothing stands out, the mask itself.

    Args:
        above: (H, W), how far each pixel stands out, see :func:`above_skin`.
        mask: (H, W), bool, what differs from the background by the noise of calibration.
        ball_radius_px: of the ball.
    """
    blobs = strong_blobs(mask & (above > FLOOR), above)
    if not blobs:
        return mask
    parts = [_hull(blobs)] if one_ball(blobs, ball_radius_px) else [_hull([blob]) for blob in blobs]
    return torch.from_numpy(np.maximum.reduce([_grown(part) for part in parts])) > 0


class Blob(NamedTuple):
    """A connected part of a mask.

    Attributes:
        mask: (H, W), uint8.
        centroid: (x, y), pixels.
    """

    mask: Any
    centroid: tuple[float, float]


def strong_blobs(mask: Tensor, strength: Tensor, share: float = SECOND) -> list[Blob]:
    """Connected blobs of an (H, W) mask that hold at least this share of the largest one's strength, the strongest first."""
    import cv2

    count, labels, _, centroids = cv2.connectedComponentsWithStats(mask.numpy().astype(np.uint8))
    weights = np.bincount(labels.ravel(), weights=(strength * mask).numpy().ravel(), minlength=count)[1:]
    if count < 2 or weights.max() <= 0:
        return []
    chosen = [k for k in np.argsort(-weights) if weights[k] >= share * weights.max()]
    return [Blob((labels == k + 1).astype(np.uint8), tuple(centroids[k + 1])) for k in chosen]


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
