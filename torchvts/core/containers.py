"""Reads recordings that are kept in containers: stores of arrays, tables, archives and bags, one function and one library each.

A container may hold several recordings, such as those of two sensors. A path that goes on inside of it names one:
``day.h5/left/rgb``, ``day.mcap/left/image_raw``. Arrays are R, G, B.
"""

import json
import os
import tarfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .checks import NAMED
from .files import IMAGE_SUFFIXES, IN_COLOUR, Pixels, check_colour, check_still_head, decode_bytes, natural_order
from .videos import video_reads

BLOCK = 64
"""Frames of an array that are read at once, where its chunks are not smaller."""

EXTRA = "pip install 'torchvts[containers]'"


class Film(NamedTuple):
    """One recording of a container."""

    length: int  # number of its frames
    reads: Callable[[], Iterator[Callable[[], Any]]]  # goes through them; each is decoded by a call, before the next is asked for


Films = Mapping[str, Film]


class NoImages(ValueError):
    """A container that can be read and holds no images; says what it holds."""


def _of_zarr(path: Path) -> Films:
    import zarr

    def arrays(group: Any, prefix: str) -> Iterator[tuple[str, Any]]:
        if hasattr(group, "shape"):
            yield prefix, group
            return
        for name, member in (*group.arrays(), *group.groups()):
            yield from arrays(member, f"{prefix}/{name}")

    store = zarr.storage.ZipStore(path, mode="r") if path.is_file() else path
    return _of_arrays(arrays(zarr.open(store, mode="r"), ""))


def _of_hdf5(path: Path) -> Films:
    import h5py

    found: dict[str, Any] = {}
    h5py.File(path, "r").visititems(found.__setitem__)
    return _of_arrays((name, array) for name, array in found.items() if isinstance(array, h5py.Dataset))


def _of_npy(path: Path) -> Films:
    return _of_arrays([("", np.load(path, mmap_mode="r"))])


def _of_arrays(arrays: Iterable[tuple[str, Any]]) -> Films:
    """Those arrays that hold images: (T, H, W, 3), (T, N, H, W, 3) of N sensors, or T encoded ones, (T,) or padded (T, bytes)."""
    films: dict[str, Film] = {}
    others: list[str] = []
    for name, array in arrays:
        colour = len(array.shape) > 3 and array.shape[-1] == 3 and array.dtype.kind in "uf"
        if colour and len(array.shape) == 5:
            films |= {f"{name}/{k}": Film(array.shape[0], partial(_slices, array, (k,))) for k in range(array.shape[1])}
        elif (colour and len(array.shape) == 4) or (len(array.shape) in (1, 2) and _is_encoded(array)):
            films[name] = Film(array.shape[0], partial(_slices, array, ()))
        else:
            others.append(f"{name.strip('/')} {tuple(array.shape)} {array.dtype}".strip())
    if not films and others:
        raise NoImages(f"got {', '.join(others[:NAMED])}{', ...' if len(others) > NAMED else ''}")
    return films


def _is_encoded(array: Any) -> bool:
    """Whether the rows of an array are the bytes of PNG or JPEG files."""
    if array.shape[0] == 0 or array.dtype.kind not in "uO":
        return False
    return np.asarray(array[0]).tobytes()[:4] in (b"\x89PNG", b"\xff\xd8\xff\xe0", b"\xff\xd8\xff\xe1", b"\xff\xd8\xff\xdb")


def _slices(array: Any, index: tuple[int, ...]) -> Iterator[Callable[[], Any]]:
    step = min(BLOCK, (getattr(array, "chunks", None) or (1,))[0])
    for start in range(0, array.shape[0], step):
        try:
            block = array[(slice(start, start + step), *index)]
        except Exception as error:  # a damaged chunk: its frames cannot be read, those after it can
            yield from (partial(_refuse, error) for _ in range(start, min(start + step, array.shape[0])))
        else:
            yield from (partial(block.__getitem__, k) for k in range(len(block)))


def _refuse(error: Exception) -> Any:
    raise ValueError(f"cannot be read: {error}") from error


