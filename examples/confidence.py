"""Bounds beside depth: how far it may be off at each pixel, with a probability of 95 %.

    python examples/confidence.py

docs/confidence.md says what the bounds are made of, and how often they hold.
"""

from pathlib import Path

import torchvts as vts
from torchvts import scenes, viz

PITCH = 0.1
sensor = vts.Sensor("rig", height=120, width=160, mm_per_pixel=PITCH)
lights = vts.PointLights([[20, 9, 30], [-18, 13, 30], [-2, -22, 30]], [900, 900, 900])
scene = scenes.sphere_press(5.0, 0.6, (1.0, 0.0), 120, 160, PITCH)
image = scenes.render(scene, lights, noise_std=0.005).detach()

calibration = vts.Calibration.from_lights(lights, sensor)
out = vts.ConfidentPipeline.from_calibration(calibration, "precise")(image)
error_mm = (out.depth_mm - scene.depth_mm).abs()
share = float((error_mm <= out.depth_95_mm)[scene.contact].float().mean())
print(f"{share:.0%} of the contact lies within its bound; the frame's confidence is {float(out.frame_confidence):.2f}")

Path("out").mkdir(exist_ok=True)
figure = viz.new_figure(8.0, 3.2)
for axes, values, title in zip(figure.subplots(1, 2), (error_mm, out.depth_95_mm), ("error of depth", "its bound of 95 %")):
    shown = axes.imshow(values[0, 0].numpy(), vmin=0.0, vmax=float(out.depth_95_mm.max()))
    axes.set_title(title)
    axes.set_axis_off()
figure.colorbar(shown, ax=figure.axes, label="mm")
viz.save_figure(figure, "out/confidence.png")
print("picture: out/confidence.png")
