"""A folder of frames to depth, one file a frame. It goes on where it was stopped, and torchrun shares it among processes.

    python examples/dataset.py

The command ``torchvts reconstruct unit.safetensors FOLDER --out out/all`` does the same (docs/datasets.md).
"""

from pathlib import Path

import torchvts as vts
from torchvts import scenes
from torchvts.dataset import reconstruct_dataset

# Draw a folder of frames and calibrate; take your own folder and calibration file in their place.
folder = Path("out/dataset")
(folder / "frames").mkdir(parents=True, exist_ok=True)
lights = vts.PointLights([[12, 3, 15], [-9, 8, 15], [-3, -12, 15]], [150, 150, 150])
for number in range(6):
    scene = scenes.sphere_press(4.0, 0.2 + 0.05 * number, (number - 2.5, 0.0), 120, 160, 0.1)
    image = scenes.render(scene, lights, noise_std=0.003, bits=8, seed=number)[0].detach()
    vts.write_image(folder / "frames" / f"{number:03d}.png", image)
sensor = vts.Sensor("rig", height=120, width=160, mm_per_pixel=0.1)
vts.Calibration.from_lights(lights, sensor).save(folder / "unit.safetensors")

report = reconstruct_dataset(folder / "unit.safetensors", folder / "frames", folder / "depth", mode="fast", pictures=False)
for number in range(6):
    result = vts.read_result(folder / "depth" / f"{number:03d}.npz")  # depth_mm, normal, contact, ...
    print(f"frame {number}: deepest {float(result.depth_mm.max()):.3f} mm, pressed in by {0.2 + 0.05 * number:.3f} mm")
print(f"results and the table frames.csv: {folder}/depth")
