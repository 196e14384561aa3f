"""The registry of methods that speed, stability and evaluation compare: how each is built, and how charts draw it."""

import dataclasses
import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torchvts.calibration import RESPONSE_BLUR_PX, with_preprocessing
from torchvts.compensate import Compensate
from torchvts.core.geometry import gradient_of_depth
from torchvts.integration import AdaptiveIntegration, PerspectiveIntegration, PoissonDST
from torchvts.model import Calibration, ResponseModel, Sensor
from torchvts.normals import NormalFromIntensity, NormalFromLookup, NormalFromMLP
from torchvts.pipeline import DepthOutput, DepthPipeline, Shadows
from torchvts.scenes import render, sphere_press
from torchvts.skin import ContactFromDepth
from torchvts.training.presses import quiet_calibrate, train_network, training_pixels

from .peers import GsSdkPipeline, as_output
from .training import Training

GIVEN_NETWORK = "given network"
"""Name of a network that was trained before."""

LEAST_DEFORMED_MM = 0.02
"""Skin of anyone's depth counts as deformed above this: depth of the sensors is good to some hundredths of a mm."""

Reconstruct = Callable[[Tensor], DepthOutput]
"""Images (B, 3, H, W) to depth."""


class Built(NamedTuple):
    """A method that was built for one unit.

    Attributes:
        reconstruct: maps images to depth; a :class:`torchvts.DepthPipeline` for most methods.
        parameters: number of parameters that it learned or was given.
        note: a remark for the table.
        used: number of presses that it learned from.
    """

    reconstruct: Reconstruct
    parameters: int
    note: str = ""
    used: int = 0


FromCalibration = Callable[[Calibration], Built]
FromPresses = Callable[[Training], Built]


@dataclass(frozen=True)
class Method:
    """One way to reconstruct depth.

    Attributes:
        name: key in :data:`METHODS`, and name in tables.
        from_calibration: builds it for a calibrated unit; None if it must learn from presses.
        from_presses: builds it from presses; None if it is not compared on presses.
        style: arguments of Matplotlib's ``plot``.
        ours: whether it is the library's own way, and not there for comparison.
        learns: whether the presses influence it, so that every fold of a cross-validation needs its own.
        seen: whether it may have learned from the very presses that it is scored on.
        needs_prior: whether it is a variant for sensors that have a prior.
    """

    name: str
    from_calibration: FromCalibration | None = None
    from_presses: FromPresses | None = None
    style: Mapping[str, Any] = field(default_factory=dict)
    ours: bool = True
    learns: bool = True
    seen: bool = False
    needs_prior: bool = False

    def calibrated(self, calibration: Calibration) -> Built:
        """The method for a calibrated unit.

        Raises:
            ValueError: a method that must learn from presses.
        """
        if self.from_calibration is None:
            raise ValueError(f"method: expected one that a calibration is enough for, got '{self.name}', which learns from presses")
        return self.from_calibration(calibration)

    def learned(self, training: Training) -> Built:
        """The method built from presses.

        Raises:
            ValueError: a method that is not compared on presses, or presses that cannot be used.
        """
        if self.from_presses is None:
            raise ValueError(f"method: expected one that presses are enough for, got '{self.name}', which needs a calibration")
        return self.from_presses(training)


# built from a calibration


def pipeline(calibration: Calibration, mode: str, normals: nn.Module | None = None, integrate: nn.Module | None = None) -> Built:
    """The pipeline of a unit, with other normals or another integrator if they are given."""
    built = DepthPipeline.from_calibration(calibration, mode, normals=normals, integrate=integrate).requires_grad_(False)
    return Built(built.freeze(), parameters(calibration, mode))


def parameters(calibration: Calibration, mode: str) -> int:
    """Number of parameters of a calibration: 12 of three lights, or all coefficients of the response that a mode uses."""
    model = calibration.response
    if model is None:
        return 12
    by_depth = None if mode == "fast" else model.by_depth
    return 2 * model.field.size() + (0 if by_depth is None else by_depth.tensor().numel())


def _flat(calibration: Calibration) -> Built:
    return Built(_zero, 0, "zero depth, for comparison")


def _zero(image: Tensor) -> DepthOutput:
    zero = torch.zeros_like(image)
    return as_output(zero[:, :1], zero[:, :2], zero[:, :1].bool())


def _reference(calibration: Calibration) -> Built:
    """Mode fast, not frozen."""
    return Built(DepthPipeline.from_calibration(calibration), parameters(calibration, "fast"), "not frozen")


