"""Description of a sensor type or unit: size, pitch, camera response, and where the gel lies in the camera's frame."""

import dataclasses
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor

from ..core.checks import (
    brief,
    check_batch,
    check_image_size,
    check_integer,
    check_least,
    check_numbers,
    check_path,
    check_positive,
    check_record,
    check_switch,
    from_dict,
)
from ..core.files import read_image, write_atomically
from ..core.geometry import check_rigid
from ..core.spelling import suggest
from ..core.strict_yaml import read_yaml
from .camera_view import CameraView, camera_above, check_corners, check_lens, check_raw_sizes, is_raw, places_in_frame, rectified
from .gs_sdk_sensor import values_from_gs_sdk
from .response_field import SensorPrior

LEAST_PITCH_MM = 5e-4
"""Smallest pixel pitch, mm: 0.5 um, the resolution of light. Sensors have 0.01 to 0.1; one in m is below."""

MOST_OBLIQUE = 1.5
"""Aspect of the corners over that of the sensor: 1.1 on a GelSight Wedge; of 4:3 it is 1.8 where they start at the next corner."""

MOST_STRETCHED = 0.02
"""Difference of aspects, logarithm, up to which frames are resized: shipped sensors have 0.002, for whole pixels."""


@dataclass(frozen=True)
class Sensor:
    """A sensor type or unit.

    Args:
        name: any text.
        height: rows of the image that the pipeline works on.
        width: columns of that image.
        mm_per_pixel: pixel pitch on the skin, mm.
        gamma: response of the camera, value = light^(1 / gamma); None leaves it open: calibration chooses it, all else uses 1.
        blur_px: standard deviation of a Gaussian blur before normals, pixels; 0 for none.
        light_position_mm: (3, 3), rows R, G, B, if the positions of the lights are known.
        camera_matrix: (3, 3), OpenCV's, in pixels of raw frames, out of which the distortion of the lens is taken first. Raw frames
            are those of ``raw_size_px``; where ``roi_px`` or ``corners_px`` are given without it, all are.
        distortion_coefficients: OpenCV's, 4, 5, 8, 12 or 14 numbers k1, k2, p1, p2, k3, ...
        turn_deg: 0, 90, 180 or 270, by which raw frames are then turned, anticlockwise. Places are those in turned frames.
        mirror: whether raw frames are then mirrored left to right.
        roi_px: (left, top, width, height) of the gel in the camera's frame, of the sensor's aspect within 2 %, resized to its size.
        corners_px: (4, 2), x and y of the gel's corners in the camera's frame: top left, top right, bottom right, bottom
            left, rectified to the sensor's size. Either this or ``roi_px``.
        raw_size_px: (N, 2), (height, width) of the frames that the camera gives. Beside ``roi_px`` or ``corners_px``: the size in
            which these were measured, frames of others are refused. Without: a frame of such a size is turned, cropped by
            ``raw_crop``, and resized; one of the sensor's size is kept as it is. Where frames are turned, mirrored or
            straightened, the sensor's size before that if nothing else is said.
        raw_crop: share of a raw frame's height and width to cut off each side, in [0, 0.49].
        markers: whether the skin has printed markers, which are filled in every frame; None: where the background shows a regular
            pattern of them.
        sensor_to_robot: (4, 4), rows of the rigid motion, mm, that takes points of the sensor (x right, y up, z towards the camera,
            origin on the skin in the middle of the image) to a frame of the robot, in which commands then write clouds and poses.
        prior: response that all units of this type share, fitted to presses on one.
    Raises:
        TypeError, ValueError: name the argument, what was expected and what was given.
    Example:
        >>> Sensor(name="rig", height=480, width=640, mm_per_pixel=0.0625).field_mm
        (30.0, 40.0)
    """

    name: str
    height: int
    width: int
    mm_per_pixel: float
    gamma: float | None = None
    blur_px: float = 0.0
    light_position_mm: tuple[tuple[float, float, float], ...] | None = None
    camera_matrix: tuple[tuple[float, ...], ...] | None = None
    distortion_coefficients: tuple[float, ...] | None = None
    turn_deg: int = 0
    mirror: bool = False
    roi_px: tuple[int, int, int, int] | None = None
    corners_px: tuple[tuple[float, float], ...] | None = None
    raw_size_px: tuple[tuple[int, int], ...] = ()
    raw_crop: float = 0.0
    markers: bool | None = None
    sensor_to_robot: tuple[tuple[float, ...], ...] | None = None
    prior: SensorPrior | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name.strip():
            raise TypeError(f"name: expected a text, got {brief(self.name)}")
        height, width = check_image_size("height", self.height, "width", self.width, 8)
        self._set("height", height)
        self._set("width", width)
        self._set("mm_per_pixel", check_positive("mm_per_pixel", self.mm_per_pixel, 10.0))
        if self.mm_per_pixel < LEAST_PITCH_MM:
            raise ValueError(f"mm_per_pixel: expected at least {LEAST_PITCH_MM:g} mm, got {self.mm_per_pixel:g}: is it in m?")
        if self.gamma is not None:
            self._set("gamma", check_least("gamma", self.gamma, 0.1, 10.0))
        self._set("blur_px", check_least("blur_px", self.blur_px, 0.0, 0.25 * min(self.height, self.width)))
        if self.light_position_mm is not None:
            numbers = check_numbers("light_position_mm", self.light_position_mm, (3, 3))
            if min(numbers[2::3]) <= 0:
                raise ValueError(f"light_position_mm: expected lights above the skin (z > 0), got {self.light_position_mm!r}")
            self._set("light_position_mm", tuple(numbers[i : i + 3] for i in (0, 3, 6)))
        self._check_view()
        if self.markers is not None and not isinstance(self.markers, bool):
            raise TypeError(f"markers: expected true, false or null, got {brief(self.markers)}")
        if self.sensor_to_robot is not None:
            numbers = check_numbers("sensor_to_robot", self.sensor_to_robot, (4, 4))
            check_rigid("sensor_to_robot", torch.tensor(numbers, dtype=torch.float64).reshape(4, 4))
            if 0.0 < (most := max(abs(numbers[i]) for i in (3, 7, 11))) < 1.0:
                warnings.warn(f"sensor_to_robot: its shift is at most {most:g} mm: was it meant in m?", UserWarning, stacklevel=3)
            self._set("sensor_to_robot", tuple(numbers[i : i + 4] for i in (0, 4, 8, 12)))
        prior: object = self.prior
        if isinstance(prior, dict):  # as YAML gives it
            self._set("prior", SensorPrior.from_dict(prior, "prior"))
        elif prior is not None:
            check_record("prior", prior, SensorPrior)

    def _check_view(self) -> None:
        """Check what leads from raw frames to the sensor's images."""
        if self.roi_px is not None and self.corners_px is not None:
            raise ValueError("roi_px, corners_px: expected one of them, got both")
        if self.roi_px is not None:
            roi = check_numbers("roi_px", self.roi_px, (4,))
            if any(v != int(v) for v in roi) or min(roi[:2]) < 0 or min(roi[2:]) < 2:
                raise ValueError(f"roi_px: expected whole numbers (left, top, width, height) in the frame, got {self.roi_px!r}")
            self._set("roi_px", tuple(int(v) for v in roi))
        if self.corners_px is not None:
            self._set("corners_px", check_corners(self.corners_px))
        if check_integer("turn_deg", self.turn_deg, 0, 270) % 90:
            raise ValueError(f"turn_deg: expected 0, 90, 180 or 270, anticlockwise, got {self.turn_deg}")
        check_switch("mirror", self.mirror)
        self._set("raw_size_px", check_raw_sizes(self.raw_size_px))
        if self.camera_matrix is not None or self.distortion_coefficients is not None:
            matrix, coefficients = check_lens(self.camera_matrix, self.distortion_coefficients)
            self._set("camera_matrix", matrix)
            self._set("distortion_coefficients", coefficients)
            if len(self.raw_size_px) > 1:
                raise ValueError(f"raw_size_px: expected one size, that of camera_matrix, got {self.raw_size_px}")
        self._set("raw_crop", check_least("raw_crop", self.raw_crop, 0.0, 0.49))
        if self._moved and not (self.raw_size_px or self.cuts_a_place):
            self._set("raw_size_px", ((self.width, self.height) if self.turn_deg % 180 else (self.height, self.width),))
        self._check_aspects()
        if self.corners_px is not None:
            self._check_corners(self.corners_px)

    def _check_aspects(self) -> None:
        """Raise where images would be stretched: the pitch is the same along x and y."""
        taken = [("roi_px", self.roi_px[2:], "a region")] if self.roi_px is not None else []
        if not self.cuts_a_place:
            taken += [("raw_size_px", size if self.turn_deg % 180 else size[::-1], "frames") for size in self.raw_size_px]
        for name, (across, down), what in taken:
            aspect, own = across / down, self.width / self.height
            if abs(math.log(aspect / own)) > MOST_STRETCHED:
                raise ValueError(
                    f"{name}: expected {what} of the aspect of width x height {self.width} x {self.height}, {own:.3f}, got "
                    f"{across} x {down}, {aspect:.3f}: pixels would not be square; set it, or height and width, to the same "
                    "aspect, or give corners_px, which set the true shape"
                )

    def _check_corners(self, corners_px: tuple[tuple[float, float], ...]) -> None:
        """Raise where corners are of another aspect than a gel seen from aside can have."""
        top, right, bottom, left = (math.dist(corners_px[k], corners_px[(k + 1) % 4]) for k in range(4))
        across, down = 0.5 * (top + bottom), 0.5 * (right + left)
        if abs(math.log(across / down * self.height / self.width)) > math.log(MOST_OBLIQUE):
            raise ValueError(
                f"corners_px: expected a gel about {self.width / self.height:.2f} times as wide as high, as width x height "
                f"{self.width} x {self.height}, got {across:.0f} x {down:.0f}: do they start at the top left, clockwise?"
            )

    def _set(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)

    @property
    def exponent(self) -> float:
        """Linear light = value^exponent: gamma, or 1 where it is left open."""
        return 1.0 if self.gamma is None else self.gamma

    def __hash__(self) -> int:
        """Of the fields that tell sensors apart: frames are looked up by their sensor, and equality asks the rest."""
        return hash((self.name, self.height, self.width, self.mm_per_pixel))

    @property
    def field_mm(self) -> tuple[float, float]:
        """Height and width of the field of view, mm."""
        return self.height * self.mm_per_pixel, self.width * self.mm_per_pixel

    @property
    def camera_mm(self) -> tuple[float, float, float] | None:
        """Where ``camera_matrix`` puts the camera above the middle of the skin: x, y, height; None where it is not known.

        Example:
            >>> lens = {"camera_matrix": [[400, 0, 159.5], [0, 400, 119.5], [0, 0, 1]], "distortion_coefficients": [0] * 5}
            >>> [round(abs(v), 6) for v in Sensor(name="rig", height=240, width=320, mm_per_pixel=0.05, **lens).camera_mm]
            [0.0, 0.0, 20.0]
        """
        return camera_above(self)

    def resized(self, height: int, width: int) -> "Sensor":
        """The same sensor with other pixels: field of view, lights and response stay; pitch and blur are scaled.

        Frames of the new size are taken as images that are cropped already, also where the camera gives raw frames of that size,
        unless these must be turned, mirrored or straightened.

        Args:
            height: new number of rows.
            width: new number of columns.
        Raises:
            ValueError: another aspect ratio (beyond 1 %), because pixels would no longer be square.
        Example:
            >>> Sensor(name="rig", height=480, width=640, mm_per_pixel=0.0625).resized(240, 320).mm_per_pixel
            0.125
        """
        height, width = check_image_size("height", height, "width", width, 8)
        scale_y, scale_x = height / self.height, width / self.width
        if abs(scale_x / scale_y - 1.0) > 0.01:
            raise ValueError(
                f"height, width: expected the aspect ratio of {self.height} x {self.width}, got {height} x {width}: "
                "pixels must stay square; crop instead"
            )
        prior = self.prior
        if prior is not None:
            response = dataclasses.replace(prior.response, blur_px=prior.response.blur_px * scale_x)
            prior = dataclasses.replace(prior, response=response)
        pitch, blur_px = self.mm_per_pixel / scale_x, self.blur_px * scale_x
        raw = tuple(size for size in self.raw_size_px if size != (height, width) or self._moved or self.cuts_a_place)
        changes: dict[str, Any] = {"mm_per_pixel": pitch, "blur_px": blur_px, "prior": prior, "raw_size_px": raw}
        return dataclasses.replace(self, height=height, width=width, **changes)

    def without_prior(self) -> "Sensor":
        """The same sensor without its prior."""
        return dataclasses.replace(self, prior=None)

    def rectify(self, frame: Tensor) -> Tensor:
        """Make the sensor's images of camera frames: turned, mirrored, cut by corners, region or crop, and resized; or not at all.

        Args:
            frame: (B, 3, H, W).
        Returns:
            (B, 3, height, width).
        Raises:
            ValueError: the frame does not contain the region, or has a size that is neither the sensor's nor that of raw frames.
        Example:
            >>> import torch
            >>> Sensor.load("digit").rectify(torch.zeros(1, 3, 240, 320)).shape  # the camera lies
            torch.Size([1, 3, 320, 240])
        """
        check_batch("frame", frame, 3)
        if not is_raw("frame", frame, self.view):
            return frame
        return rectified("frame", frame, self.view, places_in_frame(self, (frame.shape[2], frame.shape[3])))

    @property
    def cuts_a_place(self) -> bool:
        """Whether the gel lies at a stated place, ``roi_px`` or ``corners_px``, of raw frames."""
        return self.place_px is not None

    @property
    def place_px(self) -> tuple[tuple[float, float], ...] | None:
        """The gel's corners in raw frames, x and y: ``corners_px``, or those of ``roi_px``; None where neither is stated."""
        if self.roi_px is None:
            return self.corners_px
        left, top, width, height = self.roi_px
        return (left, top), (left + width, top), (left + width, top + height), (left, top + height)

    @property
    def _moved(self) -> bool:
        """Whether raw frames differ from the sensor's images by more than size and crop."""
        return self.turn_deg != 0 or self.mirror or self.camera_matrix is not None

    @property
    def view(self) -> CameraView:
        """What is taken of raw frames."""
        extent, place = (0.0, 0.0, 0.0, 0.0), ""
        if self.place_px is not None:
            x, y = zip(*self.place_px, strict=True)
            last = 0 if self.roi_px is None else 1  # a region ends before its last corner
            extent, place = (min(x), min(y), max(x) - last, max(y) - last), "corners_px" if self.roi_px is None else "roi_px"
        return CameraView(
            name=self.name,
            size=(self.height, self.width),
            raw_sizes=list(self.raw_size_px),
            turn_deg=self.turn_deg,
            mirror=self.mirror,
            place=place,
            extent_px=extent,
            raw_crop=self.raw_crop,
            bent=self.camera_matrix is not None,
        )

    def read_image(self, path: str | Path) -> Tensor:
        """Read an image file and rectify it: (3, height, width) in [0, 1], R, G, B.

        Raises:
            FileNotFoundError: no such file.
            ValueError: not an image, or of a size that is not the sensor's; names the file.
        """
        image = read_image(path)
        try:
            return self.rectify(image[None])[0]
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error

    @classmethod
    def load(cls, source: str | Path, height: int | None = None, width: int | None = None) -> "Sensor":
        """Read a sensor.

        Args:
            source: name of a shipped sensor, or path of a YAML file, of torchvts or of gs_sdk (``ppmm``, ``imgh``, ``imgw``).
            height: resize to this many rows; None keeps the size.
            width: resize to this many columns; None keeps the size.
        Raises:
            FileNotFoundError: no such name or file.
            ValueError: bad YAML, an unknown key, or a bad value; names file and key.
        Example:
            >>> Sensor.load("gelsight_mini").mm_per_pixel
            0.0634
        """
        path = _find(source)
        values = read_yaml(path)
        if isinstance(values, dict) and "ppmm" in values:
            values = values_from_gs_sdk(values, str(path), path.stem)
        sensor = cls.from_dict(values, str(path))
        if height is None and width is None:
            return sensor
        if height is None or width is None:
            raise ValueError("height, width: expected both or none")
        return sensor.resized(height, width)

    @classmethod
    def from_dict(cls, values: Any, source: str) -> "Sensor":
        """Make a sensor from a mapping; ``source`` names it in errors. ``mm_per_pixel`` may be [along x, along y]."""
        if isinstance(values, dict) and isinstance(values.get("mm_per_pixel"), list):
            values = with_square_pixels(values, source)
        return from_dict(cls, values, source)

    def to_dict(self) -> dict[str, Any]:
        """Plain lists and numbers without defaults; :meth:`from_dict` reads it back."""
        pairs = ((field, getattr(self, field.name)) for field in dataclasses.fields(self))
        return {field.name: _plain(value) for field, value in pairs if value != field.default}

    def save(self, path: str | Path, comment: Sequence[str] = ()) -> None:
        """Write the sensor as YAML, whole or not at all.

        Args:
            path: file to write.
            comment: lines to put before it, each with its #.
        """
        text = yaml.safe_dump(self.to_dict(), sort_keys=False, width=128, default_flow_style=None, allow_unicode=True)
        with write_atomically(path) as temporary:
            temporary.write_text("".join(f"{line}\n" for line in comment) + text, encoding="utf-8")


