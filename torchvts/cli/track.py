"""Pose of a touched object in every frame of a camera or a recording, from where it first touches.

The first frames must be without contact. The reference is the first frame with a contact of --least-mm2, or the image --reference.
Writes poses.csv (a pose a frame, standard deviations, what is unknown, why it was lost), summary.json and a video with
the axes of the reference on the image. Ctrl-C ends it and finishes the files. Exit status 1 where the object was lost, a frame
was left out, or depth is not metric.

examples:
  torchvts track video.avi --sensor gelsight_wedge --out out/track
  torchvts track unit.safetensors 0 --out out/track --reference press.png
"""

import argparse
import contextlib
import csv
import json
import math
import statistics
from collections import Counter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from ..core.checks import NAMED, check_positive
from ..core.files import Pixels, check_folder, make_folder, read_image, write_atomically
from ..pose import OutputFrame, PoseTracker, TrackedPose
from ..pose.follow import TRUSTED_DEG, TRUSTED_MM
from ..stream import LiveView, Overlay, TactileFrame, TactileStream, VideoFile, has_screen
from ..stream.files import summary_of
from ..stream.view import AXIS_COLOURS
from .options import add_length_unit, add_out, ended
from .parser import UsageError
from .source import add_source, add_video, load_unit, open_stream, play

USAGE = "CALIBRATION SOURCE --out FOLDER"

COLUMNS = ("frame", "time_s", *(f"T{row}{column}" for row in range(3) for column in range(4)))
QUALITY = (
    "converged", "lost", "ambiguous", "alternatives", "std_x_mm", "std_y_mm", "std_z_mm", "std_rx_deg", "std_ry_deg", "std_rz_deg",
    "keyframe", "drift_deg", "drift_mm",
)  # fmt: skip

