"""One thread for many small steps: others would wake up late for each, and spin while they wait where other programs run too."""

import threading
from contextlib import AbstractContextManager

import torch

MOST_PIXELS = 640 * 480
"""Pixels of an image up to which one thread suffices."""

_lock = threading.Lock()
_inside, _outside = 0, 1


class OneThread(AbstractContextManager[None]):
    """Within it, torch's operators run in the calling thread, if the image that is worked on is no larger than usual.

    The number of threads is each thread's own, but threads that torch sees for the first time start with the last one set: the
    number from before the first of all that are inside comes back when each of them leaves.

    Args:
        pixels: of the image.
    Example:
        >>> before = torch.get_num_threads()
        >>> with OneThread(320 * 240):
        ...     inside = torch.get_num_threads()
        >>> inside, torch.get_num_threads() == before
        (1, True)
    """

    def __init__(self, pixels: int) -> None:
        self.suffices = pixels <= MOST_PIXELS

    def __enter__(self) -> None:
        global _inside, _outside
        if self.suffices:
            with _lock:
                before = torch.get_num_threads()  # in every thread: torch begins with the last number set where it is first asked
                if _inside == 0:
                    _outside = before
                _inside += 1
                torch.set_num_threads(1)

    def __exit__(self, *_: object) -> None:
        global _inside
        if self.suffices:
            with _lock:
                _inside -= 1
                torch.set_num_threads(_outside)