def with_square_pixels(values: dict[str, Any], source: str) -> dict[str, Any]:
    """The values of a sensor whose pixels are not square, [along x, along y], mm, as those of one whose images are resampled.

    The coarser pitch stays, and ``corners_px`` are those of what was seen, so that :class:`Rectify` makes pixels square.
    """
    along = check_numbers("mm_per_pixel", values["mm_per_pixel"], (2,))
    if min(along) <= 0.0 or max(along) > MOST_OBLIQUE * min(along):
        raise ValueError(f"{source}: mm_per_pixel: expected a pitch, or [along x, along y] within {MOST_OBLIQUE:g}, got {along}")
    height, width = check_image_size("height", values.get("height"), "width", values.get("width"), 8)
    if beside := [key for key in ("corners_px", "raw_crop") if values.get(key)]:
        raise ValueError(f"{source}: mm_per_pixel: expected one pitch beside {beside[0]}, got {along}: give roi_px, or one pitch")
    seen = (width, height) if values.get("turn_deg", 0) % 180 == 0 else (height, width)
    raw = values.get("raw_size_px") or [[seen[1], seen[0]]]
    across, down = raw[0][::-1] if values.get("turn_deg", 0) % 180 == 0 else raw[0]
    left, top, across, down = values.get("roi_px") or (0, 0, across, down)
    right, bottom = left + across - 1, top + down - 1
    pitch = max(along)
    changes = {
        "mm_per_pixel": pitch,
        "width": round((width - 1) * along[0] / pitch) + 1,
        "height": round((height - 1) * along[1] / pitch) + 1,
        "corners_px": [[left, top], [right, top], [right, bottom], [left, bottom]],
    }
    if not values.get("roi_px"):
        changes["raw_size_px"] = raw
    return {**{key: value for key, value in values.items() if key != "roi_px"}, **changes}