def _of_tar(path: Path) -> Films:
    """A shard of a WebDataset: a sample's files share the name up to the first dot, what follows is the field."""
    with tarfile.open(path) as archive:
        members = [member for member in archive if member.isfile() and member.name.lower().endswith(IMAGE_SUFFIXES)]
    fields: dict[str, list[tarfile.TarInfo]] = {}
    for member in members:
        fields.setdefault(Path(member.name).name.partition(".")[2], []).append(member)

    def reads(chosen: list[tarfile.TarInfo]) -> Iterator[Callable[[], Any]]:
        with path.open("rb") as stream:
            for member in chosen:
                stream.seek(member.offset_data)
                yield partial(np.frombuffer, stream.read(member.size), np.uint8)

    return {field: Film(len(chosen), partial(reads, chosen)) for field, chosen in fields.items()}


def _reversed(read: Callable[[], Pixels]) -> Pixels:
    return read()[:, :, ::-1]


def _of_lerobot(path: Path) -> Films:
    """The cameras of a LeRobot data set, versions 2 and 3: MP4 files in order, or images in the columns of Parquet files."""
    info = json.loads((path / "meta" / "info.json").read_text(encoding="utf-8"))
    in_order = partial(sorted, key=lambda file: natural_order(file.as_posix()))

    def videos(camera: str) -> Iterator[Callable[[], Any]]:
        for file in in_order(file for file in (path / "videos").rglob("*.mp4") if camera in file.parts):
            yield from (partial(_reversed, read) for read in video_reads(file))

    def images(camera: str) -> Iterator[Callable[[], Any]]:
        import pyarrow.parquet

        for file in in_order((path / "data").rglob("*.parquet")):
            for batch in pyarrow.parquet.ParquetFile(file).iter_batches(BLOCK, columns=[camera]):
                for row in batch.to_pydict()[camera]:
                    data = row["bytes"] or (path / row["path"]).read_bytes()
                    yield partial(np.frombuffer, data, np.uint8)

    kinds = {"video": videos, "image": images}
    return {
        name: Film(int(info["total_frames"]), partial(kinds[feature["dtype"]], name))
        for name, feature in info["features"].items()
        if feature["dtype"] in kinds and 3 in feature["shape"]
    }


ROS_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/Image", "sensor_msgs/CompressedImage")


