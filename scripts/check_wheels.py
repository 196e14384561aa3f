#!/usr/bin/env python3
"""What the wheels of a folder hold: the library of their platform with its functions, and the page; those of this machine are run.

python scripts/check_wheels.py out/wheels
"""

import argparse
import os
import platform
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

from torchvts.compiled.binding import SIGNATURES
from torchvts.core.tables import markdown

HEADS = {
    "manylinux_2_17_x86_64": (b"\x7fELF", 18, b"\x3e\x00"),
    "manylinux_2_17_aarch64": (b"\x7fELF", 18, b"\xb7\x00"),
    "macosx_11_0_arm64": (b"\xcf\xfa\xed\xfe", 4, b"\x0c\x00\x00\x01"),
    "win_amd64": (b"MZ", 0, b"MZ"),
}
"""How a library of a platform begins, and where its machine stands in it."""

LIBRARY, PAGE = "torchvts/compiled/csrc/libtorchvts.so", "torchvts/web/"
MOST_PAGE_BYTES = 400_000

PRESS = """
import torch, torchvts as vts
from torchvts.compiled import library
lights = vts.PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900, 900, 900])
unit = vts.Calibration.from_lights(lights, vts.Sensor("rig", 48, 64, 0.5))
image = vts.scenes.render(vts.scenes.sphere_press(8.0, 1.0, height=48, width=64, mm_per_pixel=0.5), lights).detach()
pipe = vts.DepthPipeline.from_calibration(unit, "precise")
frozen = pipe.freeze()
assert frozen.compiled and "site-packages" not in vts.__file__, frozen.not_compiled
print(f"{float((frozen(image).depth_mm - pipe(image).depth_mm).abs().max()):.1g} mm off PyTorch")
"""


def runs_here(name: str) -> bool:
    """Whether a platform is this machine's."""
    system = {"Linux": "manylinux", "Darwin": "macosx", "Windows": "win"}.get(platform.system(), "none")
    return name.startswith(system) and name.endswith(platform.machine().lower())


def checked(wheel: Path) -> list[str]:
    """A row of the table."""
    name = wheel.stem.split("-")[-1]
    with zipfile.ZipFile(wheel) as content, tempfile.TemporaryDirectory() as folder:
        library = content.read(LIBRARY)
        magic, at, machine = HEADS[name]
        missing = [function for function in SIGNATURES if function.encode() not in library]
        if not library.startswith(magic) or library[at : at + len(machine)] != machine or missing:
            raise SystemExit(f"{wheel.name}: expected a library for {name} with all functions, got another, without {missing}")
        page = [info for info in content.infolist() if info.filename.startswith(PAGE)]
        size = sum(info.file_size for info in page)
        if PAGE + "torchvts.wasm" not in content.namelist() or size > MOST_PAGE_BYTES:
            raise SystemExit(f"{wheel.name}: expected the page with torchvts.wasm in {MOST_PAGE_BYTES} bytes, got {size}")
        ran = "not run: its functions are there"
        if runs_here(name):
            content.extractall(folder)
            environment = os.environ | {"PYTHONPATH": folder}
            done = subprocess.run([sys.executable, "-c", PRESS], env=environment, cwd=folder, capture_output=True, text=True)
            if done.returncode:
                raise SystemExit(f"{wheel.name}: {done.stderr}")
            ran = f"run: {done.stdout.strip()}"
    return [name, f"{len(library) / 1e3:.0f} kB", f"{size / 1e3:.0f} kB", f"{wheel.stat().st_size / 1e6:.2f} MB", ran]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="of the wheels")
    wheels = sorted(parser.parse_args().folder.glob("*.whl"))
    print(markdown(["platform", "library", "page", "wheel", "here"], [checked(wheel) for wheel in wheels]))


if __name__ == "__main__":
    main()
