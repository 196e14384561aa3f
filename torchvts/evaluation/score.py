"""Score of one frame against the ball of known size that was pressed."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from ..calibration import (
    RESPONSE_BLUR_PX,
    CalibrationWarning,
    Press,
    by_presses,
    calibrate,
    fit_prior,
    read_presses,
    with_preprocessing,
)
from ..compensate import Compensate
from ..contact import ContactMask
from ..core.checks import check_image, check_integer, check_same_size
from ..core.geometry import GradientFromNormal, normal_from_gradient, pixel_grid_mm
from ..integration import PoissonBackground
from ..model.calibration import Calibration
from ..model.response_field import ResponseModel
from ..model.sensor import Sensor
from ..normals import NormalFromIntensity, NormalFromLookup, NormalFromMLP, NormalFromResponse
from ..pipeline import DepthOutput, DepthPipeline
from ..training import MlpFit, fit_mlp
from ..viz import draw_contours
from .metrics import fit_sphere, normal_angle_deg

RIM_PX = 3.0
"""Width of the ring inside the contact radius that is not scored: there the skin leaves the ball, and labels are a pixel off."""

SLOPE_EDGES = (0.2, 0.4, 0.6)
"""Edges of the bins of true slope in ``by_slope_deg``, mm per mm."""

PLACES = 3
"""Number of rows and of columns of image parts in ``by_place_deg``."""


class BallTruth(NamedTuple):
    """The ball under a press, float64.

    Attributes:
        depth_mm: (1, 1, H, W), height of the ball above its equator, mm.
        gradient: (1, 2, H, W), its slope, mm per mm.
        region: (1, 1, H, W) bool, the pixels to score.
    """

    depth_mm: Tensor
    gradient: Tensor
    region: Tensor


@dataclass(frozen=True)
class PressScore:
    """Errors of one method on one press, inside the contact radius less :data:`RIM_PX`.

    Attributes:
        press: name of the press.
        method: name of the method.
        normal_deg: mean angle between normals, degrees.
        relief_um: RMS difference of depth and ball, each less its own mean, micrometres.
        tilt_um: the part of ``relief_um`` that is a plane: the effect of a wrong label of the centre, and of errors that a
            response field makes alike all over a contact.
        radius_percent: error of the radius of a sphere fitted to the depth, percent; None where the depth is a plane.
        center_px: error of the centre of that sphere, pixels; None where the depth is a plane.
        apex_um: error of the depth of the middle above the rim of the region, micrometres; None if the image cuts off either.
        by_slope_deg: mean angle where the slope of the ball is below 0.2, 0.4, 0.6, and above; None without pixels.
        by_slope_pixels: number of pixels in each bin of slope.
        by_place_deg: mean angle in 3 x 3 parts of the image, row by row; None without pixels.
        by_place_pixels: number of pixels in each part.
    """

    press: str
    method: str
    normal_deg: float
    relief_um: float
    tilt_um: float
    radius_percent: float | None
    center_px: float | None
    apex_um: float | None
    by_slope_deg: tuple[float | None, ...]
    by_slope_pixels: tuple[int, ...]
    by_place_deg: tuple[float | None, ...]
    by_place_pixels: tuple[int, ...]


def ball_truth(press: Press, height: int, width: int, mm_per_pixel: float) -> BallTruth:
    """The sphere that the skin follows inside the contact.

    Args:
        press: press with centre and contact radius.
        height: rows of the image.
        width: columns of the image.
        mm_per_pixel: pixel pitch, mm.
    Returns:
        Depth, slope and the region to score.
    Raises:
        ValueError: the press has no centre or no contact radius.
    Example:
        >>> press = Press(torch.zeros(3, 31, 31), 6.0, "middle", (15.0, 15.0), 13.0)
        >>> truth = ball_truth(press, 31, 31, 0.1)
        >>> round(float(truth.depth_mm[0, 0, 15, 15]), 3), int(truth.region.sum())
        (3.0, 305)
    """
    (center_x, center_y), contact_radius_px = label(press)
    x, y = pixel_grid_mm(height, width, mm_per_pixel, torch.float64)
    dx = x - (center_x - (width - 1) / 2) * mm_per_pixel
    dy = y - (center_y - (height - 1) / 2) * mm_per_pixel
    radius_mm = 0.5 * press.ball_diameter_mm
    r_squared = dx**2 + dy**2
    depth = torch.sqrt((radius_mm**2 - r_squared).clamp_min((0.2 * radius_mm) ** 2))
    gradient = -torch.stack((dx.expand_as(depth), dy.expand_as(depth))) / depth
    reach_mm = min((contact_radius_px - RIM_PX) * mm_per_pixel, 0.95 * radius_mm)
    region = (r_squared < reach_mm**2) if reach_mm > 0 else torch.zeros_like(depth, dtype=torch.bool)
    return BallTruth(depth[None, None], gradient[None], region[None, None])


def label(press: Press) -> tuple[tuple[float, float], float]:
    """Centre (x, y) and contact radius of a press, pixels.

    Raises:
        ValueError: one of them is missing.
    """
    if press.center_px is None or press.contact_radius_px is None:
        raise ValueError(f"press: expected one with center_px and contact_radius_px, '{press.name}' has none: it cannot be scored")
    return press.center_px, press.contact_radius_px


def score_press(press: Press, depth_mm: Tensor, normal: Tensor, mm_per_pixel: float, method: str = "") -> PressScore:
    """Compare one frame with the ball that was pressed.

    Args:
        press: press with centre and contact radius.
        depth_mm: (1, 1, H, W), measured depth, mm.
        normal: (1, 3, H, W), measured unit normals.
        mm_per_pixel: pixel pitch, mm.
        method: name that is kept with the score.
    Returns:
        The errors.
    Raises:
        ValueError: wrong shapes, a missing centre or contact radius, or a region too small for a sphere.
    Example:
        >>> press = Press(torch.zeros(3, 31, 31), 6.0, "middle", (15.0, 15.0), 13.0)
        >>> truth = ball_truth(press, 31, 31, 0.1)
        >>> score = score_press(press, truth.depth_mm, normal_from_gradient(truth.gradient), 0.1)
        >>> round(score.normal_deg, 6), round(score.relief_um, 6), round(abs(score.radius_percent), 6)
        (0.0, 0.0, 0.0)
    """
    truth = _checked_truth(press, depth_mm, normal, mm_per_pixel)
    region = truth.region[0, 0]
    depth = depth_mm.detach().cpu().double()
    angle = normal_angle_deg(normal.detach().cpu().double(), normal_from_gradient(truth.gradient))[0][region]  # (N,)
    error = (depth - truth.depth_mm)[0, 0][region]
    rows, columns = torch.nonzero(region, as_tuple=True)
    steepness = truth.gradient[0].norm(dim=0)[region]
    slope_bin = torch.bucketize(steepness, torch.tensor(SLOPE_EDGES, dtype=torch.float64), right=True)
    height, width = region.shape
    place_bin = (rows * PLACES // height) * PLACES + columns * PLACES // width
    by_slope, slope_pixels = _by_bin(angle, slope_bin, len(SLOPE_EDGES) + 1)
    by_place, place_pixels = _by_bin(angle, place_bin, PLACES * PLACES)
    radius_percent, center_px = _sphere_error(press, depth, truth, mm_per_pixel)
    return PressScore(
        press=press.name,
        method=method,
        normal_deg=float(angle.mean()),
        relief_um=1000.0 * float(error.std(correction=0)),
        tilt_um=1000.0 * _tilt(error, torch.stack((columns, rows))),
        radius_percent=radius_percent,
        center_px=center_px,
        apex_um=_apex_um(press, error, columns, rows),
        by_slope_deg=by_slope,
        by_slope_pixels=slope_pixels,
        by_place_deg=by_place,
        by_place_pixels=place_pixels,
    )


def _checked_truth(press: Press, depth_mm: Tensor, normal: Tensor, mm_per_pixel: float) -> BallTruth:
    """The ball, after a check that one frame was given and that its region is large enough."""
    if depth_mm.dim() != 4 or tuple(depth_mm.shape[:2]) != (1, 1):
        raise ValueError(f"depth_mm: expected one frame, (1, 1, H, W), got {tuple(depth_mm.shape)}: loop over the batch")
    height, width = depth_mm.shape[2], depth_mm.shape[3]
    if tuple(normal.shape[:2]) != (1, 3):
        raise ValueError(f"normal: expected one frame, (1, 3, H, W), got {tuple(normal.shape)}: loop over the batch")
    check_same_size("normal", normal, "depth_mm", height, width)
    truth = ball_truth(press, height, width, mm_per_pixel)
    if int(truth.region.sum()) < 10:
        raise ValueError(
            f"press: '{press.name}' has {int(truth.region.sum())} pixels {RIM_PX:g} px inside its contact radius of "
            f"{press.contact_radius_px:g} px, 10 are needed: pressed too faintly, or outside of the image"
        )
    return truth


def _tilt(error: Tensor, place: Tensor) -> float:
    """RMS of the plane that fits error (N,) at places (2, N) best, less its mean."""
    across = (place - place.double().mean(1, keepdim=True)).t()
    plane = across @ torch.linalg.lstsq(across, (error - error.mean())[:, None]).solution
    return float(plane.std(correction=0))


def _apex_um(press: Press, error: Tensor, columns: Tensor, rows: Tensor) -> float | None:
    """Mean error of the middle less that of the rim; None if the image cuts off either."""
    (center_x, center_y), contact_radius_px = label(press)
    away = torch.hypot(columns - center_x, rows - center_y)
    middle, rim = away < 2.0, away > contact_radius_px - RIM_PX - 1.5
    return 1000.0 * float(error[middle].mean() - error[rim].mean()) if bool(middle.any() and rim.any()) else None


def _sphere_error(press: Press, depth_mm: Tensor, truth: BallTruth, mm_per_pixel: float) -> tuple[float | None, float | None]:
    """Radius error in percent and centre error in pixels of the sphere through the depth; None for a plane."""
    height, width = depth_mm.shape[2:]
    x, y = pixel_grid_mm(height, width, mm_per_pixel, torch.float64)
    columns = torch.stack((x.expand(height, width), y.expand(height, width), torch.ones(height, width, dtype=torch.float64)), -1)
    region = truth.region[0, 0]
    z = depth_mm[0, 0][region]
    plane = torch.linalg.lstsq(columns[region], z[:, None]).solution[:, 0]
    if float((columns[region] @ plane - z).abs().max()) < 1e-6:
        return None, None
    sphere = fit_sphere(depth_mm, mm_per_pixel, truth.region)
    if not math.isfinite(sphere.radius_mm):
        return None, None
    (center_x, center_y), _ = label(press)
    # the point frame has y up
    at_x = sphere.center_mm[0] / mm_per_pixel + (width - 1) / 2
    at_y = -sphere.center_mm[1] / mm_per_pixel + (height - 1) / 2
    away_px = math.hypot(at_x - center_x, at_y - center_y)
    return 100.0 * abs(sphere.radius_mm / (0.5 * press.ball_diameter_mm) - 1.0), away_px


def _by_bin(values: Tensor, index: Tensor, bins: int) -> tuple[tuple[float | None, ...], tuple[int, ...]]:
    """Mean of the values in each bin, None where there is none, and their number."""
    counts = torch.bincount(index, minlength=bins)
    sums = torch.bincount(index, weights=values, minlength=bins)
    return tuple(float(s / n) if n else None for s, n in zip(sums, counts)), tuple(counts.tolist())


class Training:
    """Presses to learn from, their labels forgotten, and what calibration by response fields, without a prior, finds in them.

    Args:
        background: (3, H, W) in [0, 1], image at rest. presses: to learn from. sensor: the sensor; its prior is not looked at.
    Attributes:
        told: the presses with their labels, which only a prior may learn from.
    """

    def __init__(self, background: Tensor, presses: Sequence[Press], sensor: Sensor) -> None:
        self.background = background
        self.sensor = sensor.without_prior()
        self.told = presses
        self.presses = [dataclasses.replace(press, center_px=None, contact_radius_px=None) for press in presses]

    @cached_property
    def calibration(self) -> Calibration:
        """By all presses; made when first asked for."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CalibrationWarning)
            return calibrate(self.background, self.sensor, self.presses)

    @cached_property
    def located(self) -> list[Press]:
        """The presses that calibration used, with the centers and contact radii that it found."""
        return _found(self.presses, self.calibration)

    def of_family(self, degree: int, product_degree: int) -> Calibration:
        """By the located presses and response fields of that size alone."""
        return by_presses(self.background, self.sensor, self.located, None, False, ((degree, product_degree),)).unit