NOT_SEEN = {"mm": 5.0, "deg": 30.0}
"""A motion with a larger standard deviation was not seen: what a contact does not show has 10 mm at its rim."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    add_source(parser)
    add_out(parser, "for poses.csv, summary.json and the video track.webm")
    add_length_unit(parser)
    parser.add_argument("--reference", type=Path, metavar="IMAGE", help="of the contact; if not given, the first large one")
    parser.add_argument("--least-mm2", type=float, default=4.0, metavar="AREA", help="contact of the first reference, mm^2 (4)")
    add_video(parser)
    parser.add_argument("--view", action="store_true", help="show surface and axes in 3D; needs a screen")
    parser.add_argument("--save", type=Path, metavar="FILE.rrd", help="record what --view shows, with or without it")


def run(arguments: argparse.Namespace) -> int:
    """Track until the source ends, and print a summary."""
    check_positive("--least-mm2", arguments.least_mm2)
    check_folder(arguments.out)
    if arguments.view and not has_screen():
        raise UsageError("--view: expected a screen, this machine has none: --save FILE.rrd records what it would show")
    if arguments.save is not None and arguments.save.suffix.lower() != ".rrd":
        raise UsageError(f"--save: expected a name ending in .rrd, got {arguments.save.name!r}: the video is written to --out")
    reference = None if arguments.reference is None else read_image(arguments.reference)
    unit, source = load_unit(arguments)
    with contextlib.ExitStack() as stack:
        stream = stack.enter_context(open_stream(arguments, unit, source))
        pitch = stream.calibration.sensor.mm_per_pixel
        tracker = None if reference is None else tracker_of_image(stream, arguments.reference, reference)
        make_folder(arguments.out)
        video = None
        if arguments.video != "none":
            video = stack.enter_context(VideoFile(arguments.out / f"track.{arguments.video}", stream.fps))
        view = None
        if arguments.view or arguments.save is not None:
            view = stack.enter_context(LiveView(pitch, stream.metric, save=arguments.save, viewer=arguments.view))
        tracking = _Tracking(arguments, stream, video, view, tracker)
        lost = play(stream, tracking.add)
        if tracking.tracker is None:
            raise lost or ValueError("source: expected a contact to track, got none: see --least-mm2")
        with write_atomically(arguments.out / "poses.csv") as temporary, open(temporary, "w", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS + QUALITY)
            writer.writeheader()
            writer.writerows(tracking.rows)
        found = summary(tracking, stream)
        with write_atomically(arguments.out / "summary.json") as temporary:
            temporary.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    _print_summary(found)
    names = ["poses.csv", "summary.json"] + ([] if arguments.video == "none" else [f"track.{arguments.video}"])
    print(f"wrote {', '.join(names)} to {arguments.out}")
    if arguments.save is not None:
        print(f"wrote {arguments.save}; rerun {arguments.save} shows it")
    if lost is not None:
        raise lost
    step, wrong = "", found["lost"] or found["left_out"]
    if wrong:
        step = "column lost of poses.csv says why; torchvts diagnose CALIBRATION RECORDING looks at the frames"
    elif arguments.video != "none":
        step = f"look at {arguments.out / f'track.{arguments.video}'}: the axes should stay on the object"
    return ended(found["metric"], wrong, step)


class _Tracking:
    """Tracks from frame to frame, keeps the rows of poses.csv, and draws the axes of the reference where the object is."""

    def __init__(
        self,
        arguments: argparse.Namespace,
        stream: TactileStream,
        video: VideoFile | None,
        view: LiveView | None,
        tracker: PoseTracker | None,
    ) -> None:
        self.frame = OutputFrame(arguments.length_unit, stream.calibration.sensor)
        self.video, self.view, self.tracker, self.least_mm2 = video, view, tracker, arguments.least_mm2
        self.pitch = stream.calibration.sensor.mm_per_pixel
        self.overlay = Overlay(self.pitch, stream.metric)
        self.reference: int | None = None
        self.rows: list[dict[str, object]] = []

    def add(self, frame: TactileFrame) -> bool:
        found: TrackedPose | None = None
        if self.tracker is not None:
            found = self.tracker(frame.output)
            self.rows.append(record(frame, found, self.frame))
        elif float(frame.output.contact.sum()) * self.pitch**2 >= self.least_mm2:
            self.tracker = PoseTracker(frame.output, self.pitch)
            self.reference = frame.number
            print(f"frame {frame.number}: the reference")
        if self.video is not None:
            self.video.write(self.picture(frame, found))
        if self.view is not None:
            self.view.add(frame)
            self.view.add_axes(None if found is None or found.lost or self.tracker is None else axes(found, self.tracker))
        return True

    def picture(self, frame: TactileFrame, found: TrackedPose | None) -> Pixels:
        """Image and depth, with the axes where the object was found."""
        if found is None or self.tracker is None:
            return self.overlay(frame, ["no reference yet"])
        image = frame.image if found.lost else draw_axes(frame.image, found, self.tracker, self.pitch)
        return self.overlay(frame._replace(image=image), [found.message])


def record(frame: TactileFrame, found: TrackedPose, written: OutputFrame) -> dict[str, object]:
    """A row of poses.csv: T_frame_reference, standard deviations of its shifts and of small turns, what speaks against it."""
    pose = [f"{value:.9g}" for value in written.pose(found.T_target_source)[:3].flatten().tolist()]
    std_of = written.covariance(found.covariance).diagonal().sqrt()
    std = [f"{value:.4g}" for value in (*(written.mm * std_of[3:]).tolist(), *torch.rad2deg(std_of[:3]).tolist())]
    named = "; ".join(found.ambiguous)
    quality = [int(found.converged), found.lost, named, len(found.alternatives), *std, found.keyframe]
    values = [frame.number, f"{frame.time_s:.6f}", *pose, *quality, f"{found.drift_deg:.4g}", f"{found.drift_mm:.4g}"]
    return dict(zip(COLUMNS + QUALITY, values, strict=True))


def axes(found: TrackedPose, tracker: PoseTracker) -> Tensor:
    """Origin and ends of the reference's axes in a frame (4, 3), mm: 2 mm long, at the middle of its contact."""
    T = found.T_target_source
    middle = torch.from_numpy(tracker.graph.keyframes[0].many.center)
    places = middle + 2.0 * torch.cat((torch.zeros(1, 3), torch.eye(3))).double()
    return places @ T[:3, :3].T + T[:3, 3]


