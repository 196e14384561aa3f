"""Find what is wrong with frames or with the calibration for them; docs/diagnose.md explains every finding.

IMAGE is one frame, or a folder, a video or a container of them: then it is said how many frames have each finding, first the one
that costs most over all of them.
Exit status 1 where there is a warning or a fault, 0 where there is none.

examples:
  torchvts diagnose unit.safetensors image.png
  torchvts diagnose unit.safetensors folder/
  torchvts diagnose unit.safetensors image.png --background now.png --json
"""

import argparse
import dataclasses
import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from torch import Tensor
from tqdm import tqdm

from ..core.checks import in_one_line
from ..core.files import read_image, rgb_from_bgr
from ..core.recordings import RawFrame, count_frames, cut_short, is_film, raw_frames
from ..dataset import list_items
from ..diagnose import SEVERITIES, Finding, diagnose
from ..diagnose.findings import COST_DEG
from ..model import Calibration
from ..stream import read_background
from .options import load_calibration

USAGE = "CALIBRATION IMAGE [--background IMAGE] [--json]"

MOST = 100
"""So many frames of a recording are looked at; of more, each second, third, ..."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    parser.add_argument("calibration", type=Path, metavar="CALIBRATION", help="what torchvts calibrate wrote, .safetensors")
    parser.add_argument("image", type=Path, metavar="IMAGE", help="frame, folder or video, as the camera gives it")
    parser.add_argument("--background", type=Path, metavar="IMAGE", help="without contact, of now, if there is one; or a video")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> int:
    """Print the findings."""
    calibration, now = load_calibration(arguments.calibration), arguments.background
    background = None
    if now is not None:
        background = read_background([now], calibration.sensor) if is_film(now) else cut(read_image(now), calibration)
    if arguments.image.is_dir() or is_film(arguments.image):
        return of_recording(arguments, background, calibration)
    diagnosis = diagnose(background, cut(read_image(arguments.image), calibration), calibration)
    if arguments.json:
        print(json.dumps({"ok": diagnosis.ok, "findings": [dataclasses.asdict(finding) for finding in diagnosis]}, indent=1))
    else:
        print(diagnosis)
        print(next_step(arguments.calibration, arguments.image, diagnosis.ok))
    return 0 if diagnosis.ok else 1


def cut(image: Tensor, calibration: Calibration) -> Tensor:
    """A frame as ``torchvts reconstruct`` cuts it; one of another size stays, and is a finding."""
    try:
        return calibration.sensor.rectify(image[None])[0]
    except ValueError:
        if tuple(image.shape[1:]) == (calibration.sensor.height, calibration.sensor.width):
            raise  # torchvts reconstruct would leave it out
        return image


def of_recording(arguments: argparse.Namespace, background: Tensor | None, calibration: Calibration) -> int:
    """Diagnose the frames of a recording, and print how many of them have each finding, first the one that costs most over all."""
    items = list(list_items(arguments.image))
    total = sum(count_frames(item.file) if item.is_film else 1 for item in items)
    if total == 0:
        raise ValueError(f"{arguments.image}: expected images or videos, got none in this folder")
    every = -(-total // MOST) if total > MOST else 1
    found: dict[str, list[tuple[str, Finding]]] = {}

    def frames() -> Iterator[tuple[str, RawFrame]]:
        for item in items:
            number = -1
            for number, frame in enumerate(raw_frames(item.file)):
                yield item.frame_name(number if item.is_film else -1), frame
            if item.is_film and (text := cut_short(item.file, number + 1)):
                found.setdefault("unreadable", []).append((item.path, Finding("unreadable", text, "fault", 1.0)))

    count = clean = 0
    for number, (name, frame) in enumerate(tqdm(frames(), total=total, desc="diagnosing", leave=False, disable=None)):
        if number % every:
            continue
        count += 1
        try:
            findings = list(diagnose(background, cut(rgb_from_bgr(frame.read()), calibration), calibration))
        except (OSError, ValueError) as error:
            findings = [Finding("unreadable", in_one_line(error), "fault", 1.0)]
        clean += all(finding.severity == "note" for finding in findings)
        for finding in findings:
            found.setdefault(finding.name, []).append((name, finding))
    rows = [summed(same) for same in found.values()]
    ok = clean == count and "unreadable" not in found
    rows.sort(key=lambda row: (sum(COST_DEG[name] * n for name, n in row["severities"].items()), len(row["frames"])), reverse=True)
    if arguments.json:
        print(json.dumps({"ok": ok, "frames": count, "of": total, "findings": rows}, indent=1))
        return 0 if ok else 1
    looked = f"{count} frames" if every == 1 else f"{count} of {total} frames"
    print(f"{looked}: {clean} without a warning or a fault")
    for row in rows:
        shares = ", ".join(f"{severity} in {n}" for severity, n in row["severities"].items())
        print(f"{shares} of {count}, such as {row['frames'][0]}: {row['message']} [{row['name']}]")
    print(next_step(arguments.calibration, arguments.image, ok))
    return 0 if ok else 1


def summed(same: list[tuple[str, Finding]]) -> dict[str, Any]:
    """One finding of several frames: the first of the worst, the names of all, the worst first, and how many of each severity."""
    ranked = sorted(same, key=lambda pair: SEVERITIES.index(pair[1].severity))
    severities = Counter(finding.severity for _, finding in ranked)
    return {**dataclasses.asdict(ranked[0][1]), "frames": [name for name, _ in ranked], "severities": dict(severities)}


def next_step(unit: Path, image: Path, ok: bool) -> str:
    """What to do after a diagnosis."""
    if ok:
        return f"next: torchvts reconstruct {unit} {image} --out FOLDER"
    return "next: mend the first finding and take the image again; docs/diagnose.md has what to do about each [name]"
