"""How many threads work on a batch: nobody waits for threads that would wake up late."""

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import AbstractContextManager
from itertools import pairwise

import torch
from torch import Tensor

MOST_PIXELS = 640 * 480
"""Pixels of a batch up to which one thread does all. Behind a camera two threads gain nothing on so few, and their wake-up costs
up to 12 ms in one frame of ten."""

_lock = threading.Lock()
_inside = 0
_outside = 1
_pool: ThreadPoolExecutor | None = None


def one_suffices(images: Tensor) -> bool:
    """Whether one thread should do the work on a batch of images (B, C, H, W) by itself, and torch would use more."""
    if torch.compiler.is_compiling() or torch.get_num_threads() == 1:
        return False
    if not isinstance(images, Tensor) or images.dim() != 4 or not images.is_cpu:
        return False
    return images.shape[0] * images.shape[2] * images.shape[3] <= MOST_PIXELS


class OneThread(AbstractContextManager[None]):
    """Within it, torch's operators run in the calling thread.

    The number of threads is each thread's own, but threads that torch sees for the first time start with the last one set: the
    number from before the first of all that are inside comes back when each of them leaves.

    Example:
        >>> before = torch.get_num_threads()
        >>> with OneThread():
        ...     inside = torch.get_num_threads()
        >>> inside, torch.get_num_threads() == before
        (1, True)
    """

    def __enter__(self) -> None:
        global _inside, _outside
        with _lock:
            if _inside == 0:
                _outside = torch.get_num_threads()
            _inside += 1
            torch.set_num_threads(1)

    def __exit__(self, *_: object) -> None:
        global _inside
        with _lock:
            _inside -= 1
            torch.set_num_threads(_outside)


def by_frames(count: int, pixels: int, call: Callable[[int, int], int | None]) -> int:
    """Call a kernel for the frames of a batch, which do not influence one another: at once, or in parts by torch's number of
    threads.

    Args:
        count: number of frames.
        pixels: of a frame.
        call: takes the first frame and how many; what it returns, if anything, is 1 where memory is short.
    Returns:
        1 where memory was short for any part, else 0.
    """
    parts = min(count, torch.get_num_threads()) if count * pixels > MOST_PIXELS else 1
    if parts <= 1:
        return call(0, count) or 0
    ends = [count * k // parts for k in range(parts + 1)]
    waiting = [_workers().submit(call, first, end - first) for first, end in pairwise(ends[1:])]
    short = call(0, ends[1]) or 0
    return max([short, *(future.result() or 0 for future in waiting)])


def share_frames(frames: range, pixels: int, work: Callable[[int], None]) -> None:
    """Do the work of each frame, large batches in torch's number of threads, each of which works on its own frames alone.

    Args:
        frames: their indices.
        pixels: of the whole batch.
        work: takes an index; runs in several threads at once, with the caller's gradients and inference mode.
    """
    threads = min(len(frames), torch.get_num_threads()) if pixels > MOST_PIXELS else 1
    recording, inference = torch.is_grad_enabled(), torch.is_inference_mode_enabled()

    def some(first: int) -> None:
        torch.set_num_threads(1)
        with torch.inference_mode(inference), torch.set_grad_enabled(recording):
            for i in frames[first::threads]:
                work(i)

    if threads == 1:
        for i in frames:
            work(i)
        return
    with OneThread():
        waiting = [_workers().submit(some, k) for k in range(1, threads)]
        try:
            some(0)
        finally:
            wait(waiting)
    for part in waiting:
        part.result()


def _workers() -> ThreadPoolExecutor:
    global _pool
    with _lock:
        if _pool is None:
            _pool = ThreadPoolExecutor(max_workers=max(1, torch.get_num_threads() - 1), thread_name_prefix="torchvts")
        return _pool


def _forget_workers() -> None:
    """In a forked child, which has none of the parent's threads."""
    global _pool, _lock, _inside
    _pool, _lock, _inside = None, threading.Lock(), 0


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_workers)
