"""What is known of a calibrated unit: the paper's database, in memory and as one file."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .core.checks import QUANTISATION_STD, check_image
from .core.files import load_tensors, save_tensors
from .core.noise import noise_std
from .core.sensor import Sensor
from .shading import PointLights, flat_image, inverse_light_matrix

FORMAT_VERSION = 1
"""Raised when a file of an older version can no longer be read as it is."""

DEFECT_RATIO = 4.0
"""A pixel whose background is this factor darker or brighter than the model tells nothing: it is inpainted."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibrated unit: the sensor, its lights, and how its image at rest differs from the model's.

    Attributes:
        sensor: the sensor it belongs to.
        lights: the three lights (S and rho of the paper).
        background: (3, H, W) linear light of the unit at rest; the model's own where no image was given.
        noise_std: (3,), noise of an image, in image value.
        measured: whether ``background`` is an image of the unit.
        report: how it was made, plain JSON: model, convergence, figures, warnings.
    """

    sensor: Sensor
    lights: PointLights
    background: Tensor
    noise_std: Tensor
    measured: bool
    report: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def from_lights(
        cls, lights: PointLights, sensor: Sensor, background: Tensor | None = None, report: dict[str, Any] | None = None
    ) -> "Calibration":
        """A calibration from known lights: nothing is fitted.

        Args:
            lights: the three lights. sensor: the sensor.
            background: (3, H, W) image at rest in [0, 1], if there is one: it gives the constant defects and the noise.
            report: kept with the calibration.
        Raises:
            ValueError, TypeError: background of another shape or range.
        Example:
            >>> lights = PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900, 900, 900])
            >>> Calibration.from_lights(lights, Sensor("rig", 48, 64, 0.5)).compensation.abs().max()
            tensor(0.)
        """
        if not isinstance(lights, PointLights):
            raise TypeError(f"lights: expected PointLights, got {type(lights).__name__}")
        frozen = PointLights(*(t.detach().cpu() for t in (lights.position_mm, lights.albedo, lights.gloss))).requires_grad_(False)
        model = flat_image(frozen, sensor.height, sensor.width, sensor.mm_per_pixel)
        if background is None:
            noise = torch.full((3,), QUANTISATION_STD, dtype=model.dtype)
            return cls(sensor, frozen, model, noise, False, report or {"model": "point_lights", "lights": "given"})
        check_image("background", background, sensor.height, sensor.width, sensor.name)
        image = background.detach().cpu().to(model.dtype)
        noise = noise_std(image[None])[0].clamp_min(QUANTISATION_STD)
        light = image if sensor.gamma == 1.0 else image**sensor.gamma
        return cls(sensor, frozen, light, noise, True, report or {"model": "point_lights", "lights": "given"})

    @property
    def model_image(self) -> Tensor:
        """(3, H, W), what the lights give at rest, linear light."""
        return flat_image(self.lights, self.sensor.height, self.sensor.width, self.sensor.mm_per_pixel)

    @property
    def inverse(self) -> Tensor:
        """Inverse of the light matrix at rest, (3, 3, H, W): normal axis, light, row, column (eq. 9 of the paper)."""
        depth = self.background.new_zeros(1, 1, self.sensor.height, self.sensor.width)
        return inverse_light_matrix(depth, self.lights.position_mm, self.lights.albedo, self.sensor.mm_per_pixel)[0]

    @property
    def compensation(self) -> Tensor:
        """I_delta = model - background, (3, H, W), linear light (eq. 7-8 of the paper)."""
        return self.model_image - self.background

    @property
    def defects(self) -> Tensor:
        """(H, W) bool: pixels whose background is far from the model in any channel (dead pixels, opaque dirt)."""
        if not self.measured:
            return torch.zeros(self.sensor.height, self.sensor.width, dtype=torch.bool)
        model, floor = self.model_image, 3.0 * self.light_noise_std
        # a pixel that the model itself leaves within the noise cannot be judged
        far = (self.background * DEFECT_RATIO < model) | (self.background > model * DEFECT_RATIO)
        return (far & (torch.maximum(model, self.background) > floor)).any(dim=0)

    @property
    def light_noise_std(self) -> Tensor:
        """(3, H, W), noise of an image in linear light: that of the image value, times the slope of the response."""
        noise = self.noise_std.reshape(3, 1, 1)
        gamma = self.sensor.gamma
        if gamma == 1.0:
            return noise.expand_as(self.background)
        value = self.background.clamp_min(1e-6) ** (1.0 / gamma)
        return gamma * torch.maximum(value, noise) ** (gamma - 1.0) * noise

    def save(self, path: str | Path) -> None:
        """Write one safetensors file, whole or not at all.

        Tensors: S, rho, I_delta, the inverse light matrix at rest, the background, the noise. JSON metadata: the format
        version, the sensor, the report.
        """
        metadata = {
            "format_version": FORMAT_VERSION,
            "kind": "calibration",
            "sensor": self.sensor.to_dict(),
            "measured": self.measured,
            "report": self.report,
        }
        tensors = {
            "light_position_mm": self.lights.position_mm,
            "light_albedo": self.lights.albedo,
            "light_gloss": self.lights.gloss,
            "background": self.background,
            "compensation": self.compensation,
            "inverse": self.inverse,
            "noise_std": self.noise_std,
        }
        save_tensors(path, tensors, metadata)

    @classmethod
    def load(cls, path: str | Path) -> "Calibration":
        """Read what :meth:`save` wrote.

        Raises:
            FileNotFoundError: no such file. ValueError: cut, foreign, of a later version, or inconsistent; says which.
        """
        tensors, metadata = load_tensors(path)
        if metadata.get("kind") != "calibration":
            raise ValueError(f"{path}: expected a calibration, got a file of kind {metadata.get('kind')!r}")
        version = metadata.get("format_version")
        if not isinstance(version, int) or not 1 <= version <= FORMAT_VERSION:
            raise ValueError(f"{path}: format version {version!r}, this torchvts reads 1 to {FORMAT_VERSION}: update torchvts")
        sensor = Sensor.from_dict(metadata.get("sensor"), str(path))
        size = (3, sensor.height, sensor.width)
        expected = {
            "light_position_mm": (3, 3), "light_albedo": (3,), "light_gloss": (3,), "noise_std": (3,),
            "background": size, "compensation": size, "inverse": (3, *size),
        }  # fmt: skip
        for name, shape in expected.items():
            if name not in tensors:
                raise ValueError(f"{path}: tensor {name!r} is missing")
            if tuple(tensors[name].shape) != shape or not tensors[name].is_floating_point():
                raise ValueError(
                    f"{path}: tensor {name!r}: expected {shape} floats, got {tuple(tensors[name].shape)} {tensors[name].dtype}"
                )
            if not bool(torch.isfinite(tensors[name]).all()):
                raise ValueError(f"{path}: tensor {name!r}: expected finite values, got NaN or infinite ones")
        measured, report = metadata.get("measured"), metadata.get("report")
        if not isinstance(measured, bool) or not isinstance(report, dict):
            raise ValueError(f"{path}: its metadata is damaged: 'measured' or 'report' is missing")
        if not bool((tensors["noise_std"] > 0).all()):
            raise ValueError(f"{path}: tensor 'noise_std': expected values above 0")
        try:
            lights = PointLights(*(tensors[f"light_{part}"] for part in ("position_mm", "albedo", "gloss"))).requires_grad_(False)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
        calibration = cls(sensor, lights, tensors["background"], tensors["noise_std"], measured, report)
        for name, derived in (("compensation", calibration.compensation), ("inverse", calibration.inverse)):
            if not torch.allclose(tensors[name], derived, rtol=1e-3, atol=1e-3 * float(derived.abs().max())):
                raise ValueError(f"{path}: tensor {name!r} does not fit the lights in the same file: damaged or edited")
        return calibration
