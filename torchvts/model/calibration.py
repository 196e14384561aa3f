"""A calibrated unit: sensor, background and inverse model, in memory and as one file (the paper's database)."""

import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..core.checks import (
    QUANTISATION_STD,
    brief,
    check_decay,
    check_field,
    check_image,
    check_positive,
    check_record,
    check_shape,
    check_switch,
    check_values,
)
from ..core.files import image_from_bytes, image_to_bytes, load_tensors, save_tensors
from ..core.levels import SATURATED
from ..core.noise import noise_std
from .lights import PointLights, flat_image, inverse_light_matrix
from .markers import FillMarkers, is_printed
from .report import Report, read_report
from .response_field import ResponseModel
from .sensor import Sensor, check_sensor

FORMAT_VERSION = 9
"""Version of the calibration file. A file of another version is refused."""

DEFECT_RATIO = 4.0
"""A pixel whose background is this factor darker or brighter than expected is a defect: it is inpainted."""

DEFECT_WINDOW_PX = 7
"""Width of the square of which that median is taken."""

PEDESTAL = 0.03
"""Added to image and background before response fields take their ratio: where an LED does not reach, a ratio is all noise."""

LIGHTS = ("light_position_mm", "light_albedo", "light_gloss")
"""Tensors of a file by lights: the arguments of :class:`PointLights`."""

