"""A response model from presses: balls found, contradictions left out, the smallest family that explains them chosen."""

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from ..core.geometry import gradient_from_normal
from ..model.response_field import ResponseField, ResponseModel
from ..model.sensor import Sensor
from ..normals import NormalFromResponse
from .balls import center_by_slope, guess_circle, update_radius
from .contacts import LEAST_INSIDE, Contact, depths, go_deeper
from .field import PRODUCT_PENALTY, ContactForms, Family, solve, solve_with_centers
from .touches import evened, start_of_presses

FAMILIES = ((0, -1), (1, -1), (2, -1), (2, 1), (3, 2), (4, 3))
"""Degrees of candidates, linear terms and products, the smallest first."""

OWN_PENALTIES = (0.03, 0.01, 0.003)
PRIOR_PENALTIES = (10.0, 3.0, 1.0, 0.3, 0.1, 0.03)
"""How dear coefficients are, in presses: strongest first."""

WORTH = 0.02
"""A larger family must lower the held-out error by this part of it."""

ENOUGH = 5
"""Presses from which a field starts from nothing. Fewer, without a prior, start from the field that they give as touches: their
centers are too uncertain for more. A GelSight Mini by 2, 3, 5 and 7 presses, precise: from nothing 5.69, 6.27, 4.42 and 3.52
degrees, from that field 5.22, 4.98, 4.65 and 4.11."""

JUDGES_PENALTY = 0.01
"""Penalty of the small fields by which presses without a prior judge each other."""

FEW_PENALTY = 3.0
"""Penalty on leaving a prior when there are too few presses to choose one: two presses or less."""


FAR_FROM_PRIOR = 1.4
FAR_FROM_OTHERS = 1.35
FAR_FROM_ONE = 1.5
"""A diameter is wrong where it seems so many times what was said: by a prior; beside all others, by the prior or by their field;
by a single other press elsewhere. Right ones, GelSight Mini: by the prior of another ball 0.76 to 1.10, beside their median 0.82
to 1.17. Fields of seven presses or fewer are rough: in two draws of five they leave out a good one."""


@dataclass
class ResponseFit:
    """What presses gave: the model, the candidates and the choice."""

    model: ResponseModel
    error_deg: float | None
    candidates: list[dict[str, Any]] = field(default_factory=list)
    reason: str = ""


def fit_response(
    contacts: list[Contact],
    light: Tensor,
    sensor: Sensor,
    prior: ResponseModel | None,
    progress: bool = False,
    families: tuple[tuple[int, int], ...] = FAMILIES,
    product_penalty: float = PRODUCT_PENALTY,
) -> ResponseFit:
    """Locate the balls, leave out what contradicts, and fit.

    Args:
        contacts: from :func:`read_contacts`, with balls; located, judged and told of in place.
        light: (3, H, W), linear light at rest.
        sensor: the sensor, whose gamma and blur the contacts were read with.
        prior: fields of the sensor's type, or None.
        progress: show a bar.
        families: degrees to choose from, linear terms and products, the smallest first.
        product_penalty: how much dearer coefficients of products are.
    Raises:
        ValueError: no press is left; names what became of each.
    """
    pitch = sensor.mm_per_pixel
    half_mm = prior.fast.half_mm if prior is not None else 0.5 * sensor.width * pitch
    options = [Family(degree, products, False, half_mm, product_penalty) for degree, products in families]
    with tqdm(total=3, desc="calibrating from presses", disable=not progress, leave=False) as bar:
        bar.set_postfix(step="balls")
        used = _judged(contacts, light, pitch, sensor, prior, half_mm)
        if not used:
            raise ValueError("presses: none can be used: " + "; ".join(f"{c.name}: {c.reason}" for c in contacts))
        bar.update()
        bar.set_postfix(step="one pass")
        called, start = "prior", None if prior is None else prior.fast
        if prior is None and 2 <= len(used) < ENOUGH:
            called, start = "field by curl", start_of_presses(used, light, half_mm, pitch)
        fast, fast_rows, fast_index = _choose(used, options, False, start, called)
        go_deeper(used, fast, pitch)
        bar.update()
        bar.set_postfix(step="second pass")
        if start is not None:
            start = (None if prior is None else prior.precise) or fast.lifted(fast.degree, fast.product_degree, True)
        deep, deep_rows, deep_index = _choose(used, options, True, start, called)
        bar.update()
    rows = fast_rows + deep_rows
    score, before = deep_rows[deep_index]["score_deg"], fast_rows[fast_index]["score_deg"]
    if score is not None and score > before:  # depth explains nothing: the second pass repeats the first
        deep, score = fast.lifted(fast.degree, fast.product_degree, True), before
    chosen = f"{fast_rows[fast_index]['model']}; {deep_rows[deep_index]['model']}"
    count = len(used)
    how = (
        f"the smallest within {WORTH:.0%} of the best of {len(rows)} candidates, {score or 0.0:.2f} deg on each press by the others"
    )
    reason = f"{chosen}, from {count} presses: {'too few to choose by holding some out' if score is None else how}"
    return ResponseFit(ResponseModel(fast, deep, sensor.exponent, sensor.blur_px), score, rows, reason)