def draw_axes(image: Tensor, found: TrackedPose, tracker: PoseTracker, mm_per_pixel: float) -> Tensor:
    """The image (3, H, W) with :func:`axes`, thin where a rotation is unknown, or known less well than to 1 degree."""
    height, width = image.shape[1:]
    moved = axes(found, tracker)
    column, row = moved[:, 0] / mm_per_pixel + 0.5 * (width - 1), 0.5 * (height - 1) - moved[:, 1] / mm_per_pixel
    ends = torch.stack((column, row), 1).round().int().tolist()
    pixels = np.ascontiguousarray((255.0 * image.clamp(0, 1)).permute(1, 2, 0).numpy().astype(np.uint8))
    vague = math.degrees(math.sqrt(float(found.covariance.diagonal()[:3].max()))) > TRUSTED_DEG
    thick = 1 if vague or any(name.startswith("rotation") for name in found.ambiguous) else 2
    for end, colour in zip(ends[1:], AXIS_COLOURS, strict=True):
        cv2.line(pixels, tuple(ends[0]), tuple(end), colour, thick, cv2.LINE_AA)
    return torch.from_numpy(pixels).permute(2, 0, 1).float() / 255.0


def tracker_of_image(stream: TactileStream, path: Path, image: Tensor) -> PoseTracker:
    """A tracker whose reference is an image."""
    image = stream.calibration.sensor.rectify(image[None])
    if reason := stream.recording.unusable(image):
        raise ValueError(f"reference: {path}: {reason}")
    with torch.inference_mode():
        return PoseTracker(stream.recording.pipe(image), stream.calibration.sensor.mm_per_pixel)


def summary(tracking: _Tracking, stream: TactileStream) -> dict[str, Any]:
    """What summary.json holds: counts of frames, what was unknown, keyframes, drift, and whether depth is metric."""
    tracker, rows = tracking.tracker, tracking.rows
    assert tracker is not None
    lost = [row for row in rows if row["lost"]]
    followed = [row for row in rows if not row["lost"]]
    drift_deg, drift_mm = (max((float(str(row[f"drift_{u}"])) for row in followed), default=0.0) for u in ("deg", "mm"))
    return {
        **summary_of(stream, len(rows)),
        "poses": tracking.frame.axes,
        "reference_frame": tracking.reference,  # None where --reference gave an image
        "lost": len(lost),
        "lost_because": dict(Counter(str(row["lost"]) for row in lost).most_common()),
        "converged": sum(row["converged"] == 1 for row in rows),
        "unknown_motions": dict(Counter(str(row["ambiguous"]) for row in rows if row["ambiguous"]).most_common()),
        "keyframes": len(tracker.graph.keyframes),
        "loops_closed": [{"deg": deg, "mm": mm} for deg, mm in tracker.closures],
        "median_std": _median_std(followed),
        "largest_drift_deg": drift_deg,
        "largest_drift_mm": drift_mm,
    }


def _median_std(rows: list[dict[str, object]]) -> dict[str, float | None]:
    """Median standard deviation of each shift, mm, and of each turn, degrees; None where it was not seen."""
    names = [name.removeprefix("std_") for name in QUALITY if name.startswith("std_")]
    found = {name: statistics.median([float(str(row[f"std_{name}"])) for row in rows] or [math.inf]) for name in names}
    return {name: std if std < NOT_SEEN[name.rpartition("_")[2]] else None for name, std in found.items()}


def _several(number: int, name: str) -> str:
    return f"{number} {name}" if number == 1 else f"{number} {name}s"


def _print_summary(found: dict[str, Any]) -> None:
    loops = len(found["loops_closed"])
    counts = _several(found["frames"], "frame"), f"{found['lost']} lost", _several(found["keyframes"], "keyframe")
    print(", ".join((*counts, f"{_several(loops, 'loop')} closed")))
    for reason in list(found["lost_because"])[:NAMED]:
        print(f"  lost: {reason}")
    if found["left_out"]:
        print(f"  {_several(found['left_out'], 'frame')} left out, named above")
    if found["unknown_motions"]:
        unknown = found["unknown_motions"]
        print(f"  {_several(sum(unknown.values()), 'frame')} with unknown motions, mostly: {next(iter(unknown))}")
    uncertain = found["frames"] - found["lost"] - found["converged"]
    if uncertain:
        print(f"  {_several(uncertain, 'frame')} known less well than to {TRUSTED_DEG:g} degree and {TRUSTED_MM:g} mm")
        said = {name: "not seen" if value is None else f"{value:.2g}" for name, value in found["median_std"].items()}
        shifts, turns = (", ".join(f"{axis} {said[key.format(axis)]}" for axis in "xyz") for key in ("{}_mm", "r{}_deg"))
        print(f"  standard deviations, medians: {shifts} mm; turns about {turns} degrees")