def _of_bag(path: Path) -> Films:
    """A bag of ROS 1, the folder of a bag of ROS 2, or a file of MCAP."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    def opened() -> Any:
        return AnyReader([path], default_typestore=get_typestore(Stores.LATEST))

    def reads(topic: str) -> Iterator[Callable[[], Any]]:
        with opened() as bag:
            for connection, _, data in bag.messages([c for c in bag.connections if c.topic == topic]):
                yield partial(_of_message, bag.deserialize(data, connection.msgtype))

    with opened() as bag:
        topics = [(c.topic, c.msgcount) for c in bag.connections if c.msgtype in ROS_IMAGES]
    return {topic: Film(count, partial(reads, topic)) for topic, count in topics}


ORDERS = {"rgb8": "RGB", "bgr8": "BGR", "rgba8": "RGBA", "bgra8": "BGRA", "rgb16": "RGB", "bgr16": "BGR", "8UC3": "BGR"}
"""Encodings of sensor_msgs/Image in colour, and the order of their channels."""


def _of_message(message: Any) -> Any:
    """The bytes of a CompressedImage, or the pixels of an Image, R, G, B."""
    data = np.frombuffer(message.data, np.uint8)
    if not hasattr(message, "encoding"):
        return data
    order = ORDERS.get(message.encoding)
    if order is None:
        raise ValueError(f"expected an image in colour ({', '.join(ORDERS)}), got the encoding {message.encoding!r}")
    rows = data.reshape(message.height, message.step)
    if message.encoding.endswith("16"):
        rows = rows.view(">u2" if message.is_bigendian else "<u2").astype(np.uint16)
    pixels = rows[:, : message.width * len(order)].reshape(message.height, message.width, len(order))
    return pixels[:, :, [order.index(channel) for channel in "RGB"]]


class Container(NamedTuple):
    """A kind of container, and how to find the recordings in one."""

    kind: str
    suffixes: tuple[str, ...]  # of the names of its files
    marker: tuple[str, str]  # of a folder: the file that tells it, and what this file contains; ("", "") for none
    read: Callable[[Path], Films]


CONTAINERS = (
    Container("a zarr store", (".zarr.zip", ".zip"), ("zarr.json", "zarr_format"), _of_zarr),
    Container("a zarr store", (), (".zgroup", "zarr_format"), _of_zarr),
    Container("a zarr array", (), (".zarray", "zarr_format"), _of_zarr),
    Container("an HDF5 file", (".h5", ".hdf5"), ("", ""), _of_hdf5),
    Container("a NumPy array", (".npy",), ("", ""), _of_npy),
    Container("a WebDataset", (".tar",), ("", ""), _of_tar),
    Container("a LeRobot data set", (), ("meta/info.json", "codebase_version"), _of_lerobot),
    Container("a bag of ROS 1", (".bag",), ("", ""), _of_bag),
    Container("a bag of ROS 2", (), ("metadata.yaml", "rosbag2_bagfile_information"), _of_bag),
    Container("an MCAP file", (".mcap",), ("", ""), _of_bag),
)


def find_container(path: Path) -> tuple[Container, Path, str] | None:
    """The container that a path names or leads into, its file or folder, and the path inside; None for other paths."""
    for place in (path, *path.parents):
        if os.path.isdir(place):
            found = next((c for c in CONTAINERS if c.marker[0] and _contains(place / c.marker[0], c.marker[1])), None)
        elif os.path.isfile(place):
            found = next((c for c in CONTAINERS if place.name.lower().endswith(c.suffixes)), None)
        else:
            continue
        if found is None or place == Path() != path:
            return None
        return found, place, path.relative_to(place).as_posix().removeprefix(".")
    return None


def _contains(file: Path, text: str) -> bool:
    return file.is_file() and text.encode() in file.read_bytes()


EXPECTED = "expected frames (T, H, W, 3) or (T, N, H, W, 3), R, G, B, unsigned integers or floats"


def open_film(path: Path) -> Film | None:
    """The recording that a path names in a container, or an error; None where the path leads into none."""
    found = find_container(path)
    if found is None:
        return None
    container, place, inside = found
    try:
        films = {name.strip("/"): film for name, film in container.read(place).items()}
    except ImportError as error:
        raise ImportError(f"{place}: {container.kind}, which needs {error.name}: {EXTRA}") from error
    except NoImages as error:
        raise ValueError(f"{place}: {container.kind} without images in colour: {EXPECTED}, {error}") from error
    except Exception as error:  # each library has errors of its own
        raise ValueError(f"{place}: not {container.kind}, or damaged: {error}") from error
    chosen = [name for name in films if not inside or name == inside or name.startswith(f"{inside}/")]
    if len(chosen) == 1:
        film = films[chosen[0]]
        return film._replace(reads=lambda: _decoded(film, container.kind, path))
    if not films:
        raise ValueError(f"{place}: {container.kind} without images in colour: {EXPECTED}")
    named = ", ".join(str(place / name) for name in (chosen or films))
    raise ValueError(f"{path}: expected the path of one recording in {container.kind}, got {len(chosen) or 'none'}: one of {named}")


def _decoded(film: Film, kind: str, path: Path) -> Iterator[Callable[[], Pixels]]:
    read = None
    try:
        for read in film.reads():
            yield partial(_pixels, read, path)
    except ImportError:
        raise
    except Exception as error:  # each library has errors of its own
        raise ValueError(f"{path}: {kind} that is damaged or cut short: {error}") from error
    if read is None:
        raise ValueError(f"{path}: {kind} without a frame: T is 0")


def _pixels(read: Callable[[], Any], path: Path) -> Pixels:
    """A frame, encoded or (H, W, 3) R, G, B, as OpenCV's pixels, B, G, R."""
    value = read()
    array = np.frombuffer(value, np.uint8) if isinstance(value, bytes) else np.asarray(value)
    if array.ndim == 1:
        check_still_head(array[:64].tobytes(), path)
        return check_colour(decode_bytes(array, IN_COLOUR, str(path)), path)
    return np.ascontiguousarray(check_colour(array, path)[:, :, ::-1])
