"""Reads the frames of a data set ahead, by threads: images side by side, and whole videos in order."""

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from itertools import chain
from typing import NamedTuple

import torch
from torch import Tensor

from ..core.checks import in_one_line
from ..core.files import Pixels, read_pixels, rgb_from_bgr
from ..core.recordings import raw_frames
from ..model import Sensor
from ..stream import Recording
from .items import Item, list_items
from .records import Records

AHEAD = 8
"""Frames that are read ahead for each thread that reads."""


class Entry(NamedTuple):
    """A frame; or the end of a film.

    Attributes:
        item: the file that it is from.
        number: of a video's frame; -1 for an image.
        image: (1, 3, H, W), rectified; None where its result is there already, or it failed.
        failed: why it cannot be used; empty where it can.
        length: the number of frames of a video, in an entry of its own at the end; None in all others.
        recording: of a video's frame, by its first frames; None for an image.
    """

    item: Item
    number: int = -1
    image: Tensor | None = None
    failed: str = ""
    length: int | None = None
    recording: Recording | None = None

    @property
    def done(self) -> bool:
        """Whether its result is there already."""
        return self.image is None and not self.failed and self.length is None


class Loader:
    """Every N-th image and the frames of every video: those of one rank's share.

    Decoding a video in order is exact for any codec; seeking is not. ``begin`` makes the recording of a video by its first frames
    that can be read, rectified.
    """

    def __init__(
        self, records: Records, sensor: Sensor, share: tuple[int, int], begin: Callable[[Item, list[Tensor]], Recording]
    ) -> None:
        self.records, self.sensor, self.share, self.begin = records, sensor, share, begin

    def frames(self, workers: int) -> Iterator[Entry]:
        """All frames in order, read by so many threads beside the one that goes through the videos."""
        pool = partial(ThreadPoolExecutor, initializer=torch.set_num_threads, initargs=(self.records.settings.threads,))
        with pool(workers) as readers, pool(1) as order:
            share = self._share(readers)
            ahead = deque(order.submit(next, share, None) for _ in range(AHEAD * workers))
            while (found := ahead.popleft().result()) is not None:
                ahead.append(order.submit(next, share, None))
                yield found.result() if isinstance(found, Future) else found

    def _load(self, entry: Entry, read: Callable[[], Pixels]) -> Entry:
        """A frame rectified, or why there is none."""
        import cv2

        try:
            return entry._replace(image=self.sensor.rectify(rgb_from_bgr(read())[None]).clamp(0.0, 1.0))
        except (OSError, ValueError, cv2.error) as error:
            return entry._replace(failed=in_one_line(error))

    def _share(self, readers: ThreadPoolExecutor) -> "Iterator[Entry | Future[Entry]]":
        rank, world = self.share
        count = 0
        for item in list_items(self.records.source, self.records.settings.every):
            if item.is_film:
                yield from self._video(item)
                continue
            count += 1
            if (count - 1) % world != rank:
                continue
            if self.records.is_done(item, -1):
                yield Entry(item)
            else:
                yield readers.submit(self._load, Entry(item), partial(read_pixels, item.file))

    def _video(self, item: Item) -> Iterator[Entry]:
        rank, world = self.share
        records, every = self.records, self.records.settings.every
        length = records.length(item)
        own = range(rank * every, length or 0, world * every)
        if length is not None and all(records.is_done(item, number) for number in own):
            yield from (Entry(item, number) for number in own)
            return
        try:
            frames, first = enumerate(raw_frames(item.file)), list[Entry]()
            images: list[Tensor] = []
            while len(images) < records.settings.background_frames and (found := next(frames, None)) is not None:
                first.append(self._load(Entry(item, found[0]), found[1].read))
                images += [] if first[-1].image is None else [first[-1].image]
            recording, count = self.begin(item, images), len(first)
            rest = ((Entry(item, number), frame.read) for number, frame in frames)
            for entry, read in chain(((entry, None) for entry in first), rest):
                count = max(count, entry.number + 1)
                if entry.number % every == 0 and entry.number // every % world == rank:
                    if records.is_done(item, entry.number):
                        yield Entry(item, entry.number)
                    else:
                        yield (self._load(entry, read) if read else entry)._replace(recording=recording)
        except ValueError as error:  # its name, or no frame
            yield Entry(item, failed=in_one_line(error))
        else:
            yield Entry(item, length=count)
