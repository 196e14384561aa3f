"""Accepted and refused arguments of calibrations, blocks, pipelines and poses: a table for test_refusals."""

from pathlib import Path

import numpy as np
import torch
from refusals_values import *

import torchvts as vts
import torchvts.integration
from torchvts.core.geometry import normal_from_gradient
from torchvts.integration import PerspectiveIntegration
from torchvts.model import FillMarkers
from torchvts.model.response_field import ResponseModel
from torchvts.pipeline import Confidence

SLOPES = torch.zeros(1, 2, HEIGHT, WIDTH)
OTHER_DEPTHS = [DEPTH[0], DEPTH[..., 1:], DEPTH.expand(2, -1, -1, -1)]
IMAGES = [*batches(3), 255 * image()[None], image()[None] + NAN, image()[None] - 1.0]
LENS = ((50.0, 0.0, 32.0), (0.0, 50.0, 24.0), (0.0, 0.0, 1.0))
SHARES = [*(value for value in NUMBER if value is not None), 1.5]
DECAYS_MM = [*(value for value in NUMBER if value not in (None, 0)), 450.0]


DOTTED = vts.scenes.DottedSkin(48, 64, 1.0, 10.0, 4.0)
DOTS_PX = torch.stack(torch.meshgrid(torch.arange(8.0, 60.0, 10.0), torch.arange(9.0, 42.0, 10.0), indexing="xy"), -1).reshape(
    -1, 2
)


def dotted_unit():
    return vts.Calibration.from_lights(DOTTED.lights, vts.Sensor("rig", 48, 64, 1.0), DOTTED.image())


def integrator(name):
    """A class of integrators, the public one if there is one."""
    return getattr(vts, name, None) or getattr(torchvts.integration, name)


