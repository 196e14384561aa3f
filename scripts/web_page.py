#!/usr/bin/env python3
"""The page as a folder that any server of files shows: its files, the library, a drawn press, and a plan of each shipped prior.

python scripts/web_page.py --out out/web
"""

import argparse
from pathlib import Path

from torchvts.cli.web_page import write_page


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/web"), help="folder (default: out/web)")
    folder = parser.parse_args().out
    write_page(folder)
    print(f"{folder}: python -m http.server --directory {folder} shows it")


if __name__ == "__main__":
    main()
