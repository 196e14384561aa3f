"""Frames as they come: a camera, a video or a folder of images in, depth out; late frames dropped, slow light followed."""

import json
import os
import sys
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import kornia
import numpy as np
import torch
from torch import Tensor, nn

from .calibration import CalibrationWarning, calibrate
from .calibration.lights import LOOSE_DEG
from .compensate import blur, gaussian_weights
from .contact import ContactMask
from .core.checks import check_batch, check_integer, check_positive
from .core.files import IMAGE_SUFFIXES, VIDEO_SUFFIXES, rgb_from_bgr, write_atomically
from .core.geometry import pixel_grid_mm
from .core.response import CHANGE_SCALE, ResponseField, ResponseModel
from .core.sensor import Sensor
from .pipeline import DepthOutput, DepthPipeline
from .record import PEDESTAL, Calibration

Pixels = np.ndarray[Any, Any]

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

ROUGH = 0.13
"""Relative structure between the channels of an image at rest at which it is taken for a contact: see :func:`rest_image`."""

MISFIT = 0.2
"""RMS of log(background / what the lights give) from which given lights are only believed in their directions."""

STAND_IN_NOISE = 0.02
"""Least noise, relative to the background, under a stand-in model: a press scatters light that no calibration has measured."""


CODES = {".mp4": "mp4v", ".avi": "MJPG"}
"""What videos can be written, and OpenCV's code for it."""


class TactileFrame(NamedTuple):
    """number in the source, from 0; time_s since its start; image (3, H, W), rectified, in the background's light; the depth."""

    number: int
    time_s: float
    image: Tensor
    output: DepthOutput


class Rectify(nn.Module):
    """:meth:`Sensor.rectify` for frames of one size, its sampling grid made once.

    Args:
        sensor: the sensor. height, width: pixels of the camera's frames.
    Raises:
        ValueError: the frame does not hold the region that the sensor names.
    Example:
        >>> corners = ((1, 1), (14, 2), (13, 10), (2, 9))
        >>> Rectify(Sensor("rig", 8, 10, 0.1, corners_px=corners), 12, 16)(torch.zeros(1, 3, 12, 16)).shape
        torch.Size([1, 3, 8, 10])
    """

    grid: Tensor

    def __init__(self, sensor: Sensor, height: int, width: int) -> None:
        super().__init__()
        self.sensor = sensor
        self.frame_size = (height, width)
        sensor.rectify(torch.zeros(1, 3, height, width))  # raises where it does not fit
        grid = torch.zeros(0)
        if sensor.corners_px is not None:
            right, bottom = sensor.width - 1.0, sensor.height - 1.0
            target = torch.tensor([[[0.0, 0.0], [right, 0.0], [right, bottom], [0.0, bottom]]], dtype=torch.float64)
            corners = torch.tensor([sensor.corners_px], dtype=torch.float64)
            to_frame = kornia.geometry.get_perspective_transform(target, corners)[0]
            x = torch.arange(sensor.width, dtype=torch.float64).expand(sensor.height, -1)
            y = torch.arange(sensor.height, dtype=torch.float64)[:, None].expand(-1, sensor.width)
            place = torch.stack((x, y, torch.ones_like(x)), 2) @ to_frame.T
            place = place[..., :2] / place[..., 2:]
            grid = (2.0 * place / torch.tensor([width - 1.0, height - 1.0], dtype=torch.float64) - 1.0)[None].float()
        self.register_buffer("grid", grid)

    def forward(self, frame: Tensor) -> Tensor:
        """(B, 3, H, W) to (B, 3, sensor.height, sensor.width)."""
        check_batch("frame", frame, 3)
        if frame.shape[2:] != self.frame_size:
            raise ValueError(
                f"frame: expected {self.frame_size} like the first, got {tuple(frame.shape[2:])}: the source has changed"
            )
        if self.grid.numel() == 0:
            return self.sensor.rectify(frame)
        grid = self.grid.to(frame.dtype).expand(frame.shape[0], -1, -1, -1)
        return nn.functional.grid_sample(frame, grid, mode="bilinear", padding_mode="zeros", align_corners=True)


