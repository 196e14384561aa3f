"""Every public function refuses bad input with a message of one form: `argument: expected ..., got ...: cause`.

TABLE holds for every public callable one call that is accepted, and for each of its arguments values that are refused. A new public
name or a new argument without an entry fails the last two tests. Messages about files have another form: they begin with the name
of the file, and say what is wrong with it (`FILE_FORMS`).
"""

import functools
import importlib
import inspect
import re
import types
import typing
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import ring_lights

import torchvts as vts
import torchvts.export
from torchvts.core.geometry import gradient_from_normal, normal_from_gradient
from torchvts.evaluation import metrics
from torchvts.integration import DiscontinuityIntegration, PerspectiveIntegration
from torchvts.model import FillMarkers
from torchvts.model.response_field import ResponseModel
from torchvts.pipeline import Confidence

HEIGHT, WIDTH, PITCH = 24, 32, 1.25
NAN, INF = float("nan"), float("inf")
ROOMS = ("calibration", "diagnose", "integration", "model", "normals", "pipeline", "pose", "training")
"""Rooms whose names are in the table without a prefix, as the names of torchvts itself are."""
MODULES = {
    "gs_sdk.": vts.gs_sdk,
    "export.": torchvts.export,
    "stream.": vts.stream,
    "objects.": vts.scenes.objects,
    "scenes.": vts.scenes,
    "metrics.": metrics,
}
RECORDS = {
    "Bounds", "Calibration", "CalibrationWarning", "ConfidentOutput", "DepthOutput", "Diagnosis", "Diagnosis.of",
    "DiscontinuitySolution", "Finding", "LightFit", "MlpFit", "Registration", "export.ExportCheck", "export.Format",
    "gs_sdk.GsSdkFolder", "gs_sdk.GsSdkPress", "metrics.DepthError", "metrics.SphereFit", "objects.Target", "scenes.Scene",
    "stream.Reader", "stream.TactileFrame",
}  # fmt: skip
"""Results that users get and do not make: their constructors keep what they are given. (Their methods are in the table.)"""
PARTS = {
    "Adaptive", "Integrator", "NormalModel", "Once", "Repeat", "ResponseField", "ResponseModel", "SensorPrior", "Shadows", "Solve",
    "WrappedIntegrator", "WrappedNormals", "as_integrator", "as_normal_model", "check_calibration", "check_sensor",
    "discontinuity_share", "label_contacts", "read_point_cloud", "write_point_cloud", "stream.NewestFrame", "stream.Overlay",
    "stream.StageClock", "stream.StreamReport.", "stream.VideoFile.", "stream.Window",
}  # fmt: skip
"""Names, and with a dot at the end methods, that other tests cover: records, base classes, parts of the pipeline and the stream."""
FREE = {"dtype", "seed", "report", "comment", "clock", "sleep"}
"""Arguments that Python or torch itself checks; switches (bool) are free too."""
FILE_FORMS = (
    r"(no such|key '.*': (unknown|missing)|not an? |folder .* does not exist|expected .*, got |a safetensors file, but not)"
)
"""What a message says about a file after its name."""


def lights():
    return ring_lights(31.0, 40.0)


def sensor():
    return vts.Sensor("rig", HEIGHT, WIDTH, PITCH)


def scene():
    return vts.scenes.sphere_press(10.0, 1.0, (0, 0), HEIGHT, WIDTH, PITCH)


def image():
    return vts.scenes.render(vts.scenes.undeformed(scene()), lights())[0]


def fields(deep=False):
    family = vts.calibration.field.Family(0, -1, deep, 20.0)
    return family.field(torch.linspace(-0.2, 0.3, family.size(), dtype=torch.float64))


def unit(by="lights"):
    if by == "lights":
        return vts.Calibration.from_lights(lights(), sensor(), image())
    return vts.Calibration.from_response(ResponseModel(fields(), fields(True)), sensor(), image())


def pipe(mode="fast"):
    return vts.DepthPipeline.from_calibration(unit(), mode)


def lookup():
    slope = torch.randn(100, 2, generator=torch.Generator().manual_seed(1))
    return vts.NormalFromLookup.fit(image(), slope @ torch.ones(2, 3) * 0.1, slope, bins=4)


def network():
    return vts.NormalFromMLP(HEIGHT, WIDTH, image())


def frame():
    """A deep press with enough pixels for a pose."""
    return vts.scenes.sphere_press(10.0, 2.0, (0, 0), 60, 80, 0.4)


