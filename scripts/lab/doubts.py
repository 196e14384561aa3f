"""What a calibration says of what it was given: random subsets of genuine presses, and the mistakes that users make.

Presses come without labels. An answer is a refusal, presses that were left out, doubts, and whether depth is metric. It is silent
where depth is metric and nothing is doubted. What a calibration says that it cannot check is counted apart.
"""

import dataclasses
import random
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import NamedTuple

from torch import Tensor

from torchvts import Press, Sensor, calibrate
from torchvts.calibration import LEAST_WEIGHT
from torchvts.core.tables import markdown

from . import sets

UNITS = (
    "gelsight_mini_a", "gelsight_mini_c", "gelsight_pale", "gelsight_bnz", "digit_a", "digit_b", "gelslim_markers", "gelslim_b",
    "gelslim_mcube", "wyh_wedge_markers", "wyh_wedge_clear", *sets.DRAWN,
)  # fmt: skip
"""Sets with presses of balls."""

COUNTS = (2, 3, 4, 6, 8, 12)
"""Presses of a subset."""

WITH_MISTAKES = (3, 6)
"""Presses of a calibration with a mistake."""

NOT_CHECKED = "not checked"
"""How a sentence begins that says what the images cannot show."""


class Given(NamedTuple):
    """The arguments of a calibration."""

    background: Tensor
    sensor: Sensor
    presses: list[Press]


class Answer(NamedTuple):
    """What a calibration says: ``refused`` by which words, or "", and names of the presses that were left out, or count little."""

    unit: str
    prior: bool
    mistake: str
    given: tuple[str, ...]
    refused: str
    left_out: tuple[str, ...]
    doubts: tuple[str, ...]
    metric: bool

    @property
    def not_checked(self) -> bool:
        """Whether it says what it could not check."""
        return any(doubt.startswith(NOT_CHECKED) for doubt in self.doubts)

    @property
    def silent(self) -> bool:
        """Whether it says nothing, beside what it could not check."""
        doubts = [doubt for doubt in self.doubts if not doubt.startswith(NOT_CHECKED)]
        return not self.refused and self.metric and not doubts


@cache
def unit_of(name: str) -> Given:
    """A unit with all of its presses, without their labels."""
    data = sets.load(name, sets.data_folder())
    presses = {press.name: press for fold in data.folds for press in fold.learned}
    bare = [dataclasses.replace(press, center_px=None, contact_radius_px=None) for press in presses.values()]
    return Given(data.background, data.folds[0].sensor, bare)


def answer(unit: str, mistake: str, given: Given) -> Answer:
    """What a calibration says."""
    names = tuple(press.name for press in given.presses)
    prior = given.sensor.prior is not None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            made = calibrate(given.background, given.sensor, presses=given.presses)
        except ValueError as error:
            return Answer(unit, prior, mistake, names, str(error), (), (), False)
    out = tuple(row["name"] for row in made.report.get("presses", []) if row["weight"] < LEAST_WEIGHT)
    return Answer(unit, prior, mistake, names, "", out, tuple(made.report["doubts"]), made.metric)


def _sizes(given: Given, factor: float, some: slice = slice(None)) -> Given:
    presses = list(given.presses)
    for k in range(len(presses))[some]:
        presses[k] = dataclasses.replace(presses[k], ball_diameter_mm=factor * presses[k].ball_diameter_mm)
    return given._replace(presses=presses)


def _pitch(given: Given, factor: float) -> Given:
    return given._replace(sensor=dataclasses.replace(given.sensor, mm_per_pixel=factor * given.sensor.mm_per_pixel))


def _exchanged(given: Given, _: Press) -> Given:
    """Two sizes exchanged; of balls of one size, every second is said to be 1.5 times as large."""
    sizes = sorted({press.ball_diameter_mm for press in given.presses})
    if len(sizes) < 2:
        return _sizes(given, 1.5, slice(None, None, 2))
    other = {sizes[0]: sizes[-1], sizes[-1]: sizes[0]}
    presses = [
        dataclasses.replace(press, ball_diameter_mm=other.get(press.ball_diameter_mm, press.ball_diameter_mm))
        for press in given.presses
    ]
    return given._replace(presses=presses)


