#!/usr/bin/env python3
"""The drawn press that the page opens with: its plan and its image.

python scripts/web_demo.py --out out/web
"""

import argparse
from pathlib import Path

import torch

import torchvts as vts
from torchvts.core.files import make_folder, write_image

HEIGHT, WIDTH, PITCH = 120, 160, 0.12


def demo_unit() -> tuple[vts.DepthPipeline, torch.Tensor]:
    """A drawn rig of three lights, and its image (3, H, W) of a ball pressed in."""
    lights = vts.PointLights([[13, 6, 16], [-12, 8, 16], [-1, -14, 16]], [210, 210, 210]).requires_grad_(False)
    press = vts.scenes.sphere_press(4.0, 0.9, (0.6, -0.4), HEIGHT, WIDTH, PITCH)
    camera = {"noise_std": 0.003, "bits": 8}
    background = vts.scenes.render(vts.scenes.undeformed(press), lights, **camera, seed=1).detach()
    image = vts.scenes.render(press, lights, **camera, seed=2).detach()
    unit = vts.Calibration.from_lights(lights, vts.Sensor("drawn rig", HEIGHT, WIDTH, PITCH), background[0])
    return vts.DepthPipeline.from_calibration(unit, "precise"), image[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/web"), help="folder (default: out/web)")
    folder = make_folder(parser.parse_args().out)
    pipe, image = demo_unit()
    frozen = pipe.freeze()
    frozen.save(folder / "demo.plan")
    write_image(folder / "demo.png", image)
    print(f"{folder}: a press {float(frozen(image[None]).depth_mm.max()):.3f} mm deep")


if __name__ == "__main__":
    main()
