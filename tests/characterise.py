"""Characterise the library: all its outputs on fixed inputs, to hold one commit against another, bit by bit.

This is a script and no test module. It reads the public API only, so that it runs on commits before and after a refactoring::

    python tests/characterise.py against 530e295                # this checkout against a commit, both on this machine
    python tests/characterise.py write out.safetensors          # the outputs of the torchvts that Python finds
    python tests/characterise.py compare old.safetensors new.safetensors

``against`` checks the commit out into a temporary worktree, builds its compiled kernels there, and runs ``write`` on both with one
thread. ``compare`` prints Markdown tables: "equal" where all bits are equal, else the largest difference, absolute and relative to
the largest value; it exits with 1 if any relative difference exceeds 1e-6, a mask differs in a pixel, or an entry is missing. Where
a pixel is ill-conditioned, rounding alone exceeds that: for such entries it prints how far the old commit is from float64, too.

The outputs are named ``section/row/column``. Sections: inputs (images and calibrations as they enter), pipelines (units by lights
and by response fields, modes, and paths: compiled kernels, PyTorch reference, float64, TorchScript saved and loaded,
torch.export), confidence, integrators, blocks, gradients by autograd, calibrations, diagnoses, stream, poses.

The GelSight Mini is left out where there are no third-party images (``TORCHVTS_DATA``, or shared/data beside the checkout).
"""

import argparse
import contextlib
import dataclasses
import hashlib
import importlib
import io
import json
import math
import os
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

ROOT = Path(__file__).resolve().parents[1]
TOLERANCE = 1e-6
"""Largest difference allowed, relative to the largest value: 1e-6 of the depth."""

# ---------------------------------------------------------------- names that differ between commits


def find(*places: str) -> Any:
    """The first that exists of some "module:name"."""
    for place in places:
        module, _, name = place.partition(":")
        with contextlib.suppress(ImportError, AttributeError):
            return getattr(importlib.import_module(module), name)
    raise ImportError(f"none of {', '.join(places)}")


RENAMED_FINDINGS = {"nothing_at_rest": "no_free_skin"}
"""Findings of a diagnosis, old and new name."""


class Names:
    """What is called differently, or stands elsewhere, in some commits."""

    def __init__(self) -> None:
        scenes = importlib.import_module("torchvts.scenes")
        self.undeformed = getattr(scenes, "undeformed", None) or scenes.at_rest
        self.reference_only = find(
            "torchvts.accelerated:reference_only", "torchvts.core.native:reference_only", "torchvts.core.native:operators_only"
        )
        self.PoissonBackground = find("torchvts:PoissonBackground", "torchvts:PoissonRest")
        self.PerspectiveIntegration = find(
            "torchvts.accelerated:PerspectiveIntegration", "torchvts.integration:PerspectiveIntegration"
        )
        self.DiscontinuityIntegration = find(
            "torchvts.accelerated:DiscontinuityIntegration",
            "torchvts.integration:DiscontinuityIntegration",
            "torchvts.integration:CliffIntegration",
        )
        self.ResponseField = find("torchvts.model:ResponseField", "torchvts.core.response:ResponseField")
        self.DepthBrightness = find("torchvts.model:DepthBrightness")
        self.ResponseModel = find("torchvts.model:ResponseModel", "torchvts.core.response:ResponseModel")
        self.FillMarkers = find("torchvts.model:FillMarkers", "torchvts.compensate:FillMarkers", "torchvts:FillMarkers")
        self.export_program = find("torchvts.export:export_program")


# ---------------------------------------------------------------- units and frames


PITCH_AT_120 = 0.25
PRESSES = ((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.6, -0.45, 0.3), (1.8, 0.1, -0.1))
"""Depth in mm, centre as a share of the field: pressed, without contact, at the border, deep."""


class Unit(NamedTuple):
    """A calibrated unit and four frames of it (4, 3, H, W), the second without contact."""

    calibration: Any
    images: Tensor


def ring_lights(radius_mm: float = 31.0, height_mm: float = 40.0, level: float = 0.45, gloss: Sequence[float] | None = None) -> Any:
    """Three lights on a ring, 120 degrees apart, that give a matt flat skin ``level`` at the image centre."""
    angle = torch.deg2rad(torch.tensor([10.0, 130.0, 250.0], dtype=torch.float64))
    position = torch.stack((radius_mm * angle.cos(), radius_mm * angle.sin(), torch.full_like(angle, height_mm)), dim=1)
    albedo = torch.full((3,), level * (radius_mm**2 + height_mm**2) ** 1.5 / height_mm)
    return vts.PointLights(position.float(), albedo, gloss).requires_grad_(False)


