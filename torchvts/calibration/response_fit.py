"""Fit response fields to located presses: the smallest family that explains each press by the others."""

import dataclasses
import functools
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from ..core.geometry import lengths
from ..model.report import CandidateRow
from ..model.response_field import DepthBrightness, ResponseField, ResponseModel, TaughtRange, position_basis
from ..model.sensor import Sensor
from .contacts import Contact, NoUsablePress, first_pass_depths
from .field import PRODUCT_PENALTY, Evidence, Family, ball_sine
from .outliers import locate_and_screen, name_of_start
from .touches import presses_as_touches, scale_by_presses, scaled

FAMILIES = ((0, -1, -1), (1, -1, -1), (2, -1, -1), (2, 1, -1), (2, 1, 0), (3, 2, -1), (3, 2, 1), (4, 3, -1))
"""Degrees of candidates, linear terms, products of two and of three, the smallest first."""

PENALTIES = (0.03, 0.01, 0.003, 0.001, 0.0003)
PENALTIES_ON_START = (10.0, 3.0, 1.0, 0.3, 0.1, 0.03)
"""Regularisation strengths, in presses, the strongest first: towards zero, and towards a start such as a prior."""

WORTH = 0.02
"""A larger family must lower the held-out error by this part of it, and by more than its standard error over the presses: the best
of thirty candidates on three presses is a matter of chance."""

ENOUGH = 5
"""Presses from which a field is fitted without a start. Fewer, without a prior, start from the field that they give as touches,
because their centers are too uncertain."""

FEW = 3
"""Presses from which a regularisation strength is chosen by holding presses out."""

FEW_PENALTY = 3.0
"""Regularisation towards a start with fewer than these."""


DEPTH_DEGREE = 2
"""Degree in position of what depth does to brightness."""

DEPTH_PENALTY = 0.1
"""Regularisation of it towards zero, in presses times mm^2: (0.03 / 0.1)^2, because sines are right to about 0.03, and a skin that
comes 1 mm nearer to lights about 10 mm away changes its brightness by about 0.1."""

DEPTH_PENALTY_ON_PRIOR = 3.0
"""The same towards a prior, from which units of a type differ by about 0.03 per mm, and the error of a press is alike all over it,
so that its pixels do not average it: (0.05 / 0.03)^2."""

TAUGHT_SHARE = 0.95
"""Share of the presses' pixels that are no steeper, and no deeper, than the range that was taught."""

FLATTER_PART = 0.7
"""Part of that range to which a field is fitted to see how it does beyond."""

STEEPER = 1.0
"""``steeper`` of a :class:`DepthBrightness`, times half the longer side of the image: 3 h / d^2 of lights 1.2 to 1.6 times that
far out and 0.6 to 1.4 times that high is 0.6 to 1.2. It is not fitted: at the rim of a ball the skin is shallow and steep, and
leaves the ball, so balls teach a wrong value (docs/decisions.md)."""


@dataclass(frozen=True)
class Candidates:
    """Which fields are tried.

    Attributes:
        degrees: of linear terms, products of two and of three, the smallest first.
        product_penalty: regularisation of products relative to linear terms.
    """

    degrees: tuple[tuple[int, int, int], ...] = FAMILIES
    product_penalty: float = PRODUCT_PENALTY

    def families(self, half_mm: float) -> list[Family]:
        """The families."""
        return [Family(degree, products, half_mm, self.product_penalty, cubic) for degree, products, cubic in self.degrees]


@dataclass
class ResponseFit:
    """A response model fitted to presses.

    Attributes:
        model: the fields.
        error_deg: mean held-out error, degrees; None with too few presses.
        own_deg: mean error on the presses themselves, degrees; None where there is a held-out error.
        candidates: all fields tried.
        reason: why these fields.
    """

    model: ResponseModel
    error_deg: float | None
    own_deg: float | None
    candidates: list[CandidateRow] = field(default_factory=list)
    reason: str = ""


class _Start(NamedTuple):
    """A field from which coefficients are regularised, and its name in the table of candidates."""

    field: ResponseField
    name: str


class _Choice(NamedTuple):
    """The chosen field, its row, and the rows of all candidates."""

    field: ResponseField
    row: CandidateRow
    rows: list[CandidateRow]


