"""The one record of a measurement, a :class:`Row`: speed, stability and evaluation write it as Markdown and as JSON."""

import dataclasses
import json
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from torchvts.core.files import make_folder, write_atomically
from torchvts.core.tables import markdown, number


@dataclass(frozen=True)
class Size:
    """Size of the frames.

    Attributes:
        height: rows.
        width: columns.
        batch: frames in one call.
    """

    height: int
    width: int
    batch: int = 1


@dataclass(frozen=True)
class Time:
    """Time of one frame.

    Attributes:
        ms_median: median time, ms.
        ms_iqr: interquartile range of the time, ms.
        ms_p90: 90th percentile, ms.
        calls: number of calls that were timed.
        threads: number of threads that torch may use.
        machine: kind of processor, number of cores, version of torch.
        pace: what came before each call.
    """

    ms_median: float
    ms_iqr: float
    ms_p90: float
    calls: int
    threads: int
    machine: str
    pace: str


@dataclass(frozen=True)
class Row:
    """One method on one set of data.

    Attributes:
        kind: what was measured: "scene" (exact truth), "sensor" (balls on a real sensor), "corruption" (a scene of the gallery),
            "presses" (balls, objects), "coverage" (of bounds of confidence; ``method`` is the shape that was pressed in), "frame"
            (as a user runs it), "cost" (what is paid once), "pose" or "track" (of objects).
        method: its name.
        data: name of the scene, the corruption or the presses.
        errors: value by name, such as "normal_deg"; None where nothing could be measured.
        size: of the frames; None if they differ.
        time: of one frame; None if it was not measured.
        parameters: number of parameters that the method learned or was given; None if unknown.
        severity: of the corruption.
        seed: of noise and place.
        frames: number of frames behind the errors.
        ours: whether it is a method of this library, and not of a peer.
        seen: whether the method has learned from the very frames that it is scored on.
        command: command that made the row.
        note: an error, a warning or a remark.
        each: values of each frame by name, where not only their means are kept.
    """

    kind: str
    method: str
    data: str
    errors: Mapping[str, float | None] = field(default_factory=dict)
    size: Size | None = None
    time: Time | None = None
    parameters: int | None = None
    severity: float | None = None
    seed: int | None = None
    frames: int = 1
    ours: bool = True
    seen: bool = False
    command: str = ""
    note: str = ""
    each: dict[str, list[float]] = field(default_factory=dict)

    def error(self, name: str) -> float | None:
        """One error; None if it was not measured."""
        return self.errors.get(name)


class Column(NamedTuple):
    """Column of a table: its title, and the text of its cell in a row."""

    title: str
    cell: Callable[[Row], str]


def error_column(title: str, name: str, digits: int) -> Column:
    """Column of one of a row's errors."""
    return Column(title, lambda row: number(row.error(name), digits))


def table(rows: Iterable[Row], columns: Sequence[Column]) -> str:
    """Rows as a Markdown table."""
    return markdown([column.title for column in columns], [[column.cell(row) for column in columns] for row in rows])


def to_json(rows: Iterable[Row]) -> str:
    """Rows as a JSON list, one object each."""
    return json.dumps([dataclasses.asdict(row) for row in rows], indent=1)


def write_files(folder: Path, files: Mapping[str, str]) -> None:
    """Write texts by file name into a folder, which is made if missing; an interrupted write leaves no file."""
    make_folder(folder)
    for name, text in files.items():
        with write_atomically(folder / name) as temporary:
            temporary.write_text(text, encoding="utf-8")


def mean(values: Iterable[float | None]) -> float | None:
    """Mean of the known values; None if there is none."""
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def median(values: Iterable[float | None]) -> float | None:
    """Median of the known values; None if there is none."""
    known = [value for value in values if value is not None]
    return statistics.median(known) if known else None
