"""Runs an exported file in a process that cannot import torchvts; :func:`torchvts.export.run_bare` starts it.

python -I bare_process.py '{"path": ..., "format": ..., "batches": [1, 2], "threads": 1}' reads images.npy and writes
depth_1.npy, depth_2.npy, ... in the current folder.
"""

import json
import sys
from collections.abc import Callable
from typing import Any

import numpy as np


def load(path: str, name: str, threads: int) -> "Callable[[np.ndarray[Any, Any]], np.ndarray[Any, Any]]":
    """A function from a batch of images to depth, by the exported file."""
    if name == "onnx":
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.log_severity_level = 3
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        return lambda batch: session.run(["depth_mm"], {"images": batch})[0]

    import torch

    torch.set_num_threads(threads)
    by_script = name == "torchscript"
    module: Any = torch.jit.load(path) if by_script else torch.export.load(path).module()  # type: ignore[no-untyped-call]

    def run(batch: "np.ndarray[Any, Any]") -> "np.ndarray[Any, Any]":
        with torch.no_grad():
            return module(torch.from_numpy(batch))[0].numpy()  # type: ignore[no-any-return]

    return run


def main(argument: str) -> None:
    """Run the file on the first images, once for each batch size."""
    sys.modules["torchvts"] = None  # type: ignore[assignment]  # an installed one cannot be imported now either
    job, images = json.loads(argument), np.load("images.npy")
    run = load(job["path"], job["format"], job["threads"])
    for size in job["batches"]:
        np.save(f"depth_{size}.npy", run(images[:size].copy()))


if __name__ == "__main__":
    main(sys.argv[1])
