"""One thread for many small steps: others would wake up late for each, and spin while they wait where other programs run too."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch

MOST_PIXELS = 640 * 480
"""Pixels of an image up to which one thread suffices."""


@contextmanager
def one_thread(pixels: int) -> Iterator[None]:
    """Within it, torch's operators run in the calling thread, if the image that is worked on is no larger than usual.

    The number of threads is each thread's own. One that torch sees for the first time within starts with one.
    """
    before = torch.get_num_threads()
    if pixels <= MOST_PIXELS:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