def balls(height: int, width: int) -> list[Any]:
    pitch = PITCH_AT_120 * 120 / height
    scenes = []
    for press_mm, x, y in PRESSES:
        scene = vts.scenes.sphere_press(10.0, press_mm or 1.0, (x * width * pitch, y * height * pitch), height, width, pitch)
        scenes.append(scene if press_mm else names.undeformed(scene))
    return scenes


def sensor_of(height: int, width: int, **more: Any) -> Any:
    return vts.Sensor(name="rig", height=height, width=width, mm_per_pixel=PITCH_AT_120 * 120 / height, **more)


def by_lights(lights: Any, height: int, width: int, failed: int | None = None, **camera: Any) -> Unit:
    """A unit of known lights with 8-bit noise; ``failed`` is the channel of an LED that has gone out since the calibration."""
    scenes = balls(height, width)
    camera = {"noise_std": 0.003, "bits": 8} | camera
    shadows = camera.pop("shadows", False)
    background = vts.scenes.render(scenes[1], lights, **camera, seed=99)[0]
    images = torch.cat([vts.scenes.render(scene, lights, **camera, shadows=shadows, seed=k) for k, scene in enumerate(scenes)])
    if failed is not None:
        images[:, failed] = 0.01 * (images[:, failed] > 0.3)
    return Unit(vts.Calibration.from_lights(lights, sensor_of(height, width), background), images)


def response_model() -> Any:
    """A response field of degree 1 with products, and what depth does to brightness, near those of a ring of lights."""
    draw = torch.Generator().manual_seed(3)
    angle = torch.deg2rad(torch.tensor([10.0, 130.0, 250.0], dtype=torch.float64))
    slope_of_change = -0.26 * torch.stack((angle.cos(), angle.sin()))

    rows = 0.01 * torch.randn(2, 9, 3, generator=draw, dtype=torch.float64)
    rows[:, :3, 0] += slope_of_change
    field = names.ResponseField(1, 1, 20.0, tuple(map(tuple, rows.flatten(1).tolist())))
    per_mm = 0.05 * torch.randn(3, 3, generator=draw, dtype=torch.float64)
    return names.ResponseModel(field, names.DepthBrightness(1, 20.0, tuple(map(tuple, per_mm.tolist()))))


def by_response(height: int, width: int) -> Unit:
    known = by_lights(ring_lights(), height, width)
    background = vts.scenes.render(balls(height, width)[1], ring_lights(), noise_std=0.003, bits=8, seed=99)[0]
    return Unit(vts.Calibration.from_response(response_model(), sensor_of(height, width), background), known.images)


