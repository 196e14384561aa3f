"""Processes that share one job by torch.distributed: who they are, whether they live, what they tell each other."""

import os
import threading
import time
from contextlib import suppress
from datetime import timedelta
from types import TracebackType
from typing import Any

import torch
import torch.distributed as dist
from torch.distributed.distributed_c10d import PrefixStore
from torch.distributed.rendezvous import rendezvous
from tqdm import tqdm


class Ranks:
    """The processes of one run: who they are, that they live, what they say at the end.

    Each tells the others once a second, through the launcher's store, that it lives and how far it is. Waiting ends when what is
    waited for is there, when a process says that it failed, or when it has been silent for ``timeout_s``; so a slow process is
    waited for and a dead one is not. Without WORLD_SIZE in the environment, or with 1, there is one process and no network.
    Only counts travel, so the backend is gloo, which every machine has.
    """

    def __init__(self, timeout_s: float = 60.0) -> None:
        self.timeout_s = timeout_s
        self.rank, self.world = int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))
        self.count = 0
        self._store: Any = None
        self._trouble = ""
        self._over = threading.Event()
        self._seen: dict[int, tuple[str, float]] = {}

    def __enter__(self) -> "Ranks":
        if self.world == 1:
            return self
        limit = timedelta(seconds=self.timeout_s)
        try:
            self._store, _, _ = next(rendezvous("env://", timeout=limit))
            store = PrefixStore("gloo", self._store)
            dist.init_process_group("gloo", store=store, rank=self.rank, world_size=self.world, timeout=limit)
        except (RuntimeError, ValueError) as error:
            raise RuntimeError(
                f"rank {self.rank}: the {self.world} processes did not find each other within {self.timeout_s:g} s "
                f"({str(error).splitlines()[0][:200]}): are all started, and MASTER_ADDR and MASTER_PORT reachable?"
            ) from error
        self._thread = threading.Thread(target=self._live, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._store is None:
            return
        self._over.set()
        self._thread.join()
        if error is not None and not self._trouble:
            with suppress(RuntimeError):  # nobody may be left to be told
                self._store.set("stop", f"rank {self.rank} stopped: {str(error) or type(error).__name__}")
        if error is None:
            dist.destroy_process_group()

    def _live(self) -> None:
        tick = 0
        while not self._over.is_set():
            tick += 1
            try:
                self._store.set(f"alive/{self.rank}", f"{tick} {self.count}")
                if self._store.check(["stop"]):
                    self._trouble = self._store.get("stop").decode()
            except RuntimeError:
                self._trouble = "the launcher, or rank 0, is gone: run the same command again to go on"
            self._over.wait(1.0)

    def check(self) -> None:
        """Raise RuntimeError if another process has failed."""
        if self._trouble:
            raise RuntimeError(self._trouble)

    def tell(self, key: str) -> None:
        """Let all processes know that something is done."""
        if self._store is not None:
            self._store.set(key, "1")

    def wait(self, key: str, what: str, bar: "tqdm[Any] | None" = None) -> None:
        """Return once another process has told ``key``.

        Raises:
            RuntimeError: a process failed, or one has been silent for too long.
        """
        if self._store is None:
            return
        start = time.monotonic()
        while True:
            self.check()
            try:
                if self._store.check([key]):
                    return
                self._read_lives()
                silent_s = self._silence(start)
            except RuntimeError as error:
                raise RuntimeError("the launcher, or rank 0, is gone: run the same command again to go on") from error
            if bar is not None:
                bar.update(self.total() - bar.n)
            for rank, silence in silent_s.items():
                if silence > self.timeout_s:
                    raise RuntimeError(
                        f"rank {rank} has not been heard of for {silence:.0f} s (waiting for {what}): killed, out of memory, or "
                        "its machine is gone: run the same command again to go on"
                    )
            time.sleep(0.1)

    def _silence(self, start: float) -> dict[int, float]:
        """Seconds since the others that have not finished were last heard of, since ``start`` at most."""
        heard = {rank: max(start, self._seen.get(rank, ("", start))[1]) for rank in range(self.world) if rank != self.rank}
        now = time.monotonic()
        return {rank: now - at for rank, at in heard.items() if not self._store.check([f"finished/{rank}"])}

    def _read_lives(self) -> None:
        for rank in range(self.world):
            if self._store.check([f"alive/{rank}"]):
                said = self._store.get(f"alive/{rank}").decode()
                if self._seen.get(rank, ("", 0.0))[0] != said:
                    self._seen[rank] = (said, time.monotonic())

    def total(self) -> int:
        """Frames done by all processes, as far as they have told."""
        if self._store is None or self.rank > 0:
            return self.count
        try:
            self._read_lives()
        except RuntimeError:
            self.check()
        return self.count + sum(int(said.split()[1]) for rank, (said, _) in self._seen.items() if rank != self.rank)

    def gather(self, figures: tuple[float, float, float]) -> list[tuple[float, float, float]]:
        """The figures of every process, in the order of ranks; call it when all have finished."""
        if self._store is None:
            return [figures]
        own = torch.tensor(figures, dtype=torch.float64)
        every = [torch.empty_like(own) for _ in range(self.world)]
        dist.all_gather(every, own)
        return [(float(a), float(b), float(c)) for a, b, c in every]
