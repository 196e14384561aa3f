"""The registry of methods that speed, stability and evaluation compare: how each is built, and how charts draw it."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ..accelerated import (
    AdaptiveIntegration,
    Compensate,
    ContactMask,
    GradientFromNormal,
    NormalFromIntensity,
    PerspectiveIntegration,
    PoissonBackground,
    reference_only,
)
from ..calibration import fit_prior, with_preprocessing
from ..core.geometry import normal_from_gradient
from ..integration import PoissonDST
from ..model import Calibration, ResponseModel, Sensor
from ..normals import NormalFromLookup, NormalFromMLP, NormalFromResponse, NormalModel, as_normal_model
from ..pipeline import DepthOutput, DepthPipeline
from ..scenes import render, sphere_press
from .peers import PoissonSciPy
from .presses import Training, quiet_calibrate, train_network, training_pixels

Reconstruct = Callable[[Tensor], DepthOutput]
"""Images (B, 3, H, W) to depth."""


class Built(NamedTuple):
    """A method that was built for one unit.

    Attributes:
        reconstruct: maps images to depth; a :class:`torchvts.DepthPipeline` for most methods.
        parameters: number of parameters that it learned or was given.
        note: a remark for the table.
    """

    reconstruct: Reconstruct
    parameters: int
    note: str = ""


FromCalibration = Callable[[Calibration], Built]
FromPresses = Callable[[Training, Tensor, Sensor], Built]
"""(presses to learn from, background of the unit that is scored, its sensor) to the method."""


@dataclass(frozen=True)
class Method:
    """One way to reconstruct depth.

    Attributes:
        name: key in :data:`METHODS`, and name in tables.
        from_calibration: builds it for a calibrated unit; None if it must learn from presses.
        from_presses: builds it from presses; None if it is not compared on presses.
        style: arguments of Matplotlib's ``plot``.
        ours: whether it is a method of this library, and not of a peer.
        learns: whether the presses influence it, so that every fold of a cross-validation needs its own.
        needs_prior: whether the sensor must have a prior.
        needs_module: package that must be installed.
    """

    name: str
    from_calibration: FromCalibration | None = None
    from_presses: FromPresses | None = None
    style: Mapping[str, Any] = field(default_factory=dict)
    ours: bool = True
    learns: bool = True
    needs_prior: bool = False
    needs_module: str = ""

    @property
    def installed(self) -> bool:
        """Whether the package that it needs is there."""
        return not self.needs_module or find_spec(self.needs_module) is not None

    def calibrated(self, calibration: Calibration) -> Built:
        """The method for a calibrated unit.

        Raises:
            ValueError: a method that must learn from presses.
        """
        if self.from_calibration is None:
            raise ValueError(f"method: expected one that a calibration is enough for, got '{self.name}', which learns from presses")
        return self.from_calibration(calibration)


# built from a calibration


def pipeline(calibration: Calibration, mode: str, normals: nn.Module | None = None, integrate: nn.Module | None = None) -> Built:
    """The pipeline of a unit, with other normals or another integrator if they are given."""
    built = DepthPipeline.from_calibration(calibration, mode, normals=normals, integrate=integrate)
    return Built(built, parameters(calibration, mode))


def parameters(calibration: Calibration, mode: str) -> int:
    """Number of parameters of a calibration: 12 of three lights, or all coefficients of the response that a mode uses."""
    model = calibration.response
    if model is None:
        return 12
    by_depth = None if mode == "fast" else model.by_depth
    return 2 * model.field.size() + (0 if by_depth is None else by_depth.tensor().numel())


def _flat(calibration: Calibration) -> Built:
    """No depth at all: the error of every method must be below this one's."""

    def reconstruct(image: Tensor) -> DepthOutput:
        zero = torch.zeros_like(image)
        nowhere = torch.zeros_like(zero[:, :1], dtype=torch.bool)
        return DepthOutput(zero[:, :1], zero[:, :2], normal_from_gradient(zero[:, :2]), nowhere, nowhere)

    return Built(reconstruct, 0, "zero depth, for comparison")