def _judged(
    contacts: list[Contact], light: Tensor, pitch_mm: float, sensor: Sensor, prior: ResponseModel | None, half_mm: float
) -> list[Contact]:
    """Balls found and judged; found again without those left out, which have moved the others where there is no prior."""
    found = None
    while found is None or (prior is None and len(found) > sum(not contact.reason for contact in contacts)):
        locate(contacts, pitch_mm, sensor, prior, half_mm)
        found = [contact for contact in contacts if not contact.reason]
        leave_out(contacts, light, pitch_mm, prior, half_mm)
    return [contact for contact in contacts if not contact.reason]


def held_out_deg(contacts: list[Contact], like: ResponseField) -> float:
    """Mean angle on each press by a field of that family that the others give, degrees."""
    family = Family.of(like)
    evidence = _Evidence.of(family, contacts)
    return evidence.mean_error(evidence.held_out(OWN_PENALTIES[1] * family.penalty(), None))


def locate(contacts: list[Contact], pitch_mm: float, sensor: Sensor, prior: ResponseModel | None, half_mm: float) -> None:
    """Center and contact radius of every usable contact: by the prior's slopes, or jointly with fields of rising size."""
    for contact in contacts:
        if not contact.reason and 0.0 < contact.radius_mm < 2.0 * pitch_mm:
            contact.reason = f"a ball of {2 * contact.radius_mm:g} mm is smaller than four pixels: is its diameter in mm?"
        if not contact.reason and not contact.known:
            guess_circle(contact, sensor)
    usable = [contact for contact in contacts if not contact.reason]
    if prior is not None:
        for contact, slopes in zip(usable, slope_maps(usable, prior, pitch_mm)):
            if not contact.known:
                center_by_slope(contact, slopes, pitch_mm)
            for _ in range(6):
                update_radius(contact, slopes.flatten(1)[:, contact.index], pitch_mm)
    elif not all(contact.known and contact.radius_known for contact in usable):
        _locate_jointly(usable, pitch_mm, half_mm)
    for contact in usable:
        if not contact.reason and int(contact.inside().sum()) < LEAST_INSIDE:
            contact.reason = "no ball of this diameter fits what is seen"
        if not contact.reason and contact.contact_radius_mm > 0.89 * contact.radius_mm:
            wide_mm, ball_mm = 2 * contact.contact_radius_mm, 2 * contact.radius_mm
            contact.reason = f"the contact seen is {wide_mm:.2f} mm wide, too wide for a ball of {ball_mm:g} mm"


def _locate_jointly(contacts: list[Contact], pitch_mm: float, half_mm: float) -> None:
    # linear fields first: with products or depth, a shift of all centers can hide in the field, so these only refine
    # what linear ones found, each center held by a third of a press
    most = 1 if len(contacts) < 4 else 2 if len(contacts) < 10 else 3
    stages = [(0, -1, False, 3), (1, -1, False, 3), (2, -1, False, 6), (3, 2, False, 4), (3, 2, True, 4)]
    anchors = None
    fast: ResponseField | None = None
    for degree, products, uses_depth, rounds in [stage for stage in stages if stage[0] <= most]:
        family = Family(degree, products, uses_depth, half_mm)
        if products >= 0 and anchors is None:
            anchors = [contact.center_mm.clone() for contact in contacts]
        if uses_depth and fast is not None:
            go_deeper(contacts, fast, pitch_mm)
        forms = [ContactForms(family, contact) for contact in contacts]
        coefficient = torch.zeros(family.size(), dtype=torch.float64)
        for _ in range(rounds):
            coefficient = solve_with_centers(forms, 0.01 * family.penalty(), anchors, 0.3)
            for item in forms:
                update_radius(item.contact, item.slope(coefficient), pitch_mm)
        fast = family.field(coefficient)


