"""Motion of dots against drawn truth and against rivals, and there and back on real sensors: rows for scripts/motion.py."""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from PIL import Image
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from torchvts import viz
from torchvts.core.blur import blur, gaussian_weights
from torchvts.core.files import IMAGE_SUFFIXES, natural_order, read_image
from torchvts.core.tables import markdown
from torchvts.model.markers import FillMarkers, find_dots
from torchvts.scenes import DottedSkin, Drag
from torchvts.skin import DotMotion, SkinMotion
from torchvts.skin.motion import DEPTH_MM, DEPTH_SHARE

PITCH = 0.0634
"""Of the drawn sensors, mm; drags are given in pixels."""

WRONG_PX = 3.0
"""A dot that is off by more is wrong."""

RIM = 1.2
"""Dots count that lie so many diameters from the border."""

BACKGROUNDS = 8
"""Frames whose mean is the background."""

FLOWS: Any = cv2
"""OpenCV, whose types know neither a flow without a start nor all classes."""

TERM = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.001)

Array = np.ndarray[Any, Any]


def drag(
    shift_px: tuple[float, float], turn_deg: float = 0.0, bulge_px: float = 0.0, press_px: float = 14.0, **rest: float
) -> Drag:
    """A drag in pixels of the drawn sensors, from the middle of the image."""
    values = {"radius_mm": 55.0, "reach_mm": 40.0} | {f"{name}_mm": value for name, value in rest.items() if name != "stuck"}
    lengths = {name: value * PITCH for name, value in values.items()}
    x, y = shift_px
    return Drag((0.0, 0.0), lengths["radius_mm"], press_px * PITCH, (x * PITCH, y * PITCH), turn_deg, bulge_px * PITCH,
                rest.get("stuck", 1.0), lengths["reach_mm"])  # fmt: skip


MIXED = drag((3.0, -1.5), 10.0, 3.0)
GENTLE = replace(MIXED, turn_deg=5.0)
SMALL = DottedSkin(spacing_mm=16.0 * PITCH, diameter_mm=5.5 * PITCH)

PAIRS: dict[str, tuple[DottedSkin, Drag, float]] = {
    **{f"shear {px:g} px": (DottedSkin(), drag((0.9 * px, -0.43 * px)), 0.0) for px in (0.05, 0.5, 2.0, 6.0, 12.0)},
    "press, turn 10 deg, shear": (DottedSkin(), MIXED, 0.0),
    "the same, 25 px deep": (DottedSkin(), replace(MIXED, press_mm=25.0 * PITCH), 0.0),
    "noise 4 of 255": (DottedSkin(noise_std=4.0 / 255.0), GENTLE, 0.0),
    "noise 8 of 255": (DottedSkin(noise_std=8.0 / 255.0), GENTLE, 0.0),
    "lens blur 2 px": (DottedSkin(blur_px=2.0), MIXED, 0.0),
    "dots of 5.5 px, 16 apart": (SMALL, GENTLE, 0.0),
    "hexagonal pattern": (DottedSkin(pattern="hexagonal"), MIXED, 0.0),
    "square dots": (DottedSkin(shape="square"), MIXED, 0.0),
    "rings": (DottedSkin(shape="ring"), MIXED, 0.0),
    "dots off their grid": (DottedSkin(worn=0.15), MIXED, 0.0),
    "coloured dots": (DottedSkin(darkness=(0.8, 0.6, 0.3)), MIXED, 0.0),
    "pinhole camera, 20 mm": (DottedSkin(camera_height_mm=20.0), MIXED, 0.0),
    "half of the dots gone": (DottedSkin(), replace(GENTLE, radius_mm=80.0 * PITCH), 0.5),
    "1.2 spacings at once": (DottedSkin(), drag((32.0, -15.0), 0.0, 3.0, radius=45.0, reach=39.0), 0.0),
}
"""Drawn pairs, each from rest: the skin, what the object does, and the share of dots under it that are gone."""