def _reference(calibration: Calibration) -> Built:
    """Mode fast without compiled kernels."""
    built = pipeline(calibration, "fast")
    return built._replace(reconstruct=reference_only()(built.reconstruct), note="no compiled kernels")


def _zero_border(calibration: Calibration) -> Built:
    return pipeline(calibration, "fast", integrate=PoissonDST(calibration.sensor.mm_per_pixel))


def _scipy(calibration: Calibration) -> Built:
    return pipeline(calibration, "fast", integrate=PoissonSciPy(calibration.sensor.mm_per_pixel))


def _plain_inverse(calibration: Calibration) -> Built:
    """Eq. 10 at every pixel: no channel is treated as dark or saturated."""
    sensor, lights = calibration.sensor, calibration.lights
    if lights is None:
        raise ValueError("calibration: expected one by lights, got response fields")
    size = (sensor.height, sensor.width)
    normals = NormalFromIntensity(lights, *size, sensor.mm_per_pixel, noise_std=torch.zeros(3), inverse=calibration.inverse)
    return pipeline(calibration, "precise", normals=normals)


def _blurred(calibration: Calibration) -> Built:
    """Images blurred by one pixel, as with ``Sensor(blur_px=1)``."""
    return pipeline(dataclasses.replace(calibration, sensor=dataclasses.replace(calibration.sensor, blur_px=1.0)), "precise")


def _discontinuities(calibration: Calibration) -> Built:
    return pipeline(calibration, "precise", integrate=AdaptiveIntegration(calibration.sensor.mm_per_pixel))


def _pinhole(calibration: Calibration) -> Built:
    """Normals and integration for a pinhole camera if the calibration's report has its height; else mode precise."""
    height_mm = calibration.report.get("camera_height_mm", math.inf)
    if math.isinf(height_mm):
        return pipeline(calibration, "precise")
    normals = NormalFromIntensity.from_calibration(calibration, height_mm)
    integrate = PerspectiveIntegration(calibration.sensor.mm_per_pixel, height_mm)
    return pipeline(calibration, "precise", normals, integrate)


def _lookup_by_rendered_balls(calibration: Calibration) -> Built:
    """A look-up table that is filled by three rendered balls; the lights must be known."""
    lights, sensor = calibration.lights, calibration.sensor
    if lights is None:
        raise ValueError("calibration: expected one by lights, got response fields")
    values, slopes = [], []
    for center_mm in ((-5.0, -4.0), (5.0, 3.0), (0.0, 0.0)):
        ball = sphere_press(8.0, 1.2, center_mm, sensor.height, sensor.width, sensor.mm_per_pixel)
        change = (render(ball, lights).detach() - calibration.model_image)[0]
        inside = ball.contact[0, 0]
        values.append(change[:, inside].t())
        slopes.append(ball.gradient[0][:, inside].t())
    block = NormalFromLookup.fit(calibration.model_image, torch.cat(values), torch.cat(slopes))
    return pipeline(calibration, "fast", normals=block)._replace(parameters=block.table.numel())


def lookup_on(calibration: Calibration, training: Training) -> Built:
    """A look-up table behind the preprocessing of a calibration by response fields, filled by the located presses."""
    pixels = training_pixels(Compensate.from_calibration(calibration), training.located, calibration.sensor.mm_per_pixel)
    block = NormalFromLookup.fit(torch.ones_like(training.background), pixels.intensity - 1.0, pixels.slope)
    return pipeline(calibration, "fast", normals=block)._replace(parameters=block.table.numel())


# built from presses: all share one contact mask and one integrator


def flat(training: Training, background: Tensor, sensor: Sensor) -> Built:
    """No depth at all: the error of every method must be below this one's."""
    unit = _unit(background, sensor)
    return Built(_chain(unit, Compensate.from_calibration(unit), NormalFromResponse.from_calibration(unit)), 0)


def point_lights(training: Training, background: Tensor, sensor: Sensor) -> Built:
    """Three lights fitted to the background alone, mode precise."""
    unit = _unit(background, sensor)
    found = quiet_calibrate(background, dataclasses.replace(sensor.without_prior(), blur_px=unit.sensor.blur_px))
    normals = NormalFromIntensity.from_calibration(found)
    return Built(_chain(unit, Compensate.from_calibration(found), normals, "precise"), 12, "from the background alone")


