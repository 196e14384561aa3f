"""What the results of a run depend on: kept beside them, compared when it goes on, and held by one run at a time."""

import json
import os
import re
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

from ..core.checks import brief
from ..core.files import make_folder, write_atomically
from ..stream import FIRST_FRAMES
from .items import FORMATS, PARTS, STATE, VIDEO_FORMATS, Source, has_few_frames

SUFFIXES = (*filter(None, {*FORMATS.values(), *VIDEO_FORMATS.values()}), ".ply", ".obj", ".pcd", ".x3p", "_picture.png")
"""How the names of all files of a frame end."""


@dataclass(frozen=True)
class Settings:
    """What the results of a run depend on; a run is only continued with the same. ``pictures`` may be None when it begins."""

    calibration_sha256: str
    network_sha256: str
    source: str
    mode: str
    format: str
    cloud: str
    pictures: bool | None
    every: int
    device: str
    threads: int
    torchvts: str
    torch: str
    background_frames: int = FIRST_FRAMES
    contact: dict[str, float] | None = None
    length_unit: str = "mm"


def begin(source: Source, out: Path, settings: Settings, overwrite: bool) -> Settings:
    """Begin or continue a run in ``out``: write the settings, or compare them with those that are there; remove incomplete files.

    With ``overwrite`` the files of the frames that an earlier run recorded go too, whatever its settings were.
    """
    if overwrite:
        frames = out / STATE / "frames"
        for record in frames.rglob("*.json"):
            stem = out / record.relative_to(frames).with_suffix("")
            for suffix in SUFFIXES:
                stem.with_name(stem.name + suffix).unlink(missing_ok=True)
        shutil.rmtree(frames, ignore_errors=True)
        shutil.rmtree(out / STATE / PARTS, ignore_errors=True)
        for path in (out / STATE / "settings.json", out / "frames.csv", out / "failed.csv", out / "summary.json"):
            path.unlink(missing_ok=True)
    if (out / STATE / "settings.json").exists():
        settings = join(out, settings)
    else:
        if settings.pictures is None:
            settings = replace(settings, pictures=has_few_frames(source, settings.every))
        with write_atomically(out / STATE / "settings.json") as temporary:
            temporary.write_text(json.dumps(asdict(settings), indent=1), encoding="utf-8")
    incomplete = re.compile(r"\..+-[0-9a-f]{8}\.(png|npy|npz|zip|pcd|ply|obj|x3p|csv|json)")  # names of write_atomically
    for folder, folders, names in os.walk(out):
        folders[:] = [name for name in folders if name != STATE]
        for name in filter(incomplete.fullmatch, names):
            Path(folder, name).unlink(missing_ok=True)
    return settings


def join(out: Path, settings: Settings) -> Settings:
    """The settings with which a run was begun; ValueError where they differ from ``settings``, or cannot be read."""
    path = out / STATE / "settings.json"
    try:
        begun = Settings(**json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: not the settings of a run ({error}): give another --out, or --overwrite") from error
    if settings.pictures is None:
        settings = replace(settings, pictures=begun.pictures)
    if begun.source != settings.source:
        raise ValueError(
            f"out: {out} holds the results of {brief(begun.source)}, not of {brief(settings.source)}: give each input another "
            "--out, or name all inputs in one command, with --overwrite to begin anew"
        )
    files = {"calibration_sha256": "calibration", "network_sha256": "network"}
    other = [
        f"another {files[field.name]} than then, or its file was written anew"
        if field.name in files
        else f"{field.name} {str(getattr(begun, field.name))[:60]!r} then, {str(getattr(settings, field.name))[:60]!r} now"
        for field in fields(Settings)
        if getattr(begun, field.name) != getattr(settings, field.name)
    ]
    if other:
        when = time.strftime("%Y-%m-%d %H:%M", time.localtime(path.stat().st_mtime))
        raise ValueError(
            f"out: {out} was begun with other settings on {when}: {'; '.join(other)}: give another --out, or --overwrite to begin "
            "anew"
        )
    return begun


@contextmanager
def locked(out: Path) -> Iterator[None]:
    """Hold ``out`` for one run; the system releases it when the process ends, however that happens."""
    make_folder(out / STATE)
    try:
        import fcntl
    except ImportError:  # no such locks on this system
        yield
        return
    with (out / STATE / "lock").open("w") as stream:
        try:
            fcntl.lockf(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise RuntimeError(f"out: another run is writing into {out}: wait for it, or stop it") from error
        yield
