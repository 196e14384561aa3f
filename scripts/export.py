"""Export a calibrated unit to files that run without torchvts, and compare each with the pipeline in a process without it.

python scripts/export.py unit.safetensors --out folder
python scripts/export.py unit.safetensors --out folder --mode precise --format torchscript onnx --frames presses/
"""

import argparse
import itertools
import sys
from collections.abc import Sequence
from pathlib import Path

import torch

import torchvts as vts
from torchvts import export
from torchvts.core.files import read_frames


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("calibration", type=Path, help="file that calibrate.py wrote")
    parser.add_argument("--out", type=Path, required=True, help="folder for the files")
    parser.add_argument("--mode", choices=["fast", "precise", "auto"], default="fast")
    parser.add_argument("--format", nargs="+", default=list(export.FORMATS), metavar="NAME", help=", ".join(export.FORMATS))
    parser.add_argument("--frames", type=Path, help="image, folder or video to compare on, with synthetic frames; 8 at most")
    arguments = parser.parse_args(argv)
    calibration = vts.Calibration.load(arguments.calibration)
    pipe = vts.DepthPipeline.from_calibration(calibration, arguments.mode)
    images = export.sample_frames(calibration)
    if arguments.frames:
        real = [calibration.sensor.rectify(image[None]) for _, image in itertools.islice(read_frames(arguments.frames), 8)]
        images = torch.cat([*real, images])
    rows = export.export_checked(pipe, arguments.out, arguments.format, images)
    print("| format | file | kB | largest depth difference, mm | result |\n|---|---|---|---|---|")
    for row in rows:
        result = "ok" if row.ok else f"failed: {row.reason}"
        print(f"| {row.format} | {row.path} | {row.size_kb:.0f} | {row.difference_mm:.2g} | {result} |")
    return 0 if all(row.ok for row in rows) else 1


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (OSError, ValueError, TypeError, ImportError) as error:
        sys.exit(f"error: {error}")