def lookup_table(training: Training, background: Tensor, sensor: Sensor) -> Built:
    """One table from the relative change of R, G, B to slope."""
    learned, unit = _unit(training.background, sensor), _unit(background, sensor)
    pixels = training_pixels(Compensate.from_calibration(learned), training.located, sensor.mm_per_pixel)
    block = NormalFromLookup.fit(torch.ones_like(background), pixels.intensity - 1.0, pixels.slope)
    return Built(_chain(unit, Compensate.from_calibration(unit), block), block.table.numel(), "one table for all pixels")


def network(training: Training, background: Tensor, sensor: Sensor, seed: int = 0) -> Built:
    """gs_sdk's RGBXY network, trained on these presses."""
    unit = _unit(background, sensor)
    fit = train_network(training.background, training.located, sensor, unit.sensor.blur_px, seed)
    smooth = _smooth(unit)
    fit.module.set_flat(smooth(background[None])[0].clamp(0, 1))
    note = "" if fit.converged else "stopped before it converged"
    return Built(_chain(unit, smooth, fit.module), sum(p.numel() for p in fit.module.parameters()), note)


def given_network(training: Training, background: Tensor, sensor: Sensor, path: str | Path) -> Built:
    """A network that was trained before: gs_sdk's ``nnmodel.pth``, or a file of torchvts."""
    unit = _unit(background, sensor)
    smooth = _smooth(unit)
    block = NormalFromMLP.load(path, smooth(background[None])[0].clamp(0, 1))
    note = f"{Path(path).name}: may have been trained on these very presses"
    return Built(_chain(unit, smooth, block), sum(p.numel() for p in block.parameters()), note)


def response(training: Training, background: Tensor, sensor: Sensor, mode: str = "precise") -> Built:
    """Calibration by the presses without a prior."""
    return _calibrated(training.calibration, training, background, sensor, mode)


def response_with_own_prior(training: Training, background: Tensor, sensor: Sensor) -> Built:
    """Calibration by the presses and by a prior that is fitted to the same presses with their labels, mode precise.

    It shows what a prior of the sensor is worth on presses that the prior has not seen.
    """
    prior = fit_prior(training.background, training.sensor, training.labelled, "the folds learned from, with their labels")
    return response_with_prior(training, background, dataclasses.replace(sensor, prior=prior))


def response_with_prior(training: Training, background: Tensor, sensor: Sensor) -> Built:
    """Calibration by the presses and by the prior of the sensor file, mode precise."""
    found = quiet_calibrate(training.background, sensor, training.presses)
    built = _calibrated(found, training, background, sensor, "precise")
    source = "" if sensor.prior is None else f"prior fitted on {sensor.prior.source or 'a unit that it does not name'}"
    return built._replace(note="; ".join(part for part in (built.note, source) if part))


def _calibrated(found: Calibration, training: Training, background: Tensor, sensor: Sensor, mode: str) -> Built:
    """The method of a calibration, on the unit of ``background``."""
    left_out = sum(not row["used"] for row in found.report["presses"])
    notes = [f"left out {left_out} of {len(training.presses)} presses"] if left_out else []
    if background is not training.background:
        if found.response is not None:
            found = Calibration.from_response(found.response, sensor, background)
        elif found.lights is not None:
            found = Calibration.from_lights(found.lights, found.sensor, background)
    if found.response is None:
        notes.append("calibrate chose point lights")
    normals = (NormalFromIntensity if found.response is None else NormalFromResponse).from_calibration(found)
    chain = _chain(_unit(background, sensor), Compensate.from_calibration(found), normals, mode)
    return Built(chain, parameters(found, mode), "; ".join(notes))