def fit_response(
    contacts: list[Contact],
    light: Tensor,
    sensor: Sensor,
    prior: ResponseModel | None,
    progress: bool = False,
    candidates: Candidates = Candidates(),
) -> ResponseFit:
    """Locate the balls, leave out presses that contradict, and fit.

    Args:
        contacts: from :func:`read_contacts`, of presses; changed in place.
        light: (3, H, W), background, linear light.
        sensor: the sensor, with the gamma and blur of the contacts' preprocessing.
        prior: fields of the sensor's type, or None.
        progress: show a bar.
        candidates: the fields to try.
    Raises:
        NoUsablePress: no press is left; says what became of each.
    """
    pitch = sensor.mm_per_pixel
    half_mm = prior.field.half_mm if prior is not None else 0.5 * sensor.width * pitch
    families = candidates.families(half_mm)
    with tqdm(total=3, desc="calibrating from presses", disable=not progress or None, leave=False) as bar:
        bar.set_postfix(step="balls")
        presses = locate_and_screen(contacts, sensor, prior, half_mm)
        if not presses:
            raise NoUsablePress(contacts)
        bar.update()
        bar.set_postfix(step="fields")
        start = None if prior is None else _Start(prior.field, "prior")
        if prior is not None and len(presses) < FEW:
            start = _Start(scaled(prior.field, _scale_of_prior(presses, prior.field)), "scaled prior")
        if prior is None and 2 <= len(presses) < ENOUGH:
            by_curl = presses_as_touches(presses, light, half_mm, pitch)
            start = None if by_curl is None else _Start(by_curl, "field by curl")
        chosen = _choose(presses, families, start)
        bar.update()
        bar.set_postfix(step="depth")
        by_depth = fit_depth_brightness(presses, chosen.field, pitch, None if prior is None else prior.by_depth)
        bar.update()
    score = chosen.row["score_deg"]
    reason = f"{_origin(name_of_start(sensor, prior), chosen.row, len(presses))}: {_how(score, len(chosen.rows))}"
    taught = taught_range(presses, chosen.field, pitch)
    if prior is not None and prior.taught is not None:
        taught = taught.with_all_of(prior.taught)
    model = ResponseModel(chosen.field, by_depth, sensor.exponent, sensor.blur_px, taught)
    own = mean_error_deg(chosen.field, presses) if score is None else None
    return ResponseFit(model, score, own, chosen.rows, reason)


def _scale_of_prior(presses: list[Contact], field: ResponseField) -> float:
    """The factor by which presses show a prior's slopes to be too small, all alike: one press a third of it, more show more.

    Units of a type differ by a factor of slopes first of all, which one press gives: the error of radii on two other units falls
    from 12 and 20 % to 5 and 12 %. From three presses on held-out errors choose, and are higher with it.
    """
    scale = scale_by_presses(field, [dataclasses.replace(press) for press in presses])
    return float(max(scale, 1e-3) ** (len(presses) / (len(presses) + 2.0)))


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
        form += columns @ columns.t() / int(inside.sum())
        right += columns @ left[:, inside].reshape(-1) / int(inside.sum())
    found = start + torch.linalg.solve(form, right).reshape(3, size)
    steeper = STEEPER / float(contacts[0].half_size_mm.max())
    rows = tuple(tuple(row) for row in found.tolist())
    return DepthBrightness(DEPTH_DEGREE, field.half_mm, rows, steeper, _mean_depth(contacts, depths))


def taught_range(contacts: list[Contact], field: ResponseField, pitch_mm: float) -> TaughtRange:
    """How steep and how deep located presses are, and how fast a field of this size errs beyond what it was fitted to.

    The error beyond is measured: a field fitted to the flatter part of the presses is scored on their rims.

    Args:
        contacts: of presses.
        field: fitted to them.
        pitch_mm: pixel pitch, mm.
    """
    depths = [
        depth.flatten()[contact.index[contact.inside()]]
        for contact, depth in zip(contacts, first_pass_depths(contacts, field, pitch_mm))
    ]
    evidence = Evidence.of(Family.of(field), contacts)
    sines = [ball_sine(contact)[:, contact.inside()] for contact in contacts]
    steepest = float(lengths(torch.cat(sines, 1), 0).quantile(TAUGHT_SHARE))
    deepest = float(torch.cat(depths).clamp_min(0.0).quantile(TAUGHT_SHARE))
    penalty, limit = evidence.penalty(PENALTIES[2]), FLATTER_PART * steepest
    terms = [item.terms[:, item.contact.inside()] for item in evidence.forms]
    flatter = [lengths(sine, 0) < limit for sine in sines]
    gram = sum(t[:, k] @ t[:, k].t() / max(1, int(k.sum())) for t, k in zip(terms, flatter))
    right = sum(t[:, k] @ s[:, k].t() / max(1, int(k.sum())) for t, s, k in zip(terms, sines, flatter))
    half = len(penalty) // 2
    by_flatter = torch.linalg.solve(gram + torch.diag(penalty[:half]), right)
    off = torch.cat([(by_flatter.t() @ t - s)[:, ~k] for t, s, k in zip(terms, sines, flatter)], 1)
    beyond = lengths(torch.cat([s[:, ~k] for s, k in zip(sines, flatter)], 1), 0) - limit
    growth = float((off.square().sum() / beyond.square().sum().clamp_min(1e-12)).sqrt())
    return TaughtRange(steepest, deepest, growth)


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


def _origin(start_name: str, row: CandidateRow, count: int) -> str:
    """What a field was made from, for a user."""
    presses, verb = f"{count} press" + "es" * (count > 1), "do" if count > 1 else "does"
    if not start_name:
        return f"from {presses}"
    return f"from {start_name} and {presses}" if row["parameters"] else f"{start_name}, on which {presses} {verb} not improve"


