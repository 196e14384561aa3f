"""Live depth of a camera; where none is named, a drawn film of a ball that is pressed in and released stands in for it.

    python examples/camera.py
    python examples/camera.py 0 unit.safetensors

The second: the number of a camera, the path of a video, or the URL of a network camera, and what ``torchvts calibrate`` wrote for
this unit. The first frames must be without contact. The film goes to out/film.
"""

import sys
from pathlib import Path

import torch

import torchvts as vts
from torchvts import scenes

sensor = vts.Sensor("rig", height=120, width=160, mm_per_pixel=0.1)  # of the drawn film
lights = vts.PointLights([[12, 3, 15], [-9, 8, 15], [-3, -12, 15]], [150, 150, 150])
calibration = vts.Calibration.from_lights(lights, sensor)


def draw_film(folder: Path) -> Path:
    """Forty frames, a folder of images: without contact, a ball that goes in and out, without contact."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(40):
        press_mm = 0.5 * max(0.0, float(torch.sin(torch.tensor((number - 15) * torch.pi / 20))))
        scene = scenes.sphere_press(4.0, max(press_mm, 0.01), (1.0, 0.5), 120, 160, 0.1)
        scene = scene if press_mm > 0.01 else scenes.undeformed(scene)
        image = scenes.render(scene, lights, noise_std=0.003, bits=8, seed=number)[0].detach()
        vts.write_image(folder / f"{number:03d}.png", image)
    return folder


if len(sys.argv) == 2:
    sys.exit("expected a source and the calibration of its unit: python examples/camera.py 0 unit.safetensors")
source = sys.argv[1] if len(sys.argv) > 1 else draw_film(Path("out/film"))
if len(sys.argv) > 1:
    calibration = vts.Calibration.load(sys.argv[2])
deepest_mm = []
with vts.stream.TactileStream(source, calibration, mode="fast") as stream:
    for number, _, _, out in stream:
        deepest_mm.append(float(out.depth_mm.max()))
        print(f"frame {number}: deepest {deepest_mm[-1]:.3f} mm" + (f"; in doubt: {stream.doubt}" if stream.doubt else ""))
