"""The pose of a pressed object relative to an earlier contact of it: how far it has turned and moved.

    python examples/pose.py

Read ``ambiguous`` before the pose: a ball shows no turn, a plane no shift (docs/pose.md).
"""

import math
from pathlib import Path

import torch

import torchvts as vts
from torchvts import viz
from torchvts.pose import contact_cloud
from torchvts.scenes import objects, render

PITCH = 0.0625
sensor = vts.Sensor("rig", height=240, width=320, mm_per_pixel=PITCH)
lights = vts.PointLights([[20, 9, 30], [-18, 13, 30], [-2, -22, 30]], [900, 900, 900])
pipe = vts.DepthPipeline.from_calibration(vts.Calibration.from_lights(lights, sensor), mode="precise").freeze()

before, after = objects.pose(0.0), objects.pose(angle_deg=25.0, shift_mm=(1.5, -0.8))  # of a key, in the sensor's frame
target, source = (
    pipe(render(objects.press(objects.key(), place), lights, noise_std=0.005, bits=8).detach()) for place in (before, after)
)
reg = vts.register_depth(source, target, PITCH)
truth = before @ torch.linalg.inv(after)
error = reg.T_target_source @ torch.linalg.inv(truth)
angle_deg = math.degrees(math.acos(min(1.0, 0.5 * (float(error[:3, :3].trace()) - 1.0))))
shift_mm = float((reg.T_target_source[:3, 3] - truth[:3, 3]).norm())
print(f"converged: {reg.converged}, ambiguous: {reg.ambiguous}, {len(reg.alternatives)} other poses fit as well")
print(f"off by {angle_deg:.3f} degrees and {shift_mm:.4f} mm")

Path("out").mkdir(exist_ok=True)
clouds = [contact_cloud(frame, PITCH, 4000)[0] for frame in (source, target)]
viz.save_figure(viz.pose_figure(*clouds, reg.T_target_source, "key"), "out/pose.png")
print("picture: out/pose.png")
