"""What becomes of depth where a frame's light is not that at calibration: exact lights, and real sensors by half of their presses.

The level of a frame is the 95 % quantile of its depth in the contact that is found without a change.
"""

import math
import random
import statistics
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchvts import Calibration, ConfidentPipeline, DepthPipeline, Press, Sensor, calibrate, diagnose, read_presses
from torchvts.core.tables import markdown
from torchvts.pipeline.confidence import ConfidentOutput
from torchvts.scenes import Scene, punch_depth, render, sphere_press, surface
from torchvts.scenes.surfaces import undeformed

from . import sets
from .faults import ring_lights
from .sets import Target

NOISE_STD = 0.004
"""Of drawn images, and of what stands for the free skin of real sets: their background with noise."""

OTHERS = {
    "lights": "other_lights", "lights_alone": "other_lights", "gelsight_mini_a": "gelsight_mini_c",
    "gelsight_mini_c": "gelsight_mini_a", "digit_a": "digit_b", "digit_b": "digit_a", "gelslim_b": "gelslim_mcube",
    "wyh_wedge_clear": "gelsight_pale", "gelsight_pale": "wyh_wedge_clear",
}  # fmt: skip
"""For each unit another one of the same size: real sets, and exact lights with a background image and without one."""

LARGE, FREE = "large_contacts", "free skin"
UNITS = (*OTHERS, LARGE)
AS_IS, ALL, ONE, LIGHT, IMAGE = "no change", "gain in all channels", "gain in one channel", "other light", "other image"


class Change(NamedTuple):
    """What is done to an image (3, H, W) before it is cut to [0, 1] and rounded to 8 bits; ``turned`` if by 180 degrees."""

    part: str
    name: str
    apply: Callable[[Tensor], Tensor]
    turned: bool = False


class Unit(NamedTuple):
    """A unit, frames that its calibration has not seen, an image of its free skin, and the warnings of calibration."""

    calibration: Calibration
    frames: list[Target]
    free: Tensor
    note: str


class Reading(NamedTuple):
    """A frame under a change: its level, and the ratio to that without the change, None without contact.

    ``saturated`` is the share of the contact with a value of 0.99 or more, ``outside_mm`` the largest size of depth where skin is
    undeformed without the change. Confidence and findings are there for unchanged frames and other images in mode fast.
    """

    unit: str
    mode: str
    part: str
    change: str
    frame: str
    level_mm: float
    ratio: float | None
    saturated: float
    outside_mm: float
    rms_mm: float | None
    confidence: float | None
    findings: tuple[str, ...]


def _lit(image: Tensor, gain: float = 1.0, right: float = 0.0, down: float = 0.0, channels: str = "RGB") -> Tensor:
    """Channels times ``gain``, which rises by ``right`` and ``down`` from the middle of the image to its borders."""
    y, x = (torch.linspace(-1.0, 1.0, size) for size in image.shape[1:])
    chosen = torch.tensor([channel in channels for channel in "RGB"])[:, None, None]
    return torch.where(chosen, image * (gain + right * x + down * y[:, None]), image)


def _shade(size: int) -> Tensor:
    return 1.0 - 0.2 * torch.sigmoid(torch.linspace(-1.0, 1.0, size) / 0.03)


def _washed(image: Tensor, share: float) -> Tensor:
    return share * image + (1.0 - share) * image.mean(0, keepdim=True)


CHANGES = (
    Change(AS_IS, AS_IS, lambda image: image),
    *(Change(ALL, f"all x {g:g}", partial(_lit, gain=g)) for g in (0.5, 0.7, 0.85, 1.15, 1.3, 1.6)),
    *(Change(ONE, f"{c} x {g:g}", partial(_lit, gain=g, channels=c)) for g in (0.6, 1.5) for c in "RGB"),
    *(Change(LIGHT, f"{c} x {g:g}", partial(_lit, gain=g, channels=c)) for g in (0.88, 0.75) for c in "RGB"),
    *(Change(LIGHT, f"R tilted {t:.0%} to the right", partial(_lit, right=t, channels="R")) for t in (0.1, 0.25)),
    *(Change(LIGHT, f"G tilted {t:.0%} down", partial(_lit, down=t, channels="G")) for t in (0.1, 0.25)),
    *(Change(LIGHT, f"B tilted {t:.0%} to the left", partial(_lit, right=-t, channels="B")) for t in (0.1, 0.25)),
    Change(LIGHT, "right half x 0.8", lambda image: image * _shade(image.shape[2])),
    Change(LIGHT, "lower half x 0.8", lambda image: image * _shade(image.shape[1])[:, None]),
    Change(LIGHT, "ambient + 0.05", lambda image: image + 0.05),
    *(Change(IMAGE, f"value^{power:g}", partial(torch.pow, exponent=power)) for power in (0.7, 1.5)),
    *(Change(IMAGE, f"saturation {share:g}", partial(_washed, share=share)) for share in (0.5, 0.7)),
    Change(IMAGE, "R, B swapped", lambda image: image.flip(0)),
    Change(IMAGE, "turned by 180", lambda image: image.flip(1, 2), turned=True),
)


