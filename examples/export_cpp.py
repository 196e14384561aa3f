"""A pipeline for C++: one file that takes the camera's raw frames to depth, without Python and without torchvts.

    python examples/export_cpp.py

docs/export.md has the other formats, and their limits; libtorch loads this one.
"""

from pathlib import Path

import torch

import torchvts as vts
from torchvts import export, scenes

# The gel is a quadrilateral of the camera's frame of 240 x 320, seen slightly from aside.
corners = ((30, 25), (290, 35), (285, 215), (35, 220))
sensor = vts.Sensor("rig", height=120, width=160, mm_per_pixel=0.1, corners_px=corners, raw_size_px=((240, 320),))
lights = vts.PointLights([[12, 3, 15], [-9, 8, 15], [-3, -12, 15]], [150, 150, 150])
pipe = vts.DepthPipeline.from_calibration(vts.Calibration.from_lights(lights, sensor), mode="fast")
rectify = vts.Rectify(sensor)
Path("out").mkdir(exist_ok=True)
export.export_torchscript(pipe, "out/camera.pt", rectify)

# The file needs no torchvts; here it is compared with the pipeline.
raw = scenes.render(scenes.sphere_press(8.0, 1.0, (0.0, 0.0), 240, 320, 0.0625), lights).detach()
found, expected = torch.jit.load("out/camera.pt")(raw).depth_mm, pipe(rectify(raw)).depth_mm
print(f"deepest {float(found.max()):.3f} mm, largest difference to the pipeline {float((found - expected).abs().max()):.1e} mm")
print("file: out/camera.pt")