@dataclass
class Row:
    """Errors of one way on one pair: of dots in the image, and of their displacement in mm with its ratio to what is stated."""

    pair: str
    way: str
    error_px: list[float] = field(default_factory=list)
    error_mm: list[float] = field(default_factory=list)
    ratio: list[float] = field(default_factory=list)
    wrong: int = 0
    missing: int = 0
    dots: int = 0
    false: int = 0
    gone: int = 0

    def add(self, error: Array, known: Array, inside: Array, absent: Array, in_mm: tuple[Array, Array] | None = None) -> None:
        """Errors (N, 2) px of dots in view; which of them the way says it has found, and which are gone; errors and stds in mm."""
        there = inside & ~absent
        size = np.linalg.norm(error, axis=1)
        wrong = there & known & (size > WRONG_PX)
        right = there & known & ~wrong
        self.dots, self.missing = self.dots + int(there.sum()), self.missing + int((there & ~known).sum())
        self.gone, self.false = self.gone + int((inside & absent).sum()), self.false + int((inside & absent & known).sum())
        self.wrong += int(wrong.sum())
        self.error_px += error[right].ravel().tolist()
        if in_mm is not None:
            off, std = in_mm
            self.error_mm += off[right].ravel().tolist()
            self.ratio += np.abs(off[right] / std[right]).ravel().tolist()

    @property
    def rms_px(self) -> float:
        return float(np.sqrt(np.mean(np.square(self.error_px)))) if self.error_px else float("nan")

    @property
    def rms_um(self) -> float:
        return 1e3 * float(np.sqrt(np.mean(np.square(self.error_mm)))) if self.error_mm else float("nan")

    def within(self, stds: float) -> float:
        """Share of errors within so many standard deviations."""
        return float(np.mean(np.array(self.ratio) < stds)) if self.ratio else float("nan")


# rivals


def byte(image: Tensor) -> Array:
    """Grey image of 8 bits, as OpenCV takes it."""
    return (image.mean(0).numpy() * 255.0).round().astype(np.uint8)


def blobs(image: Tensor, diameter: float) -> Array:
    """Centres of dark blobs (N, 2), weighted by darkness."""
    grey = image.mean(0).numpy().astype(np.float32)
    dark = cv2.GaussianBlur(grey, (0, 0), 1.5 * diameter) - grey
    count, labels, stats, _ = cv2.connectedComponentsWithStats((dark > 0.4 * np.quantile(dark, 0.98)).astype(np.uint8))
    y, x = np.mgrid[: grey.shape[0], : grey.shape[1]]
    large = [k for k in range(1, count) if stats[k, cv2.CC_STAT_AREA] >= 0.15 * diameter**2]
    parts = [(dark * (labels == k), labels == k) for k in large]
    return np.array([((x * w)[one].sum() / w[one].sum(), (y * w)[one].sum() / w[one].sum()) for w, one in parts]).reshape(-1, 2)


def by_blobs(background: Tensor, frame: Tensor, dots: Array, diameter: float, spacing: float) -> Array:
    """Blobs of both, matched by the Hungarian method."""

    def match(before: Array, now: Array, most: float) -> Array:
        found = np.full_like(before, np.nan)
        if len(now):
            cost = np.nan_to_num(np.linalg.norm(before[:, None] - now[None], axis=2), nan=1e6)
            rows, columns = linear_sum_assignment(np.minimum(cost, most))
            near = cost[rows, columns] < most
            found[rows[near]] = now[columns[near]]
        return found

    rest = match(dots, blobs(background, diameter), 5.0)
    return match(rest, blobs(frame, diameter), 0.6 * spacing) - rest


def by_lucas_kanade(background: Tensor, frame: Tensor, dots: Array, diameter: float, spacing: float) -> Array:
    """Pyramids of Lucas and Kanade at the dots."""
    side = int(1.7 * diameter) | 1
    start = dots.astype(np.float32)[:, None]
    now, found, _ = FLOWS.calcOpticalFlowPyrLK(
        byte(background), byte(frame), start, None, winSize=(side, side), maxLevel=2, criteria=TERM
    )
    moved: Array = now[:, 0].astype(np.float64) - dots
    moved[found[:, 0] == 0] = np.nan
    return moved


def farneback(background: Tensor, frame: Tensor, start: Array | None = None) -> Array:
    """Farneback's flow (H, W, 2) with pyramids, from a start where there is one."""
    levels, flags = (4, 0) if start is None else (1, cv2.OPTFLOW_USE_INITIAL_FLOW)
    flow: Array = FLOWS.calcOpticalFlowFarneback(byte(background), byte(frame), start, 0.5, levels, 21, 8, 7, 1.5, flags)
    return flow


