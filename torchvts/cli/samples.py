"""Fetch images of a real sensor into a cache, to try the other commands on: calibration presses in gs_sdk's layout.

gelsight_mini is the example calibration of rpl-cmu/gelslam (MIT by its README), at one commit; each file is compared with its
sha256. The cache is TORCHVTS_CACHE, or torchvts in XDG_CACHE_HOME, or ~/.cache/torchvts. Prints the folder.

examples:
  torchvts samples gelsight_mini
  torchvts samples gelsight_mini --from FOLDER
  torchvts calibrate $(torchvts samples gelsight_mini) \\
      --sensor gelsight_mini --out unit.safetensors
"""

import argparse
import sys

from ..samples import SAMPLES, fetch_sample, read_sample

USAGE = "[NAME] [--from FOLDER_OR_URL]"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    parser.add_argument("name", nargs="?", choices=SAMPLES, default=SAMPLES[0], metavar="NAME", help=f"of {', '.join(SAMPLES)}")
    parser.add_argument("--from", dest="source", metavar="FOLDER_OR_URL", help="a copy of the files, in place of GitHub")


def run(arguments: argparse.Namespace) -> int:
    """Fetch, and print the folder to stdout, what it is to stderr."""
    sample = read_sample(arguments.name)
    folder = fetch_sample(arguments.name, arguments.source, progress=True)
    print(f"{sample.title}\norigin: {sample.origin}\nlicence: {sample.licence}: LICENCE.txt", file=sys.stderr)
    print(folder)
    print(f"next: torchvts calibrate {folder} --sensor {arguments.name} --out unit.safetensors", file=sys.stderr)
    return 0
