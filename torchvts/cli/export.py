"""Export a calibrated unit to files that run without torchvts, and compare each with the pipeline in a process of its own.

Exit status 1 where a file does not give the pipeline's depth.

examples:
  torchvts export unit.safetensors --out folder
  torchvts export unit.safetensors --out folder --mode precise \\
      --format torchscript onnx --frames presses/
"""

import argparse
import itertools
from pathlib import Path

import torch

from .. import export
from ..pipeline import unit_pipeline
from ..stream import frames
from .options import add_model, add_out, load_calibration

USAGE = "CALIBRATION --out FOLDER [--format NAME...] [--mode MODE]"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    parser.add_argument("calibration", type=Path, metavar="CALIBRATION", help="what torchvts calibrate wrote, .safetensors")
    add_out(parser, "for the files")
    add_model(parser)
    usual = [name for name in export.FORMATS if name != "plan"]
    names = f"{', '.join(usual)} (all three), or plan: for C and web pages"
    parser.add_argument("--format", nargs="+", default=usual, metavar="NAME", help=names)
    parser.add_argument("--frames", type=Path, metavar="INPUT", help="image, folder or video to compare on too; 8 frames at most")


def run(arguments: argparse.Namespace) -> int:
    """Write the files, and print a row for each."""
    calibration = load_calibration(arguments.calibration)
    pipe = unit_pipeline(calibration, arguments.mode, arguments.network)
    images = export.sample_frames(calibration)
    if arguments.frames:
        real = [calibration.sensor.rectify(image[None]) for _, image in itertools.islice(frames(arguments.frames), 8)]
        images = torch.cat([*real, images])
    rows = export.export_checked(pipe, arguments.out, arguments.format, images)
    print("| format | file | kB | largest depth difference, mm | result |\n|---|---|---|---|---|")
    for row in rows:
        result = "ok" if row.ok else f"failed: {row.reason}"
        size, difference = (format(v, kind) if v == v else "" for v, kind in ((row.size_kb, ".0f"), (row.difference_mm, ".2g")))
        print(f"| {row.format} | {row.path if size else ''} | {size} | {difference} | {result} |")
    if any(row.ok for row in rows):
        print(f"next: {arguments.out} goes where it is to run; docs/export.md loads each of its files in a few lines")
    return 0 if all(row.ok for row in rows) else 1