def dis(background: Tensor, frame: Tensor) -> Array:
    """Flow of OpenCV's dense inverse search."""
    search = FLOWS.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    search.setFinestScale(0)
    flow: Array = search.calc(byte(background), byte(frame), None)
    return flow


def at(flow: Array, places: Array) -> Array:
    """A flow (H, W, 2) at places (N, 2)."""
    x, y = (np.ascontiguousarray(places[:, k], dtype=np.float32)[:, None] for k in range(2))
    return np.stack([cv2.remap(np.ascontiguousarray(flow[..., k]), x, y, cv2.INTER_LINEAR).ravel() for k in range(2)], 1)


RIVALS: dict[str, Callable[[Tensor, Tensor, Array, float, float], Array]] = {
    "blobs, Hungarian": by_blobs,
    "Lucas-Kanade": by_lucas_kanade,
    "Farneback": lambda background, frame, dots, diameter, spacing: at(farneback(background, frame), dots),
    "DIS": lambda background, frame, dots, diameter, spacing: at(dis(background, frame), dots),
}
OURS = "SkinMotion"


# drawn


@dataclass
class Unit:
    """A drawn unit: its module, the background, and where its dots are, px."""

    skin: DottedSkin
    background: Tensor
    motion: SkinMotion
    dots: Array
    diameter: float

    @classmethod
    def of(cls, skin: DottedSkin, seed: int = 0) -> "Unit":
        light = skin.light()
        background = torch.stack([skin.with_noise(light, 1000 * seed + k) for k in range(BACKGROUNDS)]).mean(0)
        markers = FillMarkers.from_background(background)
        camera = (0.0, 0.0, skin.camera_height_mm)
        motion = SkinMotion(background, find_dots(background, markers), markers.diameter_px, skin.mm_per_pixel, camera)
        return cls(skin, background, motion.eval(), motion.rest_px.double().numpy(), skin.diameter_mm / skin.mm_per_pixel)

    def truth(self, moved: Drag) -> tuple[Tensor, Array, Array]:
        """Displacement (N, 3) mm of the dots, what a camera sees of it (N, 2) px, and which dots then lie in view."""
        rest = (torch.from_numpy(self.dots) - self._middle) * self.skin.mm_per_pixel
        true = moved.displacement_mm(rest)
        place = self.skin.seen_px(torch.cat((rest + true[:, :2], true[:, 2:]), 1)).numpy()
        rim = RIM * self.diameter
        most = np.array([self.skin.width - 1.0 - rim, self.skin.height - 1.0 - rim])
        inside: Array = np.all((place > rim) & (place < most), axis=1)
        return true, place - self.dots, inside

    def errors(self, got: DotMotion, true: Tensor, seen: Array) -> tuple[Array, tuple[Array, Array]]:
        """Of our motion: errors (N, 2) px in the image, and errors and standard deviations (N, 2) mm of the displacement."""
        image = (self.motion.px_of(got.displacement_mm)[0] - self.motion.rest_px).double().numpy() - seen
        off = (got.displacement_mm[0].double() - true)[:, :2].numpy()
        return image, (off, got.covariance_mm2[0].diagonal(dim1=1, dim2=2)[:, :2].sqrt().numpy())

    @property
    def _middle(self) -> Tensor:
        return torch.tensor([(self.skin.width - 1) / 2.0, (self.skin.height - 1) / 2.0], dtype=torch.float64)


