"""Work on frames beside the stream: drawing and writing in a thread of their own, so that the next depth does not wait for them."""

import queue
import threading
from collections.abc import Callable
from typing import Any, Generic, TypeVar

from ..core.checks import check_integer

_Item = TypeVar("_Item")


class Aside(Generic[_Item]):
    """Hands items, in order, to a function that runs in another thread.

    Args:
        work: takes an item.
        most_waiting: number of items that may wait.
        keeps_all: whether :meth:`put` waits when that many do, as for a recording that must be whole; else the item is dropped, as
            behind a camera.
    Attributes:
        dropped: number of items that found no place.
    Raises:
        ValueError, TypeError: ``most_waiting`` below 1.
    Example:
        >>> seen = []
        >>> with Aside(seen.append, keeps_all=True) as aside:
        ...     for number in range(3):
        ...         taken = aside.put(number)
        >>> seen, aside.dropped
        ([0, 1, 2], 0)
    """

    def __init__(self, work: Callable[[_Item], object], most_waiting: int = 8, keeps_all: bool = False) -> None:
        check_integer("most_waiting", most_waiting, 1)
        self.dropped = 0
        self._work, self._keeps_all = work, keeps_all
        self._waiting: queue.Queue[tuple[_Item] | None] = queue.Queue(most_waiting)
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="torchvts-aside", daemon=True)
        self._thread.start()

    def put(self, item: _Item) -> bool:
        """Hand over an item; returns whether it was taken.

        Raises:
            Exception: what the function raised for an earlier item.
        """
        if self._error is not None:
            raise self._error
        try:
            self._waiting.put((item,), block=self._keeps_all)
        except queue.Full:
            self.dropped += 1
            return False
        return True

    def close(self) -> None:
        """Wait until all that was taken is done, and end the thread.

        Raises:
            Exception: what the function raised.
        """
        self._waiting.put(None)
        self._thread.join()
        error, self._error = self._error, None
        if error is not None:
            raise error

    def __enter__(self) -> "Aside[_Item]":
        return self

    def __exit__(self, *error: Any) -> None:
        try:
            self.close()
        except BaseException:
            if error[0] is None:  # else the first error stands
                raise

    def _run(self) -> None:
        while (entry := self._waiting.get()) is not None:
            if self._error is not None:
                continue  # whoever puts must not wait for ever
            try:
                self._work(entry[0])
            except BaseException as error:  # raised by put() or close()
                self._error = error