def _two_contacts(given: Given, other: Press) -> Given:
    """The first image shows a second contact."""
    both = (given.presses[0].image * other.image / given.background.clamp_min(0.02)).clamp(0.0, 1.0)
    return given._replace(presses=[dataclasses.replace(given.presses[0], image=both), *given.presses[1:]])


def _wrong_label(given: Given, _: Press) -> Given:
    """The first press has a label in the opposite quarter of the image."""
    height, width = given.background.shape[1:]
    label = (0.25 * width, 0.25 * height)
    return given._replace(presses=[dataclasses.replace(given.presses[0], center_px=label), *given.presses[1:]])


MISTAKES: dict[str, Callable[[Given, Press], Given]] = {
    "radii for diameters": lambda given, _: _sizes(given, 0.5),
    "diameters times 0.8": lambda given, _: _sizes(given, 0.8),
    "diameters times 1.2": lambda given, _: _sizes(given, 1.2),
    "pitch times 0.8": lambda given, _: _pitch(given, 0.8),
    "pitch times 1.2": lambda given, _: _pitch(given, 1.2),
    "pitch times 2": lambda given, _: _pitch(given, 2.0),
    "one radius for a diameter": lambda given, _: _sizes(given, 0.5, slice(1)),
    "one diameter twice as large": lambda given, _: _sizes(given, 2.0, slice(1)),
    "exchanged balls": _exchanged,
    "a press as background": lambda given, other: given._replace(background=other.image),
    "two contacts in one image": _two_contacts,
    "a wrong label": _wrong_label,
}
"""Name, and what is given instead, from what is right and a press that is not given."""


def genuine(unit: str, draws: int, seed: int = 0) -> Iterator[Answer]:
    """Random subsets, with and without the sensor's prior."""
    all_of, chance = unit_of(unit), random.Random(f"{unit} {seed}")
    for count in COUNTS:
        for _ in range(draws):
            if count > len(all_of.presses):
                continue
            given = all_of._replace(presses=chance.sample(all_of.presses, count))
            for sensor in _sensors(all_of.sensor):
                yield answer(unit, "", given._replace(sensor=sensor))


def mistaken(unit: str, draws: int, names: Sequence[str] = tuple(MISTAKES), seed: int = 1) -> Iterator[Answer]:
    """Mistakes with random subsets, with and without the sensor's prior."""
    all_of, chance = unit_of(unit), random.Random(f"{unit} {seed}")
    for name in names:
        for count in WITH_MISTAKES:
            for _ in range(draws):
                if count >= len(all_of.presses):
                    continue
                *presses, other = chance.sample(all_of.presses, count + 1)
                for sensor in _sensors(all_of.sensor):
                    yield answer(unit, name, MISTAKES[name](all_of._replace(presses=presses, sensor=sensor), other))


def every_background(unit: str, count: int = 3, seed: int = 2) -> Iterator[Answer]:
    """Every press as the background of ``count`` others."""
    all_of, chance = unit_of(unit), random.Random(f"{unit} {seed}")
    for place, press in enumerate(all_of.presses):
        others = all_of.presses[:place] + all_of.presses[place + 1 :]
        for sensor in _sensors(all_of.sensor):
            given = Given(press.image, sensor, chance.sample(others, min(count, len(others))))
            yield answer(unit, "every press as background", given)


def _sensors(sensor: Sensor) -> list[Sensor]:
    return [sensor] if sensor.prior is None else [sensor, sensor.without_prior()]


def table(answers: Sequence[Answer]) -> str:
    """Markdown: one row per mistake, with and without prior."""
    rows = []
    for key in dict.fromkeys((one.mistake, one.prior) for one in answers):
        some = [one for one in answers if (one.mistake, one.prior) == key]
        silent = [one for one in some if one.silent]
        said = sum(one.not_checked for one in silent)
        cells = (
            key[0] or "genuine presses", "yes" if key[1] else "no", len(some), sum(bool(one.refused) for one in some),
            f"{sum(len(one.left_out) for one in some)} of {sum(len(one.given) for one in some)}",
            sum(not one.refused and not one.metric for one in some),
            sum(not one.refused and one.metric and not one.silent for one in some), f"{len(silent)} ({said})",
        )  # fmt: skip
        rows.append([str(cell) for cell in cells])
    head = ("given", "prior", "calibrations", "refused", "presses left out", "not metric", "doubts, metric", "silent (says so)")
    return markdown(head, rows)