def with_markers(height: int, width: int) -> Unit:
    """A unit by response fields whose skin has dark dots."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    dots = ((x % 20 - 10.0) ** 2 + (y % 20 - 10.0) ** 2 < 9.0).float()[None, None]
    plain = by_response(height, width)
    images = torch.round(plain.images * (1.0 - 0.5 * dots) * 255) / 255
    sensor = sensor_of(height, width, markers=True)
    return Unit(vts.Calibration.from_response(response_model(), sensor, images[1]), images)


def real_mini(data: Path) -> Unit:
    """A GelSight Mini calibrated from its background by the shipped prior."""
    folder = data / "gelsight_mini_a"
    background, presses = vts.read_presses(folder)
    calibration = vts.calibrate(background, vts.Sensor.load("gelsight_mini"))
    chosen = [press.image for press in presses[:: max(1, len(presses) // 3)][:3]]
    return Unit(calibration, torch.stack([chosen[0], background, *chosen[1:]]))


def build_units(data: Path | None) -> dict[str, Callable[[], Unit]]:
    """All units by name; "A 120x160" and so on."""
    spots = vts.scenes.skin_spots(120, 160, 6, 6)
    low = ring_lights(25.0, 13.0, 0.2)
    units: dict[str, Callable[[], Unit]] = {
        "lights, spots 120x160": lambda: by_lights(ring_lights(), 120, 160, spots=spots),
        "lights 240x320": lambda: by_lights(ring_lights(), 240, 320),
        "lights 97x131": lambda: by_lights(ring_lights(), 97, 131),
        "lights, low, shadows 120x160": lambda: by_lights(low, 120, 160, shadows=True),
        "lights, low, shadows 97x131": lambda: by_lights(low, 97, 131, shadows=True),
        "lights, failed LED 120x160": lambda: by_lights(ring_lights(), 120, 160, failed=1),
        "lights, glossy 120x160": lambda: by_lights(ring_lights(gloss=[0.4, 0.5, 0.3]), 120, 160),
        "lights, saturated 120x160": lambda: by_lights(ring_lights(level=0.85), 120, 160),
        "response 120x160": lambda: by_response(120, 160),
        "response 240x320": lambda: by_response(240, 320),
        "response 97x131": lambda: by_response(97, 131),
        "response, markers 120x160": lambda: with_markers(120, 160),
    }
    if data is not None:
        units["GelSight Mini by the prior"] = lambda: real_mini(data)
    return units


# ---------------------------------------------------------------- what is recorded


class Record:
    """Named tensors ``section/row/column``, and texts."""

    def __init__(self) -> None:
        self.tensors: dict[str, Tensor] = {}
        self.texts: dict[str, str] = {}

    def add(self, section: str, row: str, **columns: Any) -> None:
        for column, value in columns.items():
            key = f"{section}/{row}/{column}"
            if isinstance(value, str):
                self.texts[key] = value
            else:
                value = value if isinstance(value, Tensor) else torch.as_tensor(value, dtype=torch.float64)
                self.tensors[key] = value.detach().clone().contiguous()

    def add_output(self, row: str, out: Any) -> None:
        depth, gradient, normal, contact = out[:4]
        self.add("pipelines", row, depth=depth, gradient=gradient, normal=normal, contact=contact)

    def save(self, path: Path) -> None:
        hashes = {key: hashlib.sha256(value.numpy().tobytes()).hexdigest() for key, value in self.tensors.items()}
        metadata = {"texts": json.dumps(self.texts), "sha256": json.dumps(hashes)}
        save_file(self.tensors, str(path), metadata=metadata)


def in_double(calibration: Any) -> Any:
    """The same unit in float64."""
    background = calibration.background.double()
    changed: dict[str, Any] = {"background": background, "noise_std": calibration.noise_std.double()}
    if calibration.lights is not None:
        lights = calibration.lights
        parts = (lights.position_mm, lights.albedo, lights.gloss)
        changed["lights"] = vts.PointLights(*(part.detach().double() for part in parts)).requires_grad_(False)
    if calibration.ambient is not None:
        changed["ambient"] = calibration.ambient.double()
    return dataclasses.replace(calibration, **changed)


def through_a_file(pipe: nn.Module) -> Any:
    stream = io.BytesIO()
    torch.jit.save(torch.jit.script(pipe), stream)
    stream.seek(0)
    return torch.jit.load(stream)


def record_pipelines(record: Record, data: Path | None) -> None:
    for name, make in build_units(data).items():
        calibration, images = make()
        record.add("inputs", name, images=images, background=calibration.background, noise_std=calibration.noise_std)
        for mode in ("fast", "precise", "auto"):
            pipe = vts.DepthPipeline.from_calibration(calibration, mode)
            record.add_output(f"{name}, {mode}, compiled", pipe(images))
            record.add("blocks", f"{name}, {mode}", compensated=pipe.compensate(images))
            with names.reference_only():
                record.add_output(f"{name}, {mode}, reference", pipe(images))
            for k in range(2):
                record.add_output(f"{name}, {mode}, compiled, frame {k} alone", pipe(images[k : k + 1]))
            if "240" in name or "Mini" in name:
                continue
            double = vts.DepthPipeline.from_calibration(in_double(calibration), mode)
            record.add_output(f"{name}, {mode}, float64", double(images.double()))
            if "97" not in name:
                record.add_output(f"{name}, {mode}, TorchScript", through_a_file(pipe)(images))


def record_exports(record: Record) -> None:
    for name, unit, mode in (
        ("lights 48x64", by_lights(ring_lights(), 48, 64), "fast"),
        ("response 48x64", by_response(48, 64), "precise"),
    ):
        program = names.export_program(vts.DepthPipeline.from_calibration(unit.calibration, mode))
        record.add_output(f"{name}, {mode}, torch.export", program.module()(unit.images))


def record_confidence(record: Record) -> None:
    for name, unit in (
        ("lights, spots", by_lights(ring_lights(), 120, 160, spots=vts.scenes.skin_spots(120, 160, 6, 6))),
        ("lights, low, shadows", by_lights(ring_lights(25.0, 13.0, 0.2), 120, 160, shadows=True)),
        ("response", by_response(120, 160)),
    ):
        for mode in ("fast", "precise"):
            out = vts.ConfidentPipeline.from_calibration(unit.calibration, mode)(unit.images)
            record.add("confidence", f"{name}, {mode}", **out._asdict())


def record_integrators(record: Record) -> None:
    scene = vts.scenes.punch_press(4.0, 1.0, 2.0, 0.15, 97, 131, 0.2)
    drawn = torch.randn(1, 2, 97, 131, generator=torch.Generator().manual_seed(0))
    gradient = torch.cat((scene.gradient, 0.1 * drawn, vts.scenes.sine_press(0.1, 2.0, 8.0, 97, 131, 0.2).gradient))
    solvers = {
        "PoissonDST": vts.PoissonDST(0.2),
        "PoissonDCT": vts.PoissonDCT(0.2),
        "PoissonBackground": names.PoissonBackground(0.2),
        "PerspectiveIntegration": names.PerspectiveIntegration(0.2, 60.0),
        "AdaptiveIntegration": vts.AdaptiveIntegration(0.2),
        "DiscontinuityIntegration": names.DiscontinuityIntegration(0.2),
    }
    for name, solver in solvers.items():
        exact = name == "DiscontinuityIntegration"
        given = scene.gradient if exact else gradient
        record.add("integrators", f"{name}, compiled", depth=solver(given))
        with names.reference_only():
            record.add("integrators", f"{name}, reference", depth=solver(given))
        record.add("integrators", f"{name}, float64", depth=solver(given.double()))
    unit = by_lights(ring_lights(), 120, 160)
    for name, integrate in (
        ("PerspectiveIntegration", names.PerspectiveIntegration(0.25, 60.0)),
        ("AdaptiveIntegration", vts.AdaptiveIntegration(0.25)),
    ):
        for mode in ("fast", "precise"):
            pipe = vts.DepthPipeline.from_calibration(unit.calibration, mode, integrate=integrate)
            record.add_output(f"lights 120x160, {mode}, compiled, {name}", pipe(unit.images))


def record_blocks(record: Record) -> None:
    unit = by_lights(ring_lights(), 120, 160)
    torch.manual_seed(0)
    network = vts.NormalFromMLP(120, 160, unit.calibration.background).requires_grad_(False)
    record.add("blocks", "NormalFromMLP, drawn weights", normal=network(unit.images))
    draw = torch.Generator().manual_seed(1)
    slope = 0.3 * torch.randn(500, 2, generator=draw)
    change = slope @ torch.tensor([[0.2, -0.1, -0.1], [0.0, 0.15, -0.15]])
    table = vts.NormalFromLookup.fit(unit.calibration.background, change, slope)
    record.add("blocks", "NormalFromLookup, drawn samples", normal=table(unit.images))
    scene = balls(120, 160)[0]
    shadowed = vts.scenes.render(scene, ring_lights(25.0, 13.0, 0.2), shadows=True, vignetting=0.2, gamma=2.2)
    record.add("blocks", "scenes.render, shadows, vignetting, gamma", image=shadowed)
    marked = with_markers(120, 160)
    record.add("blocks", "FillMarkers", image=names.FillMarkers(6.0)(marked.images))
    record.add("blocks", "depth_to_points", points=vts.depth_to_points(scene.depth_mm, 0.25, scene.contact))


def record_gradients(record: Record) -> None:
    units = {
        "lights": by_lights(ring_lights(), 120, 160, spots=vts.scenes.skin_spots(120, 160, 6, 6)),
        "lights, low, shadows": by_lights(ring_lights(25.0, 13.0, 0.2), 120, 160, shadows=True),
        "response": by_response(120, 160),
    }
    weight = torch.randn(1, 1, 120, 160, generator=torch.Generator().manual_seed(5))
    for name, unit in units.items():
        for mode in ("fast", "precise", "auto"):
            pipe = vts.DepthPipeline.from_calibration(unit.calibration, mode).requires_grad_(True)
            images = unit.images.clone().requires_grad_(True)
            (pipe(images).depth_mm * weight).mean().backward()
            found = {"image": images.grad}
            found |= {key.split(".")[-1]: p.grad for key, p in pipe.named_parameters() if p.grad is not None}
            record.add("gradients", f"{name}, {mode}", **{key: value for key, value in found.items() if value is not None})


MIX = ((0.75, 0.2, 0.05), (0.1, 0.8, 0.1), (0.05, 0.25, 0.7))
SMALL = (120, 160, 0.125)
CENTERS_MM = ((0, 0), (5, 3), (-5, 3), (5, -3), (-5, -3), (0, 4))
DEPTHS_MM = (0.5, 0.4, 0.6, 0.45, 0.55, 0.5)


def noisy(image: Tensor, seed: int) -> Tensor:
    noise = 0.003 * torch.randn(image.shape, generator=torch.Generator().manual_seed(seed))
    return torch.round((image + noise).clamp(0, 1) * 255) / 255


def mixed_camera(scene: Any, seed: int) -> Tensor:
    """Vignetting, mixed channels, a curve: no point lights explain it."""
    light = vts.scenes.render(scene, ring_lights(), vignetting=0.4)[0]
    return noisy(torch.einsum("ij,jhw->ihw", torch.tensor(MIX), light) ** 0.6 + 0.05, seed)


def record_calibration(record: Record, name: str, calibration: Any) -> None:
    columns = {"background": calibration.background, "noise_std": calibration.noise_std}
    if calibration.ambient is not None:
        columns["ambient"] = calibration.ambient
    if calibration.lights is not None:
        lights = calibration.lights
        columns |= {"position_mm": lights.position_mm, "albedo": lights.albedo, "gloss": lights.gloss}
    if calibration.response is not None:
        for part in ("fast", "precise"):
            field = getattr(calibration.response, part)
            if field is not None:
                columns[part] = torch.tensor(field.coefficient, dtype=torch.float64)
    with tempfile.TemporaryDirectory() as folder:
        calibration.save(Path(folder) / "unit.safetensors")
        stored = load_file(Path(folder) / "unit.safetensors")
        columns |= {f"file: {key}": value for key, value in stored.items() if key in ("compensation", "inverse")}
        again = vts.Calibration.load(Path(folder) / "unit.safetensors")
    columns["loaded background"] = again.background
    model = f"{calibration.report['model']}, gamma {calibration.sensor.exponent:g}, blur {calibration.sensor.blur_px:g} px"
    record.add("calibrations", name, model=model, **columns)


def record_calibrations(record: Record, data: Path | None) -> None:
    scene = balls(120, 160)[1]
    worn = {"noise_std": 0.005, "bits": 8, "spots": vts.scenes.skin_spots(120, 160, 6, 6), "seed": 1}
    linear = sensor_of(120, 160, gamma=1.0)
    low = ring_lights(22.0, 16.0, 0.2)
    backgrounds = {
        "background": (vts.scenes.render(scene, low, **worn)[0], linear),
        "background, gamma open": (vts.scenes.render(scene, low, **worn, gamma=2.2)[0], sensor_of(120, 160)),
        "background, vignetting": (vts.scenes.render(scene, low, **worn, vignetting=0.2)[0], linear),
        "background, ambient light": ((vts.scenes.render(scene, low, **worn)[0] + 0.04).clamp(0, 1), linear),
        "background, glossy": (vts.scenes.render(scene, ring_lights(22.0, 16.0, 0.2, [0.5] * 3), **worn)[0], linear),
    }
    for name, (background, sensor) in backgrounds.items():
        record_calibration(record, name, vts.calibrate(background, sensor))
    fit = vts.fit_lights(backgrounds["background"][0], linear)
    spreads = {key: getattr(fit, key) for key in ("direction_std_deg", "position_std_mm", "residual_std", "misfit")}
    record.add("calibrations", "fit_lights", position_mm=fit.lights.position_mm, albedo=fit.lights.albedo, **spreads)
    small = vts.Sensor("rig", *SMALL, gamma=1.0)
    rest = names.undeformed(vts.scenes.sphere_press(3.0, 0.5, (0.0, 0.0), *SMALL))
    pressed = [vts.scenes.sphere_press(3.0, depth, center, *SMALL) for center, depth in zip(CENTERS_MM, DEPTHS_MM, strict=True)]
    presses = [vts.Press(mixed_camera(scene, k), 6.0, f"press {k}") for k, scene in enumerate(pressed)]
    by_presses = vts.calibrate(mixed_camera(rest, 99), small, presses)
    record_calibration(record, "6 presses", by_presses)
    rows = by_presses.report["presses"]
    record.add(
        "calibrations", "6 presses", centers_px=[row["center_px"] for row in rows], held_out=by_presses.report["held_out_deg"]
    )
    out = vts.DepthPipeline.from_calibration(by_presses, "precise")(presses[0].image[None])
    record.add_output("fitted to 6 presses, precise, compiled", out)
    bounds = vts.ConfidentPipeline.from_calibration(by_presses, "precise")(presses[0].image[None])
    record.add("confidence", "fitted to 6 presses, precise", **bounds._asdict())
    mix = torch.tensor([[0.35, -0.05], [-0.2, 0.3], [-0.1, -0.33]])

    def linear_camera(scene: Any, seed: int) -> Tensor:
        change = torch.einsum("cs,bshw->bchw", mix, scene.gradient.float())
        return noisy(0.45 * (1.0 + change)[0], seed)

    soft = [
        vts.scenes.sphere_press(6.0, depth, center, *SMALL) for depth, center in ((0.3, (-3, 1)), (0.5, (4, -2)), (0.6, (-5, -3)))
    ]
    touches = [vts.Touch(linear_camera(soft[0], 0), 0.3), *(linear_camera(scene, 7 + k) for k, scene in enumerate(soft[1:]))]
    record_calibration(record, "3 touches", vts.calibrate(linear_camera(rest, 99), small, touches=touches))
    if data is not None:
        mini, images = real_mini(data)
        record_calibration(record, "GelSight Mini, background and prior", mini)
        bounds = vts.ConfidentPipeline.from_calibration(mini, "precise")(images)
        record.add("confidence", "GelSight Mini by the prior, precise", **bounds._asdict())


def record_diagnoses(record: Record) -> None:
    for name, unit in (("lights", by_lights(ring_lights(), 120, 160)), ("response", by_response(120, 160))):
        calibration, images = unit
        background = images[1]
        drifted = (background * torch.tensor([1.15, 1.0, 0.9]).reshape(3, 1, 1)).clamp(0, 1)
        cases = {
            "as calibrated": (background, images[0]),
            "channels swapped": (background[[2, 1, 0]], images[0][[2, 1, 0]]),
            "flipped": (background.flip(2), images[0].flip(2)),
            "light drift": (drifted, images[0]),
            "dark": (None, 0.3 * images[0]),
            "too bright": (None, (2.0 * images[0]).clamp(0, 1)),
        }
        for case, (now, image) in cases.items():
            findings = vts.diagnose(now, image, calibration).findings
            text = ", ".join(f"{finding.severity}: {RENAMED_FINDINGS.get(finding.name, finding.name)}" for finding in findings)
            record.add("diagnoses", f"{name}, {case}", findings=text, values=[finding.value for finding in findings] or [0.0])


class Pictures:
    """A reader of pictures made up front."""

    name, live, fps = "made up", False, 30.0

    def __init__(self, images: Sequence[Tensor]) -> None:
        pictures = [(image.permute(1, 2, 0).flip(2) * 255).round().to(torch.uint8).numpy() for image in images]
        self._pictures = iter(pictures)

    def read(self) -> Any:
        return next(self._pictures, None)

    def close(self) -> None:
        self._pictures = iter(())


def record_stream(record: Record) -> None:
    for name, unit in (("lights", by_lights(ring_lights(), 120, 160)), ("response", by_response(120, 160))):
        images = [unit.images[1]] * 4 + [unit.images[0]] * 3 + [unit.images[1], unit.images[2], unit.images[3]]
        with vts.stream.TactileStream(Pictures(images), unit.calibration, mode="auto", background_frames=4) as stream:
            for number, frame in enumerate(stream):
                record.add("stream", f"{name}, frame {number}", image=frame.image, depth=frame[3].depth_mm)


def turned_bumps(angle_deg: float, shift_mm: tuple[float, float]) -> Any:
    """A pressed object without symmetry, turned and moved in the plane."""
    turn = math.radians(angle_deg)

    def depth(x: Tensor, y: Tensor) -> Tensor:
        x, y = x - shift_mm[0], y - shift_mm[1]
        u, v = x * math.cos(turn) + y * math.sin(turn), y * math.cos(turn) - x * math.sin(turn)
        height = torch.zeros_like(u)
        for peak, along, across, width in ((0.8, 0.0, 0.0, 2.0), (0.6, 2.5, 0.5, 0.8), (0.5, -1.0, 2.2, 1.2)):
            height = height + peak * torch.exp(-((u - along) ** 2 + (v - across) ** 2) / width**2)
        return height - 0.15

    return vts.scenes.surface(depth, 96, 128, 0.125)


def record_poses(record: Record) -> None:
    target, source = turned_bumps(0.0, (0.0, 0.0)), turned_bumps(30.0, (1.0, -0.5))
    direct = vts.register_depth(source, target, 0.125)
    record.add("poses", "register_depth", T=direct.T_target_source, rmse_mm=direct.rmse_mm, fitness=direct.fitness)
    started = vts.register_depth(source, target, 0.125, initial=direct.T_target_source)
    record.add("poses", "register_depth, started", T=started.T_target_source, rmse_mm=started.rmse_mm, fitness=started.fitness)


def write(path: Path) -> None:
    """Everything, with one thread."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    record = Record()
    data = third_party_images()
    parts: dict[str, Callable[[], None]] = {
        "pipelines": lambda: record_pipelines(record, data),
        "exports": lambda: record_exports(record),
        "confidence": lambda: record_confidence(record),
        "integrators": lambda: record_integrators(record),
        "blocks": lambda: record_blocks(record),
        "gradients": lambda: record_gradients(record),
        "calibrations": lambda: record_calibrations(record, data),
        "diagnoses": lambda: record_diagnoses(record),
        "stream": lambda: record_stream(record),
        "poses": lambda: record_poses(record),
    }
    library = list(Path(vts.__file__).parent.rglob("libtorchvts.so"))
    if not library:
        raise SystemExit(f"{Path(vts.__file__).parent}: no compiled kernels: install the package, or build them first")
    for name, part in parts.items():
        print(f"{name} ...", file=sys.stderr, flush=True)
        part()
    record.save(path)
    print(f"{path}: {len(record.tensors)} tensors, {len(record.texts)} texts", file=sys.stderr)


