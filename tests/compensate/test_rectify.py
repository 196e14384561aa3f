"""Raw frames to the sensor's images: the lens against OpenCV's, gradients, graphs from the camera to depth, and what is refused."""

import dataclasses
import json

import cv2
import numpy as np
import pytest
import torch
from conftest import LONG

import torchvts as vts
from torchvts import export

PLACE = {"corners_px": ((5.0, 3.0), (60.0, 8.0), (58.0, 44.0), (2.0, 40.0)), "raw_size_px": ((48, 64),)}
LENS = {"camera_matrix": ((60.0, 0.0, 31.0), (0.0, 61.0, 24.0), (0.0, 0.0, 1.0))}
SENSOR = vts.Sensor("camera", 24, 32, 1.2, **PLACE)


def frames(count=2, height=48, width=64, dtype=torch.float32):
    return torch.rand(count, 3, height, width, generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(dtype)


@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_a_lens_is_that_of_opencv(count):
    """Of all its models: radial, tangential, rational, thin prism, tilted."""
    numbers = (-0.2, 0.05, 0.004, -0.003, 0.01, 0.02, -0.01, 0.005, 0.002, -0.001, 0.003, 0.001, 0.02, -0.015)[:count]
    raw = torch.from_numpy(cv2.GaussianBlur(frames(1)[0].permute(1, 2, 0).numpy(), (0, 0), 2.0)).permute(2, 0, 1)[None]
    sensor = vts.Sensor("bent", 48, 64, 0.6, **LENS, distortion_coefficients=numbers)
    found = vts.Rectify(dataclasses.replace(sensor, roi_px=(8, 6, 48, 36)))(raw)
    matrix = np.array(LENS["camera_matrix"])
    maps = cv2.initUndistortRectifyMap(matrix, np.array(numbers), np.eye(3), matrix, (64, 48), cv2.CV_32FC1)
    grid = torch.from_numpy(np.stack(maps, -1)) / torch.tensor([63.0, 47.0]) * 2.0 - 1.0
    straight = torch.nn.functional.grid_sample(raw, grid[None], padding_mode="border", align_corners=True)[..., 6:42, 8:56]
    expected = torch.nn.functional.interpolate(straight, (48, 64), mode="bilinear", align_corners=False, antialias=True)
    assert (found - expected).abs().max() < 1e-5 < 0.1 < (found - raw).abs().max()


@pytest.mark.parametrize(
    "size, options, raw",
    [
        ((8, 12), {"corners_px": ((1.0, 1.5), (13.0, 1.0), (14.0, 10.0), (2.0, 9.0))}, (12, 16)),
        ((8, 10), {"raw_size_px": ((12, 15),), "raw_crop": 0.1}, (12, 15)),
        ((16, 12), {"turn_deg": 90, "mirror": True, "roi_px": (1, 2, 12, 16)}, (20, 24)),
        (
            (9, 12),
            {**LENS, "distortion_coefficients": (-0.2, 0.05, 0, 0), "roi_px": (8, 6, 16, 12), "raw_size_px": ((24, 32),)},
            (24, 32),
        ),
    ],
)
def test_gradients_are_those_of_difference_quotients(size, options, raw):
    block = vts.Rectify(vts.Sensor("small", *size, 1.0, **options))
    assert torch.autograd.gradcheck(block, (frames(1, *raw, dtype=torch.float64).requires_grad_(True),), fast_mode=not LONG)


@pytest.fixture(scope="module")
def pipe():
    lights = vts.PointLights([[20, 9, 30], [-18, 13, 30], [-2, -22, 30]], [900, 900, 900])
    return vts.DepthPipeline.from_calibration(vts.Calibration.from_lights(lights, SENSOR), "fast")


def test_one_graph_leads_from_the_camera_to_depth(pipe):
    raw, rectify = 0.2 + 0.6 * frames(), vts.Rectify(SENSOR)
    whole = torch.nn.Sequential(rectify, pipe)
    expected = pipe(SENSOR.rectify(raw)).depth_mm
    assert torch.allclose(whole(raw).depth_mm, expected, atol=1e-5)
    leaf = raw.clone().requires_grad_(True)
    whole(leaf).depth_mm.square().sum().backward()
    assert bool(torch.isfinite(leaf.grad).all())


@pytest.mark.long  # scripts of Rectify: test_contract; files without torchvts: test_export
@pytest.mark.parametrize("name", ["torchscript", "pt2", "onnx"])
def test_files_take_raw_frames_without_torchvts(pipe, tmp_path, name):
    if export.missing(name):
        pytest.skip(export.missing(name))
    rectify, raw = vts.Rectify(SENSOR), 0.2 + 0.6 * frames(3)
    path = tmp_path / export.FORMATS[name].file_name
    {"torchscript": export.export_torchscript, "pt2": export.export_program, "onnx": export.export_onnx}[name](pipe, path, rectify)
    (found,) = export.run_bare(path, raw, name, [3])
    assert (found - pipe(rectify(raw)).depth_mm).abs().max() <= export.FORMATS[name].tolerance_mm
    if name == "torchscript":
        extra = {"torchvts.json": ""}
        torch.jit.load(path, _extra_files=extra)
        assert json.loads(extra["torchvts.json"])["raw_size_px"] == [[48, 64]]


def test_graphs_of_frames_of_several_sizes_or_another_sensor_are_refused(pipe, tmp_path):
    several = vts.Rectify(vts.Sensor("several", 24, 32, 1.2, raw_size_px=((48, 64), (96, 128))))
    with pytest.raises(ValueError, match=r"rectify: expected a sensor of one raw size, got \[\(48, 64\), \(96, 128\)\]"):
        export.export_program(pipe, rectify=several)
    with pytest.raises(
        ValueError, match=r"rectify: expected images of 24 x 32 like the pipeline, got Rectify.*: of another sensor"
    ):
        export.export_torchscript(pipe, tmp_path / "pipe.pt", vts.Rectify(vts.Sensor.load("digit")))
    with pytest.raises(TypeError, match="rectify: expected a Rectify, got Sensor"):
        export.export_torchscript(pipe, tmp_path / "pipe.pt", SENSOR)


@pytest.mark.parametrize(
    "raw, message",
    [
        (
            frames(1, 96, 128),
            r"^raw: expected raw frames of 48 x 64, .* has its corners_px, got 96 x 128: .*of another resolution: resize",
        ),
        (
            frames(1, 24, 32),
            "^raw: expected raw frames of 48 x 64, .* got 24 x 32: another mode of the camera, of another resolution",
        ),
        (frames(1, 48, 63), "^raw: expected raw frames of 48 x 64, .* got 48 x 63: another mode of the camera$"),
        (frames()[:, :1], r"^raw: expected \(B, 3, H, W\), got \[2, 1, 48, 64\]: grey images"),
        (torch.cat((frames(), frames()[:, :1]), 1), r"^raw: .* got \[2, 4, 48, 64\]: with an alpha channel: image\[:, :3\]"),
    ],
)
def test_other_frames_are_refused(raw, message):
    with pytest.raises(ValueError, match=message):
        vts.Rectify(SENSOR)(raw)
    with pytest.raises(torch.jit.Error, match=message.removeprefix("^").removesuffix("$")):
        torch.jit.script(vts.Rectify(SENSOR))(raw)


def test_a_lens_and_a_place_without_the_size_of_their_frames_are_refused():
    """Both are in pixels of frames of one size, and a frame of twice that size would be cut and bent wrongly."""
    sensor = vts.Sensor("bent", 24, 32, 1.2, **LENS, distortion_coefficients=(-0.2, 0, 0, 0), roi_px=(8, 6, 48, 36))
    with pytest.raises(ValueError, match="sensor: expected raw_size_px beside camera_matrix of sensor 'bent', got none"):
        vts.Rectify(sensor)
    known = dataclasses.replace(sensor, raw_size_px=((48, 64),))
    assert torch.allclose(vts.Rectify(known)(frames()), sensor.rectify(frames()), atol=1e-5)
    with pytest.raises(TypeError, match=r"sensor: expected a Sensor, got str: load it by Sensor.load\('digit'\)"):
        vts.Rectify("digit")