def run_pairs(names: list[str], seeds: int) -> Iterator[Row]:
    """All ways on drawn pairs, so many noises each, on two skins."""
    for name in names:
        skin, moved, gone = PAIRS[name]
        rows = {way: Row(name, way) for way in (*RIVALS, OURS)}
        for seed in range(seeds):
            if seed in (0, seeds // 2):  # another skin
                skin = replace(skin, seed=20 + seed)
                unit = Unit.of(skin, seed + 1)
                left = None
                under = skin.dots_mm.norm(dim=1) < moved.radius_mm
                if gone:
                    draw = torch.rand(len(under), generator=torch.Generator().manual_seed(seed))
                    left = torch.where(under & (draw < gone), 0.0, 1.0)
                light, depth = skin.light(moved, left), skin.depth_mm(moved).float()
                true, seen, inside = unit.truth(moved)
                rest = (torch.from_numpy(unit.dots) - unit._middle) * PITCH
                absent = np.zeros_like(inside) if left is None else (left[torch.cdist(rest, skin.dots_mm).argmin(1)] < 0.5).numpy()
            frame = skin.with_noise(light, 500 + seed)
            spacing = unit.motion.spacing_px
            for way, rival in RIVALS.items():
                found = rival(unit.background, frame, unit.dots, unit.diameter, spacing)
                known = np.logical_not(np.isnan(found).any(axis=1))
                rows[way].add(found - seen, np.asarray(known), inside, absent)
            with torch.no_grad():
                got = unit.motion(frame[None], off_depth(depth, seed))
            error, in_mm = unit.errors(got, true, seen)
            rows[OURS].add(error, got.seen[0].numpy(), inside, absent, in_mm)
        yield from rows.values()


def off_depth(depth: Tensor, seed: int) -> Tensor:
    """Depth (1, 1, H, W) mm with as smooth and large an error as the module takes it to have."""
    draw = torch.Generator().manual_seed(seed)
    height, width = depth.shape[2:]
    error = blur(torch.randn(1, 1, height + 120, width + 120, generator=draw), gaussian_weights(20.0))[..., 60:-60, 60:-60]
    off: Tensor = (DEPTH_SHARE * depth).hypot(torch.tensor(DEPTH_MM)) * error * (40.0 * np.pi**0.5)
    return depth + off


def run_fields(seeds: int) -> Iterator[Row]:
    """The field between dots, on a grid of 4 px at least half a spacing from the border."""
    cases = {"shear 3.4 px": (DottedSkin(), drag((3.0, -1.5))), "press, turn 10 deg, shear": (DottedSkin(), MIXED),
             "the same, turn 5 deg, dots 16 px apart": (SMALL, GENTLE)}  # fmt: skip
    for name, (skin, moved) in cases.items():
        unit = Unit.of(skin, 1)
        light, depth = skin.light(moved), skin.depth_mm(moved).float()
        half = int(0.5 * skin.spacing_mm / PITCH)
        rest = skin.rest_mm()[half:-half:4, half:-half:4].reshape(-1, 2)
        true = moved.displacement_mm(rest)[:, :2].numpy() / PITCH
        rows = {way: Row(name, way) for way in ("Farneback", "DIS", OURS)}
        for seed in range(seeds):
            frame = skin.with_noise(light, 500 + seed)
            for way, flow in (("Farneback", farneback(unit.background, frame)), ("DIS", dis(unit.background, frame))):
                places = skin.seen_px(torch.nn.functional.pad(rest, (0, 1))).numpy()
                rows[way].error_px += (at(flow, places) - true).ravel().tolist()
            with torch.no_grad():
                mean, variance = unit.motion(frame[None], depth).at(rest.float())
            error = mean[0, :, :2].numpy() / PITCH - true
            rows[OURS].error_px += error.ravel().tolist()
            rows[OURS].ratio += np.abs(error / (variance[0, :, :2].sqrt().numpy() / PITCH)).ravel().tolist()
        yield from rows.values()


@dataclass
class SlipRow:
    """Slip under an object: shares found and true, and errors."""

    shift_px: float
    turn_deg: float
    stuck: float
    found: float
    true: float
    shift_error_px: float
    turn_error_deg: float
    slip_rms_px: float


def run_slips() -> Iterator[SlipRow]:
    """An object of 70 px radius that slips from its rim inward."""
    unit = Unit.of(DottedSkin(), 2)
    rest = unit.skin.rest_mm()
    for shift, turn in ((2.0, 0.0), (6.0, 0.0), (4.0, 6.0)):
        for stuck in (1.0, 0.8, 0.6, 0.4):
            moved = drag((shift, -0.4 * shift), turn, 0.0, 10.0, radius=70.0, reach=35.0, stuck=stuck)
            frame, depth = unit.skin.image(moved, 9), unit.skin.depth_mm(moved).float()
            contact = (unit.skin.rest_mm(moved).norm(dim=-1) < moved.radius_mm)[None, None]
            with torch.no_grad():
                got = unit.motion(frame[None], depth)
                slip = got.slip(contact)
            under = rest[rest.norm(dim=-1) < moved.radius_mm]
            away = (moved.object_mm(under) - moved.displacement_mm(under)[:, :2]).norm(dim=1)
            touched = ~slip.slip_mm[0, :, 0].isnan()
            places = got.rest_mm[touched].double()
            error = slip.slip_mm[0, touched] - (moved.object_mm(places) - moved.displacement_mm(places)[:, :2])
            off = (slip.shift_mm[0].double() - torch.tensor(moved.shift_mm)).norm()
            yield SlipRow(shift, turn, stuck, float(slip.stuck_share), float((away < 0.15 * PITCH).double().mean()),
                          float(off) / PITCH, float(slip.turn_deg) - turn, float(error.square().mean().sqrt()) / PITCH)  # fmt: skip


def film(frames: int) -> list[Drag]:
    """A press that is dragged to 1.5 spacings, turned by 20 degrees, and released; the last frame is at rest."""
    drags = []
    for k in range(frames):
        t = k / (frames - 1)
        pressed = min(1.0, t / 0.15) * min(1.0, (1.0 - t) / 0.15)
        pressed *= pressed * (3.0 - 2.0 * pressed)
        far = 45.0 * np.sin(np.pi * np.clip((t - 0.1) / 0.5, 0.0, 1.0)) ** 2 * pressed
        turn = 20.0 * np.sin(2.0 * np.pi * np.clip((t - 0.5) / 0.4, 0.0, 1.0)) * pressed
        drags.append(drag((0.9 * far, -0.43 * far), float(turn), 3.0 * pressed, 14.0 * pressed, reach=60.0))
    return drags


def run_film(frames: int, gone: float) -> Iterator[Row]:
    """A film from rest and back, from frame to frame; a share of the dots under the object is gone in its middle third."""
    skin = DottedSkin()
    unit = Unit.of(skin, 3)
    under = skin.dots_mm.norm(dim=1) < 55.0 * PITCH
    lost = under & (torch.rand(len(under), generator=torch.Generator().manual_seed(5)) < gone)
    near = torch.cdist((torch.from_numpy(unit.dots) - unit._middle) * PITCH, skin.dots_mm).argmin(1)
    title = f"{frames} frames" + (f", {int(lost.sum())} dots gone for a third" if gone else "")
    rows = {way: Row(title, way) for way in ("Lucas-Kanade, frame to frame", "Farneback, from the flow before", OURS)}
    last: DotMotion | None = None
    flow: Array | None = None
    before, chained = unit.background, unit.dots.copy()
    for k, moved in enumerate(film(frames)):
        away = lost & (frames / 3 < k < 2 * frames / 3)
        frame = skin.image(moved, 100 + k, 1.0 - away.double())
        true, seen, inside = unit.truth(moved)
        absent = away[near].numpy()
        chained = chained + by_lucas_kanade(before, frame, chained, unit.diameter, 30.0)
        flow = farneback(unit.background, frame, flow)
        for way, found in zip(rows, (chained - unit.dots, at(flow, unit.dots)), strict=False):
            rows[way].add(found - seen, ~np.isnan(found).any(1), inside, absent)
        with torch.no_grad():
            last = unit.motion(frame[None], skin.depth_mm(moved).float(), last)
        error, in_mm = unit.errors(last, true, seen)
        rows[OURS].add(error, last.seen[0].numpy(), inside, absent, in_mm)
        before = frame
    yield from rows.values()


def picture(path: Path, frames: int) -> None:
    """An animation of the film on a smaller skin: arrows of the dots over the image, and the field between them."""
    skin = DottedSkin(150, 200, 0.1)
    unit = Unit.of(skin, 4)
    drags = []
    for one in film(frames):
        x, y = one.shift_mm
        drags.append(replace(one, press_mm=0.8 * one.press_mm, shift_mm=(0.6 * x, 0.6 * y), radius_mm=3.2, reach_mm=3.5))
    last: DotMotion | None = None
    pictures = []
    extent = (0.0, 20.0, 15.0, 0.0)
    for k, moved in enumerate(drags):
        frame = skin.image(moved, k)
        with torch.no_grad():
            last = unit.motion(frame[None], skin.depth_mm(moved).float(), last)
            size = last.field()[0][0, :2].norm(dim=0)
        figure = viz.new_figure(6.4, 2.7, 80)
        left, right = figure.subplots(1, 2)
        left.imshow(frame.permute(1, 2, 0).numpy(), extent=extent)
        viz.draw_motion(left, last)
        left.set_title("dots: arrows in true length", fontsize=9)
        drawn = right.imshow(size.numpy(), extent=extent, vmin=0.0, vmax=2.2, cmap="cividis")
        figure.colorbar(drawn, ax=right, label="mm")
        right.set_title("motion of the skin between them", fontsize=9)
        for axes in (left, right):
            axes.set_xlabel("x, mm", fontsize=8)
            axes.tick_params(labelsize=7)
        figure.canvas.draw()
        pictures.append(Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()))  # type: ignore[attr-defined]
    colors = pictures[frames // 3].quantize(128)  # the same in all frames
    first, *others = (one.quantize(palette=colors, dither=Image.Dither.NONE) for one in pictures)
    first.save(path, save_all=True, append_images=others, duration=120, loop=0, optimize=True)


# real sensors

REAL = {
    "wyh_wedge_markers": ("background.png", "*.png"), "gelslim_b": ("background.png", "*.png"),
    "gelslim_mcube": ("background.png", "*.png"), "gelslim_markers": ("ref.jpg", "*.jpg"),
    "gelsight_bnz": ("background.png", "*.png"), "tactex_mini_markers": ("background.png", "*.png"),
}  # fmt: skip


@dataclass
class RealRow:
    """A real sensor without truth: shares, and differences in px."""

    name: str
    dots: int
    diameter_px: float
    frames: int
    seen: float
    largest_px: float
    back_median_px: float
    back_99_px: float
    flow_median_px: float
    flow_90_px: float
    left_out_rms_px: float
    within_1: float
    within_2: float


def run_real(data: Path, limit: int) -> Iterator[RealRow]:
    """There and back, against Farneback, and one dot in five left out and told by the field."""
    for name, (rest, pattern) in REAL.items():
        background = read_image(data / name / rest)
        markers = FillMarkers.from_background(background)
        images = sorted((data / name).glob(pattern), key=lambda file: natural_order(file.name))
        files = [file for file in images if file.name != rest and file.suffix.lower() in IMAGE_SUFFIXES]
        there = SkinMotion(background, find_dots(background, markers), markers.diameter_px, 1.0, (0.0, 0.0, float("inf")))
        zero = torch.zeros(1, 1, *background.shape[1:])
        seen, largest, back, apart, out, ratio = [], 0.0, [], [], [], []
        chosen = files[:: max(1, len(files) // limit)][:limit]
        for k, file in enumerate(chosen):
            frame = read_image(file)
            with torch.no_grad():
                moved = there(frame[None], zero)
                known = moved.seen[0]
                shift = moved.displacement_mm[0, :, :2]
                seen.append(float(known.double().mean()))
                largest = max(largest, float(shift[known].norm(dim=1).max()))
                flow = at(farneback(background, frame), there.rest_px.numpy())
                apart += np.linalg.norm(flow - shift.numpy(), axis=1)[known].tolist()
                home = SkinMotion(frame, (there.rest_px + shift)[known], markers.diameter_px, 1.0, (0.0, 0.0, float("inf")))
                start = home(frame[None], zero)
                kept = torch.cdist(home.rest_px, (there.rest_px + shift)[known]).argmin(1)
                start = start._replace(displacement_mm=torch.nn.functional.pad(-shift[known][kept], (0, 1))[None])
                again = home(background[None], zero, start)
                back += (shift[known][kept] + again.displacement_mm[0, :, :2])[again.seen[0]].norm(dim=1).tolist()
                left_out = known & (torch.rand(len(known), generator=torch.Generator().manual_seed(k)) < 0.2)
                mean, variance = moved._replace(seen=moved.seen & ~left_out[None]).at(moved.rest_mm[left_out])
                error = mean[0, :, :2] - shift[left_out]
                both = variance[0, :, :2] + moved.covariance_mm2[0, left_out].diagonal(dim1=1, dim2=2)[:, :2]
                out += error.flatten().tolist()
                ratio += (error / both.sqrt()).abs().flatten().tolist()
        yield RealRow(
            *(name, len(there.rest_px), markers.diameter_px, len(chosen), float(np.mean(seen)), largest),
            *(*np.quantile(back, (0.5, 0.99)).tolist(), *np.quantile(apart, (0.5, 0.9)).tolist()),
            *(float(np.sqrt(np.mean(np.square(out)))), *(float((np.array(ratio) < stds).mean()) for stds in (1, 2))),
        )


# tables


def _within(row: Row) -> str:
    return f"{row.within(1.0):.2f}, {row.within(2.0):.2f}" if row.ratio else ""


TABLES: dict[str, tuple[str, Callable[[Any], str]]] = {
    "field": (
        "field between dots | way | rms, px | worst, px | within 1, 2 sigma",
        lambda row: f"{row.pair} | {row.way} | {row.rms_px:.3f} | {max(map(abs, row.error_px)):.2f} | {_within(row)}",
    ),
    "slip": (
        "object moves | stick | stuck share, found / true | shift off, px | turn off, deg | slip rms, px",
        lambda row: (
            f"{row.shift_px:g} px, {row.turn_deg:g} deg | {row.stuck:g} | {row.found:.2f} / {row.true:.2f} | "
            f"{row.shift_error_px:.3f} | {row.turn_error_deg:+.3f} | {row.slip_rms_px:.3f}"
        ),
    ),
    "film": (
        "film to 45 px and back | way | rms, px | wrong | missing | of | gone, said to be seen",
        lambda row: (
            f"{row.pair} | {row.way} | {row.rms_px:.3f} | {row.wrong} | {row.missing} | {row.dots} | "
            + (f"{row.false} of {row.gone}" if row.gone else "")
        ),
    ),
    "real": (
        "sensor | dots | frames | seen | moved, px | there and back: median, 99 % | against Farneback: median, 90 % | "
        "one dot in five left out: rms, within 1, 2 sigma",
        lambda row: (
            f"{row.name} | {row.dots} of {row.diameter_px:.0f} px | {row.frames} | {row.seen:.3f} | {row.largest_px:.1f} | "
            f"{row.back_median_px:.3f}, {row.back_99_px:.2f} | {row.flow_median_px:.3f}, {row.flow_90_px:.2f} | "
            f"{row.left_out_rms_px:.2f}, {row.within_1:.2f}, {row.within_2:.2f}"
        ),
    ),
}
"""Titles of a part's table, and the cells of a row."""


def table(part: str, rows: list[Any]) -> str:
    """The rows of a part as Markdown; of pairs rms in px per axis, wrong and missing dots, and coverage of ours."""
    if part != "pairs":
        titles, cells_of = TABLES[part]
        return markdown(titles.split(" | "), [cells_of(row).split(" | ") for row in rows])
    ways = list(dict.fromkeys(row.way for row in rows))
    lines = []
    for pair in dict.fromkeys(row.pair for row in rows):
        here = {row.way: row for row in rows if row.pair == pair}
        best = min(row.rms_px for row in here.values())
        cells = []
        for row in here.values():
            text = f"**{row.rms_px:.3f}**" if row.rms_px < 1.005 * best else f"{row.rms_px:.3f}"
            text += f", {row.wrong} wrong" if row.wrong else ""
            text += f", {row.missing} missing" if row.missing else ""
            cells.append(text + (f", {row.false} of {row.gone} gone seen" if row.gone else ""))
        lines.append([pair, *cells, f"{here[OURS].rms_um:.2f}", _within(here[OURS])])
    return markdown(["pair, from rest", *ways, "um", "within 1, 2 sigma"], lines)


def to_json(rows: list[Any]) -> str:
    """The rows without their single errors."""
    kept = [{key: value for key, value in vars(row).items() if not isinstance(value, list)} for row in rows]
    return json.dumps([one | ({"rms_px": row.rms_px} if isinstance(row, Row) else {}) for one, row in zip(kept, rows)], indent=1)
