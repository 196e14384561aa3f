"""Train gs_sdk's RGBXY network on presses of balls; --network of the other commands takes the file.

FOLDER has gs_sdk's layout (catalog.csv, background.png, N/gelsight.png). Centers and contact radii come from label.npz or
labels.csv, otherwise from calibration. Whole presses are held out; the epoch with the least error on them is written.

example:
  torchvts train presses/ --sensor gelsight_mini --out network.safetensors
"""

import argparse
from pathlib import Path

from ..calibration import read_presses
from ..training.presses import train_network
from .options import add_sensor, cut_frames, load_sensor
from .parser import UsageError

USAGE = "FOLDER --sensor NAME --out FILE"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="presses of balls, in gs_sdk's layout")
    add_sensor(parser)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="network to write, .safetensors")
    text = "at most (60); stops where held-out error does not fall"
    parser.add_argument("--max-epochs", type=int, default=60, metavar="N", help=text)


def run(arguments: argparse.Namespace) -> int:
    """Train, write the network, and print its errors."""
    if arguments.sensor is None:
        raise UsageError("expected --sensor")
    if arguments.out.suffix != ".safetensors":
        raise UsageError(f"--out: expected a name ending in .safetensors, got {arguments.out}")
    sensor = load_sensor(arguments.sensor)
    background, presses = cut_frames(*read_presses(arguments.folder), sensor)
    fit = train_network(background, presses, sensor, max_epochs=arguments.max_epochs, progress=True)
    training, held_out = fit.history[fit.best_epoch]
    fit.module.save(arguments.out)
    print(f"{sum(p.numel() for p in fit.module.parameters())} weights")
    print(f"RMS error of the slopes' angles: training {training:.2f} deg, held out {held_out:.2f} deg")
    print(fit.message)
    print(f"wrote {arguments.out}: torchvts reconstruct unit.safetensors INPUT --network {arguments.out} --out FOLDER uses it")
    return 0
