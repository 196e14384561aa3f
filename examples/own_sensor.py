"""A sensor that is not shipped: a few lines describe it, presses of a ball calibrate it, a ball of another size checks it.

    python examples/own_sensor.py

The images are drawn: take your own in their place. docs/own_sensor.md has the keys of a sensor file.
"""

from pathlib import Path

import torch

import torchvts as vts
from torchvts import scenes

folder = Path("out/own_sensor")
folder.mkdir(parents=True, exist_ok=True)
lights = vts.PointLights([[9, 2, 10], [-6, 7, 10], [-4, -8, 10]], [45, 45, 45])  # mm; nobody needs to know them


presses = [scenes.sphere_press(3.0, 0.5, at, 120, 160, 0.1) for at in ((-4, -3), (4, -3), (-4, 3), (4, 3))]
other = scenes.sphere_press(5.0, 0.4, (1.0, 1.0), 120, 160, 0.1)
for number, scene in enumerate([scenes.undeformed(other), *presses, other]):
    gel = scenes.render(scene, lights, noise_std=0.002, bits=8, seed=number).detach()
    vts.write_image(folder / f"frame_{number}.png", torch.nn.functional.pad(gel, (20, 20, 20, 20))[0])  # the camera sees more

(folder / "my_sensor.yaml").write_text("""
name: my_sensor
height: 120                 # of the images that are worked on, pixels
width: 160
mm_per_pixel: 0.1           # size of a pixel on the skin
roi_px: [20, 20, 160, 120]  # where the gel lies in the camera's frame: left, top, width, height
raw_size_px: [[160, 200]]   # height and width of that frame
""")
sensor = vts.Sensor.load(folder / "my_sensor.yaml")
background, *balls, image = (sensor.read_image(folder / f"frame_{number}.png") for number in range(6))
calibration = vts.calibrate(background, sensor, presses=[vts.Press(ball, ball_diameter_mm=6.0) for ball in balls])
calibration.save(folder / "my_unit.safetensors")
out = vts.DepthPipeline.from_calibration(calibration, mode="precise")(image[None])
print(f"a ball of 10 mm, pressed in by 0.400 mm, reads {float(out.depth_mm.max()):.3f} mm")
print(f"calibration: {folder}/my_unit.safetensors")
