"""Accepted and refused arguments of gs_sdk's formats, scenes, objects, export and stream: a table for test_refusals."""

from pathlib import Path

import numpy as np
import torch
from refusals_values import *

import torchvts as vts
import torchvts.export

# fmt: off
TABLE = {
    # ---- gs_sdk ----
    "gs_sdk.read_calibration_folder": Entry({"folder": ...}, {"folder": [Path("no/such"), ".", None]}, file=("folder",), run=False),
    "gs_sdk.read_labels": Entry({"folder": ...}, {"folder": [Path("no/such"), ".", None]}, file=("folder",), run=False),
    "gs_sdk.depth_from_height_map": Entry({"height_map_px": MAP, "mm_per_pixel": 1.0}, {"height_map_px": BAD_MAP}),
    "gs_sdk.height_map_from_depth": Entry(
        {"depth_mm": DEPTH, "mm_per_pixel": 1.0}, {"depth_mm": [*batches(1), torch.zeros(2, 1, 4, 4)]}),
    "gs_sdk.gradient_from_gs_sdk": Entry({"gx": MAP, "gy": MAP}, {"gx": BAD_MAP, "gy": [*BAD_MAP, np.zeros((3, 3))]}),
    "gs_sdk.gradient_to_gs_sdk": Entry({"gradient": torch.zeros(1, 2, 4, 4)}, {"gradient": [*batches(2), torch.zeros(2, 2, 4, 4)]}),
    "gs_sdk.image_from_bgr": Entry({"pixels": np.zeros((4, 4, 3), np.uint8)},
        {"pixels": [np.zeros((3, 4, 4), np.uint8), np.zeros((4, 4), np.uint8), np.zeros((4, 4, 3)), image(), None]}),
    "gs_sdk.image_to_bgr": Entry({"image": image()}, {"image": [image()[None], image()[:1], image().permute(1, 2, 0),
        (255 * image()).to(torch.uint8), image() + NAN, image().numpy(), None]}),
    # ---- scenes ----
    "scenes.surface": Entry({"depth_mm": lambda x, y: 1.0 - x**2 - y**2, **SIZE},
        {"depth_mm": [None, torch.zeros(4, 4), lambda x, y: 1.0, lambda x, y: x[0]], "camera_height_mm": HEIGHTS}),
    "scenes.surface_at": Entry(
        {"depth_mm": lambda x, y: 1.0 - x**2 - y**2, "x": torch.rand(8, 8), "y": torch.rand(8, 8), "mm_per_pixel": 1.0}, {
        "depth_mm": [None, torch.zeros(4, 4), lambda x, y: 1.0, lambda x, y: x[0]], "x": [None, np.zeros((8, 8))],
        "y": [None, torch.zeros(4, 8), torch.zeros(1, 8, 8)]}),
    "scenes.sphere_press": Entry({"radius_mm": 10.0, "press_mm": 1.0, "center_mm": (0.0, 0.0), **SIZE},
        {"radius_mm": NUMBER, "press_mm": [*NUMBER, 99.0], "center_mm": CENTER, "camera_height_mm": HEIGHTS}),
    "scenes.cylinder_depth": Entry(
        {"radius_mm": 4.0, "press_mm": 0.5, "length_mm": 9.0, "angle_deg": 25.0, "center_mm": (0.0, 0.0)},
        {"radius_mm": NUMBER, "press_mm": [*NUMBER, 99.0], "length_mm": NUMBER, "angle_deg": ["1", None, NAN], "center_mm": CENTER}
        ),
    "scenes.cone_depth": Entry({"half_angle_deg": 65.0, "press_mm": 1.0, "tip_radius_mm": 0.5, "center_mm": (0.0, 0.0)},
        {"half_angle_deg": [*NUMBER, 90.0], "press_mm": NUMBER, "tip_radius_mm": NUMBER, "center_mm": CENTER}),
    "scenes.sine_depth": Entry({"amplitude_mm": 0.1, "period_mm": 2.0, "radius_mm": 8.0},
        {"amplitude_mm": NUMBER, "period_mm": NUMBER, "radius_mm": NUMBER}),
    "scenes.punch_depth": Entry({"radius_mm": 5.0, "press_mm": 0.6, "tilt_deg": 2.0, "wall_mm": 1.0},
        {"radius_mm": NUMBER, "press_mm": NUMBER, "tilt_deg": ["1", None, NAN], "wall_mm": NUMBER}),
    "scenes.letters_depth": Entry({"text": "VTS", "press_mm": 0.5, "size_mm": 6.0, "stroke_mm": 1.0, "bevel_mm": 0.6},
        {"text": ["", "a", None, 3], "press_mm": NUMBER, "size_mm": NUMBER, "stroke_mm": NUMBER, "bevel_mm": NUMBER}),
    "scenes.render": Entry({"scene": scene(), "lights": lights(), "noise_std": 0.01, "bits": 8, "gamma": 1.0, "vignetting": 0.1,
        "spots": torch.ones(1, 1, HEIGHT, WIDTH)}, {"scene": [None, DEPTH, "sphere"], "lights": [POSITION, None],
        "noise_std": ["1", None, NAN, -1.0], "bits": ["8", 0, 2.5, 99], "gamma": NUMBER,
        "vignetting": ["1", None, NAN, -1.0, 2.0], "spots": [torch.ones(1, 1, 4, 4), "worn", 30]}),
    "scenes.Drag": Entry({"center_mm": (0.0, 0.0), "radius_mm": 3.0, "press_mm": 0.5, "shift_mm": (0.2, 0.1), "turn_deg": 5.0,
        "bulge_mm": 0.1, "stuck": 1.0, "reach_mm": 2.0}, {"center_mm": CENTER, "radius_mm": NUMBER, "shift_mm": CENTER,
        "press_mm": ["1", None, NAN, -1.0], "turn_deg": ["1", None, NAN], "bulge_mm": ["1", None, NAN],
        "stuck": ["1", None, NAN, -1.0, 2.0],
        "reach_mm": NUMBER}),
    "scenes.DottedSkin": Entry({"spacing_mm": 1.9, "diameter_mm": 0.6, "pattern": "square", "shape": "round", "worn": 0.03,
        "darkness": (0.7, 0.7, 0.7), "blur_px": 0.9, "noise_std": 0.01, "camera_height_mm": 20.0, "height": 24, "width": 32,
        "mm_per_pixel": 0.2}, {"spacing_mm": NUMBER, "diameter_mm": [*NUMBER, 9.0], "pattern": ["round", None, 1],
        "shape": ["oval", None, 1], "worn": ["1", None, NAN, -1.0, 2.0], "darkness": [(0.5, 0.5), (2.0, 0.0, 0.0), None, 0.5],
        "blur_px": ["1", None, NAN, -1.0], "noise_std": ["1", None, NAN, -1.0], "camera_height_mm": HEIGHTS}),
    "scenes.undeformed": Entry({"scene": scene()}, {"scene": [None, DEPTH, "sphere"]}),
    "scenes.hanging_skin": Entry({"object_mm": torch.zeros(1, 1, 8, 8), "reach_mm": 0.5, "mm_per_pixel": 0.1, "sweeps": 2},
        {"object_mm": batches(1), "reach_mm": NUMBER, "sweeps": INTEGER}),
    "scenes.skin_spots": Entry(
        {"height": HEIGHT, "width": WIDTH, "spots": 3, "dead_pixels": 3}, {"spots": ["3", -1, 1.5], "dead_pixels": ["3", -1, 1.5]}
        ),
    "scenes.smooth_step": Entry({"t": torch.zeros(3)}, {"t": [None, "t", np.zeros(3), [0.0]]}),
    "scenes.letter_segments": Entry({"text": "VTS", "size_mm": 6.0}, {"text": ["", "a", None, 3], "size_mm": NUMBER}),
    "scenes.distance_to_segments": Entry({"x": torch.zeros(3), "y": torch.zeros(3), "segments": [((0.0, 0.0), (1.0, 0.0))]},
        {"x": [None, np.zeros(3)], "y": [None, np.zeros(3), torch.zeros(4)], "segments": [None, [], [(0.0, 0.0)], "V"]}),
    # ---- objects ----
    "objects.pose": Entry({"angle_deg": 0.0, "shift_mm": (0.0, 0.0), "press_mm": 0.5, "tilt_deg": (0.0, 0.0)},
        {"angle_deg": ["1", None, NAN], "shift_mm": CENTER, "press_mm": ["1", None, NAN], "tilt_deg": CENTER}),
    "objects.press": Entry(
        {"height_mm": vts.scenes.objects.sphere(), "T_sensor_object": vts.scenes.objects.pose(), **SIZE, "fillet_mm": 0.02}, {
        "height_mm": [None, "stamp", DEPTH], "T_sensor_object": [*BAD_POSE, vts.scenes.objects.pose(tilt_deg=(60.0, 0.0))],
        "fillet_mm": NUMBER}),
    "objects.bottle_cap": Entry({"ribs": 18}, {"ribs": INTEGER}),
    "objects.stamp": Entry({"text": "VTS", "size_mm": 4.2}, {"text": ["", "a", None], "size_mm": NUMBER}),
    "objects.bolt_head": Entry({"across_flats_mm": 9.0}, {"across_flats_mm": NUMBER}),
    "objects.gear": Entry({"teeth": 12}, {"teeth": INTEGER}),
    "objects.textured_patch": Entry({"bumps": 60, "radius_mm": 5.5}, {"bumps": INTEGER, "radius_mm": NUMBER}),
    "objects.capsule": Entry({"radius_mm": 1.0, "length_mm": 4.0}, {"radius_mm": NUMBER, "length_mm": NUMBER}),
    "objects.prism": Entry({"slope": 0.4, "length_mm": 6.0}, {"slope": NUMBER, "length_mm": NUMBER}),
    "objects.sphere": Entry({"radius_mm": 10.0}, {"radius_mm": NUMBER}),
    "objects.cylinder": Entry({"radius_mm": 6.0}, {"radius_mm": NUMBER}),
    # ---- export ----
    "export.describe": Entry({"pipe": pipe(), "rectify": None}, {"pipe": [None, unit(), "pipeline.pt"]}),
    **{f"export.{name}": Entry({"pipe": pipe(), "path": ..., "rectify": vts.Rectify(sensor())},
        {"pipe": [None, unit(), "pipeline.pt"], "path": [Path("no/such.pt2"), "."]}, file=("path",), run=False)
        for name in ("export_torchscript", "export_program", "export_onnx")},
    "export.missing": Entry({"name": "pt2"}, {"name": ["pdf", None]}, named={"name": "format"}),
    "export.sample_frames": Entry({"calibration": unit()}, {}),
    "export.export_checked": Entry({"pipe": pipe(), "folder": ..., "formats": ["pt2"], "images": image()[None]}, {
        "pipe": [None, unit()], "folder": [None, 3], "formats": [["pdf"], "pt2", None],
        "images": [None, image(), image().numpy()]}, named={"formats": "format"}, run=False),
    "export.compare": Entry({"path": ..., "pipe": pipe(), "images": image()[None], "name": "pt2"},
        {"path": [Path("no/such.pt2"), "."], "pipe": [None, unit()], "images": [None, image()], "name": ["pdf", None]},
        file=("path",), named={"name": "format"}, run=False),
    "export.run_bare": Entry({"path": ..., "images": image()[None], "name": "pt2", "batches": [1]},
        {"path": [Path("no/such.pt2"), "."], "images": [None, image()], "name": ["pdf", None], "batches": [[0], ["1"], None]},
        file=("path",), named={"name": "format"}, run=False),
    # ---- stream ----
    "stream.FrameCheck": Entry({"background": image()}, {"background": [b for k, b in enumerate(images()) if k not in (3, 4)]}),
    "stream.Recording": Entry({"calibration": unit(), "mode": "fast", "first": None}
        | {"network": None, "device": "cpu", "contact": None},
        {"calibration": [None, "unit"], "mode": ["slow"], "first": []}
        | {"network": [], "device": [None, "gpu", "cuda:99"], "contact": ["4.5", 4.5]}),
    "stream.StreamReport": Entry({"stream": ...}, {"stream": [None, "camera"]}, run=False),
    "stream.TactileStream": Entry({"source": ..., "sensor_or_calibration": sensor(), "mode": "fast", "background_frames": 12,
        "presses": (), "network": None, "device": "cpu", "reconnect_s": 0.0, "contact": None, "record": None,
        "settings": vts.stream.CameraSettings()}, {
        "settings": [None, (640, 480)], "reconnect_s": ["1", None, NAN, -1.0], "source": ["no/such.mp4", None, 2.5],
        "sensor_or_calibration": [None, "gelsight_mini"], "mode": ["slow", None], "background_frames": INTEGER, "presses": [],
        "network": [], "device": [], "contact": ["4.5", 4.5], "record": []}, run=False),
    "stream.Recorder": Entry(
        {"path": "raw", "fps": 30.0}, {"path": ["raw.avi", None, 2.5], "fps": []}, named={"path": "record"}, run=False),
    "stream.VideoFile": Entry(
        {"path": "film.avi", "fps": 10.0}, {"path": ["film.gif", "film"], "fps": NUMBER}, named={"path": "video"}),
    "stream.open_source": Entry({"source": ..., "reconnect_s": 0.0, "settings": vts.stream.CameraSettings()}, {
        "settings": [None, (640, 480)], "source": ["no/such.mp4", ".", None, 2.5, True, -1, 2**31, 10**400, "9" * 20, "\u00b2"],
        "reconnect_s": ["1", None, NAN, -1.0]}, run=False),
    **dict.fromkeys(("frames", "stream.frames"), Entry(
        {"source": ...}, {"source": ["no/such.mp4", ".", None, 2.5, True, -1, 2**31, 10**400, "9" * 20, "\u00b2"]}, run=False)),
    "stream.find_background": Entry(
        {"images": image()[None].expand(5, -1, -1, -1), "sensor": None},
        {"images": [*batches(3), image()[None]], "sensor": []}
        ),
}
