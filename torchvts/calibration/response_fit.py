"""Fit response fields to located presses: the smallest family that explains each press by the others."""

import dataclasses
from dataclasses import dataclass, field
from typing import NamedTuple

from torch import Tensor
from tqdm import tqdm

from ..model.report import CandidateRow
from ..model.response_field import ResponseField, ResponseModel
from ..model.sensor import Sensor
from .contacts import Contact, prepare_second_pass
from .field import PRODUCT_PENALTY, Evidence, Family
from .outliers import locate_and_screen
from .refusals import NoUsablePress
from .touches import presses_as_touches

FAMILIES = ((0, -1), (1, -1), (2, -1), (2, 1), (3, 2), (4, 3))
"""Degrees of candidates, linear terms and products, the smallest first."""

PENALTIES = (0.03, 0.01, 0.003)
PENALTIES_ON_START = (10.0, 3.0, 1.0, 0.3, 0.1, 0.03)
"""Regularisation strengths, in presses, the strongest first: towards zero, and towards a start such as a prior."""

WORTH = 0.02
"""A larger family must lower the held-out error by this part of it."""

ENOUGH = 5
"""Presses from which a field is fitted without a start. Fewer, without a prior, start from the field that they give as touches,
because their centers are too uncertain. A GelSight Mini by 2, 3, 5 and 7 presses, precise: without a start 5.69, 6.27, 4.42 and
3.52 degrees, from that field 5.22, 4.98, 4.65 and 4.11."""

FEW = 3
"""Presses from which a regularisation strength is chosen by holding presses out."""

FEW_PENALTY = 3.0
"""Regularisation towards a start with fewer than these."""


@dataclass(frozen=True)
class Candidates:
    """Which fields are tried.

    Attributes:
        degrees: of linear terms and products, the smallest first.
        product_penalty: regularisation of products relative to linear terms.
    """

    degrees: tuple[tuple[int, int], ...] = FAMILIES
    product_penalty: float = PRODUCT_PENALTY

    def families(self, half_mm: float) -> list[Family]:
        """The families, without depth."""
        return [Family(degree, products, False, half_mm, self.product_penalty) for degree, products in self.degrees]


@dataclass
class ResponseFit:
    """A response model fitted to presses.

    Attributes:
        model: the fields.
        error_deg: mean held-out error, degrees; None with too few presses.
        candidates: all fields tried.
        reason: why these fields.
    """

    model: ResponseModel
    error_deg: float | None
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
    half_mm = prior.fast.half_mm if prior is not None else 0.5 * sensor.width * pitch
    families = candidates.families(half_mm)
    with tqdm(total=3, desc="calibrating from presses", disable=not progress, leave=False) as bar:
        bar.set_postfix(step="balls")
        presses = locate_and_screen(contacts, light, sensor, prior, half_mm)
        if not presses:
            raise NoUsablePress(contacts)
        bar.update()
        bar.set_postfix(step="one pass")
        start = None if prior is None else _Start(prior.fast, "prior")
        if prior is None and 2 <= len(presses) < ENOUGH:
            by_curl = presses_as_touches(presses, light, half_mm, pitch)
            start = None if by_curl is None else _Start(by_curl, "field by curl")
        fast = _choose(presses, families, False, start)
        prepare_second_pass(presses, fast.field, pitch)
        bar.update()
        bar.set_postfix(step="second pass")
        repeated = fast.field.embedded(fast.field.degree, fast.field.product_degree, True)
        if start is not None:
            start = start._replace(field=(None if prior is None else prior.precise) or repeated)
        precise = _choose(presses, families, True, start)
        bar.update()
    score, before = precise.row["score_deg"], fast.row["score_deg"]
    field = precise.field
    if score is not None and before is not None and score > before:  # depth explains nothing: the second pass repeats the first
        field, score = repeated, before
    rows = fast.rows + precise.rows
    reason = f"{fast.row['model']}; {precise.row['model']}, from {len(presses)} presses: {_how(score, len(rows))}"
    return ResponseFit(ResponseModel(fast.field, field, sensor.exponent, sensor.blur_px), score, rows, reason)


def _how(score_deg: float | None, count: int) -> str:
    if score_deg is None:
        return "too few to choose by holding some out"
    return f"the smallest within {WORTH:.0%} of the best of {count} candidates, {score_deg:.2f} deg on each press by the others"


def held_out_deg(contacts: list[Contact], like: ResponseField) -> float:
    """Mean angle on each press by a field of the family of ``like`` that the others give, degrees."""
    family = Family.of(like)
    evidence = Evidence.of(family, contacts)
    return evidence.mean_error_deg(evidence.held_out(PENALTIES[1] * family.penalty(), None))


def _choose(contacts: list[Contact], families: list[Family], uses_depth: bool, start: _Start | None) -> _Choice:
    """The field of the smallest family within WORTH of the best held-out angle."""
    few = len(contacts) < FEW
    families = [dataclasses.replace(family, uses_depth=uses_depth) for family in families[: 1 if few else None]]
    rows: list[CandidateRow] = []
    fields: list[ResponseField] = []
    if start is not None:
        own = Family.of(start.field)
        larger = [f for f in families if f.degree >= own.degree and f.product_degree >= own.product_degree and f != own]
        families = [own] + ([] if few else larger)
    for k, family in enumerate(families):
        evidence = Evidence.of(family, contacts)
        if start is not None and k == 0:
            unchanged = [start.field.tensor().reshape(-1)] * len(contacts)
            rows.append(_row(f"{start.name} as it is", family, 0, None if few else evidence.mean_error_deg(unchanged)))
            fields.append(start.field)
        row, found = _fit_family(evidence, start, few)
        rows.append(row)
        fields.append(found)
    best = min((row["score_deg"] for row in rows if row["score_deg"] is not None), default=None)
    index = len(rows) - 1
    if best is not None:
        index = next(k for k, row in enumerate(rows) if row["score_deg"] is not None and row["score_deg"] <= best * (1.0 + WORTH))
    return _Choice(fields[index], rows[index], rows)


def _fit_family(evidence: Evidence, start: _Start | None, few: bool) -> tuple[CandidateRow, ResponseField]:
    """The field of one family with the regularisation strength of least held-out error, and its row."""
    family = evidence.family
    origin: Tensor | None = None
    strengths: tuple[float, ...] = PENALTIES
    if start is not None:
        origin = start.field.embedded(family.degree, family.product_degree, family.uses_depth).tensor().reshape(-1)
        strengths = (FEW_PENALTY,) if few else PENALTIES_ON_START
    penalties = {strength: strength * family.penalty() for strength in strengths}
    scores = {} if few else {s: evidence.mean_error_deg(evidence.held_out(p, origin)) for s, p in penalties.items()}
    strength = min(scores, key=lambda s: scores[s]) if scores else strengths[0]
    model = f"response, {family.label()}"
    if start is not None:
        model = f"{start.name} adapted, regularisation of {strength:g} presses, {family.label()}"
    row = _row(model, family, family.size(), scores.get(strength))
    return row, family.field(evidence.solve(penalties[strength], origin))


def _row(model: str, family: Family, parameters: int, score_deg: float | None) -> CandidateRow:
    passes = 2 if family.uses_depth else 1
    return {"model": model, "family": family.label(), "parameters": parameters, "score_deg": score_deg, "passes": passes}
