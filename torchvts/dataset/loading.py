"""Reads the frames of a data set in loader processes: images, each process its share, and whole videos in order."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from ..core.arrays import Array
from ..core.checks import in_one_line
from ..core.files import Pixels, read_pixels, rgb_from_bgr
from ..core.recordings import raw_frames
from ..model import Sensor
from .items import Item, list_items
from .records import Records

HANDED_OVER = 8
"""Frames that a loader process hands over at once."""


class Entry(NamedTuple):
    """What a loader hands over: a frame, without image where it cannot be used or is not needed any more, or the end of a film.

    Attributes:
        item: the file that it is from.
        number: of a video's frame; -1 for an image.
        done: whether its result is there.
        failed: why it cannot be used; empty where it can.
        length: the number of frames of a video, in an entry of its own at the end; None in all others.
        doubt: why less may have been seen in it than is there; empty for nothing.
    """

    item: Item
    number: int = -1
    done: bool = False
    failed: str = ""
    length: int | None = None
    doubt: str = ""


Batch = tuple[list[tuple[Entry, bool]], Array]
"""Frames, whether each has an image, and these images in one array: tensors would go through files in shared memory, which a small
/dev/shm or a limit of the size of files ends in silence."""


def load_frames(records: Records, sensor: Sensor, share: tuple[int, int], workers: int) -> Iterator[tuple[Entry, Tensor | None]]:
    """The frames of one rank's share, each with its image (1, 3, H, W), rectified, if it has one.

    Args:
        records: of the run: which source it reads and which frames are done.
        sensor: rectifies the frames.
        share: rank of this process, number of processes.
        workers: number of loader processes; 0 reads in this process.
    """
    loader = DataLoader(_Frames(records, sensor, share), batch_size=None, num_workers=workers, collate_fn=_as_is)
    for frames, images in loader:
        left = (image[None] for image in torch.from_numpy(images))
        for frame, has_image in frames:
            yield frame, next(left) if has_image else None


def _stacked(images: list[Tensor]) -> Array:
    return torch.cat(images).numpy() if images else np.empty(0, np.float32)


def _as_is(batch: Any) -> Any:
    return batch


class _Frames(IterableDataset[Batch]):
    """Every N-th image and the frames of every video, which one loader process of each rank decodes, in order.

    Decoding in order is exact for any codec; seeking is not.
    """

    def __init__(self, records: Records, sensor: Sensor, share: tuple[int, int]) -> None:
        self.records, self.sensor, self.share = records, sensor, share

    def __iter__(self) -> Iterator[Batch]:
        frames: list[tuple[Entry, bool]] = []
        images: list[Tensor] = []
        for frame, read in self._share():
            image, failed = self._load(read) if read is not None else ([], frame.failed)
            frames.append((frame._replace(failed=failed), bool(image)))
            images += image
            if len(frames) == HANDED_OVER:
                yield frames, _stacked(images)
                frames, images = [], []
        yield frames, _stacked(images)

    def _load(self, read: Callable[[], Pixels]) -> tuple[list[Tensor], str]:
        """An image rectified, in a list; or an empty list and why there is none."""
        import cv2

        try:
            return [self.sensor.rectify(rgb_from_bgr(read())[None]).clamp(0.0, 1.0)], ""
        except (OSError, ValueError, cv2.error) as error:
            return [], in_one_line(error)

    def _share(self) -> Iterator[tuple[Entry, Callable[[], Pixels] | None]]:
        """Frames of this loader process, each with what reads its image if it is to be read."""
        rank, world = self.share
        worker = get_worker_info()
        number, workers = (0, 1) if worker is None else (worker.id, worker.num_workers)
        count = 0
        for item in list_items(self.records.source, self.records.settings.every):
            if item.is_film:
                if number == 0:
                    yield from self._video(item)
                continue
            count += 1
            if (count - 1) % (world * workers) != rank * workers + number:
                continue
            if self.records.is_done(item, -1):
                yield Entry(item, done=True), None
            else:
                yield Entry(item), partial(read_pixels, item.file)

    def _video(self, item: Item) -> Iterator[tuple[Entry, Callable[[], Pixels] | None]]:
        rank, world = self.share
        length, every = self.records.length(item), self.records.settings.every
        own = range(rank * every, length or 0, world * every)
        if length is not None and all(self.records.is_done(item, number) for number in own):
            yield from ((Entry(item, number, done=True), None) for number in own)
            return
        number = 0
        try:
            for number, frame in enumerate(raw_frames(item.file)):
                if number % every == 0 and number // every % world == rank:
                    done = self.records.is_done(item, number)
                    yield Entry(item, number, done), None if done else frame.read
        except ValueError as error:  # its name, or no frame
            yield Entry(item, failed=in_one_line(error)), None
        else:
            yield Entry(item, length=number + 1), None
