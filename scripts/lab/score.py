"""Score of one frame: against the ball of known size that was pressed, or against an exact surface."""

import dataclasses
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchvts.calibration import Press
from torchvts.core.geometry import normal_from_gradient, pixel_grid_mm
from torchvts.training.balls import RIM_PX, Truth, ball_truth

from .metrics import fit_sphere, mask_iou, normal_angle_deg


@dataclass(frozen=True)
class PressScore:
    """Errors of one method on one press, in the region of its truth.

    Attributes:
        press: name of the press.
        method: name of the method.
        lowest_mm: least depth of the whole frame, mm: below zero the skin seems to bulge out.
        normal_deg: mean angle between normals, degrees; None, as all that follows, where it is not known.
        depth_normal_deg: the same of the normals of the depth.
        relief_um: RMS difference of depth and truth, each less its own mean, micrometres.
        tilt_um: the part of ``relief_um`` that is a plane: the effect of a wrong label of the centre, and of errors that a
            response field makes alike all over a contact.
        depth_um: mean difference of depth and truth, micrometres: below zero depth is too small; None where truth is known up to a
            constant only, as of balls whose depth below the undeformed skin nobody measured.
        iou: intersection over union of the contact found and the true one.
        radius_percent: error of the radius of a sphere fitted to the depth of a ball, percent; None where the depth is a plane.
    """

    press: str
    method: str
    lowest_mm: float
    normal_deg: float | None = None
    depth_normal_deg: float | None = None
    relief_um: float | None = None
    tilt_um: float | None = None
    depth_um: float | None = None
    iou: float | None = None
    radius_percent: float | None = None

    @property
    def level_um(self) -> float | None:
        """The part of ``relief_um`` that is no tilt, micrometres."""
        if self.relief_um is None or self.tilt_um is None:
            return None
        return math.sqrt(max(0.0, self.relief_um**2 - self.tilt_um**2))


def score_press(
    press: Press, depth_mm: Tensor, normal: Tensor, mm_per_pixel: float, method: str = "", contact: Tensor | None = None
) -> PressScore:
    """Compare one frame with the ball that was pressed.

    Args:
        press: press with centre and contact radius.
        depth_mm: (1, 1, H, W), measured depth, mm.
        normal: (1, 3, H, W), measured unit normals.
        mm_per_pixel: pixel pitch, mm.
        method: name that is kept with the score.
        contact: (1, 1, H, W) bool, measured contact; None leaves it out.
    Raises:
        ValueError: wrong shapes, a missing centre or contact radius, or a region too small for a sphere.
    Example:
        >>> press = Press(torch.zeros(3, 31, 31), 6.0, "middle", (15.0, 15.0), 13.0)
        >>> truth = ball_truth(press, 31, 31, 0.1)
        >>> score = score_press(press, truth.depth_mm, normal_from_gradient(truth.gradient), 0.1)
        >>> round(score.normal_deg, 6), round(score.relief_um, 6), round(abs(score.radius_percent), 6)
        (0.0, 0.0, 0.0)
    """
    truth = ball_truth(press, depth_mm.shape[2], depth_mm.shape[3], mm_per_pixel)
    if int(truth.region.sum()) < 10:
        raise ValueError(
            f"press: '{press.name}' has {int(truth.region.sum())} pixels {RIM_PX:g} px inside its contact radius of "
            f"{press.contact_radius_px:g} px, 10 are needed: pressed too faintly, or outside of the image"
        )
    radius_percent = _radius_percent(press, depth_mm.detach().cpu().double(), truth, mm_per_pixel)
    score = score_surface(truth, depth_mm, normal, mm_per_pixel, press.name, method, contact)
    return dataclasses.replace(score, radius_percent=radius_percent)


def score_surface(
    truth: Truth, depth_mm: Tensor, normal: Tensor, mm_per_pixel: float, name: str, method: str = "", contact: Tensor | None = None
) -> PressScore:
    """Compare one frame with a known surface: :func:`score_press` without what only a ball has.

    Args:
        truth: the surface, with at least one pixel to score.
        depth_mm: (1, 1, H, W), measured depth, mm.
        normal: (1, 3, H, W), measured unit normals.
        mm_per_pixel: pixel pitch, mm.
        name: name of the press that is kept with the score.
        method: name that is kept with the score.
        contact: (1, 1, H, W) bool, measured contact; None leaves it out.
    Raises:
        ValueError: wrong shapes, or an empty region.
    Example:
        >>> truth = ball_truth(Press(torch.zeros(3, 31, 31), 6.0, "middle", (15.0, 15.0), 13.0), 31, 31, 0.1)
        >>> score = score_surface(truth, truth.depth_mm - 0.1, normal_from_gradient(truth.gradient), 0.1, "too low")
        >>> abs(round(score.relief_um, 6)), round(score.normal_deg, 6)
        (0.0, 0.0)
    """
    if not bool(truth.region.any()):
        raise ValueError(f"truth: expected at least one pixel to score, '{name}' has none: nothing touches")
    depth, region = depth_mm.detach().cpu().double(), truth.region[0, 0]
    true_normal = normal_from_gradient(truth.gradient)
    slope = torch.stack(torch.gradient(depth[0, 0], spacing=mm_per_pixel)[::-1])[None]  # torch gives rows first
    error = (depth - truth.depth_mm)[0, 0][region]
    return PressScore(
        press=name,
        method=method,
        lowest_mm=float(depth.min()),
        normal_deg=float(normal_angle_deg(normal.detach().cpu().double(), true_normal, truth.region).mean()),
        depth_normal_deg=float(normal_angle_deg(normal_from_gradient(slope), true_normal, truth.region).mean()),
        relief_um=1000.0 * float(error.std(correction=0)),
        tilt_um=1000.0 * _tilt(error, torch.nonzero(region).t()),
        depth_um=1000.0 * float(error.mean()) if truth.from_undeformed else None,
        iou=None if contact is None or truth.contact is None else mask_iou(contact.cpu(), truth.contact),
    )


def _tilt(error: Tensor, place: Tensor) -> float:
    """RMS of the plane that fits error (N,) at places (2, N) best, less its mean."""
    across = (place - place.double().mean(1, keepdim=True)).t()
    plane = across @ torch.linalg.lstsq(across, (error - error.mean())[:, None]).solution
    return float(plane.std(correction=0))


def _radius_percent(press: Press, depth_mm: Tensor, truth: Truth, mm_per_pixel: float) -> float | None:
    """Error of the radius of the sphere through the depth, percent; None for a plane."""
    height, width = depth_mm.shape[2:]
    x, y = pixel_grid_mm(height, width, mm_per_pixel, torch.float64)
    columns = torch.stack((x.expand(height, width), y.expand(height, width), torch.ones(height, width, dtype=torch.float64)), -1)
    region = truth.region[0, 0]
    z = depth_mm[0, 0][region]
    plane = torch.linalg.lstsq(columns[region], z[:, None]).solution[:, 0]
    if float((columns[region] @ plane - z).abs().max()) < 1e-6:
        return None
    sphere = fit_sphere(depth_mm, mm_per_pixel, truth.region)
    if not math.isfinite(sphere.radius_mm):
        return None
    return 100.0 * abs(sphere.radius_mm / (0.5 * press.ball_diameter_mm) - 1.0)