def _found(presses: Sequence[Press], calibration: Calibration) -> list[Press]:
    told = {row["name"]: row for row in calibration.report["presses"] if row["used"]}
    return [
        dataclasses.replace(
            press, center_px=tuple(told[press.name]["center_px"]), contact_radius_px=told[press.name]["contact_radius_px"]
        )
        for press in presses
        if press.name in told
    ]


class Method(NamedTuple):
    """A method made ready: the pipeline, how many numbers it learned, and what there is to say of it."""

    pipeline: DepthPipeline
    numbers: int
    note: str = ""


Build = Callable[[Training, Tensor, Sensor], Method]
"""(presses to learn from, background of the unit that is judged, sensor) -> Method."""


def flat(training: Training, background: Tensor, sensor: Sensor) -> Method:
    """Says that all is flat: what errors are worth."""
    unit = _unit(background, sensor)
    return Method(_chain(unit, Compensate.from_calibration(unit), NormalFromResponse.from_calibration(unit)), 0)


def point_lights(training: Training, background: Tensor, sensor: Sensor) -> Method:
    """Three lights fitted to the background alone, precise."""
    unit = _unit(background, sensor)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CalibrationWarning)
        found = calibrate(background, dataclasses.replace(sensor.without_prior(), blur_px=unit.sensor.blur_px))
    normals = NormalFromIntensity.from_calibration(found)
    return Method(_chain(unit, Compensate.from_calibration(found), normals, "precise"), 12, "from the background alone")


