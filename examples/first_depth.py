"""First depth: an image without contact and three presses of a ball calibrate a sensor; another press becomes depth.

    python examples/first_depth.py

The images are drawn. In place of them take your own: ``sensor.read_image("background.png")`` reads one.
"""

from pathlib import Path

import torchvts as vts
from torchvts import scenes, viz

PITCH = 0.1  # mm on the skin per pixel
lights = vts.PointLights([[9, 2, 10], [-6, 7, 10], [-4, -8, 10]], [45, 45, 45])  # mm; red, green, blue
balls = [scenes.sphere_press(3.0, 0.5, at, 120, 160, PITCH) for at in ((-4, -2), (4, -2), (0, 3))]  # radius, press, place: mm
other = scenes.sphere_press(5.0, 0.4, (1.0, 1.0), 120, 160, PITCH)
background, *presses, image = (
    scenes.render(scene, lights, noise_std=0.002, bits=8, seed=seed).detach()[0]  # (3, H, W), R, G, B in [0, 1]
    for seed, scene in enumerate((scenes.undeformed(other), *balls, other))
)

# Calibrate: neither the lights nor the places of the ball are told.
sensor = vts.Sensor("drawn", height=120, width=160, mm_per_pixel=PITCH)
calibration = vts.calibrate(background, sensor, presses=[vts.Press(press, ball_diameter_mm=6.0) for press in presses])

# Depth: a batch of images in, maps of millimetres out.
pipe = vts.DepthPipeline.from_calibration(calibration, mode="precise").freeze()
out = pipe(image[None])
points = vts.depth_to_points(out.depth_mm, PITCH, out.contact)  # (N, 3), mm, of the contact
print(f"deepest {float(out.depth_mm.max()):.3f} mm, pressed in by 0.400 mm; {len(points)} points of contact")

Path("out").mkdir(exist_ok=True)
viz.save_figure(viz.depth_figure(out.depth_mm, PITCH, image, out.contact), "out/first_depth.png")
print("picture: out/first_depth.png")