def _eight_bits(image: Tensor) -> Tensor:
    return torch.round(image.clamp(0.0, 1.0) * 255.0) / 255.0


@cache
def unit_of(name: str) -> Unit:
    """Draw a unit, or read a real set and calibrate by half of its presses, without labels; ValueError where that is refused."""
    if name not in sets.REAL:
        return _drawn(name)
    if name == "gelsight_mini_a":  # its folds are no halves, and their prior has seen what is scored here
        sensor = Sensor.load("gelsight_mini").without_prior()
        background, presses = read_presses(sets.data_folder() / name)
        learned, frames = presses[::2], [Target(f"{name} {p.name}", p.image) for p in presses[1::2]]
    else:
        data = sets.load(name, sets.data_folder())
        background, sensor, learned = data.background, data.folds[0].sensor, list(data.folds[0].learned)
        frames = [Target(f"{name} {target.name}", target.image) for target in data.folds[0].scored]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        calibration = calibrate(background, sensor, [Press(p.image, p.ball_diameter_mm, p.name) for p in learned])
    noise = NOISE_STD * torch.randn(background.shape, generator=torch.Generator().manual_seed(0))
    return Unit(calibration, frames, _eight_bits(background + noise), "; ".join(str(warning.message) for warning in caught))


def _drawn(name: str) -> Unit:
    lights = ring_lights(16.0, 30.0, 50.0, 0.4) if name == "other_lights" else ring_lights(20.0, 25.0)
    size: dict[str, Any] = {"height": 240, "width": 320, "mm_per_pixel": 0.0634}
    sensor, draw = Sensor(name, **size), random.Random(0)
    balls = [(4.0 + 0.6 * k, 0.5 + 0.15 * k, (draw.uniform(-5.0, 5.0), draw.uniform(-3.0, 3.0))) for k in range(10)]
    scenes = [sphere_press(*ball, **size) for ball in balls]
    if name == LARGE:
        scenes = [sphere_press(radius, press, **size) for radius, press in ((35.0, 1.0), (50.0, 0.75), (60.0, 0.8))]
        scenes += [surface(punch_depth(radius, 0.6, tilt), **size) for radius, tilt in ((7.5, 2.0), (8.5, 1.0))]

    def photo(scene: Scene, seed: int) -> Tensor:
        return render(scene, lights, noise_std=NOISE_STD, bits=8, seed=seed)[0]

    flat = undeformed(scenes[0])
    calibration = Calibration.from_lights(lights, sensor, None if name == "lights_alone" else photo(flat, 0))
    texts = [
        f"{name} {k}: {float(s.depth_mm.max()):.2f} mm, covers {float(s.contact.float().mean()):.0%}" for k, s in enumerate(scenes)
    ]
    frames = [Target(texts[k], photo(scene, 10 + k), sets.truth_of(scene)) for k, scene in enumerate(scenes)]
    return Unit(calibration, frames, photo(flat, 1), "")


def measure(name: str, mode: str, limit: int = 10) -> Iterator[Reading]:
    """Read at most ``limit`` frames of one of :data:`UNITS` and its free skin under all changes, and frames of another unit."""
    unit = unit_of(name)
    pipe = ConfidentPipeline.from_calibration(unit.calibration, mode)
    changes = [change for change in CHANGES if name != LARGE or change.name in (AS_IS, "all x 0.7", "all x 1.3")]
    nowhere = torch.zeros(1, 1, *unit.free.shape[1:], dtype=torch.bool)
    known = [(frame, *_found(pipe.pipe, frame)) for frame in sets.spread(unit.frames, limit)]
    cases = [(change, *case) for case in [*known, (Target(FREE, unit.free), nowhere, nowhere, 0.0)] for change in changes]
    if name in OTHERS:
        other, foreign = unit_of(OTHERS[name]), Change(IMAGE, "another unit", lambda image: image)
        theirs = DepthPipeline.from_calibration(other.calibration, mode)
        cases += [(foreign, frame, *_found(theirs, frame)) for frame in sets.spread(other.frames, limit)]
    for change, frame, contact, deformed, before_mm in cases:
        image = _eight_bits(change.apply(frame.image))
        careful = mode == "fast" and change.part in (AS_IS, IMAGE) and name != LARGE
        out = pipe(image[None]) if careful else pipe.pipe(image[None])
        depth, seen = (maps.flip(-2, -1) if change.turned else maps for maps in (out.depth_mm, image))
        level, truth = _level(depth, contact), frame.truth
        yield Reading(
            *(name, mode, change.part, change.name, frame.name, level),
            ratio=level / before_mm if before_mm > 0.0 else None,
            saturated=float((seen >= 0.99).any(0)[contact[0, 0]].sum() / contact.sum().clamp_min(1)),
            outside_mm=float(torch.where(deformed, 0.0, depth).abs().max()),
            rms_mm=None if truth is None else float((depth - truth.depth_mm)[truth.region].square().mean().sqrt()),
            confidence=float(out.frame_confidence) if isinstance(out, ConfidentOutput) else None,
            findings=tuple(f"{f.severity} {f.name}" for f in diagnose(None, image, unit.calibration)) if careful else (),
        )