def lookup_table(training: Training, background: Tensor, sensor: Sensor) -> Method:
    """One table from the relative change of R, G, B to slope."""
    learned, unit = _unit(training.background, sensor), _unit(background, sensor)
    value, _, slope, _ = training_pixels(Compensate.from_calibration(learned), training.located, sensor.mm_per_pixel)
    block = NormalFromLookup.fit(torch.ones_like(background), value - 1.0, slope)
    return Method(_chain(unit, Compensate.from_calibration(unit), block), block.table.numel(), "one table for all pixels")


def network(training: Training, background: Tensor, sensor: Sensor, seed: int = 0) -> Method:
    """gs_sdk's RGBXY network, trained on these presses."""
    unit = _unit(background, sensor)
    fit = train_network(training.background, training.located, sensor, unit.sensor.blur_px, seed)
    smooth = _smooth(unit)
    fit.module.set_flat(smooth(background[None])[0].clamp(0, 1))
    note = "" if fit.converged else "stopped before it converged"
    return Method(_chain(unit, smooth, fit.module), sum(p.numel() for p in fit.module.parameters()), note)


def given_network(training: Training, background: Tensor, sensor: Sensor, path: str | Path) -> Method:
    """A network trained elsewhere, gs_sdk's ``nnmodel.pth`` or one of torchvts."""
    unit = _unit(background, sensor)
    smooth = _smooth(unit)
    block = NormalFromMLP.load(path, smooth(background[None])[0].clamp(0, 1))
    note = f"{Path(path).name}: may have been trained on these very presses"
    return Method(_chain(unit, smooth, block), sum(p.numel() for p in block.parameters()), note)