def slope_maps(contacts: list[Contact], model: ResponseModel, pitch_mm: float) -> list[Tensor]:
    """(2, H, W) each: slopes of the model's last pass."""
    if not contacts:
        return []
    height, width = contacts[0].mask.shape
    normals = NormalFromResponse(model.fast, model.precise, height, width, pitch_mm, dtype=torch.float64)
    images = [1.0 + contact.change[None] for contact in contacts]
    if model.precise is None:
        return [gradient_from_normal(normals(image))[0] for image in images]
    first = depths(contacts, model.fast, pitch_mm)
    return [gradient_from_normal(normals(image, depth[None, None]))[0] for image, depth in zip(images, first)]


def leave_out(contacts: list[Contact], light: Tensor, pitch_mm: float, prior: ResponseModel | None, half_mm: float) -> None:
    """Give a reason to presses that the others, or the prior, contradict, one after the other.

    By the prior a ball seems so many times smaller than was said. Without one it is the field of the others that says so, and a
    wrong press bends it for all: the press to leave out is the one without which the others agree best.
    """
    while True:
        used = [contact for contact in contacts if not contact.reason]
        if len(used) < (1 if prior is not None else 2):
            return
        if prior is not None:
            judge, evidence = "the sensor's prior", _Evidence.of(Family.of(prior.fast), used)
            solutions = [prior.fast.tensor().reshape(-1)] * len(used)
        else:
            judge = "the other press" if len(used) == 2 else f"the other {len(used) - 1} presses"
            # fields are small here: let brightness tell what it can of the place
            small = Family(2 if len(used) >= 8 else 0, -1, False, half_mm)
            evidence = _Evidence.of(small, evened(used, light, half_mm, pitch_mm)[1])
            solutions = evidence.held_out(JUDGES_PENALTY * small.penalty(), None)
        gains = evidence.gains(solutions)
        errors = torch.tensor([item.error_deg(solution) for item, solution in zip(evidence.forms, solutions)], dtype=torch.float64)
        for contact, gain, error in zip(used, gains.tolist(), errors.tolist()):
            contact.figures |= {"error_deg": error, "gain": gain}
        odd = _odd_by_others(evidence, gains) if prior is None else _odd_by_prior(gains)
        if odd is not None:
            press = used[odd]
            seen = 2 * press.radius_mm / max(float(gains[odd]), 1e-3)
            press.reason = f"by {judge} the ball seems {seen:.2f} mm wide, but {2 * press.radius_mm:g} mm was given"
            if prior is None and len(used) == 2:
                used[1 - odd].reason = "contradicts the only other press: one of the two diameters is wrong"
            continue
        worst, usual = int(errors.argmax()), float(errors.median())
        if float(errors[worst]) > max(3.0 * usual, 8.0) or float(errors[worst]) > 15.0:
            off_deg = float(errors[worst])
            used[worst].reason = f"its slopes are {off_deg:.1f} degrees from a ball's, others' {usual:.1f}: not a clean press"
            continue
        return


def _odd_by_prior(gains: Tensor) -> int | None:
    """Which press to leave out for its diameter, if any; gains are slopes by the prior over slopes expected."""
    logs = gains.clamp_min(1e-3).log()
    beside = logs - logs.median() if len(logs) > 2 else logs
    for far, limit in ((logs, FAR_FROM_PRIOR), (beside, FAR_FROM_OTHERS)):
        worst = int(far.abs().argmax())
        if float(far[worst].abs()) > math.log(limit):
            return worst
    return None


def _odd_by_others(evidence: "_Evidence", gains: Tensor) -> int | None:
    """The same where each press's gain is by the field of the others."""
    logs = gains.clamp_min(1e-3).log()
    if float(logs.abs().max()) <= math.log(FAR_FROM_OTHERS if len(logs) > 2 else FAR_FROM_ONE):
        return None
    if len(logs) == 2:
        return int(logs.abs().argmax())
    penalty = JUDGES_PENALTY * evidence.family.penalty()

    def disagreement(place: int) -> float:
        rest = evidence.without(place)
        return float(rest.gains(rest.held_out(penalty, None)).clamp_min(1e-3).log().square().mean())

    return min(range(len(logs)), key=disagreement)