def _found(pipe: DepthPipeline, frame: Target) -> tuple[Tensor, Tensor, float]:
    """Contact, deformed area and level of a frame without a change."""
    out = pipe(_eight_bits(frame.image)[None])
    return out.contact, out.deformed, _level(out.depth_mm, out.contact)


def _level(depth_mm: Tensor, contact: Tensor) -> float:
    return float(depth_mm[contact].quantile(0.95)) if bool(contact.any()) else 0.0


LEGEND = """Level with the change over that without: median (worst), then how many frames are off by more than 10 %, of those with
less than a third of the contact saturated; then the largest depth in mm of free skin, and outside of what was deformed before."""


def tables(readings: Sequence[Reading], notes: Mapping[str, str]) -> str:
    """All tables in Markdown, and ``notes``, what calibration said of each unit."""
    parts = [*(f"* {name}: {note}" for name, note in notes.items() if note), LEGEND]
    for mode in dict.fromkeys(reading.mode for reading in readings):
        light = [reading for reading in _of(readings, mode=mode) if reading.unit != LARGE and reading.part != IMAGE]
        parts += [f"## mode {mode}", _grid(light, "part", "unit", _cell), _grid(light, "change", "unit", _cell)]
        large = [reading for reading in _of(readings, mode=mode, unit=LARGE) if reading.frame != FREE]
        parts += [f"## mode {mode}: RMS error, mm", _grid(large, "frame", "change", lambda found: f"{found[0].rms_mm:.3f}")]
    known = [reading for reading in _of(readings, mode="fast") if reading.ratio is not None and reading.part in (AS_IS, IMAGE)]
    return "\n\n".join([*parts, "## other images, mode fast", _other_images(known)])


def _of(readings: Sequence[Reading], **values: str) -> list[Reading]:
    return [reading for reading in readings if all(getattr(reading, key) == value for key, value in values.items())]


def _grid(readings: Sequence[Reading], row: str, column: str, cell: Callable[[Sequence[Reading]], str]) -> str:
    rows, columns = (list(dict.fromkeys(getattr(reading, key) for reading in readings)) for key in (row, column))
    return markdown([row, *columns], [[r, *(cell(_of(readings, **{row: r, column: c})) for c in columns)] for r in rows])


def _cell(found: Sequence[Reading]) -> str:
    ratios = [reading.ratio for reading in found if reading.ratio is not None]
    usable = [reading.ratio for reading in found if reading.ratio is not None and reading.saturated < 1.0 / 3.0]
    free, outside = (max((r.outside_mm for r in found if (r.frame == FREE) is skin), default=math.nan) for skin in (True, False))
    return f"{_ratio(ratios)}, {sum(abs(r - 1.0) > 0.1 for r in usable)} of {len(usable)}; {free:.3f}, {outside:.3f}"


def _ratio(ratios: Sequence[float]) -> str:
    return f"{statistics.median(ratios):.2f} ({max(ratios, key=lambda r: abs(r - 1.0)):.2f})" if ratios else ""


def _other_images(known: Sequence[Reading]) -> str:
    """One line for each unit and change, with medians; what is found in a frame as it is, is not new."""
    usual, lines = {(reading.unit, reading.frame): set(reading.findings) for reading in _of(known, change=AS_IS)}, []
    for unit, change in dict.fromkeys((reading.unit, reading.change) for reading in known if reading.unit != LARGE):
        found = _of(known, unit=unit, change=change)
        low = [r for r in found if r.ratio is not None and r.ratio < 0.5]
        sure = [r for r in low if r.confidence is not None and r.confidence > 0.5]
        new = [{f for f in r.findings if not f.startswith("note")} - usual.get((unit, r.frame), set()) for r in low]
        said = Counter(name for r in found for name in r.findings).most_common(4)
        counts = [str(count) for count in (len(found), len(low), len(sure), sum(not findings for findings in new))]
        texts = [_ratio([r.ratio or 0.0 for r in found]), f"{statistics.median(r.confidence or 0.0 for r in found):.2f}"]
        lines.append([unit, change, *counts, *texts, ", ".join(f"{name} {count}" for name, count in said)])
    titles = ["unit", "image", "frames", "below half", "and confidence > 0.5", "and no new warning or fault", "ratio", "confidence"]
    return markdown([*titles, "findings (frames)"], lines)
