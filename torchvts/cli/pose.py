"""Pose of a pressed object relative to a reference press: two frames, a sequence against a reference, or two clouds.

SOURCE and REFERENCE are images, and CALIBRATION is what torchvts calibrate wrote; a folder of images or a video as SOURCE is
followed frame by frame. Two clouds (.pcd, .ply) need no calibration. Exit status 1 where a pose was not found, or
depth is not metric.

examples:
  torchvts pose unit.safetensors source.png reference.png --out out/pose
  torchvts pose unit.safetensors video.avi reference.png --out out/all
  torchvts pose source.ply reference.pcd --out out/pose
"""

import argparse
import json
import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from .. import viz
from ..core.files import check_folder, make_folder, read_image, write_atomically
from ..core.recordings import count_frames
from ..model import Calibration
from ..pipeline import DepthOutput
from ..pose import OutputFrame, contact_cloud, read_point_cloud, register_depth, register_points, write_point_cloud
from ..pose.clouds import CLOUD_SUFFIXES
from ..pose.result import Registration
from ..stream import Recording, frames
from .options import add_length_unit, add_model, add_out, ended, load_calibration
from .parser import UsageError

USAGE = "CALIBRATION SOURCE REFERENCE --out FOLDER"

LEAST_MM, MOST_MM = 0.2, 2000.0
"""Extent of a cloud that a touch can be compared with; metres for millimetres, or the reverse, lie outside for 1 to 200 mm."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    parser.add_argument("files", type=Path, nargs="+", metavar="FILE", help="calibration, source, reference; or two clouds")
    add_out(parser, "for pose.json and pictures")
    add_model(parser)
    parser.add_argument("--cloud", choices=["pcd", "ply", "none"], default="none", help="write both contacts, the source moved")
    add_length_unit(parser)
    parser.add_argument("--no-pictures", action="store_true", help="no picture of both contacts")


def run(arguments: argparse.Namespace) -> int:
    """Find the poses, write pose.json, and print them."""
    clouds = [path.suffix.lower() in CLOUD_SUFFIXES for path in arguments.files]
    names = ", ".join(map(str, arguments.files))
    if any(clouds) and (not all(clouds) or len(clouds) != 2):
        raise UsageError(f"expected two clouds and nothing beside them, got {names}")
    if not any(clouds) and len(clouds) != 3:
        raise UsageError(f"expected a calibration file, an image, folder or video, and an image as reference, got {names}")
    check_folder(arguments.out)
    if all(clouds):
        metric, results = True, of_clouds(arguments, *arguments.files)
    else:
        unit = load_calibration(arguments.files[0])
        metric, results = unit.metric, of_frames(arguments, unit, *arguments.files[1:])
    with write_atomically(make_folder(arguments.out) / "pose.json") as temporary:
        temporary.write_text(json.dumps(results if len(results) > 1 else results[0], indent=1) + "\n")
    without = [result for result in results if not result["converged"]]
    if len(results) > 1 and without:
        print(f"no pose in {len(without)} of {len(results)} frames, the first {without[0]['frame']}: {without[0]['message']}")
    print(f"wrote {arguments.out / 'pose.json'}")
    step = "T_target_source of pose.json takes points of the source to the target"
    if without and not all(clouds):
        step = f"torchvts diagnose {arguments.files[0]} {arguments.files[1]} says what is wrong with the frames"
    return ended(metric, without, step)


def of_clouds(arguments: argparse.Namespace, source_file: Path, target_file: Path) -> list[dict[str, Any]]:
    """Register two clouds."""
    (source, source_normals), (target, target_normals) = (read_point_cloud(path) for path in (source_file, target_file))
    frame = OutputFrame(arguments.length_unit)
    source, target = frame.mm * source, frame.mm * target
    for path, points in ((source_file, source), (target_file, target)):
        width_mm = float((points.amax(0) - points.amin(0)).max())
        if not LEAST_MM <= width_mm <= MOST_MM:
            raise ValueError(
                f"{path}: expected points that lie {LEAST_MM:g} to {MOST_MM:g} mm apart, got {width_mm:.3g} mm: in metres? "
                f"--unit m reads them so, this was read as {arguments.length_unit}"
            )
    found = register_points(source, target, source_normals=source_normals, target_normals=target_normals)
    print_result(source_file.stem, found, source, target)
    draw(arguments, source_file.stem, (source, target), found, frame)
    return [record(source_file.stem, found, frame)]


def of_frames(arguments: argparse.Namespace, calibration: Calibration, source: Path, reference: Path) -> list[dict[str, Any]]:
    """Register every frame with the reference."""
    recording, pitch = Recording(calibration, arguments.mode, network=arguments.network), calibration.sensor.mm_per_pixel
    written = OutputFrame(arguments.length_unit, calibration.sensor)

    def depth_of(image: Tensor) -> DepthOutput:
        image = calibration.sensor.rectify(image[None])
        if reason := recording.unusable(image):
            raise ValueError(f"frame: expected one that can be used: {reason}")
        return recording(image)

    try:
        target = depth_of(read_image(reference))
        target_points = contact_cloud(target, pitch, 4000)[0]
    except ValueError as error:
        raise ValueError(f"reference: {str(error).removeprefix('frame: ')}") from error
    results: list[dict[str, Any]] = []
    last = None
    count = count_frames(source)
    for name, image in tqdm(frames(source), total=count, unit="frame", disable=None):
        try:
            frame = depth_of(image)
            found = register_depth(frame, target, pitch, initial=last)
        except ValueError as error:  # a frame of a sequence that cannot be used, or without contact
            if count == 1:
                raise
            results.append({"frame": name, "converged": False, "message": str(error)})
            continue
        last = found.T_target_source if found.converged else last
        results.append(record(name, found, written))
        points = contact_cloud(frame, pitch, 4000)[0]
        if len(results) <= 20:
            print_result(name, found, points, target_points)
        if count == 1:
            draw(arguments, name, (points, target_points), found, written)
    return results


def record(name: str, found: Registration, written: OutputFrame) -> dict[str, Any]:
    """A result, for pose.json."""
    return {
        "frame": name,
        "axes": written.axes,
        "T_target_source": written.pose(found.T_target_source).tolist(),
        "rmse_mm": found.rmse_mm if math.isfinite(found.rmse_mm) else None,
        "fitness": found.fitness,
        "converged": found.converged,
        "message": found.message,
        "covariance_order": ["w_x", "w_y", "w_z", "t_x", "t_y", "t_z"],
        "covariance": written.covariance(found.covariance).tolist(),
        "ambiguous": found.ambiguous,
        "alternatives": [written.pose(T).tolist() for T in found.alternatives],
    }


def print_result(name: str, found: Registration, source: Tensor, target: Tensor) -> None:
    """Print a pose in words; where it is one of several that fit, also how the contact has moved, of points (N, 3), mm."""
    T = found.T_target_source
    turn = float(torch.rad2deg(torch.atan2(T[1, 0], T[0, 0])))
    tilt = float(torch.rad2deg(torch.acos(T[2, 2].clamp(-1, 1))))
    x, y, z = T[:3, 3].tolist()
    fit = f", rmse {1000 * found.rmse_mm:.1f} um" if math.isfinite(found.rmse_mm) else ""
    print(f"{name}: {'converged' if found.converged else 'NOT converged'}{fit}: {found.message}")
    which = ""
    if found.ambiguous or found.alternatives:
        right, up = (target.double().mean(0) - source.double().mean(0))[:2].tolist()
        print(f"{name}: whichever pose it is, the middle of the contact moved by ({right:.2f}, {up:.2f}) mm, x right, y up")
        which = "one of the poses that fit: "
    print(f"{name}: {which}turned {turn:.3f} degrees in the plane, tilted {tilt:.3f}, moved ({x:.4f}, {y:.4f}, {z:.4f}) mm")


def draw(
    arguments: argparse.Namespace, name: str, contacts: tuple[Tensor, Tensor], found: Registration, written: OutputFrame
) -> None:
    """Draw both contacts, and write their clouds."""
    make_folder(arguments.out)
    (source, target), T = contacts, found.T_target_source
    if not arguments.no_pictures:
        viz.save_figure(viz.pose_figure(source, target, T, name), arguments.out / f"{name}_pose.png")
    if arguments.cloud != "none":
        for which, points in (("moved", source.double() @ T[:3, :3].T + T[:3, 3]), ("target", target)):
            path = arguments.out / f"{name}_{which}.{arguments.cloud}"
            write_point_cloud(path, written.points(points), text=written.axes)
