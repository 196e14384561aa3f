"""The background of a unit: found in the first frames of a stream, and replaced where a stream is zeroed again."""

import dataclasses
import math
from collections.abc import Sequence
from itertools import islice
from pathlib import Path

import torch
from torch import Tensor

from ..calibration import ROUGH, Press, channel_structure
from ..core.blur import band_of_ratios, without_margin
from ..core.cells import whole_cell_means
from ..core.checks import check_batch, check_image, check_integer, check_path, check_positive, check_sequence, parse_number
from ..core.recordings import is_film
from ..model import Calibration, Sensor, SensorPrior, check_calibration, check_sensor
from ..model.calibration import PEDESTAL
from ..normals import NormalFromResponse
from .sources import frames

MOVED = 0.02
"""Relative change of a cell of 1/20 of the frame that counts as movement among the first frames."""

TOUCHED = 0.06
"""Relative change of three cells of 1/20 of the frame from which something touches the skin: presses of five sensors have 0.15 and
more, the skin far from them up to 0.035."""

ROUGH_DEG = 3.3
"""Slopes for which a prior takes the structure of an image; more is a contact."""


def find_background(images: Tensor, sensor: Sensor | None = None) -> Tensor:
    """Find the image of the skin without contact in the first frames, or refuse and say why.

    The image is the median over the frames, averaged with the half of the values next to it. Refused are changing light, movement,
    and structure between the channels: the fall-off of an LED is smooth, and a spot is dark in all channels; a contact is bright in
    one channel where it is dark in another. Limits: :data:`MOVED`, :data:`ROUGH_DEG`. A faint contact in all frames is not found.

    Args:
        images: (N, 3, H, W) in [0, 1], rectified, at least 3.
        sensor: of the images; its prior is used if it has one.
    Returns:
        The image (3, H, W) in steps of 1/65535, which a calibration file keeps.
    Raises:
        ValueError: with the reason.
    """
    check_batch("images", images, 3)
    if sensor is not None:
        check_sensor("sensor", sensor)
    if images.shape[0] < 3:
        raise ValueError(
            f"images: expected at least 3 frames without contact, got {images.shape[0]}: the source is too short, or fewer were "
            "asked for (background_frames, --background-frames; 0 keeps a calibration's)"
        )
    check_steady(images)
    rank = images.sort(0).values
    quarter = len(images) // 4
    image = _in_16_bits(rank[quarter : len(images) - quarter].mean(0))
    seen = ""
    if (structure := channel_structure(image)) > ROUGH:
        seen = f"between the channels of {structure:.3f}, without contact it is below {ROUGH}"
    elif sensor is not None and sensor.prior is not None and (deg := _structure_deg(image, sensor, sensor.prior)) > ROUGH_DEG:
        seen = f"that looks like slopes of {deg:.1f} degrees, without contact it is below {ROUGH_DEG:g}"
    if seen:
        other = "" if sensor is None else f", or the frames are not those of a sensor '{sensor.name}'"
        raise ValueError(
            f"background: the first {len(images)} frames show structure {seen}: something touches the skin{other}; start without "
            "contact, or use the background of a calibration file (--background-frames 0; background_frames=0)"
        )
    return image


def _structure_deg(image: Tensor, sensor: Sensor, prior: SensorPrior) -> float:
    """Slopes, degrees, for which a sensor's prior takes the structure between the channels of an image without contact."""
    height = sensor.height
    band = band_of_ratios(image[None].float() ** sensor.exponent, height, PEDESTAL)
    normals = NormalFromResponse(prior.response.field, None, height, sensor.width, sensor.mm_per_pixel)
    upright = without_margin(normals(band.exp())[0, 2])
    return math.degrees(math.acos(min(1.0, float(upright.flatten().quantile(0.01)))))


def _in_16_bits(image: Tensor) -> Tensor:
    """Values that a calibration file keeps exactly."""
    return (image.double() * 65535.0).round().div(65535.0).to(image.dtype)


FIRST_FRAMES = 12
"""So many first frames of a recording show the skin without contact, unless the user says otherwise."""