class Reader(Protocol):
    """Where frames come from. ``live`` sources do not wait; ``fps`` is their rate, or what is assumed of it."""

    name: str
    live: bool
    fps: float

    def read(self) -> Pixels | None:
        """The next frame, (H, W, 3) B, G, R, 8 or 16 bits; None at the end."""

    def close(self) -> None:
        """Let go of the device or file."""


class CaptureReader:
    """A camera (an index) or a video file, by OpenCV."""

    def __init__(self, source: int | Path) -> None:
        import cv2

        self.live = isinstance(source, int)
        self.name = f"camera {source}" if self.live else str(source)
        self._capture = cv2.VideoCapture(source if isinstance(source, int) else str(source))
        if not self._capture.isOpened():
            self._capture.release()
            if self.live:
                raise OSError(f"source: expected a camera with index {source}, got none that opens: plugged in? in use elsewhere?")
            raise ValueError(f"source: {source}: not a video, or cut short: it does not open")
        if self.live:
            self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        fps = float(self._capture.get(cv2.CAP_PROP_FPS))
        self.fps = fps if 0.5 <= fps <= 1000.0 else 30.0

    def read(self) -> Pixels | None:
        there, pixels = self._capture.read()
        return pixels if there else None

    def close(self) -> None:
        self._capture.release()


class FolderReader:
    """A folder of images, by name."""

    def __init__(self, folder: Path, fps: float = 30.0) -> None:
        self.name, self.live, self.fps = str(folder), False, fps
        files = sorted(p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES)
        if not files:
            raise ValueError(f"source: {folder}: no images in this folder ({', '.join(IMAGE_SUFFIXES)})")
        self._files = iter(files)

    def read(self) -> Pixels | None:
        import cv2

        path = next(self._files, None)
        if path is None:
            return None
        pixels = cv2.imdecode(np.fromfile(path, dtype=np.uint8), cv2.IMREAD_COLOR)
        if pixels is None:
            raise ValueError(f"source: {path}: not an image, or cut short")
        return pixels

    def close(self) -> None:
        self._files = iter(())


def open_source(source: str | int | Path) -> Reader:
    """A camera by its index (digits), a video file, or a folder of images.

    Raises:
        FileNotFoundError: nothing there. OSError: no such camera. ValueError: not a video, or no images; all name ``source``.
    """
    if isinstance(source, int) or str(source).isdigit():
        return CaptureReader(int(str(source)))
    path = Path(source)
    if path.is_dir():
        return FolderReader(path)
    if not path.is_file():
        raise FileNotFoundError(f"source: {path}: no such file or folder, and no camera's index (digits)")
    if path.suffix.lower() not in VIDEO_SUFFIXES:
        raise ValueError(f"source: {path}: expected a video ({', '.join(VIDEO_SUFFIXES)}), a folder of images or a camera's index")
    return CaptureReader(path)