def check_sensor(name: str, value: object) -> None:
    """Raise unless ``value`` is a Sensor; for a name or path the message shows how to load it."""
    text = str(value) if isinstance(value, str | Path) else "gelsight_mini"
    check_record(name, value, Sensor, f"load it by Sensor.load({text!r})")


def shipped_sensors() -> list[str]:
    """Names that :meth:`Sensor.load` finds."""
    return sorted(path.stem for path in _shipped_folder().glob("*.yaml"))


def _shipped_folder() -> Path:
    here = Path(__file__).resolve()
    installed = here.parents[1] / "configs" / "sensors"  # in a wheel
    return installed if installed.is_dir() else here.parents[2] / "configs" / "sensors"  # in a checkout


def _find(source: str | Path) -> Path:
    path = check_path("source", source)
    if path.suffix in (".yaml", ".yml"):
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such sensor file")
        return path
    if str(source) in shipped_sensors():
        return _shipped_folder() / f"{source}.yaml"
    shipped = shipped_sensors()
    raise FileNotFoundError(
        f"source: expected a path ending in .yaml, or one of {', '.join(shipped)}, got {str(source)!r}"
        + suggest(str(source), shipped)
    )


def _plain(value: Any) -> Any:
    if isinstance(value, SensorPrior):
        return value.to_dict()
    return [_plain(item) for item in value] if isinstance(value, tuple) else value