def read_background(paths: Sequence[str | Path], sensor: Sensor, first_frames: int = FIRST_FRAMES) -> Tensor:
    """The image without contact from files, rectified, (3, height, width).

    One image is taken as it is, several by the median of each pixel, and a film's first frames by :func:`find_background`.

    Args:
        paths: one or more images, or one video.
        sensor: rectifies.
        first_frames: of a video, at least 3.
    Raises:
        FileNotFoundError: no such file.
        ValueError: not an image, sizes that the sensor does not accept, contact or movement in the first frames. Names the file.
    """
    check_sequence("background", paths, "paths of images, or of one video")
    check_integer("first_frames", first_frames, 3)
    if len(paths) == 0:
        raise ValueError("background: expected one image or more, or a video, got none")
    files = [check_path("background", path) for path in paths]
    if any(is_film(file) for file in files):
        if len(files) > 1:
            raise ValueError(f"background: expected images or one video, got {len(files)} files with a video among them")
        return _background_of_film(files[0], sensor, first_frames)
    images = torch.stack([sensor.read_image(file) for file in files])
    if len(images) == 1:
        return images[0]
    rank = images.sort(0).values
    return _in_16_bits(rank[(len(images) - 1) // 2 : len(images) // 2 + 1].mean(0))


def _background_of_film(path: Path, sensor: Sensor, first_frames: int) -> Tensor:
    try:
        first = [sensor.rectify(image[None]).clamp(0.0, 1.0) for _, image in islice(frames(path), first_frames)]
        if len(first) < first_frames:
            raise ValueError(f"background: expected at least {first_frames} frames, got {len(first)}: ask for fewer")
        return find_background(torch.cat(first), sensor)
    except ValueError as error:
        raise ValueError(str(error) if str(error).startswith(str(path)) else f"{path}: {error}") from error


def read_press_images(presses: Sequence[tuple[str | Path, float | str]], sensor: Sensor) -> list[Press]:
    """Presses from image files and ball diameters in mm.

    Raises:
        FileNotFoundError: no such image.
        ValueError: not an image, a size that the sensor does not accept, or no diameter; names the file.
    """
    found = []
    alike = len({Path(path).name for path, _ in presses}) < len(presses)  # gs_sdk calls every image gelsight.png
    for path, diameter in presses:
        try:
            diameter_mm = check_positive("press", parse_number(diameter) if isinstance(diameter, str) else diameter)
        except (TypeError, ValueError):
            hint = ": write a decimal point" if "," in str(diameter) else ""
            raise ValueError(f"press: expected the diameter of the ball in mm after {path}, got {diameter!r}{hint}") from None
        found.append(Press(sensor.read_image(path), diameter_mm, str(path) if alike else Path(path).name))
    return found


def is_touched(image: Tensor, background: Tensor) -> bool:
    """Whether an image (3, H, W) differs from the skin without contact in some places, whatever its level; :data:`TOUCHED`."""
    ratio = _cells(image[None]) / _cells(background[None])
    change = (ratio / ratio.flatten(2).median(2).values[..., None, None] - 1.0).abs().amax(1)
    return int((change > TOUCHED).sum()) >= 3


def _cells(images: Tensor) -> Tensor:
    """Means over cells of 1/20 of the frame, float64, never 0."""
    side = max(2, min(images.shape[2], images.shape[3]) // 20)
    return whole_cell_means(images, side).double() + PEDESTAL


def check_steady(images: Tensor) -> None:
    """Raise ValueError where the light changes or something moves in frames (N, 3, H, W).

    The light changes where the level of a channel, its median over cells of 1/20 of the frame, does by :data:`MOVED`. Something
    moves where three cells differ from the level by that, by 8 times the spread of all cells, and by 4 times their own flicker.
    """
    cells = _cells(images)
    ratio = cells / cells.median(0, keepdim=True).values
    level = ratio.flatten(2).median(2).values  # (N, 3)
    change = (level.amax(0) - level.amin(0)).max()
    if change > MOVED:
        raise ValueError(
            f"background: the light changes by {float(change):.1%} during the first {len(images)} frames: wait until the LEDs and "
            "the camera's exposure have settled"
        )
    relative = ratio / level[..., None, None]
    difference = (relative - 1.0).abs()  # (N, 3, h, w)
    spread = 1.4826 * float(difference.amax(1).median())
    # compression makes dark cells flicker; a step, or steady growth, is larger than four times what changes from frame to frame
    flicker = 4.0 * relative.diff(dim=0).abs().median(0).values
    moves = (difference > flicker.clamp_min(max(MOVED, 8.0 * spread))).any(1)  # (N, h, w)
    moved = moves.flatten(1).sum(1)
    if int(moved.max()) < 3:
        return
    most = 255.0 * float((cells - cells.median(0, keepdim=True).values).abs().amax(1)[moves].max())
    raise ValueError(
        f"background: frame {int(moved.argmax())} of the first {len(images)} differs from the others in {int(moved.max())} of "
        f"{difference[0, 0].numel()} places, by at most {most:.1f} of 255: a contact, or the sensor moves: start without contact, "
        "or take fewer (--background-frames N); up to 4 of 255 may be blocks of a lossy video, which hide faint contacts: record "
        "without loss (--record raw.mkv, or PNG), or use a calibration's background (--background-frames 0; background_frames=0)"
    )


def with_background(calibration: Calibration, background: Tensor) -> Calibration:
    """The calibration with another image (3, H, W) without contact, which gives defects, gain and noise; the model stays.

    Raises:
        ValueError, TypeError: background of another shape or range.
    Example:
        >>> from torchvts.model import PointLights
        >>> lights = PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900, 900, 900])
        >>> unit = Calibration.from_lights(lights, Sensor("rig", 48, 64, 0.5))
        >>> with_background(unit, torch.full((3, 48, 64), 0.5)).background.mean()
        tensor(0.5000)
    """
    check_calibration("calibration", calibration)
    sensor = calibration.sensor
    check_image("background", background, sensor.height, sensor.width, sensor.name)
    if calibration.response is not None:
        background = background.to(calibration.background.dtype)
        unit = Calibration.from_response(calibration.response, sensor, background, calibration.report, calibration.covariance)
    else:
        assert calibration.lights is not None
        unit = Calibration.from_lights(calibration.lights, sensor, background, calibration.report, calibration.ambient)
    share, decay_mm = calibration.contact_share, calibration.contact_decay_mm
    return dataclasses.replace(unit, contact_share=share, contact_decay_mm=decay_mm)