def _integrated(mode: str, integrator: Callable[[float], nn.Module]) -> FromCalibration:
    """The pipeline with another integrator, made of the pitch in mm."""
    return lambda calibration: pipeline(calibration, mode, integrate=integrator(calibration.sensor.mm_per_pixel))


def _plain_inverse(calibration: Calibration) -> Built:
    """Eq. 10 at every pixel: no channel is treated as dark or saturated."""
    sensor, lights = calibration.sensor, calibration.lights
    if lights is None:
        raise ValueError("calibration: expected one by lights, got response fields")
    size = (sensor.height, sensor.width)
    normals = NormalFromIntensity(lights, *size, sensor.mm_per_pixel, noise_std=torch.zeros(3), inverse=calibration.inverse)
    return pipeline(calibration, "precise", normals=normals)


def _shadows(calibration: Calibration) -> Built:
    """Mode precise that settles what dark channels mean."""
    pipe = DepthPipeline.from_calibration(calibration, "precise")
    pipe.refine = Shadows(pipe.refine, pipe.mm_per_pixel)
    return Built(pipe.freeze(), parameters(calibration, "precise"))


def _blurred(calibration: Calibration) -> Built:
    """Images blurred by one pixel, as with ``Sensor(blur_px=1)``."""
    return pipeline(dataclasses.replace(calibration, sensor=dataclasses.replace(calibration.sensor, blur_px=1.0)), "precise")


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


# built from presses


def flat(training: Training) -> Built:
    """No depth at all: the error of every method must be below this one's."""
    return Built(_zero, 0)


def point_lights(training: Training) -> Built:
    """Three lights fitted to the background alone, mode precise."""
    found = quiet_calibrate(training.background, _blurred_sensor(training.sensor.without_prior()))
    return pipeline(found, "precise")._replace(note="from the background alone")


def lookup_table(training: Training) -> Built:
    """One table from the relative change of R, G, B to slope, behind the preprocessing of a response field that is zero."""
    background, sensor = training.background, _blurred_sensor(training.sensor)
    unit = Calibration.from_response(ResponseModel.zero(sensor.exponent, sensor.blur_px), training.sensor, background)
    pixels = training_pixels(Compensate.from_calibration(unit), training.located, sensor.mm_per_pixel)
    block = NormalFromLookup.fit(torch.ones_like(background), pixels.intensity - 1.0, pixels.slope)
    return pipeline(unit, "fast", block)._replace(parameters=block.table.numel(), used=len(training.located))


def network(training: Training) -> Built:
    """gs_sdk's RGBXY network, trained on these presses, and a frame in the steps of gs_sdk."""
    fit = train_network(training.background, training.located, training.sensor)
    note = "" if fit.converged else "stopped before it converged"
    return _as_gs_sdk(fit.module, training, note)._replace(used=len(training.located))


def given_network(training: Training, path: str | Path) -> Built:
    """A network that was trained before, gs_sdk's ``nnmodel.pth`` or a file of torchvts, and a frame in the steps of gs_sdk."""
    return _as_gs_sdk(NormalFromMLP.load(path, training.background), training, f"{Path(path).name}: trained before")


def by_calibration(training: Training, mode: str, prior: bool = True) -> Built:
    """What a user gets: calibration by the presses, with or without the prior of the sensor."""
    training = training if prior else training.without_prior
    notes = ["calibrate chose point lights"] * (training.calibration.response is None)
    if training.sensor.prior is not None:
        notes.append(f"prior fitted on {training.sensor.prior.source or 'a unit that it does not name'}")
    used = sum(row["used"] for row in training.calibration.report.get("presses", []))
    return pipeline(training.calibration, mode)._replace(note="; ".join(notes), used=used)


def shipped_prior(training: Training, sensor: Sensor) -> Built:
    """The prior of another description of the sensor, and no presses, mode precise."""
    return by_calibration(Training(training.background, (), sensor), "precise")


def with_network(path: Path) -> Method:
    """The method of a network that was trained before on the unit, perhaps on the very presses."""
    return Method(GIVEN_NETWORK, from_presses=partial(given_network, path=path), ours=False, learns=False, seen=True)


def own_methods(normals: str | None, depth: str | None) -> tuple[Method, ...]:
    """The methods of anyone's networks, each named as ``module:factory`` and made by ``factory(training)`` for every unit.

    Args:
        normals: gives an ``nn.Module`` of compensated images (B, 3, H, W) to unit normals, which takes the place of the calibrated
            model in mode fast.
        depth: gives a callable of images (B, 3, H, W) in [0, 1] to depth (B, 1, H, W), mm; contact is found in it, as in all depth.
    Raises:
        ValueError: a text of another form, or a module without this factory.
        ImportError: no such module.
    """
    given = ((normals, _by_own_normals), (depth, _by_own_depth))
    return tuple(
        Method(name, from_presses=partial(build, factory=_factory(name)), ours=False) for name, build in given if name is not None
    )


