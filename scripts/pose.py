"""Pose of a pressed object relative to a reference press: two frames, a sequence against a reference, or two clouds.

python scripts/pose.py source.png reference.png --calibration unit.safetensors --out out/pose
python scripts/pose.py folder_or_video reference.png --calibration unit.safetensors --out out/track
python scripts/pose.py source.ply reference.pcd --out out/pose
"""

import argparse
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

import torchvts as vts
from torchvts import viz
from torchvts.core.files import count_frames, read_frames, write_atomically
from torchvts.pose import contact_cloud, read_point_cloud, write_point_cloud
from torchvts.pose.clouds import CLOUD_SUFFIXES


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path, help="image, or .pcd / .ply; a folder of images or a video is tracked frame by frame")
    parser.add_argument("target", type=Path, help="the reference: an image, or .pcd / .ply")
    parser.add_argument("--calibration", type=Path, help="file that calibrate.py wrote; not needed for clouds")
    parser.add_argument("--out", type=Path, required=True, help="folder for pose.json and pictures")
    parser.add_argument("--mode", choices=["fast", "precise", "auto"], default="precise")
    parser.add_argument("--cloud", choices=["pcd", "ply", "none"], default="none", help="write both contacts, the source moved")
    parser.add_argument("--no-pictures", action="store_true")
    arguments = parser.parse_args(argv)
    clouds = [path.suffix.lower() in CLOUD_SUFFIXES for path in (arguments.source, arguments.target)]
    if any(clouds) and not all(clouds):
        raise ValueError("source and target: expected two images or two clouds, got one of each")
    arguments.out.mkdir(parents=True, exist_ok=True)
    results = of_clouds(arguments) if all(clouds) else of_frames(arguments)
    with write_atomically(arguments.out / "pose.json") as temporary:
        temporary.write_text(json.dumps(results if len(results) > 1 else results[0], indent=1) + "\n")
    print(f"wrote {arguments.out / 'pose.json'}")
    return 0 if all(result["converged"] for result in results) else 2


def of_clouds(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    (source, source_normals), (target, target_normals) = (read_point_cloud(p) for p in (arguments.source, arguments.target))
    found = vts.register_points(source, target, source_normals=source_normals, target_normals=target_normals)
    print_result(arguments.source.stem, found)
    draw(arguments, arguments.source.stem, source, target, found)
    return [record(arguments.source.stem, found)]


def of_frames(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    if arguments.calibration is None:
        raise ValueError("--calibration: expected the file that calibrate.py wrote, for images must become depth first")
    calibration = vts.Calibration.load(arguments.calibration)
    pipe = vts.DepthPipeline.from_calibration(calibration, arguments.mode if calibration.response is None else "auto")
    pitch = calibration.sensor.mm_per_pixel
    with torch.inference_mode():
        target = pipe(calibration.sensor.rectify(vts.read_image(arguments.target)[None]))
    target_points = contact_cloud(target, pitch, 4000)[0]
    results: list[dict[str, Any]] = []
    last = None
    for name, image in tqdm(read_frames(arguments.source), total=count_frames(arguments.source), unit="frame", disable=None):
        with torch.inference_mode():
            frame = pipe(calibration.sensor.rectify(image[None]))
        try:
            found = vts.register_depth(frame, target, pitch, initial=last)
        except ValueError as error:  # a frame of a sequence without contact
            if count_frames(arguments.source) == 1:
                raise
            results.append({"frame": name, "converged": False, "message": str(error)})
            continue
        last = found.T_target_source if found.converged else last
        results.append(record(name, found))
        if len(results) <= 20:
            print_result(name, found)
        if count_frames(arguments.source) == 1:
            draw(arguments, name, contact_cloud(frame, pitch, 4000)[0], target_points, found)
    return results


def record(name: str, found: vts.pose.Registration) -> dict[str, Any]:
    return {
        "frame": name,
        "T_target_source": found.T_target_source.tolist(),
        "rmse_mm": found.rmse_mm if math.isfinite(found.rmse_mm) else None,
        "fitness": found.fitness,
        "converged": found.converged,
        "message": found.message,
        "covariance_order": ["w_x", "w_y", "w_z", "t_x", "t_y", "t_z"],
        "covariance": found.covariance.tolist(),
        "ambiguous": found.ambiguous,
        "alternatives": [T.tolist() for T in found.alternatives],
    }


def print_result(name: str, found: vts.pose.Registration) -> None:
    T = found.T_target_source
    turn = float(torch.rad2deg(torch.atan2(T[1, 0], T[0, 0])))
    tilt = float(torch.rad2deg(torch.acos(T[2, 2].clamp(-1, 1))))
    x, y, z = T[:3, 3].tolist()
    print(f"{name}: {'converged' if found.converged else 'NOT converged'}, rmse {1000 * found.rmse_mm:.1f} um: {found.message}")
    which = "one of the poses that fit: " if found.ambiguous or found.alternatives else ""
    print(f"{name}: {which}turned {turn:.3f} degrees in the plane, tilted {tilt:.3f}, moved ({x:.4f}, {y:.4f}, {z:.4f}) mm")


def draw(
    arguments: argparse.Namespace, name: str, source: torch.Tensor, target: torch.Tensor, found: vts.pose.Registration
) -> None:
    T = found.T_target_source
    if not arguments.no_pictures:
        viz.save_figure(viz.pose_figure(source, target, T, name), arguments.out / f"{name}_pose.png")
    if arguments.cloud != "none":
        write_point_cloud(arguments.out / f"{name}_moved.{arguments.cloud}", source.double() @ T[:3, :3].T + T[:3, 3])
        write_point_cloud(arguments.out / f"{name}_target.{arguments.cloud}", target)


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (OSError, ValueError, TypeError, ImportError) as error:
        sys.exit(f"error: {error}")