# fmt: off
TABLE = {
    "Calibration.from_lights": Entry({"lights": lights(), "sensor": sensor(), "background": image(), "ambient": torch.zeros(3)},
        {"lights": [POSITION, None, "lights"], "background": images()[:-2] + ["image.png"],
        "ambient": [torch.zeros(2), torch.full((3,), -1.0), torch.full((3,), NAN), [0.0, 0.0, 0.0], 0.1]}),
    "Calibration.from_response": Entry({"response": ResponseModel(fields(), None), "sensor": sensor(), "background": image(),
        "covariance": torch.eye(3)},
        {"response": [None, fields(), "prior"], "background": images(),
        "covariance": [torch.eye(2), torch.full((3, 3), NAN), -torch.eye(3), 0.1, "eye"]}),
    "Calibration.load": Entry({"path": ...}, {"path": [*MISSING, ".", 3, None]}, file=("path",), run=False),
    "Calibration.save": Entry({"path": ...}, {"path": [*MISSING, ".", 3, None]}, lambda: unit().save, file=("path",), run=False),
    "Compensate": Entry({"gain": FLAT, "offset": FLAT, "gamma": 2.2, "defects": FLAT[0] > 1, "blur_px": 1.0,
        "markers": FillMarkers(), "relight": None}, {
        "relight": [True, "mode", torch.nn.Identity()],
        "gain": BAD_FLAT[:-1], "offset": BAD_FLAT[:-1], "gamma": NUMBER,
        "defects": [FLAT[0], FLAT > 1, torch.ones(HEIGHT, WIDTH, dtype=torch.bool), (FLAT[0] > 1).numpy(), "none"],
        "blur_px": ["1", None, NAN, INF, -1.0], "markers": [True, 9.0, "markers"]}),
    "Compensate.from_calibration": Entry({"calibration": unit()}, {}),
    "Compensate.forward": forward(lambda: vts.Compensate.from_calibration(unit()), 3, "image"),
    "ContactMask": Entry({"flat": FLAT, "light": FLAT, "noise_std": 0.01 * FLAT, "sigmas": 4.5},
        {"flat": BAD_FLAT[:-1], "light": [*BAD_FLAT[:-1], FLAT[:, 1:]], "noise_std": [*BAD_FLAT[:-1], 0.01], "sigmas": NUMBER}),
    "ContactMask.from_calibration": Entry({"calibration": unit()}, {"settings": ["4.5", 4.5, torch.ones(3)]}),
    "ContactMask.forward": Entry({"compensated": FLAT[None], "gradient": SLOPES}, {"compensated": batches(3),
        "gradient": [*(b for b in batches(2) if b is not None), SLOPES[..., 1:], SLOPES.expand(3, -1, -1, -1)]},
        lambda: pipe().mask),
    "ContactFromDepth": Entry({"mm_per_pixel": 1.0, "share": 0.8, "decay_mm": 0.3}, {"share": SHARES, "decay_mm": DECAYS_MM}),
    "ContactFromDepth.from_calibration": Entry({"calibration": unit()}, {"settings": ["4.5", 4.5, torch.ones(3)]}),
    "ContactFromDepth.forward": Entry({"depth_mm": DEPTH, "deformed": DEPTH > 0},
        {"depth_mm": batches(1), "deformed": [DEPTH, *(mask > 0 for mask in OTHER_DEPTHS), (DEPTH > 0).numpy(), None]},
        lambda: vts.ContactFromDepth(1.0)),
    "SkinMotion": Entry({"background": DOTTED.image(), "dots_px": DOTS_PX, "diameter_px": 4.0, "mm_per_pixel": 1.0,
        "camera_mm": (0.0, 0.0, 30.0)}, {"background": [DOTTED.image()[None], None, "image.png", 255 * DOTTED.image()],
        "dots_px": [DOTS_PX[:, :1], DOTS_PX + NAN, DOTS_PX.long(), DOTS_PX.tolist(), None], "diameter_px": NUMBER,
        "camera_mm": [(0.0, 0.0), (0.0, 0.0, -1.0), (NAN, 0.0, 30.0), "up", 30.0]}),
    "SkinMotion.from_calibration": Entry({"calibration": dotted_unit(), "camera_mm": None},
        {"calibration": [*OTHERS, unit()], "camera_mm": [(0.0, 0.0), (0.0, 0.0, -1.0), "up", 30.0]}),
    "SkinMotion.forward": Entry({"images": DOTTED.image()[None], "depth_mm": torch.zeros(1, 1, 48, 64), "last": None},
        {"images": [*batches(3, 48, 64), DOTTED.image()[None, :, 1:]], "depth_mm": [*batches(1, 48, 64), torch.zeros(1, 1, 48, 60)],
        "last": [torch.zeros(1, 4, 3), "last", 3]}, lambda: vts.SkinMotion.from_calibration(dotted_unit())),
    "ContactSettings": Entry({"sigmas": 4.5, "share": 0.8, "decay_mm": 0.3},
        {"sigmas": NUMBER, "share": SHARES, "decay_mm": DECAYS_MM}),
    "ZeroBackground": Entry({"mm_per_pixel": 1.0}, {}),
    "ZeroBackground.forward": Entry({"depth_mm": DEPTH, "weight": DEPTH + 1.0},
        {"depth_mm": batches(1), "weight": [*batches(1), *OTHER_DEPTHS]}, lambda: vts.skin.ZeroBackground(1.0)),
    "DepthPipeline": Entry({
        **{name: getattr(pipe(), name) for name in ("compensate", "mask", "normals", "gradient", "integrate")}, "mode": "fast",
        "mm_per_pixel": pipe().mm_per_pixel}, {
        **{name: [None, lambda x: x] for name in ("compensate", "mask", "normals", "gradient", "integrate")},
        "contact": [lambda x: x, 0.8], "mode": ["slow", None, 1, "auto"]}),
    "DepthPipeline.from_calibration": Entry({"calibration": unit(), "mode": "fast", "normals": None, "integrate": None},
        {"mode": ["slow", None, 1], "normals": ["lookup", 3], "integrate": ["dct", 3], "contact": ["4.5", 4.5, torch.ones(3)]}),
    "DepthPipeline.from_gs_sdk": Entry({"weights": ..., "background": image(), "sensor": sensor()}, {
        "weights": [Path("no/such/nnmodel.pth"), "."], "background": images(), "sensor": ["no_such_sensor", "no/such.yaml"]},
        label=("mode", "markers"), file=("weights", "sensor"), run=False),
    "DepthPipeline.forward": Entry({"images": image()[None]}, {"images": IMAGES}, lambda: pipe()),
    "FrozenPipeline": Entry({"pipe": pipe()}, {"pipe": [None, "pipe.pt", torch.nn.Identity()]}),
    "FrozenPipeline.load": Entry({"path": ...}, {"path": [*MISSING, ".", 3, None]}, file=("path",), run=False),
    "FrozenPipeline.save": Entry(
        {"path": ...}, {"path": [*MISSING, ".", 3, None]}, lambda: pipe().freeze().save, file=("path",), run=False),
    "FrozenPipeline.with_background": Entry({"background": image()}, {"background": images()},
        lambda: vts.DepthPipeline.from_calibration(unit("response")).freeze().with_background),
    "FrozenPipeline.with_conditions": Entry({"images": image()[None]}, {"images": IMAGES}, lambda: pipe().freeze().with_conditions),
    "FillMarkers": Entry({"diameter_px": 9.0, "contrast": 0.06, "sigmas": 5.0, "margin": 0.2},
        {"diameter_px": ["9", None, NAN, -1], "contrast": NUMBER, "sigmas": NUMBER, "margin": NUMBER}),
    "FillMarkers.from_background": Entry(
        {"background": torch.full((3, 64, 64), 0.5), "margin": 0.2}, {
        "background": [b for b in images(64, 64) if not (isinstance(b, torch.Tensor) and tuple(b.shape) == (3, 63, 64))],
        "margin": NUMBER}),
    "FillMarkers.forward": forward(lambda: FillMarkers(), 3, "image"),
    "GradientFromNormal": Entry({"max_slope": 10.0}, {"max_slope": NUMBER}),
    "GradientFromNormal.forward": forward(lambda: vts.GradientFromNormal(), 3, "normal"),
    "NormalFromIntensity": Entry(
        {"lights": lights(), **SIZE, "noise_std": torch.full((3,), 0.01), "inverse": unit().inverse, "saturated_above": FLAT}, {
        "lights": [POSITION, None], "noise_std": [torch.zeros(2), torch.full((3,), NAN), 0.01],
        "inverse": [unit().inverse[None], "inverse"], "camera_height_mm": HEIGHTS,
        "saturated_above": [FLAT[None], FLAT[:, 1:], "full"]}),
    "NormalFromIntensity.from_calibration": Entry(
        {"calibration": unit(), "camera_height_mm": 30.0}, {"calibration": [*OTHERS, unit("response")], "camera_height_mm": HEIGHTS}
        ),
    "NormalFromIntensity.forward": Entry({"image": FLAT[None], "depth_mm": DEPTH},
        {"image": batches(3), "depth_mm": [b for b in batches(1) if b is not None]},
        lambda: pipe().normals, named={"image": "compensated"}),
    "NormalFromIntensity.solve": Entry(
        {"image": FLAT[None], "depth_mm": None, "expected": torch.zeros(1, 2, HEIGHT, WIDTH)}, {
        "image": batches(3), "depth_mm": [b for b in batches(1) if b is not None],
        "expected": [b for b in batches(2) if b is not None]}, lambda: pipe().normals.solve,
        named={"image": "compensated"}),
    "NormalFromLookup": Entry(
        {"flat": FLAT, "table": torch.zeros(4, 4, 4, 2), "step": torch.ones(3), "zero_index": torch.ones(3, dtype=torch.int64)},
        {"flat": BAD_FLAT, "table": [torch.zeros(4, 4, 2), torch.full((4, 4, 4, 2), NAN), None, np.zeros((4, 4, 4, 2))],
        "step": [torch.ones(2), torch.zeros(3), torch.full((3,), NAN), None, 1.0],
        "zero_index": [torch.ones(2), torch.full((3,), 9), None, 1]}),
    "NormalFromLookup.fit": Entry(
        {"flat": FLAT, "change": 0.1 * torch.randn(50, 3), "slope": torch.randn(50, 2), "bins": 4, "smoothing": 1.0}, {
        "flat": BAD_FLAT, "change": [torch.zeros(50, 2), torch.zeros(0, 3), torch.zeros(50, 3), torch.full((50, 3), NAN), None,
        np.zeros((50, 3))],
        "slope": [torch.zeros(49, 2), torch.full((50, 2), INF), torch.zeros(50, 2, dtype=torch.int64), None],
        "bins": [2, 500, 4.5, "4"], "smoothing": [-1.0, NAN, 99.0, "1"]}),
    "NormalFromLookup.load": Entry({"path": ...}, {"path": [*MISSING, "."]}, file=("path",), run=False),
    "NormalFromLookup.save": Entry({"path": ...}, {"path": [*MISSING, "."]}, lambda: lookup().save, file=("path",), run=False),
    "NormalFromLookup.forward": forward(lookup, 3, "compensated", label=("depth_mm",)),
    "NormalFromMLP": Entry({"height": HEIGHT, "width": WIDTH, "flat": FLAT, "hidden": (4,), "output": "angle",
        "input_domain": "image", "blur_px": 0.0}, {"flat": images(), "hidden": [(), (0,), ("4",)], "output": ["slope", None],
        "input_domain": ["raw", None], "blur_px": [-1.0, NAN, "1"]}),
    "NormalFromMLP.load": Entry({"path": ..., "flat": None, "output": None},
        {"path": [Path("no/such/nnmodel.pth"), "."], "flat": [], "output": []}, file=("path",), run=False),
    "NormalFromMLP.save": Entry(
        {"path": ...}, {"path": [*MISSING, "weights.pth"]}, lambda: network().save, file=("path",), run=False),
    "NormalFromMLP.set_flat": Entry({"flat": FLAT}, {"flat": images()}, lambda: network().set_flat),
    "NormalFromMLP.check_flat": Entry({"flat": FLAT}, {"flat": images()}, lambda: network().check_flat),
    "NormalFromMLP.gradient_px": forward(lambda: network().gradient_px, 3, "image"),
    "NormalFromMLP.forward": forward(network, 3, "compensated", label=("depth_mm",)),
    "NormalFromResponse": Entry(
        {"field": fields(), "by_depth": by_depth(), **SIZE}, {"field": [None, "field", by_depth()], "by_depth": ["field", fields()]}
        ),
    "NormalFromResponse.from_calibration": Entry({"calibration": unit("response")}, {"calibration": [*OTHERS, unit()]}),
    "NormalFromResponse.forward": Entry({"image": FLAT[None], "depth_mm": DEPTH},
        {"image": batches(3), "depth_mm": [b for b in batches(1) if b is not None]},
        lambda: vts.NormalFromResponse.from_calibration(unit("response")), named={"image": "compensated"}),
    "PointLights": Entry({"position_mm": POSITION, "albedo": [900.0] * 3, "gloss": [0.1] * 3}, {"position_mm": BAD_POSITION,
        "albedo": [[900.0] * 2, [0.0] * 3, [NAN] * 3, None, "bright"], "gloss": [[0.1] * 2, [-0.1] * 3, [NAN] * 3, "satin"]}),
    "PointLights.forward": Entry({"depth_mm": DEPTH, "normal": torch.zeros(1, 3, HEIGHT, WIDTH), "mm_per_pixel": 1.0},
        {"depth_mm": batches(1), "normal": [*batches(3), torch.zeros(1, 3, 8, 8)], "camera_height_mm": HEIGHTS}, lights),
    **{name: Entry({"mm_per_pixel": 1.0}, {}) for name in ("AdaptiveIntegration", "PoissonDST", "PoissonBackground")},
    "PoissonDCT": Entry({"mm_per_pixel": 1.0, "size": (8, 8)}, {"size": [(8, 1), (8, 8.5), (8,), 8, "8x8"]}),
    "PerspectiveIntegration": Entry({"mm_per_pixel": 1.0, "camera_height_mm": 30.0, "integrate": vts.PoissonBackground()},
        {"camera_height_mm": NUMBER, "integrate": ["dct", 3]}),
    "PerspectiveIntegration.forward": Entry({"gradient": GRADIENT}, {}, lambda: PerspectiveIntegration(1.0, 30.0)),
    "Confidence": Entry(
        {"calibration": unit(), "normals": pipe().normals}, {"normals": ["mine", torch.nn.Identity()]}),
    "Confidence.forward": Entry({"images": FLAT[None], "compensated": FLAT[None], "out": OUT, "light": None}, {"images": batches(3),
        "compensated": batches(3), "out": [*(OUT._replace(depth_mm=bad) for bad in batches(1)),
        *(OUT._replace(gradient=bad) for bad in batches(2)), *(OUT._replace(normal=bad) for bad in batches(3)),
        *(OUT._replace(contact=bad) for bad in (DEPTH[0] > 0, (DEPTH > 0)[:, :, 1:], None, "all", DEPTH))],
        "light": [torch.ones(1, 3, 5), torch.ones(2, 3, 6), torch.ones(3, 6)]},
        lambda: Confidence(unit()), named={"out": "depth_mm|gradient|normal|contact"}),
    "ConfidentPipeline": Entry({"pipe": pipe(), "confidence": Confidence(unit())},
        {"pipe": ["fast", None, unit()], "confidence": [True, None, unit()]}),
    "ConfidentPipeline.from_calibration": Entry({"calibration": unit(), "mode": "fast"}, {"mode": ["quick", None],
        "normals": ["mine", torch.nn.Identity()], "integrate": ["mine"], "contact": ["4.5", 4.5, torch.ones(3)]}),
    "ConfidentPipeline.forward": forward(lambda: vts.ConfidentPipeline.from_calibration(unit()), 3, "images"),
    "press_next": Entry({"calibration": unit()}, {"calibration": [None, "unit"]}),
    "bound_at": Entry({"bound_95": torch.ones(2), "level": 0.5, "spread": 1.0},
        {"bound_95": [1.0, None, np.ones(2)], "level": [0.0, 1.0, 95, NAN, "0.5", None], "spread": NUMBER}),
    "diagnose": Entry({"background": image(), "image": image(), "calibration": unit()}, {
        "background": [bad for bad in images() if bad is not None and not of_other_size(bad)],
        "image": [bad for bad in images() if not of_other_size(bad)]}),
    "PoissonDST.forward": Entry({"gradient": GRADIENT}, {"gradient": batches(2)}, lambda: vts.PoissonDST()),
    **{f"{name}.forward": Entry({"gradient": GRADIENT}, {}, lambda name=name: integrator(name)())
        for name in ("PoissonBackground", "PoissonDCT")},
    "AdaptiveIntegration.forward": Entry({"gradient": GRADIENT}, {"gradient": batches(2)}, lambda: vts.AdaptiveIntegration()),
    "Press": Entry(
        {"image": image(), "ball_diameter_mm": 6.0, "center_px": (4.0, 5.0), "contact_radius_px": 3.0},
        {"ball_diameter_mm": NUMBER, "center_px": [(1.0,), "here", (NAN, 0.0)], "contact_radius_px": ["3", 0, -1.0, NAN]},
        label=("name", "image"),  # calibrate checks the image: it knows the sensor's size
    ),
    "Sensor": Entry({"name": "rig", "height": 24, "width": 32, "mm_per_pixel": 0.1, "gamma": 1.0, "blur_px": 0.0,
        "light_position_mm": None, "camera_matrix": LENS, "distortion_coefficients": (0.1, 0.0, 0.0, 0.0),
        "turn_deg": 0, "mirror": False, "roi_px": None, "corners_px": None, "raw_size_px": ((48, 64),),
        "raw_crop": 0.1, "markers": False, "sensor_to_robot": EYE.tolist(), "prior": None},
        {"name": ["", None, 3], "mm_per_pixel": [*NUMBER, 11.0], "gamma": ["2", 0, NAN, 0.01, 99.0],
        "blur_px": ["1", None, NAN, -1.0, 99.0],
        "light_position_mm": [[[0, 0, 1]], "lights", [[20.0, 0.0, -30.0]] * 3, [[20.0, 0.0, NAN]] * 3],
        "camera_matrix": ["all", LENS[:2], ((-50.0, 0.0, 32.0), *LENS[1:]), (LENS[0], (1.0, 50.0, 24.0), LENS[2])],
        "distortion_coefficients": ["all", (0.1,), (0.1, 0.0, 0.0, "0"), (0.1, 0.0, 0.0, NAN)],
        "turn_deg": ["90", None, True, 90.5, -90, 45, 360], "mirror": ["yes", 1],
        "roi_px": [(1, 2), (0, 0, 1.5, 9), (-1, 0, 9, 9), "all"],
        "corners_px": [((0, 0),), ((0, 0), (0, 1), (1, 1), (1, 0)), "all"],
        "raw_size_px": ["all", None, (48, 64), ((48,),), ((4.5, 64),), ((2, 64),)], "raw_crop": ["1", None, NAN, -0.1, 0.5],
        "markers": ["yes", 1], "sensor_to_robot": ["all", EYE[:3].tolist(), (2 * EYE).tolist()], "prior": ["prior", 3]}),
    "Sensor.load": Entry({"source": "gelsight_mini", "height": 240, "width": 320},
        {"source": ["no_such_sensor", "no/such.yaml", None, 3], "height": ["240", 100, 0], "width": ["320", 100, 0]},
        named={"width": "(height, )?width"}, file=("source",)),
    "Sensor.resized": Entry({"height": 48, "width": 64}, {"height": [*INTEGER, 50], "width": [*INTEGER, 99]},
        lambda: sensor().resized, named={"width": "(height, )?width"}),
    "Rectify": Entry({"sensor": sensor()}, {}),
    "Rectify.forward": Entry(
        {"raw": image()[None]}, {"raw": [*batches(3), torch.zeros(1, 3, 8, 8)]}, lambda: vts.Rectify(sensor())),
    "Sensor.rectify": Entry({"frame": image()[None]}, {"frame": [*batches(3), torch.zeros(1, 3, 8, 8)]}, lambda: sensor().rectify),
    "Sensor.read_image": Entry({"path": ...}, {"path": [*MISSING, "."]}, lambda: sensor().read_image, file=("path",), run=False),
    "Sensor.from_dict": Entry({"values": sensor().to_dict(), "source": "file"},
        {"values": [None, [], {"unknown": 1.0}, {"name": "rig"}, {**sensor().to_dict(), "height": -1}]}, label=("source",),
        named={"values": "file"}, file=("values",)),
    "Sensor.save": Entry(
        {"path": ...}, {"path": [Path("no/such/rig.yaml"), "."]}, lambda: sensor().save, file=("path",), run=False),
    "calibrate": Entry({"background": image(), "sensor": sensor(), "presses": ()}, {
        "background": [*images(), 0 * image(), torch.full_like(image(), 0.5), torch.ones_like(image())],
        "presses": [PRESS, [image()], ["press.png"], None, "presses", 3]}),
    "contact_cloud": Entry({"frame": frame(), "mm_per_pixel": 0.4, "most": 100},
        {"frame": [None, DEPTH, "frame", vts.scenes.undeformed(frame())], "most": ["9", 0, 1.5]}),
    "depth_to_points": Entry({"depth_mm": DEPTH, "mm_per_pixel": 1.0, "contact": DEPTH > 0},
        {"depth_mm": BAD_DEPTH[:-1], "contact": [torch.ones(4, 4), np.ones((HEIGHT, WIDTH)), "all"]}),
    "divergence": Entry({"gradient": torch.zeros(1, 2, 8, 8)}, {"gradient": [*batches(2), torch.zeros(1, 2, 1, 8)]}),
    "fill_markers": Entry({"image": image()[None], "mask": DEPTH > 0, "relaxations": 4}, {
        "image": [b for k, b in enumerate(batches(3)) if k not in (1, 2, 3)],
        "mask": [DEPTH, DEPTH[0] > 0, torch.ones(1, 1, 4, 4, dtype=torch.bool), (DEPTH > 0).numpy(), None],
        "relaxations": ["4", -1, 1.5]}),
    "find_markers": Entry({"image": image()[None], "diameter_px": 5.0, "contrast": 0.06, "sigmas": 5.0, "margin": 0.2}, {
        "image": [*batches(3), torch.zeros(1, 3, 4, 4)], "diameter_px": NUMBER, "contrast": NUMBER, "sigmas": NUMBER,
        "margin": NUMBER}),
    "fit_lights": Entry({"background": image(), "sensor": sensor(), "start": None, "max_steps": 3}, {
        "background": [*images(), 0 * image(), torch.full_like(image(), 0.5), torch.ones_like(image())],
        "start": [POSITION, "lights"], "max_steps": INTEGER}),
    "fit_mlp": Entry({"intensity": torch.full((9, 3), 0.5), "xy": torch.zeros(9, 2), "slope": torch.zeros(9, 2), "flat": FLAT,
        "groups": torch.arange(9), "hidden": (4,), "max_epochs": 1, "patience": 1, "batch_size": 9, "held_out": 0.2,
        "weight_decay": 0.2, "input_domain": "image", "blur_px": 0.0}, {"input_domain": ["raw", None],
        "blur_px": [-1.0, NAN, "1"], "intensity": [torch.zeros(9), torch.zeros(0, 3), torch.full((9, 3), 255.0),
        torch.full((9, 3), NAN), None, np.zeros((9, 3)), torch.zeros(9, 3, dtype=torch.uint8)],
        "xy": [torch.zeros(8, 2), torch.full((9, 2), NAN), torch.full((9, 2), 999.0), None], "slope": [torch.zeros(8, 2),
        torch.full((9, 2), NAN), torch.full((9, 2), 99.0), None, torch.zeros(9, 2, dtype=torch.int64)],
        "flat": [b for k, b in enumerate(images()) if k not in (3, 4)],
        "groups": [torch.zeros(8), torch.zeros(9, dtype=torch.int64), None], "hidden": [(), (0,), ("4",)],
        "max_epochs": INTEGER, "patience": INTEGER, "batch_size": INTEGER, "held_out": [0.0, 1.0, NAN, "some"],
        "weight_decay": [-1.0, NAN, "some"]}),
    "gradient_from_normal": Entry(
        {"normal": torch.ones(1, 3, 8, 8), "max_slope": 10.0}, {"normal": batches(3), "max_slope": NUMBER}),
    "near_field_shading": Entry(
        {"depth_mm": DEPTH, "normal": torch.zeros(1, 3, HEIGHT, WIDTH), "lights": lights(), "mm_per_pixel": 1.0}, {
        "depth_mm": batches(1), "normal": [*batches(3), torch.zeros(1, 3, 8, 8)], "lights": [POSITION, None],
        "camera_height_mm": HEIGHTS}),
    "integrate_perspective": Entry(
        {"gradient": GRADIENT, "mm_per_pixel": 1.0, "camera_height_mm": 30.0}, {"camera_height_mm": NUMBER}),
    "normal_from_gradient": forward(lambda: normal_from_gradient, 2, "gradient"),
    **{name: Entry(
        {"gradient": torch.zeros(1, 2, 8, 8), "mm_per_pixel": 1.0}, {"gradient": [*batches(2), torch.zeros(1, 2, 1, 8)]})
        for name in ("poisson_dct", "poisson_dst", "poisson_background")},
    "read_image": Entry({"path": ...}, {"path": [Path("no/such.png"), ".", None, 3]}, file=("path",), run=False),
    "read_presses": Entry({"folder": ...}, {"folder": [Path("no/such"), ".", None, 3]}, file=("folder",), run=False),
    "OutputFrame": Entry({"length_unit": "m", "sensor": sensor()}, {"length_unit": ["cm", None, 1.0],
        "sensor": ["gelsight_mini", 3]}),
    "register_depth": Entry({"source": frame(), "target": frame(), "mm_per_pixel": 0.4, "initial": EYE},
        {**{name: [None, DEPTH, "frame", vts.scenes.undeformed(frame())] for name in ("source", "target")}}),
    "register_points": Entry(
        {"source": cloud(), "target": cloud(), "source_normals": None, "target_normals": None, "initial": EYE}, {
        "source": BAD_POINTS, "target": BAD_POINTS, "source_normals": [torch.zeros(9, 3), cloud() + NAN, cloud().numpy(), "up"],
        "target_normals": [torch.zeros(9, 3), cloud() + NAN, cloud().numpy(), "up"]}),
    "write_image": Entry({"path": Path("no/such.png"), "image": image()}, {
        "path": [Path("no/such.png"), ".", "image.gif", None, 3], "image": [image()[None], image()[:1],
        image().permute(1, 2, 0), (255 * image()).to(torch.uint8), image().numpy(), None, image() + NAN]}, file=("path",),
        run=False),
}