def _factory(name: str) -> Callable[[Training], Any]:
    module, _, function = name.partition(":")
    if not module or not function:
        raise ValueError(f"expected module:factory, as in my_networks:normals, got {name!r}")
    if (here := str(Path.cwd())) not in sys.path:  # as python -m has it
        sys.path.append(here)
    try:
        found: Callable[[Training], Any] | None = getattr(import_module(module), function, None)
    except ModuleNotFoundError as error:
        if error.name != module:  # what it imports itself
            raise
        raise ImportError(f"{name}: expected {module}.py in {here} or on PYTHONPATH, found none") from error
    if not callable(found):
        raise ValueError(f"{name}: expected a function {function} in {module}, got {type(found).__name__}")
    return found


def _by_own_normals(training: Training, factory: Callable[[Training], nn.Module]) -> Built:
    block = factory(training)
    built = DepthPipeline.from_calibration(training.calibration, normals=block).requires_grad_(False)
    return Built(built, sum(p.numel() for p in block.parameters()), used=len(training.located) if training.presses else 0)


def _by_own_depth(training: Training, factory: Callable[[Training], Callable[[Tensor], Tensor]]) -> Built:
    reconstruct, pitch = factory(training), training.sensor.mm_per_pixel
    find = ContactFromDepth(pitch)

    def output(image: Tensor) -> DepthOutput:
        depth_mm = reconstruct(image)
        deformed = depth_mm > LEAST_DEFORMED_MM
        return as_output(depth_mm, gradient_of_depth(depth_mm, pitch), find(depth_mm, deformed))

    count = sum(p.numel() for p in reconstruct.parameters()) if isinstance(reconstruct, nn.Module) else 0
    return Built(output, count, used=len(training.presses))


def _as_gs_sdk(module: NormalFromMLP, training: Training, note: str) -> Built:
    peer = GsSdkPipeline(module, training.background, RESPONSE_BLUR_PX)
    count = sum(p.numel() for p in module.parameters())
    return Built(partial(peer.as_output, mm_per_pixel=training.sensor.mm_per_pixel), count, note)


def _blurred_sensor(sensor: Sensor) -> Sensor:
    """The sensor with the blur that calibration by presses uses."""
    return dataclasses.replace(sensor, blur_px=with_preprocessing(sensor, None).blur_px)


# the registry; in charts each method has a colour of Okabe and Ito's palette and dashes of its own

MASK_STYLE: Mapping[str, Any] = {"color": "black", "lw": 1.4, "marker": "o", "ms": 3}
"""Style of the contact mask, which is no method of its own."""

METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        Method("flat", _flat, flat, {"color": "0.6", "lw": 1.2, "ls": ":"}, ours=False, learns=False),
        Method(
            "fast",
            partial(pipeline, mode="fast"),
            partial(by_calibration, mode="fast"),
            {"color": "#0072b2", "lw": 2.2},
        ),
        Method(
            "precise",
            partial(pipeline, mode="precise"),
            partial(by_calibration, mode="precise"),
            {"color": "#d55e00", "lw": 2.2},
        ),
        Method("precise, shadows", _shadows, style={"color": "#e69f00", "lw": 1.6, "ls": (0, (4, 1))}),
        Method("fast, zero border", _integrated("fast", PoissonDST), style={"color": "#56b4e9", "lw": 1.6, "ls": "--"}),
        Method("fast, PyTorch reference", _reference),
        Method("precise, plain inverse", _plain_inverse, style={"color": "#cc79a7", "lw": 1.6, "ls": (0, (6, 1, 1, 1))}),
        Method("precise, blur 1 px", _blurred, style={"color": "#009e73", "lw": 1.6, "ls": (0, (2, 1))}),
        Method(
            "precise, discontinuities", _integrated("precise", AdaptiveIntegration), style={"color": "black", "lw": 1.4, "ls": "-."}
        ),
        Method("precise, pinhole", _pinhole, style={"color": "#7a5195", "lw": 1.6, "ls": (0, (1, 1))}),
        Method("point lights", from_presses=point_lights, learns=False),
        Method("look-up table", _lookup_by_rendered_balls, lookup_table, ours=False),
        Method("MLP", from_presses=network, ours=False),
        Method("fast, no prior", from_presses=partial(by_calibration, mode="fast", prior=False), needs_prior=True),
        Method("precise, no prior", from_presses=partial(by_calibration, mode="precise", prior=False), needs_prior=True),
    )
}
"""Every method by its name."""