UNKNOWN_NOISE = 0.003
"""Noise in image value, three quarters of a grey level, of a camera of which there is no image."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibrated unit: the sensor, its inverse model (three lights, or a response), and its background.

    Derived arrays (``gain``, ``inverse`` and so on) are computed once, at first use. Treat all tensors as read-only:
    ``dataclasses.replace`` makes a changed calibration.

    Attributes:
        sensor: the sensor it belongs to.
        lights: the three lights (S and rho of the paper), if they are the model; else None.
        background: (3, H, W), linear light without contact; the image of the model where no image was given.
        noise_std: (3,), noise of an image, in image value.
        measured: whether ``background`` comes from an image of the unit.
        report: how the calibration was made, see :class:`torchvts.model.report.Report`.
        response: the response fields, if they are the model; else None.
        markers: the block that fills printed markers before anything else, or None.
        ambient: (3,), constant linear light that the lights do not give, subtracted before the gain; None for none.
        covariance: (K, K), of the coefficients of either slope of the response's field, up to the noise of a press, float32; None
            where neither presses nor a prior gave one. See :func:`torchvts.model.stated_error.stated_error_deg`.
        contact_share: pressure from which an object touches, as a share of the frame's; None where no press of a ball
            shows it.
        contact_decay_mm: length over which free skin decays for the pressure of contact, mm: the median that presses of balls show,
            0 where no skin hangs around them; None where there are none.
        printed: (3, H, W) in [0, 1], the image without contact as the camera gives it, before its printed markers are filled; None
            where there are none.
    Raises:
        TypeError: a field of another type.
        ValueError: lights, background, noise or ambient light of another shape, or not finite; a background without light; lights
            and a response together, or neither.
    """

    sensor: Sensor
    lights: PointLights | None
    background: Tensor
    noise_std: Tensor
    measured: bool
    report: Report
    response: ResponseModel | None = None
    markers: FillMarkers | None = None
    ambient: Tensor | None = None
    contact_share: float | None = None
    contact_decay_mm: float | None = None
    covariance: Tensor | None = None
    printed: Tensor | None = None

    def __post_init__(self) -> None:
        check_sensor("sensor", self.sensor)
        for name, part, kind in (
            ("lights", self.lights, PointLights),
            ("response", self.response, ResponseModel),
            ("markers", self.markers, FillMarkers),
        ):
            if part is not None:
                check_record(name, part, kind)
        check_switch("measured", self.measured)
        if self.contact_share is not None:
            check_positive("contact_share", self.contact_share, 1.0)
        if self.contact_decay_mm is not None:
            check_decay("contact_decay_mm", self.contact_decay_mm)
        read_report(self.report, "report")
        if self.ambient is not None:
            check_values("ambient", self.ambient, (3,), "of at least 0")
        check_field("background", self.background)
        check_shape("background", self.background, (3, self.sensor.height, self.sensor.width), f"sensor '{self.sensor.name}'")
        check_values("noise_std", self.noise_std, (3,), "above 0")
        if self.lights is None and self.response is None:
            raise ValueError("lights, response: expected one of them, got none: a calibration without a model")
        if self.lights is not None and self.response is not None:
            raise ValueError("lights, response: expected one of them, got both: which of the two should give the normals?")
        if self.covariance is not None:
            self._check_covariance(self.covariance)
        if self.printed is not None:
            check_image("printed", self.printed, self.sensor.height, self.sensor.width, self.sensor.name)
        if self.measured and not bool((self.background > self.light_noise_std).any()):
            raise ValueError(
                f"background: expected light above the noise, got at most {float(self.background.max()):.3g}: black image, LEDs or "
                "exposure off"
            )

    def _check_covariance(self, covariance: Tensor) -> None:
        if self.response is None:
            raise ValueError("covariance: expected None of a calibration by lights, got a tensor: it is that of a response field")
        size = self.response.field.size()
        check_values("covariance", covariance, (size, size))
        if not bool((covariance == covariance.t()).all() & (covariance.diagonal() > 0).all()):
            least = float(covariance.diagonal().min())
            raise ValueError(f"covariance: expected a symmetric matrix with a positive diagonal, got {least:.3g} on the diagonal")

    @classmethod
    def from_lights(
        cls,
        lights: PointLights,
        sensor: Sensor,
        background: Tensor | None = None,
        report: Report | dict[str, Any] | None = None,
        ambient: Tensor | None = None,
    ) -> "Calibration":
        """Make a calibration from known lights. Nothing is fitted.

        Args:
            lights: the three lights.
            sensor: the sensor.
            background: (3, H, W), image without contact in [0, 1], if there is one. It gives defects, gain and noise;
                without one, :data:`UNKNOWN_NOISE` is assumed.
            report: kept with the calibration; model "point_lights" and source "given" unless it says otherwise.
            ambient: (3,), constant linear light per channel, at least 0; None for none.
        Raises:
            ValueError, TypeError: background or ambient of another shape or range.
        Example:
            >>> lights = PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900, 900, 900])
            >>> Calibration.from_lights(lights, Sensor("rig", 48, 64, 0.5)).measured
            False
        """
        check_record("lights", lights, PointLights, "PointLights(position_mm, albedo) makes them")
        check_sensor("sensor", sensor)
        sensor = dataclasses.replace(sensor, gamma=sensor.exponent, prior=None)
        frozen = PointLights(*(t.detach().cpu() for t in (lights.position_mm, lights.albedo, lights.gloss))).requires_grad_(False)
        summary = read_report(
            {"model": "point_lights", "source": "given", "doubts": []} | ({} if report is None else dict(report)), "report"
        )
        if ambient is not None:
            check_shape("ambient", ambient, (3,))
            ambient = ambient.detach().cpu().to(frozen.position_mm.dtype)
        if background is None:
            model = flat_image(frozen, sensor.height, sensor.width, sensor.mm_per_pixel)
            model = model if ambient is None else model + ambient.reshape(3, 1, 1)
            noise = torch.full((3,), UNKNOWN_NOISE, dtype=model.dtype)
            return cls(sensor, frozen, model, noise, False, summary, None, None, ambient)
        light, noise, markers, printed = _measure(background, sensor, frozen.position_mm.dtype)
        return cls(sensor, frozen, light, noise, True, summary, None, markers, ambient, printed=printed)

    @classmethod
    def from_response(
        cls,
        response: ResponseModel,
        sensor: Sensor,
        background: Tensor,
        report: Report | dict[str, Any] | None = None,
        covariance: Tensor | None = None,
    ) -> "Calibration":
        """Make a calibration from known response fields, such as those of another unit of the same type. Nothing is fitted.

        Args:
            response: the fields.
            sensor: the sensor; gamma and blur of the response replace its own.
            background: (3, H, W), image without contact in [0, 1].
            report: kept with the calibration; model "response" and source "given" unless it says otherwise.
            covariance: (K, K), of the coefficients of the field; None where it is not known.
        Raises:
            ValueError, TypeError: background of another shape or range.
        Example:
            >>> from torchvts.model.response_field import ResponseField
            >>> field = ResponseField(0, -1, 10.0, ((0.3, 0, 0), (0, 0.3, 0)))
            >>> sensor = Sensor("rig", 48, 64, 0.5)
            >>> Calibration.from_response(ResponseModel(field, None), sensor, torch.full((3, 48, 64), 0.5)).sensor.blur_px
            1.0
        """
        check_record("response", response, ResponseModel, "a sensor's prior has one: sensor.prior.response")
        check_sensor("sensor", sensor)
        sensor = dataclasses.replace(sensor, gamma=response.gamma, blur_px=response.blur_px, prior=None)
        summary = read_report(
            {"model": "response", "source": "given", "doubts": []} | ({} if report is None else dict(report)), "report"
        )
        light, noise, markers, printed = _measure(background, sensor)
        if covariance is not None:
            check_shape("covariance", covariance, (response.field.size(),) * 2, "one row for each coefficient of a slope")
            covariance = covariance.detach().cpu().float()
            covariance = 0.5 * (covariance + covariance.mT)
        return cls(sensor, None, light, noise, True, summary, response, markers, covariance=covariance, printed=printed)

    def __repr__(self) -> str:
        sensor, origin = self.sensor, "an image" if self.measured else "the lights alone"
        source = self.report.get("source", "given").replace("_", " ")
        model = f"response fields ({source})" if self.lights is None else f"point lights, {self.lights}"
        size = f"{sensor.height} x {sensor.width}, {sensor.mm_per_pixel:g} mm per pixel"
        return f"Calibration({sensor.name!r}, {size}, from {origin}: {model})"

    def __str__(self) -> str:
        """What a person reads of it: the model, how good it is likely to be, and why not to trust it."""
        from .summary import summary_of

        return summary_of(self)

    def __getstate__(self) -> dict[str, Any]:
        """The fields without the cached arrays, so that pickles and copies stay small."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}

    @property
    def metric(self) -> bool:
        """Whether depth is in mm, as far as its calibration knows; ``report["not_metric"]`` says why not."""
        return not self.report.get("not_metric")

    @cached_property
    def flat(self) -> Tensor:
        """(3, H, W), compensated image of the undeformed skin: ``model_image`` for lights, 1 for a response field."""
        return self.model_image if self.response is None else torch.ones_like(self.background)

    @cached_property
    def gain(self) -> Tensor | None:
        """(3, H, W), compensated / linear light; None where no background was measured."""
        if not self.measured:
            return None
        if self.response is not None:
            return 1.0 / (self.background + PEDESTAL)
        light = self.background_without_ambient.clamp_min(1e-6)
        gain = (self.model_image / light).clamp(1.0 / DEFECT_RATIO, DEFECT_RATIO)
        clipped = self._clipped
        # the brightness of the skin was not measured there
        usual = torch.stack([channel[~one].median() for channel, one in zip(gain, clipped, strict=True)]).nan_to_num(1.0)
        return torch.where(clipped, usual[:, None, None], gain)

    @cached_property
    def saturation_light(self) -> float:
        """Linear light from which a channel may be saturated: that of 99.5 % of the largest image value, less the noise."""
        return float(SATURATED**self.sensor.exponent) - 3.0 * float(self.light_noise_std.max())

    @cached_property
    def unclipped_background(self) -> Tensor:
        """(3, H, W), linear light of the undeformed skin: the background, and what the lights give where it is saturated."""
        gain = self.gain
        if self.lights is None or gain is None:
            return self.background
        ambient = 0.0 if self.ambient is None else self.ambient.reshape(3, 1, 1)
        return torch.where(self._clipped, self.model_image / gain + ambient, self.background)

    @cached_property
    def _clipped(self) -> Tensor:
        """(3, H, W) bool, where background and model are saturated."""
        return (self.background >= self.saturation_light) & (self.model_image >= self.saturation_light)

    @cached_property
    def saturated_above(self) -> Tensor:
        """(3, H, W), compensated intensity from which a channel is saturated: that of 99.5 % of the largest image value."""
        gain, offset = self.gain, self.offset
        limit: Tensor = (SATURATED**self.sensor.exponent) * (torch.ones_like(self.background) if gain is None else gain)
        return limit if offset is None else limit + offset

    @cached_property
    def offset(self) -> Tensor | None:
        """(3, H, W), added after the gain; None for none.

        With a response field it is the pedestal's part, so that the background becomes 1. With lights it is minus the
        ambient light, times the gain.
        """
        if self.response is not None:
            return PEDESTAL * (1.0 / (self.background + PEDESTAL))  # exactly so many times the gain
        if self.ambient is None:
            return None
        offset, gain = -self.ambient.reshape(3, 1, 1), self.gain
        return offset.expand_as(self.background) if gain is None else offset * gain

    @property
    def background_value(self) -> Tensor:
        """(3, H, W) in [0, 1], float32: the background as the camera gives it, with printed markers filled."""
        return self.background.detach().float().clamp(0.0, 1.0) ** (1.0 / self.sensor.exponent)

    @cached_property
    def background_without_ambient(self) -> Tensor:
        """(3, H, W), background minus ambient light, linear light."""
        return self.background if self.ambient is None else self.background - self.ambient.reshape(3, 1, 1)

    @cached_property
    def model_image(self) -> Tensor:
        """(3, H, W), image of the undeformed skin under the lights, linear light; with a response field, the background."""
        if self.lights is None:
            return self.background
        return flat_image(self.lights, self.sensor.height, self.sensor.width, self.sensor.mm_per_pixel)

    @cached_property
    def inverse(self) -> Tensor:
        """Inverse of the light matrix of the undeformed skin, (3, 3, H, W): normal axis, light, row, column (eq. 9 of the paper).

        Raises:
            ValueError: the model is a response field, which has none.
        """
        if self.lights is None:
            raise ValueError("inverse: expected a calibration by lights, got one by response fields")
        depth = self.background.new_zeros(1, 1, self.sensor.height, self.sensor.width)
        return inverse_light_matrix(depth, self.lights.position_mm, self.lights.albedo, self.sensor.mm_per_pixel)[0]

    @cached_property
    def defects(self) -> Tensor:
        """(H, W) bool: pixels whose background is far from the lights' model, or for a response field from the median around them.

        Where a hundredth of the image or more is far from the lights' model, the model may be a poor one. Then defects must be
        far from the median of a quarter of the image around them, too.
        """
        if not self.measured:
            return torch.zeros(self.sensor.height, self.sensor.width, dtype=torch.bool)
        if self.lights is not None:
            found = self._far(self.model_image)
            return found if float(found.double().mean()) < 0.01 else found & self._far(self._median_of_quarter())
        return self._far(self._median_around())

    def _far(self, expected: Tensor) -> Tensor:
        """(H, W) bool: pixels whose background is far from what is expected, (3, H, W), in any channel."""
        light, floor = self.background_without_ambient, 3.0 * self.light_noise_std
        # where both are within the noise, nothing can be said
        far = (light * DEFECT_RATIO < expected) | (light > expected * DEFECT_RATIO)
        found: Tensor = (far & (torch.maximum(expected, light) > floor)).any(dim=0)
        return found

    def _median_of_quarter(self) -> Tensor:
        """(3, H, W): median of the background in a quarter of the image around each pixel, on a grid of about 20 cells a side."""
        light = self.background_without_ambient[None]
        cell = max(1, min(self.sensor.height, self.sensor.width) // 20)
        cells = torch.nn.functional.pad(light[:, :, cell // 2 :: cell, cell // 2 :: cell], [5] * 4, mode="replicate")
        size = (cells.shape[2] - 10, cells.shape[3] - 10)
        median = torch.nn.functional.unfold(cells.transpose(0, 1), 11).median(dim=1).values.reshape(1, 3, *size)
        wide: Tensor = torch.nn.functional.interpolate(median, light.shape[2:], mode="nearest")[0]
        return wide

    def _median_around(self) -> Tensor:
        """(3, H, W): the background where the extremes around a pixel show that it is no defect; else the median around it."""
        light, reach = self.background_without_ambient, DEFECT_WINDOW_PX // 2
        pool = torch.nn.functional.max_pool2d
        most = pool(light[None], DEFECT_WINDOW_PX, 1, reach)[0]
        least = -pool(-light[None], DEFECT_WINDOW_PX, 1, reach)[0]
        # the median lies between the extremes
        channel, row, column = torch.nonzero((light * DEFECT_RATIO < most) | (light > least * DEFECT_RATIO), as_tuple=True)
        padded = torch.nn.functional.pad(light[None], [reach] * 4, mode="replicate")[0]
        steps = torch.arange(DEFECT_WINDOW_PX)
        rows, columns = row[:, None, None] + steps[:, None], column[:, None, None] + steps
        around = light.clone()
        around[channel, row, column] = padded[channel[:, None, None], rows, columns].flatten(1).median(dim=1).values
        return around

    @cached_property
    def light_noise_std(self) -> Tensor:
        """(3, H, W), noise of an image in linear light: noise of the image value times the slope of the camera response."""
        noise = self.noise_std.reshape(3, 1, 1)
        gamma = self.sensor.exponent
        if gamma == 1.0:
            return noise.expand_as(self.background)
        value = self.background.clamp_min(1e-6) ** (1.0 / gamma)
        return gamma * torch.maximum(value, noise) ** (gamma - 1.0) * noise

    @cached_property
    def compensated_noise_std(self) -> Tensor:
        """(3, H, W), noise of a compensated image: that of the frame and of the background, after gain and blur."""
        noise, gain = self.light_noise_std, self.gain
        if gain is not None:
            noise = noise * gain * 2.0**0.5
        # standard deviation of white noise after a Gaussian blur; a narrow blur changes almost nothing
        return noise * min(1.0, 1.0 / (2.0 * math.sqrt(math.pi) * max(self.sensor.blur_px, 0.1)))

    def save(self, path: str | Path) -> None:
        """Write one safetensors file, whole or not at all.

        Tensors by lights: S, rho, gloss, the background, the noise, and ambient light if there is any. Tensors by response: the
        noise, the background as a 16-bit PNG of the camera's values, which keeps an 8-bit image bit for bit, and the upper triangle
        of the covariance, if there is one. Where markers are printed, the image with them, as such a PNG. JSON metadata: format
        version, sensor, response, markers, report.
        """
        metadata = {
            "format_version": FORMAT_VERSION,
            "kind": "calibration",
            "sensor": self.sensor.to_dict(),
            "measured": self.measured,
            "report": self.report,
            "response": None if self.response is None else self.response.to_dict(),
            "markers": None if self.markers is None else self.markers.to_dict(),
            "contact_share": self.contact_share,
            "contact_decay_mm": self.contact_decay_mm,
        }
        tensors = {"noise_std": self.noise_std}
        if self.printed is not None:
            tensors["printed_png"] = image_to_bytes(self.printed)
        if self.lights is None:
            tensors["background_png"] = image_to_bytes(self.background.clamp(0, 1) ** (1.0 / self.sensor.exponent))
            if self.covariance is not None:
                row, column = torch.triu_indices(*self.covariance.shape)
                tensors["covariance"] = self.covariance[row, column]
        else:
            tensors |= dict(zip(LIGHTS, (self.lights.position_mm, self.lights.albedo, self.lights.gloss), strict=True))
            tensors["background"] = self.background
            if self.ambient is not None:
                tensors["ambient"] = self.ambient
        save_tensors(path, tensors, metadata)

    @classmethod
    def load(cls, path: str | Path) -> "Calibration":
        """Read a file written by :meth:`save`.

        Raises:
            FileNotFoundError: no such file.
            ValueError: cut short, of another kind or version, or inconsistent; says which.
        """
        tensors, metadata = load_tensors(path)
        if metadata.get("kind") != "calibration":
            raise ValueError(f"{path}: expected a calibration, got a file of kind {brief(metadata.get('kind'))}")
        version = metadata.get("format_version")
        if version != FORMAT_VERSION or isinstance(version, bool):
            raise ValueError(
                f"{path}: expected format version {FORMAT_VERSION}, got {brief(version)}: written by another torchvts; "
                "calibrate again, or update torchvts"
            )
        try:
            return _of_file(tensors, metadata)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{path}: {error}") from error


def check_calibration(name: str, value: object) -> None:
    """Raise unless ``value`` is a Calibration."""
    check_record(name, value, Calibration, "Calibration.load reads a file, calibrate makes one")


def _measure(
    background: Tensor, sensor: Sensor, dtype: torch.dtype | None = None
) -> tuple[Tensor, Tensor, FillMarkers | None, Tensor | None]:
    """Linear light of a background image, its noise in image value, the block that fills its markers, and the image with them."""
    check_image("background", background, sensor.height, sensor.width, sensor.name)
    image = background.detach().cpu().to(dtype or background.dtype)
    markers = None if sensor.markers is False else FillMarkers.from_background(image)
    if markers is not None and (markers.diameter_px == 0 or (sensor.markers is None and not is_printed(image, markers))):
        markers = None
    printed = None if markers is None else image.float().clamp(0.0, 1.0)
    if markers is not None:
        image = markers(image[None])[0]
    noise = noise_std(image[None])[0].clamp_min(QUANTISATION_STD)
    return image if sensor.exponent == 1.0 else image**sensor.exponent, noise, markers, printed


def _of_file(tensors: dict[str, Tensor], metadata: dict[str, Any]) -> Calibration:
    """The calibration of a file, whose values its constructor checks as those of a user."""
    sensor = Sensor.from_dict(metadata.get("sensor"), "sensor")
    by_lights = metadata.get("response") is None
    for name in ("noise_std", *((*LIGHTS, "background") if by_lights else ("background_png",))):
        if name not in tensors:
            raise ValueError(f"tensor {name!r} is missing")
    named = ("measured", "report", "contact_share", "contact_decay_mm")
    parts: dict[str, Any] = {name: metadata.get(name) for name in named} | {"noise_std": tensors["noise_std"]}
    if metadata.get("markers") is not None:
        parts["markers"] = FillMarkers(**metadata["markers"])
    images = {
        name: image_from_bytes(tensors[name], (sensor.height, sensor.width), f"tensor {name!r}")
        for name in ("background_png", "printed_png")
        if name in tensors
    }
    if "printed_png" in images:
        parts["printed"] = images["printed_png"].float()
    if by_lights:
        lights = PointLights(*(tensors[name] for name in LIGHTS)).requires_grad_(False)
        return Calibration(sensor, lights, tensors["background"], ambient=tensors.get("ambient"), **parts)
    response = ResponseModel.from_dict(metadata["response"], "response")
    if (sensor.exponent, sensor.blur_px) != (response.gamma, response.blur_px):
        raise ValueError("sensor and response differ in gamma or blur_px: damaged or edited")
    light = images["background_png"].to(tensors["noise_std"].dtype) ** sensor.exponent
    covariance = _symmetric(tensors["covariance"], response.field.size()) if "covariance" in tensors else None
    return Calibration(sensor, None, light, response=response, covariance=covariance, **parts)


def _symmetric(triangle: Tensor, size: int) -> Tensor:
    """The matrix (size, size) of an upper triangle."""
    check_shape("covariance", triangle, (size * (size + 1) // 2,), "the triangle of its field")
    matrix = triangle.new_zeros(size, size)
    row, column = torch.triu_indices(size, size)
    matrix[row, column] = matrix[column, row] = triangle
    return matrix
