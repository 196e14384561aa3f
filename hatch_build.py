"""Builds the compiled kernels in torchvts/compiled/csrc with the C compiler at hand; without one, PyTorch does their work.

CC names another compiler. WHEEL_PLATFORM, such as manylinux_2_17_aarch64, names the platform that it builds for, if not this one:
then a wheel without kernels is none.
"""

import os
import shlex
import shutil
import subprocess
import sysconfig
import tempfile
import zlib
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

FLAGS = ["-std=c11", "-O3", "-fno-math-errno", "-fno-strict-aliasing", "-ffp-contract=off"]
FLAGS += ["-fPIC", "-shared", "-fvisibility=hidden"]
PLAIN = "-DWIDE="  # compilers that cannot build a function for several kinds of processors


class CompiledKernels(BuildHookInterface):
    """Writes torchvts/compiled/csrc/libtorchvts.so before the files are collected."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        folder = Path(self.root) / "torchvts" / "compiled" / "csrc"
        library = folder / "libtorchvts.so"
        compiler = shlex.split(os.environ.get("CC") or "cc")
        if shutil.which(compiler[0]) is None:
            self.app.display_warning(f"no C compiler {compiler[0]!r}: frames will take 2 to 7 times as long")
        else:
            self.build(compiler, folder, library)
        platform = os.environ.get("WHEEL_PLATFORM")
        if not library.is_file():
            if platform:
                raise RuntimeError(f"WHEEL_PLATFORM: expected a compiler that builds for {platform}, got {compiler}, which failed")
            return
        build_data["pure_python"] = False
        build_data["tag"] = "py3-none-" + (platform or sysconfig.get_platform().replace("-", "_").replace(".", "_"))

    def build(self, compiler: list[str], folder: Path, library: Path) -> None:
        sources = [str(source) for source in sorted(folder.glob("*.c"))]
        texts = b"".join(source.read_bytes() for source in sorted(folder.glob("*.[ch]")))
        define = f"-DSOURCES={zlib.crc32(texts)}u"  # torchvts/compiled/binding.py compares it
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            built = Path(scratch) / library.name
            for more in ([], [PLAIN]):
                command = [*compiler, *FLAGS, define, *more, *sources, "-o", str(built), "-lm"]
                done = subprocess.run(command, capture_output=True, text=True)
                if done.returncode == 0:
                    os.replace(built, library)
                    return
        self.app.display_warning(f"the C compiler failed, so frames will take 2 to 7 times as long:\n{done.stderr}")