class NewestFrame:
    """The newest frame of a reader that does not wait: a thread reads, who comes late finds only the last one.

    Args:
        reader: read by the thread until it ends or :meth:`close`.
        rate: frames a second at which a recording is played; None for a camera, which has its own.
        clock, sleep: for tests.
    """

    def __init__(
        self,
        reader: Reader,
        rate: float | None = None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], Any] | None = None,
    ) -> None:
        self.dropped = 0
        self._reader, self._rate, self._clock = reader, rate, clock
        self._changed, self._stop = threading.Condition(), threading.Event()
        self._sleep = sleep or self._stop.wait
        self._newest: tuple[int, float, Pixels] | None = None
        self._error: BaseException | None = None
        self._ended = False
        self._thread = threading.Thread(target=self._run, name="torchvts-reader", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            start, index = self._clock(), 0
            while not self._stop.is_set():
                pixels = self._reader.read()
                if pixels is None:
                    break
                if self._rate is not None:
                    wait = start + index / self._rate - self._clock()
                    if wait > 0:
                        self._sleep(wait)
                self.put(index, self._clock() - start, pixels)
                index += 1
        except Exception as error:  # handed to who takes the frames
            self._error = error
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify_all()

    def put(self, index: int, time_s: float, pixels: Pixels) -> None:
        """Lay down a frame; one that nobody took is dropped."""
        with self._changed:
            self.dropped += self._newest is not None
            self._newest = (index, time_s, pixels)
            self._changed.notify_all()

    def take(self) -> tuple[int, float, Pixels] | None:
        """The newest frame that was not yet taken: waits for it; None at the end. Raises what the reader raised."""
        with self._changed:
            while self._newest is None and not self._ended:
                self._changed.wait(0.2)  # so that Ctrl-C comes through
            newest, self._newest = self._newest, None
            if newest is None and self._error is not None:
                raise self._error
            return newest

    def close(self) -> None:
        """End the thread, then let go of the source."""
        self._stop.set()
        self._thread.join(timeout=5.0)
        self._reader.close()


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
    rough = _roughness(image)
    if rough > ROUGH:
        raise ValueError(
            f"background: the first {len(images)} frames show structure between the channels of {rough:.2f}, a skin at rest stays "
            f"below {ROUGH}: a contact rests there; start without contact, or give a calibration"
        )
    deviation = nn.functional.avg_pool2d(images - image, 3, 1, 1, count_include_pad=False).square().mean(0)
    smooth = nn.functional.avg_pool2d(deviation[None], 15, 1, 7, count_include_pad=False)[0]
    return image, 3.0 * torch.sqrt(smooth)


def _roughness(image: Tensor) -> float:
    stride = max(1, min(image.shape[1], image.shape[2]) // 120)
    log = (nn.functional.avg_pool2d(image[None].float(), stride) + PEDESTAL).log()
    log = log - log.mean(1, keepdim=True)
    height = log.shape[2]
    band = blur(log, gaussian_weights(height / 40.0)) - blur(log, gaussian_weights(height / 16.0))
    margin = round(0.14 * height)
    inner = band[0, :, margin : height - margin, margin : log.shape[3] - margin]
    return float(inner.square().sum(0).sqrt().flatten().quantile(0.99))


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
        if float((self.plane - torch.tensor([1.0, 0.0, 0.0])).abs().max()) < 1e-5:
            return image
        level, tilt_x, tilt_y = (self.plane[:, k, None, None].to(image.dtype) for k in range(3))
        return (image / (level + tilt_x * self._x + tilt_y * self._y)).clamp_(0.0, 1.0)

    def update(self, image: Tensor, contact: Tensor, seconds: float) -> str:
        """Learn from a frame (1, 3, H, W) as the camera gave it, its contact, and the time since the last; returns the state."""
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
        rest = nn.functional.avg_pool2d(image, self.cell)[0].double()
        self._rest = rest + PEDESTAL
        self._judged = (rest > 0.06) & (rest < 0.97)

    def start(self, image: Tensor) -> None:
        """Take over the light of an image (1, 3, H, W) that is known to be at rest."""
        for _ in range(3):
            cells, missing = self._missing(image)
            self.plane += self._fit(missing, self._judged & (cells < 0.97)) * self.plane[:, :1]

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
    background (RMS of the log ratio above 0.2), only their directions are believed: slope = - pinv(D) change, D being the lights'
    x / z and y / z. That is a stand-in: shapes are right, and how deep they are is only as right as the lamps' heights.

    Example:
        >>> from torchvts.shading import PointLights, flat_image
        >>> lights = PointLights([[25, 0, 30], [-12, 20, 30], [-12, -20, 30]], [900, 900, 900])
        >>> calibrate_at_rest(flat_image(lights, 48, 64, 0.6).detach(), Sensor("rig", 48, 64, 0.6)).metric
        True
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        calibration = calibrate(background, sensor)
    told = [str(w.message) for w in caught if issubclass(w.category, CalibrationWarning)]
    reason = str(calibration.report["reason"])
    if calibration.lights is not None and sensor.light_position_mm is not None:
        log = (background + PEDESTAL).log() - (calibration.model_image.to(background) + PEDESTAL).log()
        misfit = float((log - log.mean((1, 2), keepdim=True)).square().mean().sqrt())
        if misfit > MISFIT:
            lights = torch.tensor(sensor.light_position_mm, dtype=torch.float64)
            slope = -torch.linalg.pinv(lights[:, :2] / lights[:, 2:]) * CHANGE_SCALE
            rows = tuple(tuple(row) for row in slope.tolist())
            half_mm = 0.5 * sensor.width * sensor.mm_per_pixel
            model = ResponseModel(ResponseField(0, -1, False, half_mm, rows), None, sensor.exponent, max(1.0, sensor.blur_px))
            reason = f"directions of the sensor file's lights; as point lights they miss the background by {misfit:.0%}"
            report = {"model": "response", "response": "stand-in", "reason": reason}
            calibration = Calibration.from_response(model, sensor, background, report)
        told.append("the lights are the sensor file's, not this unit's")
    metric = not told
    told = [reason, *told] + ([] if metric else ["depth is NOT METRIC: calibrate with presses of a ball"])
    return AtRest(calibration, "; ".join(told), metric)


def _given(calibration: Calibration) -> AtRest:
    report = calibration.report
    told = f"calibration given: {report.get('reason', report.get('model', 'lights'))}"
    metric = max(report.get("direction_std_deg", [0.0])) <= LOOSE_DEG
    return AtRest(calibration, told if metric else f"{told}; depth is NOT METRIC: calibrate with presses of a ball", metric)


class StageClock:
    """Milliseconds by stage, of the last 10,000 frames."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self._frames: deque[dict[str, float]] = deque(maxlen=10_000)  # a camera may run for days
        self._now: dict[str, float] = {}
        self._started: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time what is done inside."""
        start = self._clock()
        try:
            yield
        finally:
            self._now[name] = self._now.get(name, 0.0) + 1000.0 * (self._clock() - start)

    def watch(self, pipe: DepthPipeline) -> list[Any]:
        """Time the blocks of a pipeline; returns what ``remove()`` ends it."""
        handles: list[Any] = []
        for name in ("compensate", "contact", "normals", "gradient", "integrate"):
            block = getattr(pipe, name)

            def before(_module: nn.Module, _inputs: Any, name: str = name) -> None:
                self._started[name] = self._clock()

            def after(_module: nn.Module, _inputs: Any, _output: Any, name: str = name) -> None:
                self._now[name] = self._now.get(name, 0.0) + 1000.0 * (self._clock() - self._started[name])

            handles += [block.register_forward_pre_hook(before), block.register_forward_hook(after)]
        return handles

    def end_frame(self) -> None:
        """What was timed since the last call was one frame."""
        self._frames.append(self._now)
        self._now = {}

    @property
    def last(self) -> dict[str, float]:
        """Stages of the last whole frame, ms."""
        return self._frames[-1] if self._frames else {}

    def median_ms(self) -> dict[str, float]:
        """Median of each stage over the frames in which it ran."""
        names = dict.fromkeys(name for frame in self._frames for name in frame)
        return {name: float(np.median([frame[name] for frame in self._frames if name in frame])) for name in names}


class TactileStream:
    """Depth of every frame of a camera, a video or a folder of images.

    The first frames are taken at rest (:func:`rest_image`); without a calibration the unit is calibrated from them
    (:func:`calibrate_at_rest`), with one they are held against its background and must be free of contact. Then each frame is
    rectified, brought into the background's light (:class:`FollowLight`), and sent through the pipeline. Of cameras, and of
    recordings with ``realtime``, only the newest frame is taken and late ones are dropped; of recordings else all.

    Args:
        source: a camera's index, a video file, a folder of images, or a :class:`Reader`.
        sensor_or_calibration: what rectifies, and the calibration, if there is one.
        mode: "fast", "precise" or "auto". background_frames: how many frames are at rest at the start.
        realtime: play a recording at its own rate as if it were a camera. follow: follow slow drift of the light.
        time_constant_s: of following.
    Attributes:
        calibration; told: what is to be known of it, in words; metric: whether depth is, as far as it knows;
        dropped: frames nobody took; stages: :class:`StageClock`;
        light: :class:`FollowLight`; fps: rate of the source.
    Raises:
        ValueError, OSError: the source, or contact or changing light in the first frames; says which.
    Example:
        >>> with TactileStream(0, Sensor.load("gelsight_mini")) as stream:  # doctest: +SKIP
        ...     for number, time_s, image, out in stream:
        ...         print(number, float(out.depth_mm.max()))
    """

    def __init__(
        self,
        source: str | int | Path | Reader,
        sensor_or_calibration: Sensor | Calibration,
        *,
        mode: str = "auto",
        background_frames: int = 12,
        realtime: bool = False,
        follow: bool = True,
        time_constant_s: float = TIME_CONSTANT_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        check_integer("background_frames", background_frames, 3)
        check_positive("time_constant_s", time_constant_s)
        given = sensor_or_calibration if isinstance(sensor_or_calibration, Calibration) else None
        if given is None and not isinstance(sensor_or_calibration, Sensor):
            raise TypeError(
                f"sensor_or_calibration: expected a Sensor or a Calibration, got {type(sensor_or_calibration).__name__}"
            )
        sensor = sensor_or_calibration.sensor if isinstance(sensor_or_calibration, Calibration) else sensor_or_calibration
        self.reader: Reader = open_source(source) if isinstance(source, str | int | Path) else source
        self._newest: NewestFrame | None = None
        self._hooks: list[Any] = []
        try:
            self._clock, self._follow = clock, follow
            self._realtime = realtime or self.reader.live
            self.fps = self.reader.fps
            self.stages = StageClock()
            self._waiting = self._first_frames(background_frames)
            self.rectify = Rectify(sensor, *self._waiting[0].shape[:2])
            rest = torch.cat([self.rectify(rgb_from_bgr(pixels)[None]) for pixels in self._waiting])
            image, noise = rest_image(rest)
            at_rest = calibrate_at_rest(image, sensor) if given is None else _given(given)
            self.calibration, self.told, self.metric = at_rest
            value = self.calibration.background.float() ** (1.0 / self.calibration.sensor.exponent)
            self.light = FollowLight(value, time_constant_s)
            self.pipe = DepthPipeline.from_calibration(self.calibration, mode).float()
            self.pipe.contact = _contact_in_video(self.calibration, noise)
            image = image[None].clamp(0.0, 1.0)
            if given is not None:
                self._check_rest(image)
            self.light.set_rest(self.light.correct(image))
            self._hooks = self.stages.watch(self.pipe)
        except BaseException:
            self.reader.close()
            raise

    @property
    def dropped(self) -> int:
        """Frames that came while another was worked on, and were left out."""
        return 0 if self._newest is None else self._newest.dropped

    def _first_frames(self, count: int) -> list[Pixels]:
        if self.reader.live:  # exposure settles
            for _ in range(5):
                self.reader.read()
        frames: list[Pixels] = []
        while len(frames) < count:
            pixels = self.reader.read()
            if pixels is None:
                break
            frames.append(pixels)
        if len(frames) < count:
            raise ValueError(
                f"background_frames: expected at least {count} frames from {self.reader.name}, got {len(frames)}: ask for fewer"
            )
        return frames

    def _check_rest(self, image: Tensor) -> None:
        """Bring the first frames into the calibration's light, and refuse a contact in them."""
        light = self.light
        light.start(image if self.calibration.markers is None else self.calibration.markers(image))
        level = max(abs(v - 1.0) for v in light.level)
        if level > 0.15:
            raise ValueError(
                f"background: the light is {level:.0%} off the calibration's: another unit, exposure or lamps; calibrate again"
            )
        with torch.inference_mode():
            contact = self.pipe.contact(self.pipe.compensate(light.correct(image)))
        if bool(contact.any()):
            raise ValueError(
                f"background: the first frames show contact on {float(contact.float().mean()):.1%} of the skin against the "
                "calibration's background: start without contact, or calibrate again if the skin has changed"
            )

    def __enter__(self) -> "TactileStream":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the reading and let go of the source."""
        for handle in self._hooks:
            handle.remove()
        self._hooks = []
        if self._newest is not None:
            self._newest.close()
        else:
            self.reader.close()

    def __iter__(self) -> Iterator[TactileFrame]:
        before = None
        for index, time_s, pixels in self._frames():
            with torch.inference_mode():
                with self.stages.stage("rectify"):
                    raw = self.rectify(rgb_from_bgr(pixels)[None]).clamp_(0.0, 1.0)
                with self.stages.stage("light"):
                    image = self.light.correct(raw)
                output = self.pipe(image)
                if self._follow:
                    with self.stages.stage("light"):
                        self.light.update(raw, output.contact, 1.0 / self.fps if before is None else time_s - before)
            before = time_s
            yield TactileFrame(index, time_s, image[0], output)
            self.stages.end_frame()

    def _frames(self) -> Iterator[tuple[int, float, Pixels]]:
        if self._realtime:
            reader = self.reader if self.reader.live else _Replay(self.reader, self._waiting)
            self._waiting = []
            self._newest = NewestFrame(reader, None if self.reader.live else self.fps, self._clock)
            while (item := self._take()) is not None:
                yield item
            return
        for index, pixels in enumerate(self._waiting):
            yield index, index / self.fps, pixels
        index = len(self._waiting)
        self._waiting = []
        while True:
            with self.stages.stage("read"):
                pixels_or_end = self.reader.read()
            if pixels_or_end is None:
                return
            yield index, index / self.fps, pixels_or_end
            index += 1

    def _take(self) -> tuple[int, float, Pixels] | None:
        assert self._newest is not None
        with self.stages.stage("wait"):
            return self._newest.take()


class _Replay:
    """The frames that were already read, then the rest of a reader."""

    def __init__(self, reader: Reader, first: Sequence[Pixels]) -> None:
        self.name, self.live, self.fps = reader.name, reader.live, reader.fps
        self._reader, self._first = reader, iter(list(first))

    def read(self) -> Pixels | None:
        pixels = next(self._first, None)
        return self._reader.read() if pixels is None else pixels

    def close(self) -> None:
        self._reader.close()


def _contact_in_video(calibration: Calibration, noise: Tensor) -> ContactMask:
    """The unit's contact mask, which knows how far a video wavers from frame to frame."""
    calibrated = ContactMask.from_calibration(calibration)
    sensor = calibration.sensor
    value = calibration.background.float().clamp_min(1e-6) ** (1.0 / sensor.exponent)
    compensated = noise.float() * sensor.exponent * torch.maximum(value, noise.float()) ** (sensor.exponent - 1.0)
    if calibration.gain is not None:
        compensated = compensated * calibration.gain.float() * 2.0**0.5
    least = STAND_IN_NOISE if calibration.report.get("response") == "stand-in" else 0.0
    most = torch.maximum(1.0 / calibrated.per_noise.float(), compensated).clamp_min(least)
    return ContactMask(calibrated.flat.float(), most).eval()


_RANGES = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)


class Overlay:
    """Draws a frame: the image with its contact outlined, beside it depth in colour with contour lines, figures beneath.

    The range of colours grows with the deepest press so far, over round numbers; ten lines fill it.

    Args:
        metric: whether depth is in mm; if not, it says so.
    """

    TEXT_HEIGHT = 86

    def __init__(self, metric: bool = True) -> None:
        import cv2

        self.metric, self.range_mm = metric, 0.1
        table = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_VIRIDIS)
        self._table = np.ascontiguousarray(table)

    def depth(self, depth_mm: Tensor) -> Pixels:
        """Depth (1, 1, H, W) as colours with contour lines, (H, W, 3) B, G, R."""
        import cv2

        depth = depth_mm[0, 0].float().numpy()
        high = float(depth.max())
        while high > self.range_mm:
            power = 10.0 ** np.floor(np.log10(self.range_mm) + 1e-9)
            self.range_mm = float(power * next(s for s in _RANGES if s > self.range_mm / power + 1e-6))
        depth = np.maximum(depth, 0.0)
        level = cv2.convertScaleAbs(depth, alpha=255.0 / self.range_mm)
        picture: Pixels = cv2.applyColorMap(level, self._table)
        if high > 0.02 * self.range_mm:
            smooth = cv2.blur(depth, (3, 3))
            step = cv2.convertScaleAbs(smooth, alpha=10.0 / self.range_mm, beta=-0.5)  # ten lines over the range
            lines = np.zeros(step.shape, np.uint8)
            lines[:, 1:] |= (step[:, 1:] != step[:, :-1]).view(np.uint8)
            lines[1:] |= (step[1:] != step[:-1]).view(np.uint8)
            picture[lines.astype(bool)] = (255, 255, 255)
        return picture

    def __call__(self, frame: TactileFrame, lines: Sequence[str] = ()) -> Pixels:
        """The overlay, B, G, R, with up to three lines of text under it; images narrower than 300 pixels are shown larger."""
        import cv2

        height, width = frame.image.shape[1:]
        left = np.ascontiguousarray((frame.image.flip(0).permute(1, 2, 0) * 255.0 + 0.5).to(torch.uint8).numpy())
        contact = frame.output.contact[0, 0].numpy().view(np.uint8)
        if contact.any():
            smooth = (cv2.blur(contact * 255, (7, 7)) > 127).view(np.uint8)
            outline, _ = cv2.findContours(smooth, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(left, outline, -1, (255, 255, 255), 1, cv2.LINE_AA)
        right, larger = self.depth(frame.output.depth_mm), -(-300 // width)
        height, width = height * larger, width * larger
        out = np.zeros((height + self.TEXT_HEIGHT + height % 2, 2 * width, 3), np.uint8)
        for picture, place in ((left, 0), (right, width)):
            if larger > 1:
                picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_NEAREST)
            out[:height, place : place + width] = picture
        unit = "mm" if self.metric else "mm, NOT METRIC"
        texts = [f"depth 0 to {self.range_mm:g} {unit}, a line each {self.range_mm / 10:g}", *lines][:4]
        for k, text in enumerate(texts):
            cv2.putText(out, text, (6, height + 18 + 20 * k), cv2.FONT_HERSHEY_SIMPLEX, 0.43, (230, 230, 230), 1, cv2.LINE_AA)
        return out


class VideoFile:
    """A video that is there whole or not at all: written beside its name, renamed when the block ends well.

    Args:
        path: .mp4 (mp4v) or .avi (MJPG). fps: frames a second.
    Raises:
        ValueError: another suffix. OSError: OpenCV cannot write it.
    """

    def __init__(self, path: str | Path, fps: float) -> None:
        self.path, self.fps = Path(path), check_positive("fps", fps)
        if self.path.suffix.lower() not in CODES:
            raise ValueError(f"video: expected a name ending in {' or '.join(CODES)}, got {self.path.name!r}")
        self._file: Any = None
        self._writer: Any = None
        self._temporary = self.path

    def __enter__(self) -> "VideoFile":
        self._file = write_atomically(self.path)
        self._temporary = self._file.__enter__()
        return self

    def write(self, picture: Pixels) -> None:
        """Append a frame, (H, W, 3) B, G, R, 8 bits; all of one size."""
        import cv2

        if self._writer is None:
            code = cv2.VideoWriter.fourcc(*CODES[self.path.suffix.lower()])
            self._writer = cv2.VideoWriter(str(self._temporary), code, self.fps, (picture.shape[1], picture.shape[0]))
            if not self._writer.isOpened():
                raise OSError(f"video: {self.path}: OpenCV cannot write this kind of file here: try .avi")
        self._writer.write(picture)

    def __exit__(self, *error: Any) -> None:
        if self._writer is not None:
            self._writer.release()
        if self._writer is None and error[0] is None:
            nothing = OSError(f"video: {self.path}: no frame came, so none is written")
            self._file.__exit__(OSError, nothing, None)  # removes the temporary file
            return
        self._file.__exit__(*error)


class StreamReport:
    """What is kept of every frame, for a table at the end and two files.

    Args:
        stream: told of by its frames.
    """

    HEADER = "frame,time_s,contact_mm2,deepest_mm,light"

    def __init__(self, stream: TactileStream, clock: Callable[[], float] = time.perf_counter) -> None:
        self.stream, self._clock = stream, clock
        self.rows: list[tuple[int, float, float, float, str]] = []
        self._begin = self._end = clock()
        self._pixel_mm2 = stream.calibration.sensor.mm_per_pixel**2

    def add(self, frame: TactileFrame) -> list[str]:
        """Keep a frame's figures; returns them as lines of text."""
        self._end = self._clock()
        area = float(frame.output.contact.sum()) * self._pixel_mm2
        deepest = float(frame.output.depth_mm.max())
        state = self.stream.light.state
        self.rows.append((frame.number, frame.time_s, area, deepest, state))
        dropped = f", {self.stream.dropped} dropped" if self.stream.dropped else ""
        times = [f"{name} {ms:.1f}" for name, ms in self.stream.stages.last.items()]
        half = (len(times) + 1) // 2
        light = "  LIGHT HAS CHANGED: start again without contact" if state == "stepped" else ""
        return [
            f"frame {frame.number}  {frame.time_s:.2f} s  contact {area:.1f} mm2  deepest {deepest:.2f}{light}",
            f"{self.fps:.0f} fps{dropped}, ms: {' '.join(times[:half])}",
            " ".join(times[half:]),
        ]

    @property
    def fps(self) -> float:
        """Frames a second from the start to the last frame, drawing and writing included."""
        return len(self.rows) / max(self._end - self._begin, 1e-9)

    def summary(self) -> dict[str, Any]:
        """Plain JSON: frames, dropped, fps, stages_ms, and what the stream is."""
        stream = self.stream
        return {
            "source": stream.reader.name,
            "source_fps": stream.fps,
            "frames": len(self.rows),
            "dropped": stream.dropped,
            "fps": round(self.fps, 2),
            "stages_ms": {name: round(ms, 3) for name, ms in stream.stages.median_ms().items()},
            "contact_frames": sum(row[2] > 0 for row in self.rows),
            "deepest_mm": max((row[3] for row in self.rows), default=0.0),
            "light_level": [round(v, 5) for v in stream.light.level],
            "light_steps": stream.light.steps,
            "metric": stream.metric,
            "calibration": stream.told,
        }

    def table(self) -> str:
        """The summary as text."""
        values = self.summary()
        lines = [f"{values['frames']} frames, {values['dropped']} dropped, {values['fps']:.1f} frames a second"]
        lines.append("| stage | median ms |\n|---|---|")
        lines += [f"| {name} | {ms:.2f} |" for name, ms in values["stages_ms"].items()]
        unit = "mm" if values["metric"] else "mm (NOT METRIC)"
        lines.append(f"contact in {values['contact_frames']} frames, deepest {values['deepest_mm']:.3f} {unit}")
        lines.append("light at the end, R G B: " + " ".join(f"{v:.3f}" for v in values["light_level"]) + " of the background's")
        if values["light_steps"]:
            lines.append(f"the light stepped {values['light_steps']} times (frames marked 'stepped' in frames.csv): not learned")
        return "\n".join(lines)

    def save(self, folder: Path) -> None:
        """Write summary.json and frames.csv, each whole or not at all."""
        with write_atomically(folder / "summary.json") as temporary:
            temporary.write_text(json.dumps(self.summary(), indent=2) + "\n", encoding="utf-8")
        with write_atomically(folder / "frames.csv") as temporary:
            rows = (f"{i},{t:.4f},{area:.4f},{deepest:.6f},{state}\n" for i, t, area, deepest, state in self.rows)
            temporary.write_text(f"{self.HEADER}\n" + "".join(rows), encoding="utf-8")


def has_display() -> bool:
    """Whether a window could be opened: a screen is named, and Matplotlib finds a toolkit for it."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return False
    import matplotlib

    try:
        import matplotlib.pyplot as plt

        plt.figure().clear()
        plt.close("all")
    except Exception:  # toolkits raise of their own when the screen does not answer
        return False
    return str(matplotlib.get_backend()).lower() not in ("agg", "pdf", "ps", "svg", "cairo", "template")


class Window:
    """A live view by Matplotlib, because OpenCV without a screen has none."""

    def __init__(self) -> None:
        import matplotlib.pyplot as plt

        plt.ion()
        self._plt = plt
        self._figure, self._axes = plt.subplots(num="torchvts")
        self._axes.axis("off")
        self._image: Any = None

    def show(self, picture: Pixels) -> bool:
        """Show a picture (H, W, 3) B, G, R; False once the window is closed."""
        rgb = picture[:, :, ::-1]
        if self._image is None:
            self._image = self._axes.imshow(rgb)
        else:
            self._image.set_data(rgb)
        self._plt.pause(0.001)
        return bool(self._plt.fignum_exists(self._figure.number))
