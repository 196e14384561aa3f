"""Depth from camera images: an image, a folder of images or a video in; depth, clouds and pictures out.

python scripts/reconstruct.py unit.safetensors press.png --out out/press
python scripts/reconstruct.py unit.safetensors folder/ --out out/all --depth npy --cloud ply --mode precise
"""

import argparse
import itertools
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from tqdm import tqdm

import torchvts as vts
from torchvts import viz
from torchvts.core.files import count_frames, read_frames, write_atomically, write_depth_png

T = TypeVar("T")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("calibration", type=Path, help="file that calibrate.py wrote")
    parser.add_argument("source", type=Path, help="image, folder of images, or video")
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")
    parser.add_argument("--mode", choices=["fast", "precise", "auto"], default="auto")
    parser.add_argument("--depth", choices=["png", "npy", "none"], default="png", help="png: 16 bits, 32768 + depth / 0.0001 mm")
    parser.add_argument("--cloud", choices=["pcd", "ply", "none"], default="none", help="contact points in mm, y up")
    parser.add_argument("--no-pictures", action="store_true", help="leave out the contour and surface pictures")
    parser.add_argument("--batch", type=int, default=8)
    arguments = parser.parse_args()
    calibration = vts.Calibration.load(arguments.calibration)
    pipe = vts.DepthPipeline.from_calibration(calibration, arguments.mode)
    frames = read_frames(arguments.source)
    arguments.out.mkdir(parents=True, exist_ok=True)
    pitch = calibration.sensor.mm_per_pixel
    rows = []
    with torch.inference_mode(), tqdm(total=count_frames(arguments.source), unit="frame") as bar:
        for batch in batches(frames, max(1, arguments.batch)):
            images = torch.cat([calibration.sensor.rectify(image[None]) for _, image in batch])
            result = pipe(images)
            for k, (name, _) in enumerate(batch):
                frame = vts.DepthOutput(*(t[k : k + 1] for t in result))
                write_frame(arguments, name, images[k : k + 1], frame, pitch)
                area = float(frame.contact.double().sum()) * pitch**2
                rows.append((name, float(frame.depth_mm.max()), area))
                bar.update()
    print("| frame | deepest mm | contact mm^2 |\n|---|---|---|")
    for name, deepest, area in rows[:20]:
        print(f"| {name} | {deepest:.3f} | {area:.2f} |")
    if len(rows) > 20:
        print(f"... {len(rows) - 20} more")
    with write_atomically(arguments.out / "frames.csv") as temporary:
        temporary.write_text("frame,deepest_mm,contact_mm2\n" + "".join(f"{n},{d:.6f},{a:.6f}\n" for n, d, a in rows))
    print(f"wrote {len(rows)} frames to {arguments.out}")
    return 0


def batches(items: Iterator[T], size: int) -> Iterator[list[T]]:
    while batch := list(itertools.islice(items, size)):
        yield batch


def write_frame(arguments: argparse.Namespace, name: str, image: torch.Tensor, frame: vts.DepthOutput, pitch: float) -> None:
    stem = arguments.out / name
    if arguments.depth == "png":
        write_depth_png(f"{stem}_depth.png", frame.depth_mm)
    elif arguments.depth == "npy":
        with write_atomically(f"{stem}_depth.npy") as temporary:
            np.save(temporary, frame.depth_mm[0, 0].numpy())
    if arguments.cloud != "none" and bool(frame.contact.any()):
        from torchvts.pose import write_point_cloud

        inside = frame.contact[0, 0]
        normals = frame.normal[0].permute(1, 2, 0)[inside] * torch.tensor([1.0, -1.0, 1.0])  # y up
        write_point_cloud(f"{stem}.{arguments.cloud}", vts.depth_to_points(frame.depth_mm, pitch, frame.contact), normals)
    if not arguments.no_pictures:
        viz.save_figure(viz.depth_figure(frame.depth_mm, pitch, image, frame.contact, name), f"{stem}_picture.png")


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (OSError, ValueError, TypeError, ImportError) as error:
        sys.exit(f"error: {error}")
