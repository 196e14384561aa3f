"""Fetches the files of a sample from where they were published, or from a copy, and keeps those whose sha256 is the listed one."""

import csv
import hashlib
import io
import json
import os
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from ..core.checks import check_choice
from ..core.files import write_atomically

SAMPLES = ("gelsight_mini",)
"""Names of the samples; each has a JSON file beside this one."""

LARGEST_FILE = 2**24
"""Bytes; more is not read from a server or folder: no file of a sample is as large."""

TIMEOUT_S = 30.0
"""A server that is silent for so long is given up."""


@dataclass(frozen=True)
class Sample:
    """What a sample consists of.

    Attributes:
        name: one of :data:`SAMPLES`.
        title: what the images show.
        origin: who made them, and where they were published.
        url: folder of the files at the commit.
        commit: of the repository.
        licence: which, and where that stands.
        conditions: of the licence, its text.
        sensor: shipped sensor file that fits.
        sha256: of each file, by its path in the folder.
        diameter_mm: of the ball, by the folder of a press.
    """

    name: str
    title: str
    origin: str
    url: str
    commit: str
    licence: str
    conditions: str
    sensor: str
    sha256: Mapping[str, str]
    diameter_mm: Mapping[str, float]

    def licence_text(self) -> str:
        """What is written beside the images."""
        return f"{self.title}.\nOrigin: {self.origin}; commit {self.commit}.\nLicence: {self.licence}.\n\n{self.conditions}"

    def catalog(self) -> str:
        """Presses and diameters, in gs_sdk's layout."""
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([("experiment_reldir", "diameter(mm)"), *self.diameter_mm.items()])
        return text.getvalue()


def read_sample(name: str) -> Sample:
    """The description of a sample.

    Args:
        name: one of :data:`SAMPLES`.
    Raises:
        ValueError: another name.
    Example:
        >>> sample = read_sample("gelsight_mini")
        >>> len(sample.sha256), len(sample.diameter_mm), sample.diameter_mm["9.500mm/0"]
        (36, 34, 9.5)
    """
    check_choice("name", name, SAMPLES)
    listed: dict[str, Any] = json.loads((Path(__file__).parent / f"{name}.json").read_text(encoding="utf-8"))
    presses = [path.rpartition("/")[0] for path in listed["sha256"] if path.endswith("/gelsight.png")]
    return Sample(name, diameter_mm={press: float(press.partition("mm/")[0]) for press in presses}, **listed)


def cache_folder() -> Path:
    """Where samples are kept: TORCHVTS_CACHE, else torchvts in XDG_CACHE_HOME, else ~/.cache/torchvts."""
    if os.environ.get("TORCHVTS_CACHE"):
        return Path(os.environ["TORCHVTS_CACHE"])
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "torchvts"


def cached_sample(name: str = "gelsight_mini") -> Path | None:
    """The folder of a sample that was fetched whole, in gs_sdk's layout; None where it was not.

    Args:
        name: one of :data:`SAMPLES`.
    """
    folder = _folder(read_sample(name))
    return folder if (folder / "catalog.csv").is_file() else None


def fetch_sample(name: str = "gelsight_mini", source: str | Path | None = None, *, progress: bool = False) -> Path:
    """Fetch a sample into the cache, unless it is there; each file is compared with its sha256 before it is kept.

    Stopped, the next call goes on where it was. ``catalog.csv`` and ``LICENCE.txt`` are written last.

    Args:
        name: one of :data:`SAMPLES`.
        source: folder or http(s) address of a copy of the files; None for where they were published.
        progress: show a bar.
    Returns:
        The folder, in gs_sdk's layout.
    Raises:
        ValueError: another name, or a file whose sha256 is not the listed one.
        FileNotFoundError: no such file at the source.
        ConnectionError: the server cannot be reached.
    """
    sample = read_sample(name)
    folder = _folder(sample)
    place = sample.url if source is None else str(source)
    for path, digest in tqdm(sample.sha256.items(), desc=name, unit="file", leave=False, disable=not progress or None):
        target = folder / path
        if target.is_file() and _digest(target.read_bytes()) == digest:
            continue
        data = _read(place, path, sample)
        if _digest(data) != digest:
            raise ValueError(
                f"{place}/{path}: expected sha256 {digest}, got {_digest(data)}: the copy is damaged, or of another version than "
                f"commit {sample.commit}"
            )
        _write(target, data)
    _write(folder / "LICENCE.txt", sample.licence_text().encode())
    _write(folder / "catalog.csv", sample.catalog().encode())
    return folder


def _folder(sample: Sample) -> Path:
    return cache_folder() / "samples" / f"{sample.name}-{sample.commit[:12]}"


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _write(target: Path, data: bytes) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    with write_atomically(target) as temporary:
        temporary.write_bytes(data)


def _read(place: str, path: str, sample: Sample) -> bytes:
    """At most :data:`LARGEST_FILE` bytes of a file in a folder or on a server."""
    if "://" not in place:
        file = Path(place) / path
        if not file.is_file():
            raise FileNotFoundError(f"{file}: no such file: --from names the folder that holds background.png and the presses")
        with file.open("rb") as stream:
            return stream.read(LARGEST_FILE)
    if urllib.parse.urlsplit(place).scheme not in ("http", "https"):
        raise ValueError(f"source: expected a folder, or an address that begins with https:// or http://, got {place!r}")
    address = f"{place.rstrip('/')}/{urllib.parse.quote(path)}"
    try:
        with urllib.request.urlopen(address, timeout=TIMEOUT_S) as answer:
            data: bytes = answer.read(LARGEST_FILE)
            return data
    except urllib.error.HTTPError as error:
        raise FileNotFoundError(f"{address}: the server answers {error.code} {error.reason}: not there") from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "reason", error)
        raise ConnectionError(
            f"{address}: cannot be read ({reason}): without network, copy the folder of {sample.origin.rpartition(', ')[2]} by "
            "another way and name it by --from"
        ) from error