def response(training: Training, background: Tensor, sensor: Sensor, mode: str = "precise") -> Method:
    """What ``calibrate`` makes of the presses without a prior."""
    return _calibrated(training.calibration, training, background, sensor, mode)


def response_with_own_prior(training: Training, background: Tensor, sensor: Sensor) -> Method:
    """What ``calibrate`` makes of the presses and of a prior fitted with labels on the same, precise: what a sensor's prior is
    worth on presses that it has not seen."""
    prior = fit_prior(training.background, training.sensor, training.told, "the folds learned from, with their labels")
    return response_with_prior(training, background, dataclasses.replace(sensor, prior=prior))


def response_with_prior(training: Training, background: Tensor, sensor: Sensor) -> Method:
    """What ``calibrate`` makes of the presses and the prior of the sensor file, precise."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CalibrationWarning)
        found = calibrate(training.background, sensor, training.presses)
    made = _calibrated(found, training, background, sensor, "precise")
    source = "" if sensor.prior is None else f"prior fitted on {sensor.prior.source or 'a unit that it does not name'}"
    return made._replace(note="; ".join(part for part in (made.note, source) if part))


def _calibrated(found: Calibration, training: Training, background: Tensor, sensor: Sensor, mode: str) -> Method:
    left_out = sum(not row["used"] for row in found.report["presses"])
    notes = [f"left out {left_out} of {len(training.presses)} presses"] if left_out else []
    model = found.response
    if background is not training.background:
        if model is not None:
            found = Calibration.from_response(model, sensor, background)
        elif found.lights is not None:
            found = Calibration.from_lights(found.lights, found.sensor, background)
    unit, compensate = _unit(background, sensor), Compensate.from_calibration(found)
    if model is None:
        notes.append("calibrate chose point lights")
        numbers = 12
        block: nn.Module = NormalFromIntensity.from_calibration(found)
    else:
        fields = (model.fast, model.precise if mode != "fast" else None)
        numbers = sum(2 * field.size() for field in fields if field is not None)
        block = NormalFromResponse.from_calibration(found)
    return Method(_chain(unit, compensate, block, mode), numbers, "; ".join(notes))


METHODS: dict[str, Build] = {
    "flat": flat,
    "point lights": point_lights,
    "look-up table": lookup_table,
    "MLP": network,
    "response fast": partial(response, mode="fast"),
    "response precise": response,
    "response precise, prior by folds": response_with_own_prior,
    "response precise, prior": response_with_prior,
}
"""Name in the table to function; "response precise, prior" needs a sensor with a prior."""

GIVEN_NETWORK = "given network"
ALONE = ("flat", "point lights", GIVEN_NETWORK)
"""Methods that learn nothing from presses: made once, not for every fold."""


class _Both(nn.Module):
    """Two views of a frame in one tensor, (B, 6, H, W): one for the contact mask, one for the normals."""

    def __init__(self, first: nn.Module, second: nn.Module) -> None:
        super().__init__()
        self.first, self.second = first, second

    def forward(self, images: Tensor) -> Tensor:
        return torch.cat((self.first(images), self.second(images)), dim=1)


class _OfFirst(nn.Module):
    def __init__(self, contact: nn.Module) -> None:
        super().__init__()
        self.contact = contact

    def forward(self, both: Tensor) -> Tensor:
        contact: Tensor = self.contact(both[:, :3])
        return contact


class _OfSecond(nn.Module):
    def __init__(self, normals: nn.Module) -> None:
        super().__init__()
        self.normals = normals
        self.uses_depth = bool(getattr(normals, "uses_depth", False))
        self.passes = int(getattr(normals, "passes", 8))

    def forward(self, both: Tensor, depth_mm: Tensor | None = None) -> Tensor:
        normal: Tensor = self.normals(both[:, 3:]) if depth_mm is None else self.normals(both[:, 3:], depth_mm)
        return normal


def _unit(background: Tensor, sensor: Sensor) -> Calibration:
    """The unit as a response field sees it that says 0 everywhere: it gives every method's contact mask."""
    blur_px = with_preprocessing(sensor, None).blur_px
    return Calibration.from_response(ResponseModel.zero(sensor.exponent, blur_px), sensor, background)