def cloud():
    return torch.rand(50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


# values that a kind of argument does not take
NUMBER = ["1", None, True, NAN, INF, 0, -1.0, [1.0]]
INTEGER = ["8", None, True, 8.5, 0, -3]
SENSOR = ["gelsight_mini", None, Path("rig.yaml")]
MISSING = [Path("no/such/file.safetensors")]
OTHERS = ["unit.safetensors", None, 3]


def batches(channels, height=HEIGHT, width=WIDTH):
    """Values that are no (B, channels, H, W) batch of floats."""
    good = torch.full((2, channels, height, width), 0.5)
    return [
        good[0], good[:, :0], torch.cat((good, good), 1), good.permute(0, 2, 3, 1), good.to(torch.uint8), good.bool(),
        good.numpy(), (255 * good[0].permute(1, 2, 0)).numpy().astype(np.uint8), good.tolist(), None, "image.png",
    ]  # fmt: skip


def images(height=HEIGHT, width=WIDTH):
    """Values that are no (3, H, W) image in [0, 1]."""
    good = torch.full((3, height, width), 0.5)
    return [
        good[None], good[:1], good[0], good[:, :0], good[:, :-1], good.permute(1, 2, 0), (255 * good).to(torch.uint8),
        255 * good, good - 1.0, good + NAN, good + INF, good.numpy(), (255 * good).permute(1, 2, 0).numpy().astype(np.uint8),
        None, "image.png",
    ]  # fmt: skip


def of_other_size(frame):
    """Whether it is a valid image of a size that diagnose accepts: another size is a finding."""
    return isinstance(frame, torch.Tensor) and tuple(frame.shape) in {(1, 3, HEIGHT, WIDTH), (3, HEIGHT - 1, WIDTH)}


PRESS = vts.Press(torch.full((3, HEIGHT, WIDTH), 0.5), 6.0)


@dataclass
class Entry:
    """A call that is accepted, and for each argument what is refused; ``call`` makes the callable, its own name if None."""

    good: dict[str, Any]
    bad: dict[str, list[Any]]
    call: Any = None
    named: dict[str, str] = field(default_factory=dict)  # arguments that messages call by another name
    label: tuple[str, ...] = ()  # arguments that only name things in messages
    file: tuple[str, ...] = ()  # arguments that are files
    run: bool = True  # whether the accepted call is made: not where it would open a camera or take minutes


def forward(make, channels, argument, size=(HEIGHT, WIDTH)):
    return Entry({argument: torch.full((1, channels, *size), 0.5)}, {argument: batches(channels, *size)}, make)


def shaped(**more):
    """Arguments that all presses of scenes share."""
    return {"height": INTEGER, "width": INTEGER, "mm_per_pixel": NUMBER, **more}


HEIGHTS = ["1", None, True, NAN, 0, -1.0, [1.0]]  # of a camera; infinite is one
SIZE = {"height": HEIGHT, "width": WIDTH, "mm_per_pixel": PITCH}
CENTER = [(1.0,), None, "00", (0.0, NAN), 3.0]
DEPTH = torch.zeros(1, 1, HEIGHT, WIDTH)
BAD_DEPTH = [torch.zeros(2, 1, 8, 8), torch.zeros(4), np.zeros((8, 8)), None, [[0.0]], torch.zeros(8, 8, dtype=torch.int64)]
MAP = np.zeros((4, 4))
BAD_MAP = [np.zeros((1, 4, 4)), np.zeros((4, 4), np.uint8), None, "map.npy", [[0.0]]]
FLAT = torch.full((3, HEIGHT, WIDTH), 0.5)
BAD_FLAT = [FLAT[None], FLAT[0], FLAT.permute(1, 2, 0), (255 * FLAT).to(torch.uint8), FLAT + NAN, FLAT.numpy(), None]
POSITION = [[20.0, 0.0, 30.0], [-10.0, 17.0, 30.0], [-10.0, -17.0, 30.0]]
BAD_POSITION = [[[0, 0, 1]], "lights", None, [[20.0, 0.0, -30.0]] * 3, [[20.0, 0.0, NAN]] * 3]
BAD_POINTS = [torch.zeros(50), torch.zeros(50, 2), torch.zeros(0, 3), torch.zeros(50, 3), cloud() + NAN, cloud().numpy(), None]
EYE = torch.eye(4, dtype=torch.float64)
BAD_POSE = [EYE[:3], 2 * EYE, EYE + NAN, np.eye(4), "pose"]

UP = torch.tensor([0.0, 0.0, 1.0]).reshape(1, 3, 1, 1).expand(1, 3, HEIGHT, WIDTH)
GRADIENT = torch.zeros(1, 2, 8, 8)
BAD_GRADIENT = [*batches(2), torch.zeros(1, 2, 1, 8)]
BAD_MASKS = [torch.zeros(1, 1, 4, 4) > 0, torch.zeros(1, 1, 8, 8), torch.zeros(8, 8) > 0, "all", np.zeros((1, 1, 8, 8), bool)]
BAD_WEIGHTS = [torch.ones(1, 1, 4, 4), torch.ones(8, 8), torch.ones(1, 1, 8, 8).bool(), "all", np.ones((1, 1, 8, 8))]
KNOWN = {name: torch.ones(1, 1, 8, 8) for name in ("known_mm", "known_weight")}
BAD_KNOWN = {
    "known_mm": [*BAD_WEIGHTS, KNOWN["known_mm"] + NAN],
    "known_weight": [*BAD_WEIGHTS, KNOWN["known_weight"] - 2.0, KNOWN["known_weight"] + INF],
}

TABLE = {
    "Calibration.from_lights": Entry(
        {"lights": lights(), "sensor": sensor(), "background": image(), "ambient": torch.zeros(3)},
        {
            "lights": [POSITION, None, "lights"],
            "sensor": SENSOR,
            "background": images()[:-2] + ["image.png"],
            "ambient": [torch.zeros(2), torch.full((3,), -1.0), torch.full((3,), NAN), [0.0, 0.0, 0.0], 0.1],
        },
    ),
    "Calibration.from_response": Entry(
        {"response": ResponseModel(fields(), None), "sensor": sensor(), "background": image()},
        {"response": [None, fields(), "prior"], "sensor": SENSOR, "background": images()},
    ),
    "Calibration.load": Entry({"path": ...}, {"path": [*MISSING, ".", 3, None]}, file=("path",), run=False),
    "Calibration.save": Entry({"path": ...}, {"path": [*MISSING, ".", 3, None]}, lambda: unit().save, file=("path",), run=False),
    "Compensate": Entry(
        {
            "gain": FLAT,
            "offset": FLAT,
            "gamma": 2.2,
            "defects": FLAT[0] > 1,
            "blur_px": 1.0,
            "markers": FillMarkers(),
            "drift": None,
            "saturated_model": FLAT,
            "saturation_light": 0.99,
        },
        {
            "drift": [True, "mode", torch.nn.Identity()],
            "saturated_model": BAD_FLAT[:-1],
            "saturation_light": NUMBER,
            "gain": BAD_FLAT[:-1],
            "offset": BAD_FLAT[:-1],
            "gamma": NUMBER,
            "defects": [FLAT[0], FLAT > 1, torch.ones(HEIGHT, WIDTH, dtype=torch.bool), (FLAT[0] > 1).numpy(), "none"],
            "blur_px": ["1", None, NAN, INF, -1.0],
            "markers": [True, 9.0, "markers"],
        },
    ),
    "Compensate.from_calibration": Entry({"calibration": unit()}, {"calibration": OTHERS}),
    "Compensate.forward": forward(lambda: vts.Compensate.from_calibration(unit()), 3, "image"),
    "ContactMask": Entry(
        {"flat": FLAT, "noise_std": torch.full((3,), 0.01), "sigmas": 4.5, "min_size_px": 8.0},
        {
            "flat": BAD_FLAT,
            "noise_std": [torch.zeros(2), FLAT[:, 1:], torch.full((3,), NAN), 0.01, None, np.zeros(3)],
            "sigmas": NUMBER,
            "min_size_px": NUMBER,
        },
    ),
    "ContactMask.from_calibration": Entry({"calibration": unit()}, {"calibration": OTHERS}),
    "ContactMask.forward": forward(lambda: pipe().contact, 3, "compensated"),
    "ContactMask.shadowed": forward(lambda: pipe().contact.shadowed, 3, "compensated"),
    "ContactMask.soft": forward(lambda: pipe().contact.soft, 3, "compensated"),
    "DepthPipeline": Entry(
        {
            **{name: getattr(pipe(), name) for name in ("compensate", "contact", "normals", "gradient", "integrate")},
            "mode": "fast",
            "mm_per_pixel": 1.0,
            "tolerance_px": 0.002,
            "refine_threshold_px": 0.05,
            "max_passes": 8,
        },
        {
            **{name: [None, lambda x: x] for name in ("compensate", "contact", "normals", "gradient", "integrate")},
            "mm_per_pixel": NUMBER,
            "mode": ["slow", None, 1],
            "tolerance_px": NUMBER,
            "refine_threshold_px": ["1", None, NAN, -1.0],
            "max_passes": INTEGER,
        },
    ),
    "DepthPipeline.from_calibration": Entry(
        {"calibration": unit(), "mode": "fast", "normals": None, "integrate": None},
        {"calibration": OTHERS, "mode": ["slow", None, 1], "normals": ["lookup", 3], "integrate": ["dct", 3]},
    ),
    "DepthPipeline.forward": Entry(
        {"images": image()[None]},
        {"images": [*batches(3), 255 * image()[None], image()[None] + NAN, image()[None] - 1.0]},
        lambda: pipe(),
    ),
    "FillMarkers": Entry(
        {"diameter_px": 9.0, "contrast": 0.06, "sigmas": 5.0, "margin": 0.2},
        {"diameter_px": ["9", None, NAN, -1], "contrast": NUMBER, "sigmas": NUMBER, "margin": NUMBER},
    ),
    "FillMarkers.from_background": Entry(
        {"background": torch.full((3, 64, 64), 0.5), "contrast": 0.06, "least_markers": 8, "margin": 0.2},
        {
            "background": [b for b in images(64, 64) if not (isinstance(b, torch.Tensor) and tuple(b.shape) == (3, 63, 64))],
            "contrast": NUMBER,
            "least_markers": INTEGER,
            "margin": NUMBER,
        },
    ),
    "FillMarkers.from_dict": Entry(
        {"values": FillMarkers().to_dict(), "source": "file"},
        {"values": [None, [], {"unknown": 1.0}, {"contrast": -1}]},
        label=("source",),
        named={"values": "file"},
        file=("values",),
    ),
    "FillMarkers.forward": forward(lambda: FillMarkers(), 3, "image"),
    "GradientFromNormal": Entry({"max_slope": 10.0}, {"max_slope": NUMBER}),
    "GradientFromNormal.forward": forward(lambda: vts.GradientFromNormal(), 3, "normal"),
    "NormalFromIntensity": Entry(
        {"lights": lights(), **SIZE, "noise_std": torch.full((3,), 0.01), "inverse": unit().inverse, "saturated_above": FLAT},
        {
            "lights": [POSITION, None],
            **shaped(),
            "noise_std": [torch.zeros(2), torch.full((3,), NAN), 0.01],
            "inverse": [unit().inverse[None], "inverse"],
            "camera_height_mm": HEIGHTS,
            "saturated_above": [FLAT[None], FLAT[:, 1:], "full"],
        },
    ),
    "NormalFromIntensity.from_calibration": Entry(
        {"calibration": unit(), "camera_height_mm": 30.0},
        {"calibration": [*OTHERS, unit("response")], "camera_height_mm": HEIGHTS},
    ),
    "NormalFromIntensity.forward": Entry(
        {"image": FLAT[None], "depth_mm": DEPTH, "window": (0, 0)},
        {"image": batches(3), "depth_mm": [b for b in batches(1) if b is not None], "window": [(20, 20), (-1, 0)]},
        lambda: pipe().normals,
        named={"image": "compensated", "window": "compensated, window"},
    ),
    "NormalFromIntensity.solve": Entry(
        {"image": FLAT[None], "depth_mm": None, "window": (0, 0), "expected": torch.zeros(1, 2, HEIGHT, WIDTH)},
        {
            "image": batches(3),
            "depth_mm": [b for b in batches(1) if b is not None],
            "window": [(20, 20), (-1, 0)],
            "expected": [b for b in batches(2) if b is not None],
        },
        lambda: pipe().normals.solve,
        named={"image": "compensated", "window": "compensated, window"},
    ),
    "NormalFromIntensity.coarse": Entry({"stride": 8}, {"stride": INTEGER}, lambda: pipe().normals.coarse),
    "NormalFromLookup": Entry(
        {"flat": FLAT, "table": torch.zeros(4, 4, 4, 2), "step": torch.ones(3), "zero_index": torch.ones(3, dtype=torch.int64)},
        {
            "flat": BAD_FLAT,
            "table": [torch.zeros(4, 4, 2), torch.full((4, 4, 4, 2), NAN), None, np.zeros((4, 4, 4, 2))],
            "step": [torch.ones(2), torch.zeros(3), torch.full((3,), NAN), None, 1.0],
            "zero_index": [torch.ones(2), torch.full((3,), 9), None, 1],
        },
    ),
    "NormalFromLookup.fit": Entry(
        {"flat": FLAT, "change": 0.1 * torch.randn(50, 3), "slope": torch.randn(50, 2), "bins": 4, "smoothing": 1.0},
        {
            "flat": BAD_FLAT,
            "change": [
                torch.zeros(50, 2),
                torch.zeros(0, 3),
                torch.zeros(50, 3),
                torch.full((50, 3), NAN),
                None,
                np.zeros((50, 3)),
            ],
            "slope": [torch.zeros(49, 2), torch.full((50, 2), INF), torch.zeros(50, 2, dtype=torch.int64), None],
            "bins": [2, 500, 4.5, "4"],
            "smoothing": [-1.0, NAN, 99.0, "1"],
        },
    ),
    "NormalFromLookup.load": Entry({"path": ...}, {"path": [*MISSING, "."]}, file=("path",), run=False),
    "NormalFromLookup.save": Entry({"path": ...}, {"path": [*MISSING, "."]}, lambda: lookup().save, file=("path",), run=False),
    "NormalFromLookup.forward": forward(lookup, 3, "compensated"),
    "NormalFromMLP": Entry(
        {"height": HEIGHT, "width": WIDTH, "flat": FLAT, "hidden": (4,), "output": "angle"},
        {"height": INTEGER, "width": INTEGER, "flat": images(), "hidden": [(), (0,), ("4",)], "output": ["slope", None]},
    ),
    "NormalFromMLP.load": Entry(
        {"path": ..., "flat": None, "output": None},
        {"path": [Path("no/such/nnmodel.pth"), "."], "flat": [], "output": []},
        file=("path",),
        run=False,
    ),
    "NormalFromMLP.save": Entry(
        {"path": ...}, {"path": [*MISSING, "weights.pth"]}, lambda: network().save, file=("path",), run=False
    ),
    "NormalFromMLP.set_flat": Entry({"flat": FLAT}, {"flat": images()}, lambda: network().set_flat),
    "NormalFromMLP.check_flat": Entry({"flat": FLAT}, {"flat": images()}, lambda: network().check_flat),
    "NormalFromMLP.gradient_px": forward(lambda: network().gradient_px, 3, "image"),
    "NormalFromMLP.forward": forward(network, 3, "compensated"),
    "NormalFromResponse": Entry(
        {"fast": fields(), "precise": fields(True), **SIZE, "max_slope": 3.0},
        {"fast": [None, "field", fields(True)], "precise": ["field", fields()], **shaped(max_slope=NUMBER)},
    ),
    "NormalFromResponse.from_calibration": Entry({"calibration": unit("response")}, {"calibration": [*OTHERS, unit()]}),
    "NormalFromResponse.forward": Entry(
        {"image": FLAT[None], "depth_mm": DEPTH, "window": (0, 0)},
        {"image": batches(3), "depth_mm": [b for b in batches(1) if b is not None], "window": [(20, 20), (-1, 0)]},
        lambda: vts.NormalFromResponse.from_calibration(unit("response")),
        named={"image": "compensated", "window": "compensated, window"},
    ),
    "NormalFromResponse.coarse": Entry(
        {"stride": 8}, {"stride": INTEGER}, lambda: vts.NormalFromResponse.from_calibration(unit("response")).coarse
    ),
    "PointLights": Entry(
        {"position_mm": POSITION, "albedo": [900.0] * 3, "gloss": [0.1] * 3},
        {
            "position_mm": BAD_POSITION,
            "albedo": [[900.0] * 2, [0.0] * 3, [NAN] * 3, None, "bright"],
            "gloss": [[0.1] * 2, [-0.1] * 3, [NAN] * 3, "satin"],
        },
    ),
    "PointLights.forward": Entry(
        {"depth_mm": DEPTH, "normal": torch.zeros(1, 3, HEIGHT, WIDTH), "mm_per_pixel": 1.0},
        {
            "depth_mm": batches(1),
            "normal": [*batches(3), torch.zeros(1, 3, 8, 8)],
            "mm_per_pixel": NUMBER,
            "camera_height_mm": HEIGHTS,
        },
        lights,
    ),
    **{name: Entry({"mm_per_pixel": 1.0}, {"mm_per_pixel": NUMBER}) for name in ("PoissonDCT", "PoissonDST", "PoissonBackground")},
    "AdaptiveIntegration": Entry({"mm_per_pixel": 1.0, "share": 0.1}, {"mm_per_pixel": NUMBER, "share": [*NUMBER, 2.0]}),
    "DiscontinuityIntegration": Entry(
        {"mm_per_pixel": 1.0, "slope_std": 0.05},
        {
            **dict.fromkeys(("mm_per_pixel", "slope_std", "threshold", "residual", "tolerance_px"), NUMBER),
            "rim_weight": [*NUMBER, 2.0],
            "max_passes": INTEGER,
            "max_iterations": INTEGER,
        },
    ),
    "DiscontinuityIntegration.solve": Entry(
        {"gradient": GRADIENT, "contact": GRADIENT[:, :1] > 0, "weight": torch.ones(1, 1, 8, 8), **KNOWN},
        {"gradient": BAD_GRADIENT, "contact": BAD_MASKS, "weight": BAD_WEIGHTS, **BAD_KNOWN},
        lambda: DiscontinuityIntegration().solve,
        named={"known_mm": "known_mm", "known_weight": "known_weight|known_mm, known_weight"},
    ),
    "PerspectiveIntegration": Entry(
        {"mm_per_pixel": 1.0, "camera_height_mm": 30.0, "integrate": vts.PoissonBackground()},
        {"mm_per_pixel": NUMBER, "camera_height_mm": NUMBER, "integrate": ["dct", 3]},
    ),
    "PerspectiveIntegration.forward": Entry(
        {"gradient": GRADIENT, "window": (0, 0), "size": (16, 16)},
        {"gradient": BAD_GRADIENT, "window": [(9, 0), (-1, 0)], "size": [(4, 4)]},
        lambda: PerspectiveIntegration(1.0, 30.0),
        named={"window": "gradient, window", "size": "gradient, window"},
    ),
    "Confidence": Entry(
        {
            "normals": pipe().normals,
            "noise_std": 0.01 * FLAT,
            "image_noise_std": torch.full((3,), 0.01),
            "light_std": 0.01 * FLAT,
            "mm_per_pixel": 1.0,
        },
        {
            "normals": ["lights", None],
            "noise_std": BAD_FLAT,
            "image_noise_std": [torch.zeros(2), None, 0.01],
            "light_std": [FLAT[None], None, 0.01],
            "mm_per_pixel": NUMBER,
            "model_deg": ["1", None, NAN, -1.0],
            "blur_px": ["1", None, NAN, -1.0],
            "spread": NUMBER,
        },
    ),
    "Confidence.from_calibration": Entry(
        {"calibration": unit(), "normals": pipe().normals}, {"calibration": OTHERS, "normals": ["mine", torch.nn.Identity()]}
    ),
    "Confidence.forward": Entry(
        {
            "images": FLAT[None],
            "compensated": FLAT[None],
            "depth_mm": DEPTH,
            "gradient": torch.zeros(1, 2, HEIGHT, WIDTH),
            "normal": UP,
            "contact": DEPTH > 0,
        },
        {
            **{name: batches(3) for name in ("images", "compensated", "normal")},
            "depth_mm": batches(1),
            "gradient": batches(2),
            "contact": [DEPTH[0] > 0, (DEPTH > 0)[:, :, 1:], None, "all", DEPTH],
        },
        lambda: Confidence.from_calibration(unit()),
    ),
    "ConfidentPipeline": Entry(
        {"pipe": pipe(), "confidence": Confidence.from_calibration(unit())},
        {"pipe": ["fast", None, unit()], "confidence": [True, None, unit()]},
    ),
    "ConfidentPipeline.from_calibration": Entry(
        {"calibration": unit(), "mode": "fast"},
        {"calibration": OTHERS, "mode": ["quick", None], "normals": ["mine", torch.nn.Identity()], "integrate": ["mine"]},
    ),
    "ConfidentPipeline.forward": forward(lambda: vts.ConfidentPipeline.from_calibration(unit()), 3, "images"),
    "bound_at": Entry(
        {"bound_95": torch.ones(2), "level": 0.5, "spread": 1.0},
        {"bound_95": [1.0, None, np.ones(2)], "level": [0.0, 1.0, 95, NAN, "0.5", None], "spread": NUMBER},
    ),
    "diagnose": Entry(
        {"background": image(), "image": image(), "calibration": unit()},
        {
            "background": [bad for bad in images() if bad is not None and not of_other_size(bad)],
            "image": [bad for bad in images() if not of_other_size(bad)],
            "calibration": OTHERS,
        },
    ),
    "PoissonDST.forward": Entry(
        {"gradient": GRADIENT, "window": (0, 0), "size": (16, 16)},
        {"gradient": batches(2), "window": [(9, 0), (-1, 0)], "size": [(4, 4)]},
        lambda: vts.PoissonDST(),
        named={"window": "gradient, window", "size": "gradient, window"},
    ),
    **{
        f"{name}.forward": Entry(
            {"gradient": torch.zeros(1, 2, 8, 8), "window": (0, 0), "size": (16, 16)},
            {"gradient": [*batches(2), torch.zeros(1, 2, 1, 8)], "window": [(9, 0), (-1, 0)], "size": [(4, 4)]},
            lambda name=name: callables()[name](),
            named={"window": "gradient, window", "size": "gradient, window"},
        )
        for name in ("PoissonBackground", "PoissonDCT", "AdaptiveIntegration", "DiscontinuityIntegration")
    },
    "Press": Entry(
        {"image": image(), "ball_diameter_mm": 6.0, "center_px": (4.0, 5.0), "contact_radius_px": 3.0},
        {
            "ball_diameter_mm": NUMBER,
            "center_px": [(1.0,), "here", (NAN, 0.0)],
            "contact_radius_px": ["3", 0, -1.0, NAN],
        },
        label=("name", "image"),  # calibrate checks the image: it knows the sensor's size
    ),
    "Touch": Entry(
        {"image": image(), "depth_mm": 1.0},
        {"depth_mm": ["1", 0, -1.0, NAN]},
        label=("name", "image"),  # calibrate checks the image: it knows the sensor's size
    ),
    "Sensor": Entry(
        {
            "name": "rig",
            "height": 24,
            "width": 32,
            "mm_per_pixel": 0.1,
            "gamma": 1.0,
            "blur_px": 0.0,
            "light_position_mm": None,
            "light_azimuth_deg": None,
            "roi_px": None,
            "corners_px": None,
            "markers": False,
            "prior": None,
        },
        {
            "name": ["", None, 3],
            "height": INTEGER,
            "width": INTEGER,
            "mm_per_pixel": [*NUMBER, 11.0],
            "gamma": ["2", 0, NAN, 0.01, 99.0],
            "blur_px": ["1", None, NAN, -1.0, 99.0],
            "light_position_mm": [[[0, 0, 1]], "lights", [[20.0, 0.0, -30.0]] * 3, [[20.0, 0.0, NAN]] * 3],
            "light_azimuth_deg": [(0, 120), (0, 0, 0), (0, 120, 999), "around", (0, 120, NAN)],
            "roi_px": [(1, 2), (0, 0, 1.5, 9), (-1, 0, 9, 9), "all"],
            "corners_px": [((0, 0),), ((0, 0), (0, 1), (1, 1), (1, 0)), "all"],
            "markers": ["yes", 1, None],
            "prior": ["prior", 3],
        },
    ),
    "Sensor.load": Entry(
        {"source": "gelsight_mini", "height": 240, "width": 320},
        {"source": ["no_such_sensor", "no/such.yaml", None, 3], "height": ["240", 100, 0], "width": ["320", 100, 0]},
        named={"width": "(height, )?width"},
        file=("source",),
    ),
    "Sensor.resized": Entry(
        {"height": 48, "width": 64},
        {"height": [*INTEGER, 50], "width": [*INTEGER, 99]},
        lambda: sensor().resized,
        named={"width": "(height, )?width"},
    ),
    "Sensor.rectify": Entry({"frame": image()[None]}, {"frame": [*batches(3), torch.zeros(1, 3, 8, 8)]}, lambda: sensor().rectify),
    "Sensor.from_dict": Entry(
        {"values": sensor().to_dict(), "source": "file"},
        {"values": [None, [], {"unknown": 1.0}, {"name": "rig"}, {**sensor().to_dict(), "height": -1}]},
        label=("source",),
        named={"values": "file"},
        file=("values",),
    ),
    "Sensor.save": Entry(
        {"path": ...}, {"path": [Path("no/such/rig.yaml"), "."]}, lambda: sensor().save, file=("path",), run=False
    ),
    "calibrate": Entry(
        {"background": image(), "sensor": sensor(), "presses": (), "touches": ()},
        {
            "background": [*images(), 0 * image(), torch.full_like(image(), 0.5), torch.ones_like(image())],
            "sensor": SENSOR,
            "presses": [PRESS, [image()], ["press.png"], None, "presses", 3],
            "touches": [image(), [image()[0]], ["touch.png"], None, 3],
        },
    ),
    "contact_cloud": Entry(
        {"frame": frame(), "mm_per_pixel": 0.4, "most": 100},
        {"frame": [None, DEPTH, "frame", vts.scenes.undeformed(frame())], "mm_per_pixel": NUMBER, "most": ["9", 0, 1.5]},
    ),
    "depth_to_points": Entry(
        {"depth_mm": DEPTH, "mm_per_pixel": 1.0, "contact": DEPTH > 0},
        {"depth_mm": BAD_DEPTH[:-1], "mm_per_pixel": NUMBER, "contact": [torch.ones(4, 4), np.ones((HEIGHT, WIDTH)), "all"]},
    ),
    "divergence": Entry({"gradient": torch.zeros(1, 2, 8, 8)}, {"gradient": [*batches(2), torch.zeros(1, 2, 1, 8)]}),
    "fill_markers": Entry(
        {"image": image()[None], "mask": DEPTH > 0, "relaxations": 4},
        {
            "image": [b for k, b in enumerate(batches(3)) if k not in (1, 2, 3)],
            "mask": [DEPTH, DEPTH[0] > 0, torch.ones(1, 1, 4, 4, dtype=torch.bool), (DEPTH > 0).numpy(), None],
            "relaxations": ["4", -1, 1.5],
        },
    ),
    "find_markers": Entry(
        {"image": image()[None], "diameter_px": 5.0, "contrast": 0.06, "sigmas": 5.0, "margin": 0.2},
        {
            "image": [*batches(3), torch.zeros(1, 3, 4, 4)],
            "diameter_px": NUMBER,
            "contrast": NUMBER,
            "sigmas": NUMBER,
            "margin": NUMBER,
        },
    ),
    "fit_lights": Entry(
        {"background": image(), "sensor": sensor(), "start": None, "max_steps": 3, "vignetting": False},
        {
            "background": [*images(), 0 * image(), torch.full_like(image(), 0.5), torch.ones_like(image())],
            "sensor": SENSOR,
            "start": [POSITION, "lights"],
            "max_steps": INTEGER,
            "vignetting": [3, -1, "one", None],
        },
    ),
    "fit_mlp": Entry(
        {
            "intensity": torch.full((9, 3), 0.5),
            "xy": torch.zeros(9, 2),
            "slope": torch.zeros(9, 2),
            "flat": FLAT,
            "groups": torch.arange(9),
            "hidden": (4,),
            "max_epochs": 1,
            "patience": 1,
            "batch_size": 9,
            "held_out": 0.2,
            "weight_decay": 0.2,
        },
        {
            "intensity": [
                torch.zeros(9),
                torch.zeros(0, 3),
                torch.full((9, 3), 255.0),
                torch.full((9, 3), NAN),
                None,
                np.zeros((9, 3)),
                torch.zeros(9, 3, dtype=torch.uint8),
            ],
            "xy": [torch.zeros(8, 2), torch.full((9, 2), NAN), torch.full((9, 2), 999.0), None],
            "slope": [
                torch.zeros(8, 2),
                torch.full((9, 2), NAN),
                torch.full((9, 2), 99.0),
                None,
                torch.zeros(9, 2, dtype=torch.int64),
            ],
            "flat": [b for k, b in enumerate(images()) if k not in (3, 4)],
            "groups": [torch.zeros(8), torch.zeros(9, dtype=torch.int64), None],
            "hidden": [(), (0,), ("4",)],
            "max_epochs": INTEGER,
            "patience": INTEGER,
            "batch_size": INTEGER,
            "held_out": [0.0, 1.0, NAN, "some"],
            "weight_decay": [-1.0, NAN, "some"],
        },
    ),
    "fit_prior": Entry(
        {"background": image(), "sensor": sensor(), "presses": [PRESS], "source": ""},
        {"background": images(), "sensor": SENSOR, "presses": [PRESS, [], [image()], None, "presses"], "source": [None, 3]},
        run=False,
    ),
    "gradient_from_normal": Entry(
        {"normal": torch.ones(1, 3, 8, 8), "max_slope": 10.0}, {"normal": batches(3), "max_slope": NUMBER}
    ),
    "near_field_shading": Entry(
        {"depth_mm": DEPTH, "normal": torch.zeros(1, 3, HEIGHT, WIDTH), "lights": lights(), "mm_per_pixel": 1.0},
        {
            "depth_mm": batches(1),
            "normal": [*batches(3), torch.zeros(1, 3, 8, 8)],
            "lights": [POSITION, None],
            "mm_per_pixel": NUMBER,
            "camera_height_mm": HEIGHTS,
        },
    ),
    "integrate_discontinuities": Entry(
        {"gradient": GRADIENT, "mm_per_pixel": 1.0, "contact": GRADIENT[:, :1] > 0, "weight": torch.ones(1, 1, 8, 8), **KNOWN},
        {"gradient": BAD_GRADIENT, "mm_per_pixel": NUMBER, "contact": BAD_MASKS, "weight": BAD_WEIGHTS, **BAD_KNOWN},
    ),
    "integrate_perspective": Entry(
        {"gradient": GRADIENT, "mm_per_pixel": 1.0, "camera_height_mm": 30.0},
        {"gradient": BAD_GRADIENT, "mm_per_pixel": NUMBER, "camera_height_mm": NUMBER},
    ),
    "normal_from_gradient": forward(lambda: normal_from_gradient, 2, "gradient"),
    **{
        name: Entry(
            {"gradient": torch.zeros(1, 2, 8, 8), "mm_per_pixel": 1.0},
            {"gradient": [*batches(2), torch.zeros(1, 2, 1, 8)], "mm_per_pixel": NUMBER},
        )
        for name in ("poisson_dct", "poisson_dst", "poisson_background")
    },
    "read_image": Entry({"path": ...}, {"path": [Path("no/such.png"), ".", None, 3]}, file=("path",), run=False),
    "read_presses": Entry({"folder": ...}, {"folder": [Path("no/such"), ".", None, 3]}, file=("folder",), run=False),
    "register_depth": Entry(
        {"source": frame(), "target": frame(), "mm_per_pixel": 0.4, "initial": EYE},
        {
            **{name: [None, DEPTH, "frame", vts.scenes.undeformed(frame())] for name in ("source", "target")},
            "mm_per_pixel": NUMBER,
            "initial": BAD_POSE,
        },
    ),
    "register_points": Entry(
        {"source": cloud(), "target": cloud(), "source_normals": None, "target_normals": None, "initial": EYE},
        {
            "source": BAD_POINTS,
            "target": BAD_POINTS,
            "source_normals": [torch.zeros(9, 3), cloud() + NAN, cloud().numpy(), "up"],
            "target_normals": [torch.zeros(9, 3), cloud() + NAN, cloud().numpy(), "up"],
            "initial": BAD_POSE,
        },
    ),
    "write_image": Entry(
        {"path": Path("no/such.png"), "image": image()},
        {
            "path": [Path("no/such.png"), ".", "image.gif", None, 3],
            "image": [
                image()[None],
                image()[:1],
                image().permute(1, 2, 0),
                (255 * image()).to(torch.uint8),
                image().numpy(),
                None,
                image() + NAN,
            ],
        },
        file=("path",),
        run=False,
    ),
    # ---- gs_sdk ----
    "gs_sdk.read_calibration_folder": Entry({"folder": ...}, {"folder": [Path("no/such"), ".", None]}, file=("folder",), run=False),
    "gs_sdk.read_labels": Entry({"folder": ...}, {"folder": [Path("no/such"), ".", None]}, file=("folder",), run=False),
    "gs_sdk.sensor_from_gs_sdk": Entry(
        {"config": {"ppmm": 0.0634, "imgh": 240, "imgw": 320}},
        {
            "config": [
                None,
                3,
                [],
                {},
                {"ppmm": 15.8, "imgh": 240, "imgw": 320},
                {"ppmm": 0.1, "imgh": 1, "imgw": 320},
                {"a": 1},
                "no/such.yaml",
            ]
        },
        file=("config",),
        label=("name",),
    ),
    "gs_sdk.depth_from_height_map": Entry(
        {"height_map_px": MAP, "mm_per_pixel": 1.0}, {"height_map_px": BAD_MAP, "mm_per_pixel": NUMBER}
    ),
    "gs_sdk.height_map_from_depth": Entry(
        {"depth_mm": DEPTH, "mm_per_pixel": 1.0}, {"depth_mm": [*batches(1), torch.zeros(2, 1, 4, 4)], "mm_per_pixel": NUMBER}
    ),
    "gs_sdk.gradient_from_gs_sdk": Entry({"gx": MAP, "gy": MAP}, {"gx": BAD_MAP, "gy": [*BAD_MAP, np.zeros((3, 3))]}),
    "gs_sdk.gradient_to_gs_sdk": Entry({"gradient": torch.zeros(1, 2, 4, 4)}, {"gradient": [*batches(2), torch.zeros(2, 2, 4, 4)]}),
    "gs_sdk.image_from_bgr": Entry(
        {"pixels": np.zeros((4, 4, 3), np.uint8)},
        {"pixels": [np.zeros((3, 4, 4), np.uint8), np.zeros((4, 4), np.uint8), np.zeros((4, 4, 3)), image(), None]},
    ),
    "gs_sdk.image_to_bgr": Entry(
        {"image": image()},
        {
            "image": [
                image()[None],
                image()[:1],
                image().permute(1, 2, 0),
                (255 * image()).to(torch.uint8),
                image() + NAN,
                image().numpy(),
                None,
            ]
        },
    ),
    # ---- metrics ----
    "metrics.depth_error": Entry(
        {"depth_mm": DEPTH, "truth_mm": DEPTH, "mm_per_pixel": 1.0, "region": DEPTH == 0},
        {
            "depth_mm": [DEPTH[0], DEPTH.numpy(), None],
            "truth_mm": [DEPTH.numpy(), None],
            "mm_per_pixel": NUMBER,
            "region": [DEPTH > 0, DEPTH[0] == 0, "all", (DEPTH == 0).numpy()],
        },
    ),
    "metrics.normal_angle_deg": Entry(
        {"normal": torch.ones(1, 3, 4, 4), "truth": torch.ones(1, 3, 4, 4), "region": torch.ones(1, 1, 4, 4, dtype=torch.bool)},
        {"normal": batches(3), "truth": [np.ones((1, 3, 4, 4)), None], "region": [torch.ones(1, 1, 3, 4), "all", np.ones((4, 4))]},
    ),
    "metrics.mask_iou": Entry(
        {"mask": DEPTH > 0, "truth": DEPTH > 0}, {"mask": [DEPTH[0] > 0, None, (DEPTH > 0).numpy()], "truth": [None, [1]]}
    ),
    "metrics.rim_distance_px": Entry(
        {"mask": DEPTH > 0, "truth": DEPTH > 0}, {"mask": [torch.ones(2, 1, 4, 4), None, "m"], "truth": [torch.ones(4), None]}
    ),
    "metrics.fit_sphere": Entry(
        {"depth_mm": frame().depth_mm, "mm_per_pixel": 0.4, "contact": frame().contact, "steps": 3},
        {
            "depth_mm": BAD_DEPTH[:-1],
            "mm_per_pixel": NUMBER,
            "contact": [torch.ones(4, 4), frame().contact & False, None, "all"],
            "steps": ["3", -1, 1.5, None],
        },
    ),
    # ---- scenes ----
    "scenes.surface": Entry(
        {"depth_mm": lambda x, y: 1.0 - x**2 - y**2, **SIZE},
        {
            "depth_mm": [None, torch.zeros(4, 4), lambda x, y: 1.0, lambda x, y: x[0]],
            **shaped(camera_height_mm=HEIGHTS),
        },
    ),
    "scenes.surface_at": Entry(
        {"depth_mm": lambda x, y: 1.0 - x**2 - y**2, "x": torch.rand(8, 8), "y": torch.rand(8, 8), "mm_per_pixel": 1.0},
        {
            "depth_mm": [None, torch.zeros(4, 4), lambda x, y: 1.0, lambda x, y: x[0]],
            "x": [None, np.zeros((8, 8))],
            "y": [None, torch.zeros(4, 8), torch.zeros(1, 8, 8)],
            "mm_per_pixel": NUMBER,
        },
    ),
    "scenes.sphere_press": Entry(
        {"radius_mm": 10.0, "press_mm": 1.0, "center_mm": (0.0, 0.0), **SIZE},
        shaped(radius_mm=NUMBER, press_mm=[*NUMBER, 99.0], center_mm=CENTER, camera_height_mm=HEIGHTS),
    ),
    "scenes.cylinder_press": Entry(
        {"radius_mm": 4.0, "press_mm": 0.5, "length_mm": 9.0, "angle_deg": 25.0, "center_mm": (0.0, 0.0), **SIZE},
        shaped(radius_mm=NUMBER, press_mm=[*NUMBER, 99.0], length_mm=NUMBER, angle_deg=["1", None, NAN], center_mm=CENTER),
    ),
    "scenes.cone_press": Entry(
        {"half_angle_deg": 65.0, "press_mm": 1.0, "tip_radius_mm": 0.5, "center_mm": (0.0, 0.0), **SIZE},
        shaped(half_angle_deg=[*NUMBER, 90.0], press_mm=NUMBER, tip_radius_mm=NUMBER, center_mm=CENTER),
    ),
    "scenes.sine_press": Entry(
        {"amplitude_mm": 0.1, "period_mm": 2.0, "radius_mm": 8.0, **SIZE},
        shaped(amplitude_mm=NUMBER, period_mm=NUMBER, radius_mm=NUMBER),
    ),
    "scenes.punch_press": Entry(
        {"radius_mm": 5.0, "press_mm": 0.6, "tilt_deg": 2.0, "wall_mm": 1.0, **SIZE},
        shaped(radius_mm=NUMBER, press_mm=NUMBER, tilt_deg=["1", None, NAN], wall_mm=NUMBER),
    ),
    "scenes.letters_press": Entry(
        {"text": "VTS", "press_mm": 0.5, "size_mm": 6.0, "stroke_mm": 1.0, "bevel_mm": 0.6, **SIZE},
        shaped(text=["", "a", None, 3], press_mm=NUMBER, size_mm=NUMBER, stroke_mm=NUMBER, bevel_mm=NUMBER),
    ),
    "scenes.render": Entry(
        {
            "scene": scene(),
            "lights": lights(),
            "noise_std": 0.01,
            "bits": 8,
            "gamma": 1.0,
            "vignetting": 0.1,
            "spots": torch.ones(1, 1, HEIGHT, WIDTH),
        },
        {
            "scene": [None, DEPTH, "sphere"],
            "lights": [POSITION, None],
            "noise_std": ["1", None, NAN, -1.0],
            "bits": ["8", 0, 2.5, 99],
            "gamma": NUMBER,
            "vignetting": ["1", None, NAN, -1.0, 2.0],
            "spots": [torch.ones(1, 1, 4, 4), "worn", 30],
        },
    ),
    "scenes.undeformed": Entry({"scene": scene()}, {"scene": [None, DEPTH, "sphere"]}),
    "scenes.skin_spots": Entry(
        {"height": HEIGHT, "width": WIDTH, "spots": 3, "dead_pixels": 3},
        {"height": INTEGER, "width": INTEGER, "spots": ["3", -1, 1.5], "dead_pixels": ["3", -1, 1.5]},
    ),
    "scenes.smooth_step": Entry({"t": torch.zeros(3)}, {"t": [None, "t", np.zeros(3), [0.0]]}),
    "scenes.letter_segments": Entry({"text": "VTS", "size_mm": 6.0}, {"text": ["", "a", None, 3], "size_mm": NUMBER}),
    "scenes.distance_to_segments": Entry(
        {"x": torch.zeros(3), "y": torch.zeros(3), "segments": [((0.0, 0.0), (1.0, 0.0))]},
        {"x": [None, np.zeros(3)], "y": [None, np.zeros(3), torch.zeros(4)], "segments": [None, [], [(0.0, 0.0)], "V"]},
    ),
    # ---- objects ----
    "objects.pose": Entry(
        {"angle_deg": 0.0, "shift_mm": (0.0, 0.0), "press_mm": 0.5, "tilt_deg": (0.0, 0.0)},
        {"angle_deg": ["1", None, NAN], "shift_mm": CENTER, "press_mm": ["1", None, NAN], "tilt_deg": CENTER},
    ),
    "objects.press": Entry(
        {"height_mm": vts.scenes.objects.sphere(), "T_sensor_object": vts.scenes.objects.pose(), **SIZE, "fillet_mm": 0.02},
        {
            "height_mm": [None, "stamp", DEPTH],
            "T_sensor_object": [*BAD_POSE, vts.scenes.objects.pose(tilt_deg=(60.0, 0.0))],
            **shaped(fillet_mm=NUMBER),
        },
    ),
    "objects.bottle_cap": Entry({"ribs": 18}, {"ribs": INTEGER}),
    "objects.stamp": Entry({"text": "VTS", "size_mm": 4.2}, {"text": ["", "a", None], "size_mm": NUMBER}),
    "objects.bolt_head": Entry({"across_flats_mm": 9.0}, {"across_flats_mm": NUMBER}),
    "objects.gear": Entry({"teeth": 12}, {"teeth": INTEGER}),
    "objects.textured_patch": Entry({"bumps": 60, "radius_mm": 5.5}, {"bumps": INTEGER, "radius_mm": NUMBER}),
    "objects.sphere": Entry({"radius_mm": 10.0}, {"radius_mm": NUMBER}),
    "objects.cylinder": Entry({"radius_mm": 6.0}, {"radius_mm": NUMBER}),
    # ---- export ----
    "export.PoissonBackgroundByMatrix": Entry(SIZE, shaped()),
    "export.PoissonBackgroundByMatrix.forward": Entry(
        {"gradient": torch.zeros(1, 2, HEIGHT, WIDTH), "window": (0, 0), "size": (HEIGHT, WIDTH)},
        {"gradient": batches(2), "window": [(9, 0), (-1, 0)], "size": [(4, 4)]},
        lambda: torchvts.export.PoissonBackgroundByMatrix(HEIGHT, WIDTH, 1.0),
        named={"window": "gradient, window", "size": "gradient, window"},
    ),
    "export.describe": Entry({"pipe": pipe()}, {"pipe": [None, unit(), "pipeline.pt"]}),
    **{
        f"export.{name}": Entry(
            {"pipe": pipe(), "path": ...},
            {"pipe": [None, unit(), "pipeline.pt"], "path": [Path("no/such.pt2"), "."]},
            file=("path",),
            run=False,
        )
        for name in ("export_torchscript", "export_program", "export_aoti", "export_onnx")
    },
    "export.missing": Entry({"name": "pt2"}, {"name": ["pdf", None]}, named={"name": "format"}),
    "export.sample_frames": Entry({"calibration": unit()}, {"calibration": OTHERS}),
    "export.export_checked": Entry(
        {"pipe": pipe(), "folder": ..., "formats": ["pt2"], "images": image()[None]},
        {
            "pipe": [None, unit()],
            "folder": [None, 3],
            "formats": [["pdf"], "pt2", None],
            "images": [None, image(), image().numpy()],
        },
        named={"formats": "format"},
        run=False,
    ),
    "export.compare": Entry(
        {"path": ..., "pipe": pipe(), "images": image()[None], "name": "pt2"},
        {"path": [Path("no/such.pt2"), "."], "pipe": [None, unit()], "images": [None, image()], "name": ["pdf", None]},
        file=("path",),
        named={"name": "format"},
        run=False,
    ),
    "export.run_bare": Entry(
        {"path": ..., "images": image()[None], "name": "pt2", "batches": [1]},
        {"path": [Path("no/such.pt2"), "."], "images": [None, image()], "name": ["pdf", None], "batches": [[0], ["1"], None]},
        file=("path",),
        named={"name": "format"},
        run=False,
    ),
    # ---- stream ----
    "stream.FollowLight": Entry(
        {"background": image(), "time_constant_s": 1.0},
        {"background": [b for k, b in enumerate(images()) if k not in (4,)], "time_constant_s": NUMBER},
    ),
    **{
        f"stream.FollowLight.{name}": Entry(
            {"image": image()[None]},
            {"image": batches(3)},
            lambda name=name: getattr(vts.stream.FollowLight(image()), name),
        )
        for name in ("correct", "set_background", "start")
    },
    "stream.FollowLight.update": Entry(
        {"image": image()[None], "contact": DEPTH > 0, "seconds": 0.1},
        {"image": batches(3), "contact": [None, torch.ones(1, 1, 4, 4), (DEPTH > 0).numpy()], "seconds": ["1", None, NAN]},
        lambda: vts.stream.FollowLight(image()).update,
    ),
    "stream.Rectify": Entry(
        {"sensor": sensor(), "height": HEIGHT, "width": WIDTH},
        {"sensor": SENSOR, "height": [*INTEGER, 10], "width": [*INTEGER, 10]},
        named={"height": "height|frame", "width": "width|frame"},
    ),
    "stream.Rectify.forward": forward(lambda: vts.stream.Rectify(sensor(), HEIGHT, WIDTH), 3, "frame"),
    "stream.StreamReport": Entry({"stream": ...}, {"stream": [None, "camera"]}, run=False),
    "stream.TactileStream": Entry(
        {"source": ..., "sensor_or_calibration": sensor(), "mode": "auto", "background_frames": 12, "time_constant_s": 1.0},
        {
            "source": ["no/such.mp4", None, 2.5],
            "sensor_or_calibration": [None, "gelsight_mini"],
            "mode": ["slow", None],
            "background_frames": INTEGER,
            "time_constant_s": NUMBER,
        },
        run=False,
    ),
    "stream.VideoFile": Entry(
        {"path": "film.avi", "fps": 10.0}, {"path": ["film.gif", "film"], "fps": NUMBER}, named={"path": "video"}
    ),
    "stream.calibrate_background": Entry({"background": image(), "sensor": sensor()}, {"background": images(), "sensor": SENSOR}),
    "stream.open_source": Entry({"source": ...}, {"source": ["no/such.mp4", ".", None, 2.5]}, run=False),
    "stream.find_background": Entry({"images": image()[None].expand(5, -1, -1, -1)}, {"images": [*batches(3), image()[None]]}),
}


@functools.cache
def callables():
    """Every public callable by name: functions, constructors, and methods that take something."""
    found = {}
    rooms = [importlib.import_module(f"torchvts.{room}") for room in ROOMS if find_spec(f"torchvts.{room}")]
    for prefix, module in [("", vts), *(("", room) for room in rooms), *MODULES.items()]:
        names = getattr(module, "__all__", None) or [
            name for name, value in vars(module).items() if getattr(value, "__module__", "") == module.__name__ and name[0] != "_"
        ]
        for name in names:
            value = getattr(module, name)
            if isinstance(value, types.ModuleType) or not callable(value) or typing.is_typeddict(value):
                continue
            found[prefix + name] = value
            for method in methods(prefix + name, value) if inspect.isclass(value) else ():
                found[f"{prefix}{name}.{method}"] = getattr(value, method)
    found |= {call.__name__: call for call in (gradient_from_normal, normal_from_gradient)}
    parts = tuple(part.removesuffix(".") + "." for part in PARTS)
    return {name: value for name, value in found.items() if name not in RECORDS | PARTS and not name.startswith(parts)}


def methods(name, kind):
    """Names of a class's methods for users, those of its bases in torchvts too.

    The other methods of a module are steps of ``forward``, which gives them what they take, unless the table has them.
    """
    own = [base for base in kind.__mro__ if base.__module__.startswith("torchvts")]
    members = {key: member for base in reversed(own) for key, member in vars(base).items() if key[0] != "_"}
    made = [key for key, member in members.items() if isinstance(member, classmethod | staticmethod)]
    plain = [key for key, member in members.items() if inspect.isfunction(member)]
    steps = issubclass(kind, torch.nn.Module)
    return made + [key for key in plain if not steps or key == "forward" or f"{name}.{key}" in TABLE]


def arguments(call):
    """Names of a callable's arguments that can be wrong."""
    parameters = inspect.signature(call).parameters.values()
    return {p.name for p in parameters if p.name not in FREE | {"self"} and p.annotation not in (bool, "bool")}


def made(name):
    entry = TABLE[name]
    if entry.call is not None:
        return entry.call()
    return callables()[name]


def filled(entry, tmp_path, call):
    """The accepted arguments, paths put where they may be."""
    return {
        name: (tmp_path / "out.safetensors" if name in entry.file else tmp_path) if value is ... else value
        for name, value in entry.good.items()
    }


CASES = [(name, argument, k) for name, entry in TABLE.items() for argument, bad in entry.bad.items() for k in range(len(bad))]


@pytest.mark.parametrize("name", [name for name, entry in TABLE.items() if entry.run])
def test_the_call_of_the_table_is_accepted(name, tmp_path):
    call = made(name)
    call(**filled(TABLE[name], tmp_path, call))


def complaint(name, argument, k, tmp_path):
    """What is wrong with how a bad value is refused; empty if nothing."""
    entry = TABLE[name]
    call, value = made(name), entry.bad[argument][k]
    given = {**filled(entry, tmp_path, call), argument: value}
    case = f"{name}({argument}={str(value)[:60]!r})"
    try:
        call(**given)
    except (TypeError, ValueError, OSError) as error:
        said = str(error)
        as_named = re.match(rf"({entry.named.get(argument, argument)})[^:]*: (.*: )*expected .*, got ", said, re.DOTALL)
        as_file = argument in entry.file and re.match(rf".*: .*{FILE_FORMS}", said, re.DOTALL)
        if as_named or (as_file and "Errno" not in said):
            return ""
        return f"{case}: {type(error).__name__}: {said[:200]}"
    except Exception as error:
        return f"{case}: {type(error).__name__}: {str(error)[:200]}"
    return f"{case}: accepted"


@pytest.mark.parametrize("name", TABLE)
def test_bad_input_is_refused(name, tmp_path):
    complaints = [complaint(name, argument, k, tmp_path) for argument, bad in TABLE[name].bad.items() for k in range(len(bad))]
    assert [text for text in complaints if text] == []
    assert list(tmp_path.iterdir()) == []  # and nothing is left behind


def test_no_public_name_is_missing_from_the_table():
    takers = {name for name, value in callables().items() if arguments(value)}
    assert sorted(takers - set(TABLE)) == []
    assert sorted(set(TABLE) - set(callables())) == []


@pytest.mark.parametrize("name", TABLE)
def test_no_argument_is_missing_from_the_table(name):
    assert sorted(arguments(callables()[name]) - set(TABLE[name].bad) - set(TABLE[name].label)) == []
