"""The processes that share a run: who they are, and sums over them."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta

import torch
import torch.distributed as dist

LONGEST_WAIT = timedelta(days=7)
"""Processes that have finished wait this long for the others."""


@contextmanager
def share() -> Iterator[tuple[int, int]]:
    """Rank of this process and their number. Only counts travel between them, so the backend is gloo, which every machine has."""
    rank, world = int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))
    if world == 1:
        yield rank, world
        return
    try:
        dist.init_process_group("gloo", timeout=LONGEST_WAIT)
    except (RuntimeError, ValueError) as error:
        raise RuntimeError(
            f"WORLD_SIZE: expected {world} processes that find each other, as torchrun starts them: {error}"
        ) from error
    try:
        yield rank, world
    finally:
        dist.destroy_process_group()


def sum_over_processes(count: int) -> int:
    """Wait for all processes and add up their counts."""
    if not dist.is_initialized():
        return count
    total = torch.tensor(count)
    try:
        dist.all_reduce(total)
    except RuntimeError as error:
        raise RuntimeError(
            f"another process has stopped ({str(error).splitlines()[0][:120]}): read its message, and run the same command again"
        ) from error
    return int(total)