def _smooth(unit: Calibration) -> Compensate:
    """Raw intensity, blurred as all methods' images are: what a network sees."""
    return Compensate(blur_px=unit.sensor.blur_px, markers=unit.markers)


def _chain(unit: Calibration, compensate: nn.Module, normals: nn.Module, mode: str = "fast") -> DepthPipeline:
    pitch = unit.sensor.mm_per_pixel
    modules = (
        _Both(Compensate.from_calibration(unit), compensate),
        _OfFirst(ContactMask.from_calibration(unit)),
        _OfSecond(normals),
        GradientFromNormal(),
        PoissonBackground(pitch),
    )
    return DepthPipeline(*modules, mm_per_pixel=pitch, mode=mode).eval()


def training_pixels(compensate: nn.Module, presses: Sequence[Press], mm_per_pixel: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Pixels on balls, :data:`RIM_PX` inside their contact radius, and the slope there.

    Args:
        compensate: treats the images. presses: with centers and contact radii. mm_per_pixel: pitch, mm.
    Returns:
        Intensity (N, 3), column and row (N, 2), slope (N, 2) in mm per mm, number of the press (N,).
    Raises:
        ValueError: no presses, or one without center or contact radius.
    """
    if not presses:
        raise ValueError("presses: expected one or more with center and contact radius, got none: label some, or press deeper")
    parts: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
    for number, press in enumerate(presses):
        height, width = press.image.shape[1:]
        truth = ball_truth(press, height, width, mm_per_pixel)
        rows, columns = torch.nonzero(truth.region[0, 0], as_tuple=True)
        with torch.inference_mode():
            value = compensate(press.image[None])[0][:, rows, columns].T
        slope = truth.gradient[0][:, rows, columns].T.to(value.dtype)
        parts.append((value.clone(), torch.stack((columns, rows), 1).to(value.dtype), slope, torch.full_like(rows, number)))
    value, xy, slope, group = (torch.cat(columns) for columns in zip(*parts))
    return value, xy, slope, group


def train_network(
    background: Tensor,
    presses: Sequence[Press],
    sensor: Sensor,
    blur_px: float = RESPONSE_BLUR_PX,
    seed: int = 0,
    max_epochs: int = 60,
    progress: bool = False,
) -> MlpFit:
    """Train gs_sdk's RGBXY network on presses, on raw images behind ``Compensate(blur_px=blur_px)``.

    Args:
        background: (3, H, W) in [0, 1], image at rest.
        presses: at least two; where the contact radius is missing, ``calibrate`` finds center and radius, without the prior.
        sensor: the sensor. blur_px: of the images, pixels. seed, max_epochs, progress: as for :func:`fit_mlp`.
    Raises:
        ValueError, TypeError: as :func:`calibrate` and :func:`fit_mlp`.
    """
    check_image("background", background, sensor.height, sensor.width, sensor.name)
    for press in presses:
        check_image(f"{press.name}: image", press.image, sensor.height, sensor.width, sensor.name)
    missing = [press for press in presses if press.center_px is None]
    labelled = [press for press in presses if press.center_px is not None and press.contact_radius_px is not None]
    if missing:
        located = Training(background, presses, sensor).located
        labelled += [press for press in located if press.name in {m.name for m in missing}]
    compensate = Compensate(blur_px=blur_px)
    value, xy, slope, group = training_pixels(compensate, labelled, sensor.mm_per_pixel)
    rest = compensate(background[None])[0].clamp(0, 1)
    return fit_mlp(value.clamp(0, 1), xy, slope, rest, groups=group, seed=seed, max_epochs=max_epochs, progress=progress)


def evaluate(
    folder: str | Path,
    sensor: Sensor,
    methods: Sequence[str] = (),
    *,
    folds: int = 5,
    test: str | Path | None = None,
    network_path: str | Path | None = None,
    limit: int | None = None,
    seed: int = 0,
    progress: bool = False,
) -> Evaluation:
    """Score methods on a folder of ball presses.

    Cross-validation: press i is judged by what was learned from the presses of the other folds, i being in fold i % folds.

    Args:
        folder: presses in gs_sdk's layout.
        sensor: the sensor.
        methods: names out of :data:`METHODS`; none for all that can be made.
        folds: parts of the cross-validation; 1 judges the presses that were learned from.
        test: a second folder, to judge by what all of the first taught; no cross-validation then.
        network_path: file of a trained network, to be judged too.
        limit: take only so many presses, spread over the catalog.
        seed: of the network that is trained. progress: show a bar.
    Raises:
        ValueError: unknown method, a prior that the sensor does not have, too few presses, none that can be scored.
        FileNotFoundError: no such folder or file.
    """
    chosen = _choose(methods, sensor, network_path, seed)
    check_integer("folds", folds, 1)
    background, presses = read_presses(folder)
    if limit is not None:
        presses = _spread(presses, check_integer("limit", limit, 1))
    judged_background, judged = (background, presses) if test is None else read_presses(test)
    if test is not None and limit is not None:
        judged = _spread(judged, limit)
    if test is None and folds > len(presses):
        raise ValueError(f"folds: expected at most the number of presses, {len(presses)}, got {folds}")
    for image in (background, judged_background):
        check_image("background", image, sensor.height, sensor.width, sensor.name)
    whole = Training(background, presses, sensor)
    truth, how = _with_truth(judged, whole if test is None else Training(judged_background, judged, sensor))
    not_scored = [press.name for press in judged if press.name not in truth]
    if not truth:
        raise ValueError(f"folder: none of {len(judged)} presses has a contact radius: nothing can be scored")
    shown = _middling(list(truth.values()), sensor)
    parts: list[tuple[Training, list[Press]]] = [(whole, judged)]
    split = f"all {len(presses)} presses learned from and judged" if test is None else f"{len(presses)} presses learned from"
    if test is None and folds > 1:
        parts = []
        for fold in range(folds):
            others = [press for i, press in enumerate(presses) if i % folds != fold]
            parts.append((Training(background, others, sensor), [p for i, p in enumerate(presses) if i % folds == fold]))
        split = f"{folds}-fold cross-validation over {len(presses)} presses"
    scores: list[PressScore] = []
    outputs: dict[str, DepthOutput] = {}
    made: dict[str, list[Method]] = {name: [] for name in chosen}
    with tqdm(total=len(parts) * len(chosen), desc="evaluating", disable=not progress, leave=False) as bar:
        for training, held in parts:
            for name, build in chosen.items():
                bar.set_postfix(method=name)
                ready = made[name][0] if made[name] and name in ALONE else build(training, judged_background, sensor)
                made[name].append(ready)
                for press in held:
                    if press.name not in truth:
                        continue
                    with torch.inference_mode():
                        out = ready.pipeline(press.image[None])
                    scores.append(score_press(truth[press.name], out.depth_mm, out.normal, sensor.mm_per_pixel, name))
                    if press.name == shown.name:
                        outputs[name] = out
                bar.update()
    order = list(truth)
    scores.sort(key=lambda score: (list(chosen).index(score.method), order.index(score.press)))
    summaries = [_summary(name, made[name], [s for s in scores if s.method == name]) for name in chosen]
    how = f"{split}, learned without labels; judged by {how}"
    return Evaluation(summaries, scores, not_scored, how, shown, outputs, sensor.mm_per_pixel)


def _choose(methods: Sequence[str], sensor: Sensor, network_path: str | Path | None, seed: int) -> dict[str, Build]:
    for name in methods:
        if name not in METHODS:
            raise ValueError(f"methods: expected some of {', '.join(repr(m) for m in METHODS)}, got {name!r}")
        if name == "response precise, prior" and sensor.prior is None:
            raise ValueError(f"methods: {name!r} needs a prior, sensor '{sensor.name}' has none: scripts/fit_prior.py fits one")
    chosen = {name: METHODS[name] for name in methods or METHODS if sensor.prior is not None or name != "response precise, prior"}
    if "MLP" in chosen:
        chosen["MLP"] = partial(network, seed=seed)
    if network_path is not None:
        chosen[GIVEN_NETWORK] = partial(given_network, path=network_path)
    return chosen


def _spread(presses: list[Press], limit: int) -> list[Press]:
    """``limit`` presses at equal steps of the catalog, which lists one ball after the other."""
    count = min(limit, len(presses))
    return [presses[k * len(presses) // count] for k in range(count)]


def _with_truth(presses: list[Press], training: Training) -> tuple[dict[str, Press], str]:
    """Presses that can be scored, by name: labelled ones, and where there is no label those that calibrate finds."""
    unlabelled = {press.name for press in presses if press.center_px is None}
    truth = {press.name: press for press in presses if press.center_px is not None and press.contact_radius_px is not None}
    if unlabelled:
        truth |= {press.name: press for press in training.located if press.name in unlabelled}
    counts = {"labels": len(presses) - len(unlabelled), "calibrate, which saw all presses": len(unlabelled)}
    how = "centers from " + " and ".join(f"{source} ({count})" for source, count in counts.items() if count)
    return {press.name: truth[press.name] for press in presses if press.name in truth}, how


def _middling(presses: list[Press], sensor: Sensor) -> Press:
    """The press whose distance from the middle of the image is the median: neither flattering nor the worst."""
    x, y = (sensor.width - 1) / 2, (sensor.height - 1) / 2
    ordered = sorted(presses, key=lambda press: math.hypot(_center(press)[0] - x, _center(press)[1] - y))
    return ordered[len(ordered) // 2]


def _summary(method: str, made: list[Method], scores: list[PressScore]) -> MethodSummary:
    worst = max(scores, key=lambda score: score.normal_deg)
    notes = list(dict.fromkeys(part for ready in made for part in [ready.note] if part))
    return MethodSummary(
        method,
        max(ready.numbers for ready in made),
        len(scores),
        sum(score.normal_deg for score in scores) / len(scores),
        sum(score.relief_um for score in scores) / len(scores),
        sum(score.tilt_um for score in scores) / len(scores),
        _median([score.radius_percent for score in scores]),
        _median([score.center_px for score in scores]),
        _mean([None if score.apex_um is None else abs(score.apex_um) for score in scores]),
        worst.press,
        worst.normal_deg,
        "; ".join(notes),
    )


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return statistics.median(known) if known else None


def table(evaluation: Evaluation) -> str:
    """The summaries as a Markdown table; means over presses, but medians for the sphere; of the apex the absolute error."""
    lines = [
        "| method | numbers | normal deg | relief um | of it tilt | radius % | center px | apex um | worst press | note |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in evaluation.summaries:
        tail = [
            f"{v:.{d}f}" if v is not None else "none" for v, d in ((row.radius_percent, 1), (row.center_px, 2), (row.apex_um, 0))
        ]
        lines.append(
            f"| {row.method} | {row.numbers} | {row.normal_deg:.2f} | {row.relief_um:.1f} | {row.tilt_um:.1f} | {' | '.join(tail)} "
            f"| {row.worst_press} ({row.worst_deg:.1f} deg) | {row.note} |"
        )
    return "\n".join(lines)


def to_json(evaluation: Evaluation, command: str) -> str:
    """Rows as JSON: one of kind "method" per method, then one of kind "press" per method and press, each with the command."""
    rows: list[dict[str, Any]] = []
    for kind, items in (("method", evaluation.summaries), ("press", evaluation.scores)):
        rows += [{"kind": kind, "command": command, "how": evaluation.how} | dataclasses.asdict(item) for item in items]
    return json.dumps(rows, indent=1)


def error_figure(evaluation: Evaluation, method: str) -> Figure:
    """Mean angle of one method by the ball's steepness, and by place in the image."""
    scores = evaluation.of(method)
    if not scores:
        raise ValueError(f"method: expected one that was evaluated, got {method!r}")
    figure = Figure(figsize=(9.0, 3.8), layout="constrained", dpi=110)
    FigureCanvasAgg(figure)
    bars, places = figure.subplots(1, 2)
    by_slope = _pooled([s.by_slope_deg for s in scores], [s.by_slope_pixels for s in scores])
    edges = [f"{edge:g}" for edge in (0.0, *SLOPE_EDGES)]
    names = [f"{low} to {high}" for low, high in pairwise(edges)] + [f"over {edges[-1]}"]
    heights = [0.0 if math.isnan(v) else v for v in by_slope]
    bars.bar(names, heights, color="#4c72b0")
    for k, value in enumerate(by_slope):
        bars.text(k, heights[k], "no pixels" if math.isnan(value) else f"{value:.1f}", ha="center", va="bottom")
    bars.set_ylim(0.0, 1.15 * max(*heights, 0.1))
    bars.set_xlabel("steepness of the ball, mm per mm")
    bars.set_ylabel("mean angle between normals, deg")
    by_place = _pooled([s.by_place_deg for s in scores], [s.by_place_pixels for s in scores])
    grid = torch.tensor(by_place, dtype=torch.float64).reshape(PLACES, PLACES).numpy()
    most = max([v for v in by_place if not math.isnan(v)] + [0.1])
    picture = places.imshow(grid, cmap="viridis", vmin=0.0, vmax=most, aspect="auto")
    for k, value in enumerate(by_place):
        colour = "black" if value > 0.6 * most or math.isnan(value) else "white"
        places.text(
            k % PLACES, k // PLACES, "no pixels" if math.isnan(value) else f"{value:.1f}", ha="center", va="center", color=colour
        )
    places.set_xticks(range(PLACES), ["left", "middle", "right"])
    places.set_yticks(range(PLACES), ["top", "middle", "bottom"])
    places.set_title("by place in the image")
    figure.colorbar(picture, ax=places, shrink=0.85, label="deg")
    mean = sum(score.normal_deg for score in scores) / len(scores)
    figure.suptitle(f"{method}: {mean:.2f} deg over {len(scores)} presses")
    return figure


def press_figure(evaluation: Evaluation, methods: Sequence[str] = ("response precise", "MLP")) -> Figure:
    """The shown press by several methods, a row each: depth contours, angle between normals, error of relief.

    Raises:
        ValueError: a method that was not evaluated.
    """
    for name in methods:
        if name not in evaluation.outputs:
            raise ValueError(f"methods: expected some of {', '.join(evaluation.outputs)}, got {name!r}")
    press, pitch = evaluation.shown, evaluation.mm_per_pixel
    height, width = press.image.shape[1:]
    truth = ball_truth(press, height, width, pitch)
    inside = truth.region[0, 0]
    maps: list[tuple[str, Tensor, Tensor, Tensor]] = []
    for name in methods:
        out = evaluation.outputs[name]
        angle = normal_angle_deg(out.normal.double(), normal_from_gradient(truth.gradient))[0]
        error = 1000.0 * (out.depth_mm.double() - truth.depth_mm)[0, 0]
        error = error - error[inside].mean()
        nothing = torch.full_like(angle, math.nan)
        maps.append((name, out.depth_mm[0, 0].double(), torch.where(inside, angle, nothing), torch.where(inside, error, nothing)))
    most_deg = max(float(angle[inside].quantile(0.99)) for _, _, angle, _ in maps)
    most_um = max(float(error[inside].abs().max()) for _, _, _, error in maps)
    figure = Figure(figsize=(13.5, 3.7 * len(maps)), layout="constrained", dpi=110)
    FigureCanvasAgg(figure)
    half_x, half_y = 0.5 * width * pitch, 0.5 * height * pitch
    extent = (-half_x, half_x, half_y, -half_y)
    at_x, at_y = ((c - (n - 1) / 2) * pitch for c, n in zip(_center(press), (width, height)))
    reach = 1.15 * _radius(press) * pitch
    grid = figure.subplots(len(maps), 3, squeeze=False)
    for axes, (name, depth, angle, error) in zip(grid, maps):
        draw_contours(figure, axes[0], depth.numpy(), pitch)
        axes[0].set_title(f"{name}: {axes[0].get_title()}")
        drawn = ((axes[1], angle, "magma", 0.0, most_deg, "deg"), (axes[2], error, "RdBu_r", -most_um, most_um, "um"))
        for panel, values, colours, low, high, unit in drawn:
            picture = panel.imshow(values.numpy(), cmap=colours, vmin=low, vmax=high, extent=extent)
            figure.colorbar(picture, ax=panel, shrink=0.75, label=unit)
            panel.set_xlim(max(at_x - reach, -half_x), min(at_x + reach, half_x))
            panel.set_ylim(min(at_y + reach, half_y), max(at_y - reach, -half_y))
            panel.set_xlabel("x, mm")
            panel.set_ylabel("y, mm (down)")
        axes[1].set_title(f"angle between normals, mean {float(angle[inside].mean()):.2f} deg")
        axes[2].set_title(f"error of relief, RMS {float(error[inside].square().mean().sqrt()):.1f} um")
    figure.suptitle(f"press {press.name}, ball of {press.ball_diameter_mm:g} mm; scored {RIM_PX:g} px inside the contact radius")
    return figure


def _pooled(means: Sequence[tuple[float | None, ...]], counts: Sequence[tuple[int, ...]]) -> list[float]:
    """Mean over the pixels of all presses in each bin; NaN where there is none."""
    pooled = []
    for values, numbers in zip(zip(*means), zip(*counts)):
        total = sum(numbers)
        pooled.append(sum(v * n for v, n in zip(values, numbers) if v is not None) / total if total else math.nan)
    return pooled


def error_map_name(method: str) -> str:
    """File name of a method's picture.

    Example:
        >>> error_map_name("response precise, prior")
        'errors_response_precise_prior.png'
    """
    return f"errors_{method.replace(',', '').replace(' ', '_').replace('-', '_').lower()}.png"