class _BothImages(nn.Module):
    """Two compensated images of a frame in one tensor, (B, 6, H, W): one for the contact mask, one for the normals."""

    def __init__(self, first: nn.Module, second: nn.Module) -> None:
        super().__init__()
        self.first, self.second = first, second

    def forward(self, images: Tensor) -> Tensor:
        return torch.cat((self.first(images), self.second(images)), dim=1)


class _ContactOfFirst(nn.Module):
    def __init__(self, contact: nn.Module) -> None:
        super().__init__()
        self.contact = contact

    def forward(self, both: Tensor) -> Tensor:
        contact: Tensor = self.contact(both[:, :3])
        return contact


class _NormalsOfSecond(NormalModel):
    def __init__(self, normals: nn.Module) -> None:
        super().__init__()
        self.normals = as_normal_model(normals)
        self.uses_depth, self.max_passes = self.normals.uses_depth, self.normals.max_passes

    def forward(self, image: Tensor, depth_mm: Tensor | None = None, window: tuple[int, int] | None = None) -> Tensor:
        normal: Tensor = self.normals(image[:, 3:], depth_mm)
        return normal


def _unit(background: Tensor, sensor: Sensor) -> Calibration:
    """The unit with a response field that is zero everywhere: every method uses its contact mask."""
    blur_px = with_preprocessing(sensor, None).blur_px
    return Calibration.from_response(ResponseModel.zero(sensor.exponent, blur_px), sensor, background)


def _smooth(unit: Calibration) -> Compensate:
    """Raw intensity, blurred as for all methods: the input of a network."""
    return Compensate(blur_px=unit.sensor.blur_px, markers=unit.markers)


def _chain(unit: Calibration, compensate: nn.Module, normals: nn.Module, mode: str = "fast") -> DepthPipeline:
    pitch = unit.sensor.mm_per_pixel
    modules = (
        _BothImages(Compensate.from_calibration(unit), compensate),
        _ContactOfFirst(ContactMask.from_calibration(unit)),
        _NormalsOfSecond(normals),
        GradientFromNormal(),
        PoissonBackground(pitch),
    )
    return DepthPipeline(*modules, mm_per_pixel=pitch, mode=mode).eval()


# the registry; in charts the two modes of the paper are broad lines, and methods that give almost the same are drawn upon them

MASK_STYLE: Mapping[str, Any] = {"color": "black", "lw": 1.4, "marker": "o", "ms": 3}
"""Style of the contact mask, which is no method of its own."""

METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        Method("flat", _flat, flat, {"color": "0.6", "lw": 1.2, "ls": "--"}, ours=False, learns=False),
        Method("fast", partial(pipeline, mode="fast"), style={"color": "tab:blue", "lw": 4.0, "alpha": 0.55}),
        Method("precise", partial(pipeline, mode="precise"), style={"color": "tab:orange", "lw": 4.0, "alpha": 0.7}),
        Method("auto", partial(pipeline, mode="auto"), style={"color": "tab:red", "lw": 1.4, "ls": ":"}),
        Method("fast, zero border", _zero_border, style={"color": "navy", "lw": 1.2, "ls": "--"}),
        Method("fast, SciPy's DCT", _scipy, ours=False, needs_module="scipy"),
        Method("fast, PyTorch reference", _reference),
        Method("precise, plain inverse", _plain_inverse, style={"color": "tab:purple", "lw": 1.4}),
        Method("precise, blur 1 px", _blurred, style={"color": "tab:green", "lw": 1.4}),
        Method("precise, discontinuities", _discontinuities, style={"color": "saddlebrown", "lw": 1.4, "ls": "-."}),
        Method("precise, pinhole", _pinhole, style={"color": "deeppink", "lw": 1.2, "ls": (0, (1, 2))}),
        Method("point lights", from_presses=point_lights, learns=False),
        Method("look-up table", _lookup_by_rendered_balls, lookup_table, ours=False),
        Method("MLP", from_presses=network, ours=False),
        Method("response fast", from_presses=partial(response, mode="fast")),
        Method("response precise", from_presses=response),
        Method("response precise, prior by folds", from_presses=response_with_own_prior),
        Method("response precise, prior", from_presses=response_with_prior, needs_prior=True),
    )
}
"""Every method by its name."""
