"""The skin at rest in a stream: found in the first frames, calibrated from, and followed while its light drifts."""

import warnings
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from ..calibration import CalibrationWarning, calibrate
from ..calibration.calibrate import GIVEN_MISFIT
from ..calibration.contacts import ROUGH, channel_structure
from ..calibration.lights import LOOSE_DEG
from ..contact import ContactMask
from ..core.checks import check_batch, check_field, check_least, check_positive, check_range, check_same_size, check_shape
from ..core.geometry import pixel_grid_mm
from ..model.calibration import PEDESTAL, Calibration
from ..model.response_field import CHANGE_SCALE, ResponseField, ResponseModel
from ..model.sensor import Sensor, check_sensor

TIME_CONSTANT_S = 1.0
"""The light is followed with this time constant: a lamp that fades by 1 % a second is followed 1 % behind."""

LIGHT_STEP = 0.03
"""Light that departs further than this from what was followed so far has stepped: told, and not learned."""

RECOVERY_S = 1.0
"""After a contact the gel takes this long to come back; what the light seems to do until then is no step."""

LEAST_FREE = 0.25
"""Part of the skin that must be out of contact for the light to be judged by it."""

MOVED = 0.02
"""Relative change of a cell of 1/20 of the frame that counts as movement among the first frames."""

STAND_IN_NOISE = 0.02
"""Least noise, relative to the background, under a stand-in model: a press scatters light that no calibration has measured."""


