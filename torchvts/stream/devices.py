"""The cameras of this machine, by index, path, name or serial number."""

from pathlib import Path
from typing import NamedTuple


class Device(NamedTuple):
    """A camera that Linux lists: index of its first node, its name and those under /dev/v4l/by-id, with its serial number."""

    node: int
    names: tuple[str, ...]

    def __str__(self) -> str:
        own, *links = self.names
        return f"{self.node} {own!r}" + (f" ({', '.join(links)})" if links else "")


def list_cameras(root: Path = Path("/")) -> list[Device]:
    """All cameras that Linux lists below ``root``; none under other systems."""
    nodes: dict[Path, list[Path]] = {}  # one camera may have several nodes
    for node in (root / "sys" / "class" / "video4linux").glob("video*"):
        link = node / "device"
        nodes.setdefault(link.resolve() if link.exists() else node, []).append(node)
    links: dict[int, list[str]] = {}
    for link in sorted((root / "dev" / "v4l" / "by-id").glob("*")):
        links.setdefault(_number(link.resolve()), []).append(link.name)
    found = []
    for group in nodes.values():
        first = min(group, key=_number)
        name = (first / "name").read_text(encoding="utf-8", errors="replace").strip()
        found.append(Device(_number(first), (name, *links.get(_number(first), ()))))
    return sorted(found)


def _number(node: Path) -> int:
    """Of /dev/video2 2; -1 for what is no such node."""
    digits = node.name.removeprefix("video")
    return int(digits) if digits.isascii() and digits.isdigit() else -1


def found_cameras(root: Path = Path("/")) -> str:
    """What cameras there are, for a message."""
    return "cameras here: " + ("; ".join(map(str, list_cameras(root))) or "none that this system lists")


def find_camera(source: str, root: Path = Path("/")) -> int | None:
    """Index of the camera that a text names; None if none does, ValueError where several have that name.

    Args:
        source: an index in digits, a path such as /dev/video2 or one below /dev/v4l, or, under Linux, a part of the device's name
            or of its name in /dev/v4l/by-id, such as the serial number.
        root: where Linux lists devices.
    """
    if source.isascii() and source.isdigit():
        return int(source)
    if source.startswith("/dev/"):
        number = _number(Path(source).resolve())
        return number if number >= 0 else None
    if not source.strip() or Path(source).exists() or "://" in source:
        return None
    found = [device for device in list_cameras(root) if any(source.lower() in name.lower() for name in device.names)]
    if len(found) > 1:
        which = "; ".join(map(str, found))
        raise ValueError(f"source: expected the name of one camera, got {source!r}, which several have: {which}: give the number")
    return found[0].node if found else None
