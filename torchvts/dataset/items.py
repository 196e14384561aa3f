"""What a data set holds: its images and films in a fixed order, and the names of their results."""

import os
import re
from collections import Counter
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from ..core.containers import find_container
from ..core.files import IMAGE_SUFFIXES, PAGED_SUFFIXES, VIDEO_SUFFIXES, natural_order
from ..core.recordings import count_frames, is_film

STATE = ".torchvts"
"""Folder inside the results that holds the settings and one record per frame; a folder that has one is never read as a source."""

PARTS = "parts"
"""Folder beside the records where the frames of a video wait until it is done."""

VIDEO_FORMATS = {"video-npz": ".npz", "video-zarr": ".zarr.zip"}
"""Kinds of results with one file a video, and how its name ends."""

FORMATS = {"npz": ".npz", **dict.fromkeys(VIDEO_FORMATS, ".npz"), "png16": "_depth.png", "npy": "_depth.npy", "none": ""}
"""Kinds of results, and how the names of the files of a frame end."""

PICTURES_UP_TO = 20
"""Sources of at most this many frames get pictures by default: one picture takes longer than a hundred frames."""


class Item(NamedTuple):
    """One image or film of a source.

    Attributes:
        path: path inside the source, with "/".
        stem: path of its results inside the output folder, without suffix.
        mark: size in bytes and time of modification in ns; another mark means another file.
        file: the file itself.
        is_film: whether it has frames with numbers.
    """

    path: str
    stem: str
    mark: tuple[int, int]
    file: Path
    is_film: bool

    def frame_name(self, number: int) -> str:
        """Name of a frame in tables and messages: the path of an image, whose ``number`` is negative, else :meth:`frame_stem`."""
        return one_line(self.path if number < 0 else self.frame_stem(number))

    def frame_stem(self, number: int) -> str:
        """Stem of the results of a frame; ``number`` is negative for an image."""
        return self.stem if number < 0 else f"{self.stem}_{number:06d}"


Source = tuple[Path, ...]
"""Images, videos, recordings in containers, folders with all below them; one or more."""


def one_line(text: str) -> str:
    """A text with control characters, line ends and what is not UTF-8 as backslash escapes."""
    return "".join(
        repr(letter)[1:-1] if letter < " " or letter in "\x7f\x85\u2028\u2029" or "\ud800" <= letter <= "\udfff" else letter
        for letter in text
    )


def list_items(source: str | Path | Source, every: int = 1) -> Iterator[Item]:
    """List the images and videos of a source, by folder and name, numbers as numbers; only the names of one folder are in memory.

    Of several files and folders the paths are those below the folder that holds them all, in the order given.

    Args:
        source: an image, a video, a folder, or several of them.
        every: list only each N-th image, and all videos.
    Raises:
        FileNotFoundError: no such source.
    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for name in ("b.png", "a.png", "a.jpg", "notes.txt"):
        ...         Path(folder, name).touch()
        ...     [(item.path, item.stem) for item in list_items(folder)]
        [('a.jpg', 'a.jpg'), ('a.png', 'a.png'), ('b.png', 'b')]
    """
    first, *more = source if isinstance(source, tuple) else (Path(source),)
    if more:
        items = _several((first, *more))
    elif is_folder(first):
        items = _walk(first, "")
    else:
        items = iter([_item(first, "", first.stem)])
    images = 0
    for item in items:
        images += not item.is_film
        if item.is_film or (images - 1) % every == 0:
            yield item


def _item(file: Path, prefix: str, stem: str) -> Item:
    container = find_container(file)
    try:
        status = (file if container is None else container[1]).stat()
    except OSError:  # a link that leads nowhere, or to itself: said when it is read
        if not file.is_symlink():
            raise FileNotFoundError(f"{file}: no such file or folder") from None
        status = file.lstat()
    return Item(prefix + file.name, prefix + stem, (status.st_size, status.st_mtime_ns), file, is_film(file))


def is_folder(path: Path) -> bool:
    """Whether a path is a folder whose files are listed, not a container that is one."""
    return path.is_dir() and find_container(path) is None


def _several(source: Source) -> Iterator[Item]:
    """Items of several files and folders; a file that is named twice, or lies in a folder named too, comes once."""
    named = [Path(os.path.abspath(path)) for path in source]  # "." and ".." by their names
    places = [(path.parent.resolve(), path) for path in named]
    root = Path(os.path.commonpath([folder for folder, _ in places]))
    groups: dict[Path, list[str]] = {}
    for folder, path in places:
        groups.setdefault(folder, []).append(path.name)
    stems = {folder: output_stems([name for name in names if not is_folder(folder / name)]) for folder, names in groups.items()}
    seen: set[str] = set()
    for folder, path in places:
        prefix = "" if folder == root else f"{folder.relative_to(root).as_posix()}/"
        within = f"{prefix}{path.name}/" if path.name else ""
        found = _walk(path, within) if is_folder(path) else [_item(path, prefix, stems[folder][path.name])]
        for item in found:
            if item.path not in seen:
                seen.add(item.path)
                yield item


def _walk(folder: Path, prefix: str) -> Iterator[Item]:
    with os.scandir(folder) as entries:
        kept = sorted((entry for entry in entries if not entry.name.startswith(".")), key=lambda entry: natural_order(entry.name))
    suffixes = IMAGE_SUFFIXES + VIDEO_SUFFIXES
    stems = output_stems([entry.name for entry in kept if entry.name.lower().endswith(suffixes) and not Path(entry).is_dir()])
    for entry in kept:
        if entry.name in stems:
            yield _item(folder / entry.name, prefix, stems[entry.name])
        elif entry.is_dir(follow_symlinks=False) and not (folder / entry.name / STATE).is_dir():
            yield from _walk(folder / entry.name, f"{prefix}{entry.name}/")


def output_stems(names: list[str]) -> dict[str, str]:
    """Choose the stem of the results of each file of one folder; no two files share one.

    Frame n of a video adds ``_n`` in six digits to its stem.

    Example:
        >>> output_stems(["a.png", "b.png", "b.jpg"])
        {'a.png': 'a', 'b.png': 'b.png', 'b.jpg': 'b.jpg'}
    """
    plain = {name: os.path.splitext(name)[0] for name in names}
    count = Counter(stem.casefold() for stem in plain.values())
    films = {plain[name].casefold() for name in names if name.lower().endswith(VIDEO_SUFFIXES + PAGED_SUFFIXES)}

    def clashes(name: str) -> bool:
        stem = plain[name].casefold()
        return count[stem] > 1 or (re.sub(r"_\d{6,}$", "", stem) in films and re.search(r"_\d{6,}$", stem) is not None)

    stems = {name: name if clashes(name) else stem for name, stem in plain.items()}
    return stems if len(set(stems.values())) == len(stems) else {name: name for name in names}


def has_few_frames(source: Source, every: int = 1) -> bool:
    """Whether a run over each N-th frame of a source has at most :data:`PICTURES_UP_TO` frames."""
    items = islice(list_items(source, every), PICTURES_UP_TO + 1)
    return sum(-(-count_frames(item.file) // every) if item.is_film else 1 for item in items) <= PICTURES_UP_TO