# ---------------------------------------------------------------- comparison


class Cell(NamedTuple):
    """One entry of a table, and whether it is within the tolerance."""

    text: str
    within: bool


def difference(old: Tensor, new: Tensor) -> Cell:
    if old.shape != new.shape or old.dtype != new.dtype:
        return Cell(f"{tuple(old.shape)} {old.dtype} -> {tuple(new.shape)} {new.dtype}", False)
    if torch.equal(old, new) or old.numpy().tobytes() == new.numpy().tobytes():
        return Cell("equal", True)
    if old.dtype == torch.bool:
        return Cell(f"{int((old != new).sum())} pixels", False)
    largest = float((old.double() - new.double()).abs().nan_to_num(torch.inf).max())
    relative = largest / max(float(old.double().abs().nan_to_num(0.0).max()), 1e-300)
    return Cell(f"{largest:.1e} ({relative:.1e})", relative <= TOLERANCE)


def load(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors, in the order in which they were recorded, and texts."""
    with safe_open(str(path), "pt") as file:
        texts, order = (json.loads(file.metadata()[key]) for key in ("texts", "sha256"))
    tensors = load_file(path)
    return {key: tensors[key] for key in order}, texts


def compare(old_path: Path, new_path: Path) -> int:
    """Print the tables; 0 if everything is within the tolerance."""
    (old, old_texts), (new, new_texts) = load(old_path), load(new_path)
    cells: dict[str, Cell] = {}
    for key in {**old, **new}:
        present = [key in tensors for tensors in (old, new)]
        cells[key] = difference(old[key], new[key]) if all(present) else Cell("only in the new" if present[1] else "missing", False)
    for key in {**old_texts, **new_texts}:
        before, after = old_texts.get(key, "nothing"), new_texts.get(key, "nothing")
        cells[key] = Cell("equal", True) if before == after else Cell(f"{before!r} -> {after!r}", False)
    tables: dict[str, dict[str, dict[str, Cell]]] = {}
    for key, cell in cells.items():
        section, row, column = key.split("/")
        tables.setdefault(section, {}).setdefault(row, {})[column] = cell
    for section, rows in tables.items():
        columns = list(dict.fromkeys(column for row in rows.values() for column in row))
        print(f"\n**{section}**\n\n| | {' | '.join(columns)} |\n|---{'|---' * len(columns)}|")
        for row, values in rows.items():
            print(f"| {row} | {' | '.join(marked(values.get(column)) for column in columns)} |")
    beyond = [key for key, cell in cells.items() if not cell.within]
    print_rounding(beyond, old)
    equal = sum(cell.text == "equal" for cell in cells.values())
    print(f"\n{len(cells)} entries: {equal} equal, {len(cells) - equal - len(beyond)} within {TOLERANCE:g}, {len(beyond)} beyond")
    return 1 if beyond else 0


def print_rounding(beyond: Sequence[str], old: dict[str, Tensor]) -> None:
    """For what is beyond the tolerance: how far the old commit itself is from its result in float64, where there is one."""
    lines = []
    for key in beyond:
        section, row, column = key.split("/")
        unit = ", ".join(part for part in row.split(", ") if part not in ("compiled", "reference", "TorchScript"))
        exact = old.get(f"{section}/{unit}, float64/{column}")
        if exact is not None and key in old and exact.dtype == torch.float64:
            lines.append(f"| {row} | {column} | {difference(exact, old[key].double()).text} |")
    if lines:
        print("\n**Beyond the tolerance: rounding of the old commit, float32 against float64**\n\n| | | |\n|---|---|---|")
        print("\n".join(lines))


def marked(cell: Cell | None) -> str:
    if cell is None:
        return ""
    return cell.text if cell.within else f"**{cell.text}**"


# ---------------------------------------------------------------- another commit


BUILD = """
import sys, types
from pathlib import Path
interface = types.ModuleType("hatchling.builders.hooks.plugin.interface")
interface.BuildHookInterface = object
sys.modules[interface.__name__] = interface
import hatch_build
hook = next(value for value in vars(hatch_build).values() if isinstance(value, type) and hasattr(value, "initialize"))()
hook.root = str(Path.cwd())
hook.app = types.SimpleNamespace(display_warning=sys.exit)
hook.initialize("standard", {})
"""
"""Runs a checkout's own build hook, without hatchling."""


@contextlib.contextmanager
def checkout(commit: str) -> Iterator[Path]:
    """A temporary worktree of a commit, with its compiled kernels."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "torchvts"
        subprocess.run(["git", "-C", ROOT, "worktree", "add", "--quiet", "--detach", place, commit], check=True)
        try:
            build(place)
            yield place
        finally:
            subprocess.run(["git", "-C", ROOT, "worktree", "remove", "--force", place], check=True)


def build(place: Path) -> None:
    subprocess.run([sys.executable, "-c", BUILD], cwd=place, env=os.environ | {"PYTHONPATH": str(place)}, check=True)


def third_party_images() -> Path | None:
    for folder in (os.environ.get("TORCHVTS_DATA"), ROOT.parent / "shared" / "data"):
        if folder and (Path(folder) / "gelsight_mini_a").is_dir():
            return Path(folder)
    return None


def write_in(place: Path, path: Path) -> None:
    """Run :func:`write` on the torchvts of a checkout."""
    data = third_party_images()
    settings = {"PYTHONPATH": str(place), "OMP_NUM_THREADS": "1", "TORCHVTS_DATA": "" if data is None else str(data)}
    print(f"{place}:", file=sys.stderr)
    subprocess.run([sys.executable, __file__, "write", path], cwd=place, env=os.environ | settings, check=True)


def against(commit: str, keep: Path | None) -> int:
    with tempfile.TemporaryDirectory() as scratch, checkout(commit) as place:
        folder = Path(scratch) if keep is None else keep
        folder.mkdir(parents=True, exist_ok=True)
        old, new = folder / "old.safetensors", folder / "new.safetensors"
        write_in(place, old)
        build(ROOT)
        write_in(ROOT, new)
        return compare(old, new)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("write", help="write all outputs of the torchvts that Python finds")
    one.add_argument("path", type=Path)
    two = commands.add_parser("compare", help="compare two files of outputs")
    two.add_argument("old", type=Path)
    two.add_argument("new", type=Path)
    three = commands.add_parser("against", help="compare this checkout with a commit")
    three.add_argument("commit")
    three.add_argument("--keep", type=Path, help="folder to keep both files of outputs in")
    arguments = parser.parse_args(argv)
    if arguments.command == "compare":
        return compare(arguments.old, arguments.new)
    if arguments.command == "against":
        return against(arguments.commit, arguments.keep)
    write(arguments.path)
    return 0


if __name__ == "__main__":
    if "write" in sys.argv[1:2]:
        import torchvts as vts

        names = Names()
    sys.exit(main())
