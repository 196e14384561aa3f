"""Fit a response model to located presses: the field's posterior, and what depth does to brightness."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from ..model.response_field import (
    DepthBrightness,
    ResponseField,
    ResponseModel,
    SensorPrior,
    position_basis,
)
from ..model.sensor import Sensor
from ..model.stated_error import StatedError
from .contacts import Contact, NoUsablePress, first_pass_depths
from .field import Family, ball_sine
from .outliers import locate_and_weigh
from .posterior import FEW, Evidence, largest, prior_of

DEPTH_DEGREE = 2
"""Degree in position of what depth does to brightness."""

DEPTH_PENALTY = 0.1
"""Regularisation of it towards zero, in presses times mm^2: (0.03 / 0.1)^2, because sines are right to about 0.03, and a skin that
comes 1 mm nearer to lights about 10 mm away changes its brightness by about 0.1."""

DEPTH_PENALTY_ON_PRIOR = 3.0
"""The same towards a prior, from which units of a type differ by about 0.03 per mm, and the error of a press is alike all over it,
so that its pixels do not average it: (0.05 / 0.03)^2."""

STEEPER = 1.0
"""``steeper`` of a :class:`DepthBrightness`, times half the longer side of the image: 3 h / d^2 of lights 1.2 to 1.6 times that
far out and 0.6 to 1.4 times that high is 0.6 to 1.2. It is not fitted: at the rim of a ball the skin is shallow and steep, and
leaves the ball, so balls teach a wrong value (docs/decisions.md)."""


class ResponseFit(NamedTuple):
    """A response model fitted to presses.

    Attributes:
        model: the fields.
        covariance: (K, K), of the coefficients of the field.
        own_deg: mean error on the presses themselves, degrees.
        held_out_deg: mean error on each press by the others, degrees; None with fewer than :data:`FEW`.
        stated_deg: error to expect of slopes like the presses', anywhere on the skin, by the covariance, degrees.
    """

    model: ResponseModel
    covariance: Tensor
    own_deg: float
    held_out_deg: float | None
    stated_deg: float


def fit_response(contacts: list[Contact], sensor: Sensor, prior: SensorPrior | None, progress: bool = False) -> ResponseFit:
    """Locate the balls, weigh the presses, and fit.

    Args:
        contacts: from :func:`read_contacts`, of presses; changed in place.
        sensor: the sensor, with the gamma and blur of the contacts' preprocessing.
        prior: of the sensor's type, or None.
        progress: show a bar.
    Raises:
        NoUsablePress: no press is left; says what became of each.
    """
    pitch = sensor.mm_per_pixel
    half_mm = 0.5 * sensor.width * pitch if prior is None else prior.response.field.half_mm
    with tqdm(total=3, desc="calibrating from presses", disable=not progress or None, leave=False) as bar:
        bar.set_postfix(step="balls")
        presses = locate_and_weigh(contacts, sensor, prior, half_mm)
        if not presses:
            raise NoUsablePress(contacts)
        bar.update()
        bar.set_postfix(step="field")
        evidence = Evidence(largest(half_mm), presses)
        before = prior_of(evidence.family, presses, prior)
        found = evidence.posterior(before)
        own_deg = _mean(evidence.errors_deg([found.mean] * len(presses)), evidence.weights)
        held_out_deg = None
        if len(presses) >= FEW:
            held_out_deg = _mean(evidence.held_out_deg(before), evidence.weights)
        bar.update()
        bar.set_postfix(step="depth")
        by_depth = fit_depth_brightness(presses, found.field, pitch, None if prior is None else prior.response.by_depth)
        bar.update()
    model = ResponseModel(found.field, by_depth, sensor.exponent, sensor.blur_px)
    # of the presses' changes of light, all over the skin
    changes = torch.cat([contact.change.flatten(1)[:, contact.index[contact.inside()]] for contact in presses], 1)
    error = StatedError(own_deg, found.covariance, found.field, sensor.height, sensor.width, pitch)
    stated = error.anywhere(changes[:, :: max(1, changes.shape[1] // 300)])
    return ResponseFit(model, found.covariance, own_deg, held_out_deg, stated)


def _mean(errors_deg: Sequence[float], weights: Tensor) -> float:
    return float((torch.tensor(errors_deg, dtype=torch.float64) * weights).sum() / weights.sum())


def fit_depth_brightness(
    contacts: list[Contact], field: ResponseField, pitch_mm: float, prior: DepthBrightness | None = None
) -> DepthBrightness:
    """What depth does to brightness, by presses that are located: linear least squares on what a field leaves of their sines.

    Balls could teach a second pass much more, but what it learns beyond this holds for balls only (docs/decisions.md). What depth
    does to slopes is therefore that of usual lights, beyond the mean depth of the presses.

    Args:
        contacts: of presses.
        field: of the first pass.
        pitch_mm: pixel pitch, mm.
        prior: regularises the result; None regularises it to zero.
    """
    size = (DEPTH_DEGREE + 1) * (DEPTH_DEGREE + 2) // 2
    start = torch.zeros(3, size, dtype=torch.float64)
    if prior is not None:
        start[:, : prior.tensor().shape[1]] = prior.tensor()
    penalty = DEPTH_PENALTY if prior is None else DEPTH_PENALTY_ON_PRIOR
    form = penalty * torch.eye(3 * size, dtype=torch.float64)
    right = torch.zeros(3 * size, dtype=torch.float64)
    depths = first_pass_depths(contacts, field, pitch_mm)
    for contact, depth in zip(contacts, depths):
        inside = contact.inside()
        effect, left = _effect_of_depth(contact, field, depth, start)
        columns = effect[:, :, inside].reshape(3 * size, -1)
        form += contact.weight * columns @ columns.t() / int(inside.sum())
        right += contact.weight * columns @ left[:, inside].reshape(-1) / int(inside.sum())
    found = start + torch.linalg.solve(form, right).reshape(3, size)
    steeper = STEEPER / float(contacts[0].half_size_mm.max())
    rows = tuple(tuple(row) for row in found.tolist())
    return DepthBrightness(DEPTH_DEGREE, field.half_mm, rows, steeper, _mean_depth(contacts, depths))


def _mean_depth(contacts: list[Contact], depths: list[Tensor]) -> float:
    """Mean depth (H, W) of presses, mm, each pixel by the square of its sine: the depth at which a field fitted to them holds."""
    total, weights = 0.0, 0.0
    for contact, depth in zip(contacts, depths):
        inside = contact.inside()
        weight = ball_sine(contact)[:, inside].square().sum(0) / int(inside.sum())
        total += float((weight * depth.flatten()[contact.index[inside]]).sum())
        weights += float(weight.sum())
    return max(0.0, total / max(weights, 1e-12))


def _effect_of_depth(contact: Contact, field: ResponseField, depth: Tensor, start: Tensor) -> tuple[Tensor, Tensor]:
    """At the sampled pixels the derivative (3 K, 2, N) of the sines by the coefficients of a :class:`DepthBrightness`, and what the
    sines lack of the ball's with the coefficients ``start`` (3, K)."""
    family, weight, step = Family.of(field), field.tensor(), 1e-4
    basis = position_basis(contact.x, contact.y, field.half_mm, DEPTH_DEGREE) * depth.flatten()[contact.index]  # (K, N)
    change = contact.change.flatten(1)[:, contact.index] - start @ basis
    sine = weight @ family.terms_of(contact, change)
    shifts = step * torch.eye(3, dtype=torch.float64)[:, :, None]
    slopes = [(weight @ family.terms_of(contact, change + shift) - sine) / step for shift in shifts]
    effect = torch.cat([-slope[None] * basis[:, None] for slope in slopes])
    return effect, ball_sine(contact) - sine
