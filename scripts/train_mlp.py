"""Train gs_sdk's RGBXY network on presses of balls.

python scripts/train_mlp.py ../shared/data/gelsight_mini_a --sensor gelsight_mini --out mlp.safetensors

The folder has gs_sdk's layout (catalog.csv, background.png, N/gelsight.png). Centers and contact radii come from label.npz or
labels.csv, otherwise from calibrate. Whole presses are held out, and the epoch with the least error on them is written.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import torchvts as vts
from torchvts.evaluation.presses import train_network


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="presses of balls, in gs_sdk's layout")
    parser.add_argument("--sensor", required=True, help=f"YAML file, or one of {', '.join(vts.shipped_sensors())}")
    parser.add_argument("--out", type=Path, required=True, help="network to write, .safetensors")
    parser.add_argument("--seed", type=int, default=0, help="of weights, order and held-out presses")
    parser.add_argument("--max-epochs", type=int, default=60, help="bound; it stops when the held-out error no longer falls")
    parser.add_argument("--blur-px", type=float, default=1.0, help="blur of the images, which must be the same in use")
    arguments = parser.parse_args(argv)
    if arguments.out.suffix != ".safetensors":
        parser.error(f"--out: expected a name ending in .safetensors, got {arguments.out}")
    sensor = vts.Sensor.load(arguments.sensor)
    background, presses = vts.read_presses(arguments.folder)
    fit = train_network(
        background, presses, sensor, arguments.blur_px, arguments.seed, max_epochs=arguments.max_epochs, progress=True
    )
    training, held_out = fit.history[fit.best_epoch]
    fit.module.save(arguments.out)
    print(f"{len(presses)} presses, {sum(p.numel() for p in fit.module.parameters())} weights, seed {arguments.seed}")
    print(f"RMS error of the slopes' angles: training {training:.2f} deg, held out {held_out:.2f} deg")
    print(fit.message)
    print(
        f"wrote {arguments.out}: vts.DepthPipeline.from_gs_sdk({str(arguments.out)!r}, background, sensor) makes a pipeline of it"
    )
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (OSError, ValueError, TypeError) as error:
        sys.exit(f"error: {error}")
