"""The data that methods are scored on: a folder of presses, the real sensors of the data folder, and drawn sensors.

No set is scored on presses that were learned from, and no prior is used that has seen the presses that are scored.
"""

import dataclasses
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from torchvts.calibration import RESPONSE_BLUR_PX, Press, fit_prior, read_presses
from torchvts.cli.options import cut_frames
from torchvts.compensate import Compensate
from torchvts.core.checks import check_image, check_integer
from torchvts.core.files import read_image
from torchvts.core.geometry import GradientFromNormal
from torchvts.core.recordings import image_files
from torchvts.integration import poisson_dct
from torchvts.model import Calibration, Sensor
from torchvts.normals import NormalFromMLP
from torchvts.pipeline import DepthPipeline
from torchvts.scenes import Scene
from torchvts.skin import ZeroBackground
from torchvts.training.balls import Truth, ball_truth, label
from torchvts.training.presses import with_centers

from .drawn_sensors import SEEDS, drawn_sensor
from .methods import Method, shipped_prior, with_network
from .rims import visible_rim

CHANGED = 15.0 / 255.0
"""A pixel of gelsight_mini_b is scored where a channel has changed by more than this."""


T = TypeVar("T")


class Target(NamedTuple):
    """A frame to score.

    Attributes:
        name: name of the press.
        image: (3, H, W) in [0, 1], R, G, B.
        truth: what it shows; None where that is unknown.
        ball: the ball that was pressed, with centre and contact radius; None for other objects.
    """

    name: str
    image: Tensor
    truth: Truth | None = None
    ball: Press | None = None


class Fold(NamedTuple):
    """Presses to learn from, and frames of other presses to score.

    Attributes:
        sensor: the sensor, with a prior if one may be used.
        learned: presses to learn from; without any, the background alone.
        scored: the frames.
    """

    sensor: Sensor
    learned: Sequence[Press]
    scored: Sequence[Target]


@dataclass(frozen=True, eq=False)
class DataSet:
    """A unit and its presses.

    Attributes:
        name: its name in tables.
        background: (3, H, W) in [0, 1], image without contact, to learn from.
        folds: one fold or more.
        how: what is held out, and where the truth comes from.
        methods: methods that only this set has.
    """

    name: str
    background: Tensor
    folds: Sequence[Fold]
    how: str
    methods: tuple[Method, ...] = ()


# a folder of presses


def from_folder(
    folder: str | Path, sensor: Sensor, *, folds: int = 5, network: str | Path | None = None, limit: int | None = None
) -> DataSet:
    """Presses of balls in gs_sdk's layout; press i is in fold i % folds.

    Args:
        folder: the folder.
        sensor: the sensor.
        folds: parts of the cross-validation; with 1 the presses that were learned from are scored.
        network: file of a trained network that is to be scored too.
        limit: use only so many presses, spread over the catalog.
    Raises:
        ValueError: too few presses, or none that can be scored.
        FileNotFoundError: no such folder or file.
    """
    background, presses = cut_frames(*read_presses(folder), sensor)
    check_image("background", background, sensor.height, sensor.width, sensor.name)
    if network is not None:
        NormalFromMLP.load(network, background)  # a bad one is refused before the work, also where no method needs it
    presses = spread(presses, limit)
    if check_integer("folds", folds, 1) > len(presses):
        raise ValueError(f"folds: expected at most the number of presses, {len(presses)}, got {folds}")
    targets, source = with_truth(background, sensor, presses)
    if not targets:
        raise ValueError(f"folder: none of {len(presses)} presses has a contact radius: nothing can be scored")
    names = {target.name for target in targets}
    if left_out := [press.name for press in presses if press.name not in names]:
        source += f"; not scored, no contact radius: {', '.join(left_out)}"
    split = [Fold(sensor, presses, targets)] if folds == 1 else cross_validation(sensor, presses, targets, folds)
    how = f"{folds}-fold cross-validation over" if folds > 1 else "learned from and scored:"
    methods = () if network is None else (with_network(Path(network)),)
    return DataSet(Path(folder).name, background, split, f"{how} {len(presses)} presses, without labels; {source}", methods)


