"""Time of a frame in the compiled library and in exported files, in turn in one process: a table.

python scripts/export_speed.py --data ../shared/data --threads 2

The GelSight Mini of the data, without it a drawn rig of three lights. AOTInductor files of the rig take minutes to write.
"""

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

import torchvts as vts
from torchvts import export
from torchvts.evaluation import user_speed

LOADERS: dict[str, Callable[[str], Callable[[Tensor], object]]] = {
    "torchscript": torch.jit.load,
    "aoti": lambda path: torch._inductor.aoti_load_package(path),
}
"""How a file of each format is loaded."""


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of the data that holds gelsight_mini_a")
    parser.add_argument("--size", type=int, nargs=2, default=(320, 240), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--modes", nargs="+", choices=user_speed.MODES, default=user_speed.MODES)
    parser.add_argument("--formats", nargs="+", choices=LOADERS, default=list(LOADERS))
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--calls", type=int, default=100, help="timed frames of each; 20 more come before")
    arguments = parser.parse_args(argv)
    torch.set_num_threads(arguments.threads)
    size = arguments.size[1], arguments.size[0]
    unit = user_speed.drawn(size) if arguments.data is None else user_speed.mini(arguments.data, size)
    print(f"{unit.name}, {size[1]}x{size[0]}, {arguments.threads} threads, median ms of a frame")
    print("| mode | " + " | ".join(["library", *arguments.formats]) + " |\n|" + "---|" * (2 + len(arguments.formats)))
    for mode in arguments.modes:
        pipe = vts.DepthPipeline.from_calibration(unit.calibration, mode)
        with tempfile.TemporaryDirectory() as folder:
            files = [loaded(pipe, name, Path(folder)) for name in arguments.formats]
            own, *others = times([pipe, *files], unit.image, arguments.calls)
        print(f"| {mode} | {own:.2f} | " + " | ".join(f"{other:.2f}, {other / own:.1f} times" for other in others) + " |")
    return 0


def loaded(pipe: vts.DepthPipeline, name: str, folder: Path) -> Callable[[Tensor], object]:
    """The file of a format, written and loaded."""
    path = folder / export.FORMATS[name].file_name
    export.FORMATS[name].write(pipe, path)
    return LOADERS[name](str(path))


def times(calls: list[Callable[[Tensor], object]], image: Tensor, number: int) -> list[float]:
    """Median time of each, ms, one after the other in turn."""
    found: list[list[float]] = [[] for _ in calls]
    with torch.inference_mode():
        for _ in range(number + 20):
            for call, spent in zip(calls, found, strict=True):
                start = time.perf_counter()
                call(image)
                spent.append(1000.0 * (time.perf_counter() - start))
    return [statistics.median(spent[20:]) for spent in found]


if __name__ == "__main__":
    sys.exit(main())
