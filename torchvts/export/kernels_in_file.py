"""An AOTInductor file that holds the compiled kernels: its graph is one operator, which the file brings along.

The operator gets the images and ``pieces``, uint8 tensors: the places of addresses, the structures (the frame's program first),
and the tables that these point to. kernels_in_file.c puts the addresses in, and calls csrc/frame.c, both linked into the file.
"""

import contextlib
import functools
import os
import shlex
import shutil
import subprocess
import tempfile
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ..accelerated.kernels import LIBRARY
from ..accelerated.portable import portable_program
from ..pipeline import DepthPipeline
from .trace import size_and_dtype, traced

FLAGS = ("-std=c11", "-O3", "-fno-math-errno", "-fPIC", "-fvisibility=hidden", "-DEXPORT=", "-DTORCHVTS_MEMORY=", "-c")
"""As in hatch_build.py, for code that nobody but the file itself sees, with memory from the system: files are unloaded."""

MORE_FLAGS = (("-fopenmp",), (), ("-DWIDE=",))
"""Tried in turn: batches in several threads; in one; without versions for several kinds of processors."""

SHIM = (
    "AOTITorchError aoti_torch_cpu_solve_frames(AtenTensorHandle images, const AtenTensorHandle* pieces, int64_t count, "
    "AtenTensorHandle* depth, AtenTensorHandle* gradient, AtenTensorHandle* normal, AtenTensorHandle* contact, "
    "AtenTensorHandle* deformed)"
)
"""The function of kernels_in_file.c that stands for the operator."""


class FrameByKernels(nn.Module):
    """Images (B, 3, H, W) to the outputs of a pipeline, by the operator of such a file; runs in no other way.

    Args:
        pieces: of :func:`~torchvts.accelerated.portable.portable_program`.
    """

    def __init__(self, pieces: Sequence[Tensor]) -> None:
        super().__init__()
        for k, piece in enumerate(pieces):
            self.register_buffer(f"piece_{k}", piece)
        self.operator = operator()

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        return tuple(self.operator(images, list(self.buffers())))


def program_of_kernels(pipe: DepthPipeline) -> list[Tensor] | None:
    """The pieces for a pipeline's operator; None where the compiled kernels cannot do all that the pipeline does."""
    return portable_program(pipe, pipe.frame_blocks) if type(pipe) is DepthPipeline else None


def trace_kernels(pipe: DepthPipeline) -> torch.export.ExportedProgram | None:
    """The program whose one operator is the compiled kernels; None where they cannot do all that the pipeline does."""
    pieces = program_of_kernels(pipe)
    if pieces is None:
        return None
    height, width, dtype = size_and_dtype(pipe)
    return traced(FrameByKernels(pieces), torch.full((2, 3, height, width), 0.5, dtype=dtype), any_batch=True)


@functools.cache
def operator() -> Any:
    """The operator, of which this process knows the outputs' shapes alone."""
    schema = "(Tensor images, Tensor[] pieces) -> (Tensor, Tensor, Tensor, Tensor, Tensor)"
    torch.library.define("torchvts::solve_frames", schema)

    def shapes(images: Tensor, pieces: list[Tensor]) -> tuple[Tensor, ...]:
        count, _, height, width = images.shape
        maps = [images.new_empty((count, channels, height, width)) for channels in (1, 2, 3)]
        return (*maps, *(images.new_empty((count, 1, height, width), dtype=torch.bool) for _ in range(2)))

    torch.library.register_fake("torchvts::solve_frames", shapes)
    return torch.ops.torchvts.solve_frames.default


@contextlib.contextmanager
def linked_kernels() -> Iterator[dict[str, Any]]:
    """Gives the settings by which Inductor links the kernels into a file; they lie in a folder of their own until it is done.

    Raises:
        RuntimeError: they do not compile.
    """
    before = os.environ.get("LIBRARY_PATH")  # where compilers look for libraries; Inductor has no setting for it
    with tempfile.TemporaryDirectory() as folder:
        library = _compiled(Path(folder))
        os.environ["LIBRARY_PATH"] = os.pathsep.join(filter(None, [folder, before]))
        try:
            yield {
                "aot_inductor.custom_ops_to_c_shims": {operator(): [SHIM]},
                "aot_inductor.custom_op_libs": [library],
            }
        finally:
            if before is None:
                del os.environ["LIBRARY_PATH"]
            else:
                os.environ["LIBRARY_PATH"] = before


def _compiled(folder: Path) -> str:
    """The name of the library, another one for other sources, because Inductor keeps what it has linked."""
    sources = [*sorted(LIBRARY.parent.glob("*.c")), Path(__file__).with_suffix(".c")]
    texts = b"".join(source.read_bytes() for source in [*sources, *sorted(LIBRARY.parent.glob("*.h"))])
    compiler = shlex.split(os.environ.get("CC") or "cc")
    if shutil.which(compiler[0]) is None or shutil.which("ar") is None:
        raise RuntimeError(
            f"aoti: expected a C compiler and ar, not both of {compiler[0]!r} and 'ar' are there: install gcc or clang, or set CC"
        )
    for more in MORE_FLAGS:
        command = [*compiler, *FLAGS, f"-DSOURCES={zlib.crc32(texts)}u", *more, *map(str, sources)]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode == 0:
            name = f"torchvts_{zlib.crc32(' '.join(command).encode(), zlib.crc32(texts)):08x}"
            objects = sorted(str(part) for part in folder.glob("*.o"))
            subprocess.run(["ar", "rcs", f"lib{name}.a", *objects], cwd=folder, capture_output=True, check=True)
            return name
    raise RuntimeError(f"aoti: the C compiler failed: {done.stderr.strip()}")