def spread(items: Sequence[T], limit: int | None) -> list[T]:
    """``limit`` items at equal steps of the catalog, which lists one ball after the other; None for all."""
    count = len(items) if limit is None else min(check_integer("limit", limit, 1), len(items))
    return [items[k * len(items) // count] for k in range(count)]


def cross_validation(sensor: Sensor, presses: Sequence[Press], targets: Sequence[Target], folds: int) -> list[Fold]:
    """Press i is scored in fold i % folds, and learned from in all others."""
    by_name = {target.name: target for target in targets}
    return [
        Fold(
            sensor,
            [press for i, press in enumerate(presses) if i % folds != fold],
            [by_name[press.name] for press in presses[fold::folds] if press.name in by_name],
        )
        for fold in range(folds)
    ]


def with_truth(background: Tensor, sensor: Sensor, presses: Sequence[Press]) -> tuple[list[Target], str]:
    """The presses that can be scored: labelled ones, and without a label those that ``calibrate`` locates; and the source."""
    bare = sum(press.center_px is None for press in presses)
    counts = {"labels": len(presses) - bare, "calibrate on the scored presses": bare}
    how = "centers from " + " and ".join(f"{source} ({count})" for source, count in counts.items() if count)
    size = (sensor.height, sensor.width, sensor.mm_per_pixel)
    known = with_centers(background, sensor, presses)
    return [Target(press.name, press.image, ball_truth(press, *size), press) for press in known], how


# the real sensors


def _mini_a(folder: Path, limit: int | None) -> DataSet:
    """The balls of each diameter by five folds, with a prior that is fitted to those of the other."""
    background, presses = read_presses(folder)
    shipped = Sensor.load("gelsight_mini")
    folds: list[Fold] = []
    for ball in sorted({press.ball_diameter_mm for press in presses}):
        own = spread([press for press in presses if press.ball_diameter_mm == ball], limit)
        others = [press for press in presses if press.ball_diameter_mm != ball]
        prior = fit_prior(background, shipped, others, "the presses of the other ball, with their labels")
        targets, how = with_truth(background, shipped, own)
        folds += cross_validation(dataclasses.replace(shipped, prior=prior), own, targets, min(5, len(own)))
    seen = Method("precise, shipped prior", from_presses=partial(shipped_prior, sensor=shipped), learns=False, seen=True)
    how = f"each ball by five folds, prior of the other ball; {how}"
    return DataSet(folder.name, background, folds, how, (with_network(folder / "model" / "nnmodel.pth"), seen))


def _mini_b(folder: Path, limit: int | None) -> DataSet:
    """A bead, from the background alone; the truth is the integrable part of the unit's own network where the image has changed.

    The network gives undeformed skin slopes of 1.8 degrees, and integrated they leave pits of 0.34 mm: its depth is zeroed there as
    that of the pipeline is.
    """
    background, bead = (read_image(folder / name) for name in ("background.png", "bead.png"))
    sensor, smooth = Sensor.load("gelsight_mini"), Compensate(blur_px=RESPONSE_BLUR_PX)
    with torch.inference_mode():
        before, image = smooth(background[None]), smooth(bead[None])
        own = GradientFromNormal()(NormalFromMLP.load(folder / "model" / "nnmodel.pth", before[0].clamp(0, 1))(image))
        depth = poisson_dct(own.double(), sensor.mm_per_pixel)
        assert sensor.prior is not None
        pipe = DepthPipeline.from_calibration(Calibration.from_response(sensor.prior.response, sensor, background))
        depth = ZeroBackground(sensor.mm_per_pixel)(depth, pipe.frame_of(bead[None])[0].weight.double())
    changed = (image - before).abs().amax(1, keepdim=True) > CHANGED
    gradient = torch.stack(torch.gradient(depth[0, 0], spacing=sensor.mm_per_pixel)[::-1])[None]  # torch gives rows first
    target = Target("bead", bead, Truth(depth, gradient, changed))
    how = (
        "from the background and the shipped prior; truth: the integrable part of the unit's own network, zero on undeformed skin, "
        "in the changed part"
    )
    return DataSet(folder.name, background, [Fold(sensor, (), (target,))], how)


def _mini_c(folder: Path, limit: int | None) -> DataSet:
    """Raw frames, cut by a seventh on each side as gs_sdk does; the background is the median of the presses.

    The prior is that of another unit, since the shipped one has seen these presses.
    """
    sensor = Sensor.load("gelsight_mini")
    background, others = read_presses(folder.parent / "gelsight_mini_a")
    sensor = dataclasses.replace(sensor, prior=fit_prior(background, sensor, others, "the presses of gelsight_mini_a"))
    files = spread([file for file in image_files(folder) if file.match("frame_*.jpg")], limit)
    images = torch.stack([read_image(file) for file in files])
    height, width = images.shape[2:]
    top, left = round(height / 7), round(width / 7)
    roi = (left, top, width - 2 * left, height - 2 * top)
    images = dataclasses.replace(sensor, roi_px=roi, raw_size_px=()).rectify(images)
    presses = [Press(image, 4.0, file.stem) for image, file in zip(images, files, strict=True)]
    return _halves(folder.name, images.median(0).values, sensor, presses, "background: median of the presses")


def _balls(
    folder: Path,
    limit: int | None,
    remark: str = "",
    *,
    meta: Mapping[str, Any] | None = None,
    labelled: bool = True,
    files: tuple[str, str] = ("background.png", "ball_*.png"),
) -> DataSet:
    """Presses of one ball, by halves: its folder's meta.json or ``meta``, and labels.csv where there is one and it is trusted."""
    values = meta or json.loads((folder / "meta.json").read_text(encoding="utf-8"))
    sensor = Sensor(folder.name, values["height"], values["width"], values["pitch"], markers=values.get("markers") or None)
    labels: dict[str, tuple[tuple[float, float] | None, float | None]] = {}
    if labelled and (table := folder / "labels.csv").is_file():
        for line in table.read_text(encoding="utf-8").split()[1:]:
            name, x, y, radius = line.split(",")
            labels[name] = (float(x), float(y)), float(radius)
    found = spread([file for file in image_files(folder) if file.match(files[1])], limit)
    presses = [Press(read_image(file), values["diameter"], file.stem, *labels.get(file.stem, (None, None))) for file in found]
    return _halves(folder.name, read_image(folder / files[0]), sensor, presses, remark)


def _pale_by_rims(folder: Path, limit: int | None) -> DataSet:
    """gelsight_pale with the bright rims of its contacts as truth, which no model of slopes found, and not its hand labels."""
    data = REAL["gelsight_pale"](folder.with_name("gelsight_pale"), limit)
    size = (data.folds[0].sensor.height, data.folds[0].sensor.width, data.folds[0].sensor.mm_per_pixel)
    away: list[tuple[float, float]] = []
    folds = []
    for fold in data.folds:
        targets = []
        for target in (target for target in fold.scored if target.ball is not None):
            assert target.ball is not None
            center, radius = label(target.ball)
            rim = visible_rim(target.image, data.background, center, radius)
            away.append((center[0] - rim.center_px[0], center[1] - rim.center_px[1]))
            ball = dataclasses.replace(target.ball, center_px=rim.center_px, contact_radius_px=rim.radius_px)
            targets.append(target._replace(ball=ball, truth=ball_truth(ball, *size)))
        folds.append(fold._replace(scored=targets))
    (x, y), (spread_x, spread_y) = np.mean(away, 0), np.std(away, 0)
    how = f"truth: rims, from which the hand labels lie ({x:.1f}, {y:.1f}) px off, spread ({spread_x:.1f}, {spread_y:.1f}) px"
    return dataclasses.replace(data, name=folder.name, folds=folds, how=f"half learned from, half scored, both ways; {how}")


def _halves(name: str, background: Tensor, sensor: Sensor, presses: Sequence[Press], remark: str = "") -> DataSet:
    """Half of the presses is learned from and the other half scored, and the other way round."""
    folds, notes = [], [remark] if remark else []
    for half in (0, 1):
        scored = presses[1 - half :: 2]
        try:
            targets, how = with_truth(background, sensor, scored)
        except ValueError as error:
            targets, how = [], f"no truth: {' '.join(str(error).split())}"
        known = {target.name for target in targets}
        targets += [Target(press.name, press.image) for press in scored if press.name not in known]
        folds.append(Fold(sensor, presses[half::2], targets))
        notes.append(how)
    return DataSet(
        name, background, folds, f"half learned from, half scored, and the other way round; {'; '.join(dict.fromkeys(notes))}"
    )


_FOTS = {"height": 320, "width": 240, "pitch": 1.0 / 19.58, "diameter": 4.70}  # pixels per mm by the code of FOTS
_GELSLIM = {"height": 320, "width": 427, "pitch": 0.05, "diameter": 5.0, "markers": True}

REAL: dict[str, Callable[[Path, int | None], DataSet]] = {
    "gelsight_mini_a": _mini_a,
    "gelsight_mini_b": _mini_b,
    "gelsight_mini_c": _mini_c,
    "gelsight_pale": partial(_balls, remark="labels by hand, good to 1 to 2 px", meta=_FOTS),
    "gelsight_pale_rims": _pale_by_rims,
    "gelsight_bnz": _balls,
    "digit_a": partial(_balls, meta=_FOTS),
    "digit_b": partial(_balls, remark="its labels are rough, 0.1 to 7 px from located centers, and not used", labelled=False),
    "gelslim_markers": partial(
        _balls,
        remark="pitch of 0.05 mm and ball of 5 mm are assumed (gelslim_mcube says 0.106 and 7.6)",
        meta=_GELSLIM,
        files=("ref.jpg", "sample_*.jpg"),
    ),
    "gelslim_b": _balls,
    "gelslim_mcube": _balls,
    "wyh_wedge_markers": partial(_balls, remark="its labels are 2 to 6 px from located centers, and not used", labelled=False),
    "wyh_wedge_clear": _balls,
}
"""How the folder of each real sensor is read: (the folder, at most so many presses) to a :class:`DataSet`."""


# drawn sensors


def _drawn(name: str, limit: int | None) -> DataSet:
    """Balls are learned from, without labels; objects that are no balls are scored."""
    unit = drawn_sensor(int(name.split("_")[1]))
    targets = [Target(press.name, press.image, truth_of(press.scene)) for press in unit.objects]
    how = "balls learned from without labels; other objects, exact truth"
    return DataSet(name, unit.background, [Fold(unit.sensor, spread(unit.balls, limit), targets)], how)


def truth_of(scene: Scene) -> Truth:
    """The truth of an exact scene, to be scored in its contact."""
    return Truth(scene.depth_mm.double(), scene.gradient.double(), scene.contact, scene.contact, from_undeformed=True)


DRAWN = tuple(f"drawn_{seed}" for seed in SEEDS)
"""Names of the drawn sensors, by their seeds."""

SETS = (*REAL, *DRAWN)
"""Names of all sets."""


def data_folder() -> Path:
    """Folder of third-party images: TORCHVTS_DATA, else ../shared/data beside this checkout."""
    return Path(os.environ.get("TORCHVTS_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))


def load(name: str, data: Path, limit: int | None = None) -> DataSet:
    """Read a real set, or draw one.

    Args:
        name: one of :data:`SETS`.
        data: folder of the real sets.
        limit: use only so many presses (of each ball).
    Raises:
        ValueError: an unknown name, or bad data.
        FileNotFoundError: no such folder.
    """
    if name in DRAWN:
        return _drawn(name, limit)
    if name not in REAL:
        raise ValueError(f"sets: expected some of {', '.join(SETS)}, got {name!r}")
    if not (data / name.removesuffix("_rims")).is_dir():
        raise FileNotFoundError(f"{data / name}: no such folder: set TORCHVTS_DATA to the folder of the real sensors")
    return REAL[name](data / name, limit)