def _how(score_deg: float | None, count: int) -> str:
    if score_deg is None:
        return "too few to check any by the others"
    return f"{score_deg:.2f} degrees on each press by the others, the simplest of {count} models that is as good as the best"


def simplest_candidate(errors_deg: list[list[float]]) -> int:
    """The first candidate whose held-out errors exceed those of the best by no more than :data:`WORTH`, or a standard error of the
    difference.

    Args:
        errors_deg: of each candidate, the simplest first, one per press.
    Source:
        the one-standard-error rule: Breiman, Friedman, Olshen and Stone, Classification and Regression Trees, 1984; for paired
        differences.
    """
    errors = torch.tensor(errors_deg, dtype=torch.float64)
    best = errors[int(errors.mean(dim=1).argmin())]
    excess = errors - best
    allowed = (excess.std(dim=1) / errors.shape[1] ** 0.5).clamp_min(WORTH * float(best.mean()))
    return int((excess.mean(dim=1) <= allowed).nonzero()[0])


def _best_candidate(errors_deg: list[list[float]]) -> int:
    """The candidate of least mean held-out error."""
    return int(torch.tensor(errors_deg, dtype=torch.float64).mean(dim=1).argmin())


def fit_field(contacts: list[Contact], family: Family) -> ResponseField:
    """The field of a family by located presses, with the best regularisation towards zero."""
    return _fit_family(Evidence.of(family, contacts), None, few=False).field


def mean_error_deg(field: ResponseField, contacts: list[Contact]) -> float:
    """Mean angle between the normals of a field and those of balls, degrees."""
    evidence = Evidence.of(Family.of(field), contacts)
    return evidence.mean_error_deg([field.tensor().reshape(-1)] * len(contacts))


def held_out_deg(contacts: list[Contact], like: ResponseField) -> float:
    """Mean angle on each press by a field of the family of ``like`` that the others give, degrees."""
    family = Family.of(like)
    evidence = Evidence.of(family, contacts)
    return evidence.mean_error_deg(evidence.held_out(evidence.penalty(PENALTIES[2]), None))


def _choose(contacts: list[Contact], families: list[Family], start: _Start | None) -> _Choice:
    """The field of the smallest family that is as good as the best, by held-out angles."""
    few = len(contacts) < FEW
    families = families[: 1 if few else None]
    tried: list[_Tried] = []
    if start is not None:
        own = Family.of(start.field)
        larger = [family for family in families if family.holds(own) and not own.holds(family)]
        families = [own] + ([] if few else larger)
    whole = Evidence.of(functools.reduce(Family.with_all_of, families), contacts)
    for k, family in enumerate(families):
        evidence = whole.part(family)
        if start is not None and k == 0:
            unchanged = [start.field.tensor().reshape(-1)] * len(contacts)
            tried.append(_Tried(f"{start.name} as it is", 0, start.field, [] if few else evidence.errors_deg(unchanged)))
        tried.append(_fit_family(evidence, start, few))
    rows = [one.row() for one in tried]
    index = len(tried) - 1 if few else simplest_candidate([one.errors_deg for one in tried])
    return _Choice(tried[index].field, rows[index], rows)


class _Tried(NamedTuple):
    """A candidate: its name, how many parameters were fitted, its field, and its held-out error on each press, if there is one."""

    model: str
    parameters: int
    field: ResponseField
    errors_deg: list[float]

    def row(self) -> CandidateRow:
        score = sum(self.errors_deg) / len(self.errors_deg) if self.errors_deg else None
        family = Family.of(self.field).label()
        return {"model": self.model, "family": family, "parameters": self.parameters, "score_deg": score, "passes": 1}


def _fit_family(evidence: Evidence, start: _Start | None, few: bool) -> _Tried:
    """The field of one family, with the best regularisation; towards a start with the strongest that is as good as the best."""
    family = evidence.family
    origin: Tensor | None = None
    strengths: tuple[float, ...] = PENALTIES
    if start is not None:
        origin = start.field.embedded(family.degree, family.product_degree, family.cubic_degree).tensor().reshape(-1)
        strengths = (FEW_PENALTY,) if few else PENALTIES_ON_START
    unit = evidence.penalty(1.0) if start is None else family.penalty()
    penalties = [strength * unit for strength in strengths]
    errors = [] if few else evidence.held_out_errors_deg(penalties, origin)
    # towards zero a stronger one is no simpler model, only one of flatter slopes
    choose = _best_candidate if start is None else simplest_candidate
    k = choose(errors) if errors else 0
    model = f"response, {family.label()}"
    if start is not None:
        model = f"{start.name} adapted, regularisation of {strengths[k]:g} presses, {family.label()}"
    return _Tried(model, family.size(), family.field(evidence.solve(penalties[k], origin)), errors[k] if errors else [])