def rest_image(images: Tensor) -> tuple[Tensor, Tensor]:
    """The skin at rest from the first frames, or a refusal that says why.

    The image is the median over the frames, averaged with the half of the values next to it. Refused are, by cells of 1/20 of
    the frame, whose values are relative to their median over time:

    * frames whose level (median over the cells) wanders by more than 2 % in a channel: the light changes;
    * three cells or more of a frame that depart from its level by more than 2 % and by 8 times the spread of all
      (median absolute deviation): something moves, or a contact begins;
    * structure between the channels. A lamp's fall-off is smooth and a spot is dark in all channels alike; a contact is bright in
      one channel where it is dark in another, within a few millimetres. The channels' log ratios, band-passed (Gaussians of 1/40
      and 1/16 of the height), are below 0.11 at the 99th percentile on every sensor at rest at hand (0.01 to 0.03 on four of six;
      0.10 on a Wedge, whose lamps stand in the picture), and 0.06 to 0.36 under clear contact; 0.13 is refused. So a faint
      contact that rests there from the first frame to the last is not seen: without a calibration nothing tells it from skin.

    Args:
        images: (N, 3, H, W) in [0, 1], rectified, at least 3.
    Returns:
        The image (3, H, W), and per pixel the noise that videos have between frames (3, H, W): the RMS over frames of the mean of
        3 x 3 pixels, times 3, smoothed; the same as the pixels' own where noise is white, more where compression smears it.
    Raises:
        ValueError: with the reason.
    """
    check_batch("images", images, 3)
    if images.shape[0] < 3:
        raise ValueError(f"images: expected at least 3 frames at rest, got {images.shape[0]}: the source is too short")
    side = max(2, min(images.shape[2], images.shape[3]) // 20)
    cells = nn.functional.avg_pool2d(images, side).double() + PEDESTAL
    ratio = cells / cells.median(0, keepdim=True).values
    level = ratio.flatten(2).median(2).values  # (N, 3)
    wander = (level.amax(0) - level.amin(0)).max()
    if wander > MOVED:
        raise ValueError(
            f"background: the light changes by {float(wander):.1%} during the first {len(images)} frames: wait until the lamps and "
            "the camera's exposure have settled"
        )
    away = (ratio / level[..., None, None] - 1.0).abs().amax(1)  # (N, h, w)
    spread = 1.4826 * float(away.median())
    moved = (away > max(MOVED, 8.0 * spread)).flatten(1).sum(1)
    if int(moved.max()) >= 3:
        raise ValueError(
            f"background: frame {int(moved.argmax())} of the first {len(images)} differs from the others in {int(moved.max())} of "
            f"{away[0].numel()} places: a contact, or the sensor moves; start without contact, or take fewer frames"
        )
    rank = images.sort(0).values
    quarter = len(images) // 4
    image = rank[quarter : len(images) - quarter].mean(0)
    rough = channel_structure(image)
    if rough > ROUGH:
        raise ValueError(
            f"background: the first {len(images)} frames show structure between the channels of {rough:.2f}, a skin at rest stays "
            f"below {ROUGH}: a contact rests there; start without contact, or give a calibration"
        )
    deviation = nn.functional.avg_pool2d(images - image, 3, 1, 1, count_include_pad=False).square().mean(0)
    smooth = nn.functional.avg_pool2d(deviation[None], 15, 1, 7, count_include_pad=False)[0]
    return image, 3.0 * torch.sqrt(smooth)


class FollowLight:
    """Follows slow drift of the light by the skin out of contact, and divides it out of every frame.

    The light relative to the background is, in each channel, a plane over the image (a level and two tilts): lamps fade, one side
    perhaps more. So few numbers cannot take the shape of an object, and reach under a contact from the skin around it. Rules:

    * cells (1/24 of the height) in contact or next to it, dark, or full never count: an object that rests there is never learned;
    * from the others, robustly (Tukey), the plane moves by 1 - exp(-dt / time_constant_s) of what is missing;
    * with less than a quarter of the cells free nothing is learned ("held");
    * what departs by more than 3 % from the light followed so far is no drift. Without contact, or where one plane explains 90 % of
      all cells to 1 %, it is told as a step ("stepped"); with a contact, which scatters light, and for a second after it, while
      the gel comes back, it is "held". Neither is learned; when the light comes back, following goes on.

    Args:
        background: (3, H, W), image value of the unit at rest. time_constant_s: see above.
    Attributes:
        state: "following", "held" or "stepped". plane: (3, 3) float64, level and tilts of each channel, 1, 0, 0 at the start.
    """

    def __init__(self, background: Tensor, time_constant_s: float = TIME_CONSTANT_S) -> None:
        self.time_constant_s = check_positive("time_constant_s", time_constant_s)
        check_field("background", background)
        check_range("background", background)
        if min(background.shape[1:]) < 4:
            raise ValueError(f"background: expected H and W of at least 4, got {tuple(background.shape)}: too small for cells")
        self.size = (background.shape[1], background.shape[2])
        self.cell = max(2, background.shape[1] // 24)
        self.plane = torch.tensor([[1.0, 0.0, 0.0]] * 3, dtype=torch.float64)
        self.set_rest(background[None])
        rows, columns = self._rest.shape[1:]
        x = torch.linspace(-1.0, 1.0, columns, dtype=torch.float64).expand(rows, columns)
        y = torch.linspace(-1.0, 1.0, rows, dtype=torch.float64)[:, None].expand(rows, columns)
        self._basis = torch.stack((torch.ones_like(x), x, y)).flatten(1)  # (3, cells)
        height, width = background.shape[1:]
        reach_x, reach_y = width / (columns * self.cell), height / (rows * self.cell)  # beyond the cells lies a rest of pixels
        x_mm, y_mm = pixel_grid_mm(height, width, 1.0, background.dtype)
        self._x, self._y = (x_mm * 2.0 / width * reach_x)[None], (y_mm * 2.0 / height * reach_y)[None]
        self.state = "following"
        self.steps = 0
        self._since_contact_s = RECOVERY_S

    @property
    def level(self) -> list[float]:
        """The light in R, G, B relative to the background, at the image centre."""
        return [float(v) for v in self.plane[:, 0]]

    def correct(self, image: Tensor) -> Tensor:
        """(1, 3, H, W) as it would be in the background's light."""
        self._check(image)
        if float((self.plane - torch.tensor([1.0, 0.0, 0.0])).abs().max()) < 1e-5:
            return image
        level, tilt_x, tilt_y = (self.plane[:, k, None, None].to(image.dtype) for k in range(3))
        return (image / (level + tilt_x * self._x + tilt_y * self._y)).clamp_(0.0, 1.0)

    def update(self, image: Tensor, contact: Tensor, seconds: float) -> str:
        """Learn from a frame (1, 3, H, W) as the camera gave it, its contact, and the time since the last; returns the state."""
        self._check(image)
        check_shape("contact", contact, (1, 1, *self.size), "image")
        check_least("seconds", seconds, -np.inf)
        cells, missing = self._missing(image)
        touched = nn.functional.max_pool2d(contact.float(), self.cell)
        near = nn.functional.max_pool2d(touched, 3, 1, 1)[0, 0] > 0
        usable = self._judged & (cells < 0.97)
        before = self.state
        self._since_contact_s = 0.0 if bool(touched.any()) else self._since_contact_s + seconds
        free = usable & ~near
        enough = bool((free.flatten(1).double().mean(1) >= LEAST_FREE * usable.flatten(1).double().mean(1)).all())
        change = self._fit(missing, free if enough else usable)
        departure = float(change.abs().sum(1).max())
        if departure > LIGHT_STEP:
            left = (missing.flatten(1) - change @ self._basis).abs()[usable.flatten(1)]
            smooth = left.numel() > 0 and float((left < 0.01).double().mean()) > 0.9
            self.state = "stepped" if smooth or self._since_contact_s >= RECOVERY_S else "held"
        elif not enough:
            self.state = "held"
        else:
            self.state = "following"
            self.plane += (1.0 - float(np.exp(-max(0.0, seconds) / self.time_constant_s))) * change * self.plane[:, :1]
        self.steps += self.state == "stepped" and before != "stepped"
        return self.state

    def set_rest(self, image: Tensor) -> None:
        """Take an image (1, 3, H, W) in the background's light for what cells look like at rest, printed markers and all."""
        self._check(image)
        rest = nn.functional.avg_pool2d(image, self.cell)[0].double()
        self._rest = rest + PEDESTAL
        self._judged = (rest > 0.06) & (rest < 0.97)

    def start(self, image: Tensor) -> None:
        """Take over the light of an image (1, 3, H, W) that is known to be at rest."""
        self._check(image)
        for _ in range(3):
            cells, missing = self._missing(image)
            self.plane += self._fit(missing, self._judged & (cells < 0.97)) * self.plane[:, :1]

    def _check(self, image: Tensor) -> None:
        check_batch("image", image, 3)
        check_same_size("image", image, "the background", *self.size)

    def _missing(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Cells of an image, and how far they are off the light followed so far, relative to it."""
        cells = nn.functional.avg_pool2d(image, self.cell)[0].double()
        now = (self.plane @ self._basis).reshape(cells.shape)
        return cells, (cells / now + PEDESTAL) / self._rest - 1.0

    def _fit(self, values: Tensor, used: Tensor) -> Tensor:
        """A plane for each channel, (3, 3), by three rounds of Tukey's weights; tilts are held back where few cells bear them."""
        target, weight = values.flatten(1), used.flatten(1).double()
        ridge = torch.diag(torch.tensor([1e-9, 0.02, 0.02], dtype=torch.float64)) * target.shape[1]
        plane = torch.zeros(3, 3, dtype=torch.float64)
        plane[:, 0] = torch.where(used.flatten(1), target, torch.nan).nanmedian(1).values.nan_to_num()
        tukey = weight
        for _ in range(3):
            left = (target - plane @ self._basis).abs()
            spread = torch.where(used.flatten(1), left, torch.nan).nanmedian(1, keepdim=True).values.nan_to_num(1.0)
            tukey = weight * (1.0 - (left / (6.0 * spread).clamp_min(2e-3)).square()).clamp_min(0.0).square()
            normal = torch.einsum("cn,in,jn->cij", tukey, self._basis, self._basis) + ridge
            plane = torch.linalg.solve(normal, torch.einsum("cn,in->ci", tukey * target, self._basis))
        return plane


class AtRest(NamedTuple):
    """A calibration, what is to be told of it in words, and whether its depth is metric as far as it knows."""

    calibration: Calibration
    told: str
    metric: bool


def calibrate_at_rest(background: Tensor, sensor: Sensor) -> AtRest:
    """A calibration from one image at rest, and what is to be told of it.

    :func:`torchvts.calibrate`; but where the sensor file names its lights and the light they would give does not look like the
    background (:data:`GIVEN_MISFIT`, judged at calibration), only their directions are believed: slope = - pinv(D) change, D
    being the lights' x / z and y / z. That is a stand-in: shapes are right, and how deep they are is only as right as the lamps'
    heights.

    Example:
        >>> from torchvts.model.lights import PointLights, flat_image
        >>> lights = PointLights([[25, 0, 30], [-12, 20, 30], [-12, -20, 30]], [900, 900, 900])
        >>> calibrate_at_rest(flat_image(lights, 48, 64, 0.6).detach(), Sensor("rig", 48, 64, 0.6)).metric
        True
    """
    check_sensor("sensor", sensor)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        calibration = calibrate(background, sensor)
    told = [str(w.message) for w in caught if issubclass(w.category, CalibrationWarning)]
    reason = str(calibration.report["reason"])
    if calibration.report["source"] == "sensor_file":
        misfit = calibration.report["candidates"][0]["misfit"]
        if misfit > GIVEN_MISFIT:
            lights = torch.tensor(sensor.light_position_mm, dtype=torch.float64)
            slope = -torch.linalg.pinv(lights[:, :2] / lights[:, 2:]) * CHANGE_SCALE
            rows = tuple(tuple(row) for row in slope.tolist())
            half_mm = 0.5 * sensor.width * sensor.mm_per_pixel
            model = ResponseModel(ResponseField(0, -1, False, half_mm, rows), None, sensor.exponent, max(1.0, sensor.blur_px))
            reason = f"directions of the sensor file's lights; as point lights they miss the background by {misfit:.0%}"
            report = {"model": "response", "source": "stand_in", "reason": reason}
            calibration = Calibration.from_response(model, sensor, background, report)
        told.append("the lights are the sensor file's, not this unit's")
    metric = not told
    told = [reason, *told] + ([] if metric else ["depth is NOT METRIC: calibrate with presses of a ball"])
    return AtRest(calibration, "; ".join(told), metric)


def given_at_rest(calibration: Calibration) -> AtRest:
    """A calibration that was given, and what is to be told of it."""
    report = calibration.report
    told = f"calibration given: {report.get('reason', report.get('model', 'lights'))}"
    metric = max(report.get("direction_std_deg", [0.0])) <= LOOSE_DEG
    return AtRest(calibration, told if metric else f"{told}; depth is NOT METRIC: calibrate with presses of a ball", metric)


def contact_in_video(calibration: Calibration, noise: Tensor) -> ContactMask:
    """The unit's contact mask, which knows how far a video wavers from frame to frame."""
    calibrated = ContactMask.from_calibration(calibration)
    sensor = calibration.sensor
    value = calibration.background.float().clamp_min(1e-6) ** (1.0 / sensor.exponent)
    compensated = noise.float() * sensor.exponent * torch.maximum(value, noise.float()) ** (sensor.exponent - 1.0)
    if calibration.gain is not None:
        compensated = compensated * calibration.gain.float() * 2.0**0.5
    least = STAND_IN_NOISE if calibration.report.get("source") == "stand_in" else 0.0
    most = torch.maximum(1.0 / calibrated.per_noise.float(), compensated).clamp_min(least)
    return ContactMask(calibrated.flat.float(), most).eval()