def _choose(
    contacts: list[Contact], options: list[Family], uses_depth: bool, prior: ResponseField | None, called: str
) -> tuple[ResponseField, list[dict[str, Any]], int]:
    """The field of the smallest family within WORTH of the best held-out angle, the candidates, and which one it is."""
    few = len(contacts) < 3
    families = [dataclasses.replace(option, uses_depth=uses_depth) for option in options[: 1 if few else None]]
    if prior is not None:
        own = Family.of(prior)
        larger = [f for f in families if f.degree >= own.degree and f.product_degree >= own.product_degree and f != own]
        families = [own] + ([] if few else larger)
    rows: list[dict[str, Any]] = []
    fields: list[ResponseField] = []
    for family in families:
        evidence = _Evidence.of(family, contacts)
        start: Tensor | None = None
        names: tuple[float, ...] = OWN_PENALTIES
        if prior is not None:
            start = prior.lifted(family.degree, family.product_degree, uses_depth).tensor().reshape(-1)
            names = (FEW_PENALTY,) if few else PRIOR_PENALTIES
            if family == families[0]:
                score = None if few else evidence.mean_error([start] * len(contacts))
                rows.append(_row(f"{called} as it is", family, 0, score))
                fields.append(prior)
        penalties = {weight: weight * family.penalty() for weight in names}
        scores = {} if few else {w: evidence.mean_error(evidence.held_out(p, start)) for w, p in penalties.items()}
        weight = min(scores, key=lambda w: scores[w]) if scores else names[0]
        model = f"response, {family.label()}" if prior is None else f"{called} moved, held by {weight:g} presses, {family.label()}"
        rows.append(_row(model, family, family.size(), scores.get(weight)))
        fields.append(family.field(evidence.solve(penalties[weight], start)))
    best = min((row["score_deg"] for row in rows if row["score_deg"] is not None), default=None)
    index = len(rows) - 1 if best is None else next(k for k, row in enumerate(rows) if row["score_deg"] <= best * (1.0 + WORTH))
    return fields[index], rows, index


class _Evidence:
    """What all contacts say of a family's coefficients, together and without one."""

    def __init__(self, family: Family, forms: list[ContactForms], each: list[tuple[Tensor, Tensor]]) -> None:
        self.family, self.forms, self.each = family, forms, each
        self.form = torch.stack([form for form, _ in each]).sum(0)
        self.right = torch.stack([right for _, right in each]).sum(0)

    @classmethod
    def of(cls, family: Family, contacts: list[Contact]) -> "_Evidence":
        """What contacts say, each with its center where it is."""
        forms = [ContactForms(family, contact) for contact in contacts]
        return cls(family, forms, [item.ball() for item in forms])

    def without(self, place: int) -> "_Evidence":
        """The same less one contact."""
        others = [k for k in range(len(self.forms)) if k != place]
        return _Evidence(self.family, [self.forms[k] for k in others], [self.each[k] for k in others])

    def gains(self, solutions: list[Tensor]) -> Tensor:
        """For each contact the slopes its coefficients give over the ball's."""
        return torch.tensor([item.gain(solution) for item, solution in zip(self.forms, solutions)], dtype=torch.float64)

    def solve(self, penalty: Tensor, start: Tensor | None) -> Tensor:
        """Coefficients by all contacts."""
        return solve(self.form, self.right, penalty, start)

    def held_out(self, penalty: Tensor, start: Tensor | None) -> list[Tensor]:
        """For each contact the coefficients that all others give."""
        return [solve(self.form - form, self.right - right, penalty, start) for form, right in self.each]

    def mean_error(self, solutions: list[Tensor]) -> float:
        """Mean over presses of the mean angle each has under its own coefficients, degrees."""
        return sum(item.error_deg(solution) for item, solution in zip(self.forms, solutions)) / len(self.forms)


def _row(model: str, family: Family, numbers: int, score: float | None) -> dict[str, Any]:
    two = 2 if family.uses_depth else 1
    return {"model": model, "family": family.label(), "parameters": numbers, "score_deg": score, "passes": two}
