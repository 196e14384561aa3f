"""Recordings in containers, each written by its own library: the frames are those of the same images, and depth is too."""

import argparse
import io
import json
import sys
import tarfile

import cv2
import numpy as np
import pytest
import torch
from conftest import bgr, tiny_image, write_film

import torchvts as vts
from torchvts import stream as streams
from torchvts.cli.options import split_files
from torchvts.core.containers import _of_message
from torchvts.core.recordings import count_frames
from torchvts.dataset import reconstruct_dataset

COUNT = 7
FRAMES = [bgr(tiny_image(k)) for k in range(COUNT)]
RGB = np.stack(FRAMES)[..., ::-1].copy()
BOTH = np.stack([RGB, RGB[::-1]], axis=1)  # (T, 2, H, W, 3): two sensors of a hand


def png(pixels):
    return cv2.imencode(".png", pixels)[1].tobytes()


def write_zarr(folder):
    zarr = pytest.importorskip("zarr")
    path = folder / "day.zarr"
    group = zarr.open(str(path), mode="w")
    group["data/left_tactile_data_gel"], group["meta/episode_ends"] = BOTH, np.array([4, COUNT])
    return path / "data/left_tactile_data_gel/0"


def write_zipped_zarr(folder):
    zarr = pytest.importorskip("zarr")
    path = folder / "day.zarr.zip"
    store = zarr.storage.ZipStore(path, mode="w")
    zarr.open(store, mode="w")["data/right_tactile_data_gel"] = RGB[:, None]
    store.close()
    return path


def write_hdf5(folder):
    h5py = pytest.importorskip("h5py")
    with h5py.File(folder / "day.h5", "w") as file:
        file["left/rgb"], file["right/rgb"] = RGB, RGB[::-1]
        file["left/force"] = np.zeros((COUNT, 6))
    return folder / "day.h5/left"


def write_encoded_hdf5(folder):
    h5py = pytest.importorskip("h5py")
    with h5py.File(folder / "day.hdf5", "w") as file:
        images = file.create_dataset("observations/images/gel", (COUNT,), h5py.vlen_dtype(np.uint8))
        for k, pixels in enumerate(FRAMES):
            images[k] = np.frombuffer(png(pixels), np.uint8)
    return folder / "day.hdf5"


def write_npy(folder):
    np.save(folder / "day.npy", RGB)
    return folder / "day.npy"


def write_floats(folder):
    np.save(folder / "day.npy", RGB.astype(np.float32) / 255)
    return folder / "day.npy"


def write_webdataset(folder):
    writer = pytest.importorskip("webdataset").TarWriter(str(folder / "shard-000000.tar"))
    with writer as sink:
        for k, pixels in enumerate(FRAMES):
            sink.write({"__key__": f"{k:06d}", "gel.png": png(pixels), "force.json": {"n": k}})
    return folder / "shard-000000.tar"


def write_tar(folder):
    for k, pixels in enumerate(FRAMES):
        (folder / f"{k}.left.png").write_bytes(png(pixels))
        (folder / f"{k}.right.png").write_bytes(png(pixels[::-1]))
    with tarfile.open(folder / "two.tar", "w") as archive:
        for side in ("left", "right"):
            for k in range(COUNT):
                archive.add(folder / f"{k}.{side}.png", f"day/{k}.{side}.png")
    return folder / "two.tar/left.png"


def lerobot_info(folder, dtype, version):
    path = folder / "day"
    (path / "meta").mkdir(parents=True)
    features = {
        "observation.images.gel": {"dtype": dtype, "shape": [*RGB.shape[1:3], 3]},
        "observation.images.gel_depth": {"dtype": dtype, "shape": [*RGB.shape[1:3], 1]},
        "action": {"dtype": "float32", "shape": [3]},
    }
    info = {"codebase_version": version, "total_frames": COUNT, "features": features}
    (path / "meta/info.json").write_text(json.dumps(info))
    return path


def write_lerobot_images(folder):
    """Images in the columns of two files, as version 2.1 has one of each episode."""
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    path = lerobot_info(folder, "image", "v2.1")
    (path / "data/chunk-000").mkdir(parents=True)
    for episode, numbers in enumerate((range(4), range(4, COUNT))):
        rows = [{"bytes": png(FRAMES[k]), "path": f"frame_{k:06d}.png"} for k in numbers]
        table = pa.table({"observation.images.gel": rows, "index": list(numbers)})
        pq.write_table(table, path / f"data/chunk-000/episode_{episode:06d}.parquet")
    return path


def write_lerobot_videos(folder):
    """Two films without loss, as version 3 lays them out; its own are lossy."""
    path = lerobot_info(folder, "video", "v3.0")
    films = path / "videos/observation.images.gel/chunk-000"
    films.mkdir(parents=True)
    for number, frames in enumerate((FRAMES[:4], FRAMES[4:])):
        write_film(films / f"file-{number:03d}.mp4", frames, code="png ")
    return path


def write_ros1(folder):
    return write_bag(pytest.importorskip("rosbags.rosbag1").Writer(folder / "day.bag"), "ROS1_NOETIC", "serialize_ros1", folder)


def write_ros2(folder):
    writer = pytest.importorskip("rosbags.rosbag2").Writer(folder / "day", version=9)
    return write_bag(writer, "ROS2_HUMBLE", "serialize_cdr", folder)


def write_bag(writer, store, serialize, folder):
    """Two topics: images as they are, padded to rows of 256 bytes, and compressed ones of the second sensor."""
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores[store])
    names = ("std_msgs/msg/Header", "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "builtin_interfaces/msg/Time")
    header, image, compressed, time = (types.types[name] for name in names)
    with writer:
        raw, packed = (
            writer.add_connection(topic, kind.__msgtype__, typestore=types)
            for topic, kind in (("/left/image_raw", image), ("/right/compressed", compressed))
        )
        for k, pixels in enumerate(FRAMES):
            height, width, _ = pixels.shape
            padded = np.zeros((height, 256), np.uint8)
            padded[:, : 3 * width] = pixels.reshape(height, -1)
            stamp = header(stamp=time(0, k), frame_id="gel") if "ROS2" in store else header(seq=k, stamp=time(0, k), frame_id="gel")
            message = image(stamp, height, width, "bgr8", 0, 256, padded.reshape(-1))
            writer.write(raw, k, bytes(getattr(types, serialize)(message, image.__msgtype__)))
            message = compressed(stamp, "png", np.frombuffer(png(pixels[::-1]), np.uint8))
            writer.write(packed, k, bytes(getattr(types, serialize)(message, compressed.__msgtype__)))
    return next(folder.glob("day*")) / "left/image_raw"


def write_mcap(folder):
    ros2 = pytest.importorskip("mcap_ros2.writer")
    text = """std_msgs/Header header\nstring format\nuint8[] data
================================================================================
MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id
================================================================================
MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"""
    with (folder / "day.mcap").open("wb") as stream:
        writer = ros2.Writer(stream)
        schema = writer.register_msgdef("sensor_msgs/msg/CompressedImage", text)
        for k, pixels in enumerate(FRAMES):
            message = {"header": {"stamp": {"sec": 0, "nanosec": k}, "frame_id": "gel"}, "format": "png", "data": png(pixels)}
            writer.write_message("/gel/compressed", schema, message, log_time=k, publish_time=k)
        writer.finish()
    return folder / "day.mcap"


WRITERS = (
    write_zarr, write_zipped_zarr, write_hdf5, write_encoded_hdf5, write_npy, write_floats, write_webdataset, write_tar,
    write_lerobot_images, write_lerobot_videos, write_ros1, write_ros2, write_mcap,
)  # fmt: skip


@pytest.fixture(scope="module")
def depths(unit, tmp_path_factory):
    """Depth of the same frames as PNG files."""
    folder, out = tmp_path_factory.mktemp("images"), tmp_path_factory.mktemp("depths")
    for k, pixels in enumerate(FRAMES):
        cv2.imwrite(str(folder / f"{k}.png"), pixels)
    reconstruct_dataset(unit, folder, out, workers=1, pictures=False)
    return [vts.read_result(out / f"{k}.npz").depth_mm for k in range(COUNT)]


@pytest.mark.parametrize("write", WRITERS, ids=lambda write: write.__name__.removeprefix("write_"))
def test_frames_and_depth_are_those_of_the_same_images(write, unit, depths, tmp_path):
    (tmp_path / "in").mkdir()
    path = write(tmp_path / "in")
    found = list(vts.frames(path))
    assert [name for name, _ in found] == [f"{path.stem}_{k:06d}" for k in range(COUNT)] and count_frames(path) == COUNT
    assert all(torch.equal((image * 255).round(), (tiny_image(k) * 255).round()) for k, (_, image) in enumerate(found))
    assert all(np.array_equal(streams.open_source(path).read(), FRAMES[0]) for _ in range(2))

    options = {"workers": 1, "background_frames": 0, "pictures": False}
    report = reconstruct_dataset(unit, path, tmp_path / "out", **options)
    assert (report.rows, report.failed) == (COUNT, [])
    for k, same in enumerate(depths):
        assert (vts.read_result(tmp_path / f"out/{path.stem}_{k:06d}.npz").depth_mm - same).abs().max() < 1e-7
    assert reconstruct_dataset(unit, path, tmp_path / "out", **options).before == COUNT


def test_one_of_several_recordings_is_named(tmp_path):
    path = write_tar(tmp_path).parent

    def alone(path):
        return split_files(argparse.Namespace(files=[str(path)], sensor=None, background=None, press=[]))

    for read in (vts.frames, streams.open_source, count_frames, alone):
        with pytest.raises(ValueError, match=r"recording in a WebDataset, got 2: one of .*two\.tar/left\.png, .*two\.tar/right"):
            read(path)
        with pytest.raises(
            ValueError, match=r"two\.tar/middle: expected the path of one recording in a WebDataset, got none: one of"
        ):
            read(path / "middle")
    np.save(tmp_path / "both.npy", BOTH)
    names = [[name for name, _ in vts.frames(tmp_path / "both.npy" / side)] for side in "01"]
    assert names == [[f"{side}_{k:06d}" for k in range(COUNT)] for side in "01"]


def test_both_recordings_of_a_container_are_reconstructed_beside_each_other(unit, tmp_path):
    np.save(tmp_path / "both.npy", BOTH[:2])
    sides = [tmp_path / "both.npy" / side for side in "01"]
    assert reconstruct_dataset(unit, sides, tmp_path / "out", workers=1, pictures=False).rows == 4
    assert {file.name for file in (tmp_path / "out").glob("*.npz")} == {f"{side}_{k:06d}.npz" for side in "01" for k in range(2)}


@pytest.mark.parametrize(
    "name, content, message",
    [
        ("day.npy", b"no array", "not a NumPy array, or damaged"),
        ("day.tar", b"no archive", "not a WebDataset, or damaged"),
        ("day.parquet", b"PAR1", "name the folder of the LeRobot data set"),
        ("day.db3", b"SQLite", "name the folder of the bag"),
        ("day.npz", b"PK", "name one array: numpy.save"),
        ("day.pkl", b"", "it can run any program when it is opened"),
    ],
)
def test_what_cannot_be_read_says_what_helps(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    for read in (lambda path: list(vts.frames(path)), streams.open_source):
        with pytest.raises(ValueError, match=message):
            read(tmp_path / name)


def test_arrays_without_images_are_refused(tmp_path):
    np.save(tmp_path / "rgba.npy", np.zeros((5, 40, 60, 4), np.uint8))
    with pytest.raises(ValueError, match=r"rgba\.npy: a NumPy array without images in colour: .*, got \(5, 40, 60, 4\) uint8"):
        vts.frames(tmp_path / "rgba.npy")
    np.save(tmp_path / "none.npy", RGB[:0])
    with pytest.raises(ValueError, match=r"none\.npy: a NumPy array without a frame: T is 0"):
        list(vts.frames(tmp_path / "none.npy"))


def test_encoded_images_with_a_palette_are_refused_as_their_files_are(tmp_path):
    """Of a real press its 64 colours left a depth of 0.43 mm in place of 0.85, without a word."""
    image, file = pytest.importorskip("PIL.Image"), io.BytesIO()
    image.fromarray(RGB[0]).quantize(64).save(file, "PNG")
    with tarfile.open(tmp_path / "day.tar", "w") as archive:
        member = tarfile.TarInfo("0.png")
        member.size = len(file.getvalue())
        archive.addfile(member, io.BytesIO(file.getvalue()))
    with pytest.raises(ValueError, match=r"day\.tar: expected an image of 8 bits a channel, got a PNG with a palette"):
        list(vts.frames(tmp_path / "day.tar"))


def test_a_damaged_chunk_costs_its_own_frames_alone(unit, tmp_path):
    zarr = pytest.importorskip("zarr")
    array = zarr.create(shape=RGB.shape, chunks=(2, *RGB.shape[1:]), dtype="u1", store=str(tmp_path / "day.zarr"))
    array[:] = RGB
    (chunk,) = (
        p for p in (tmp_path / "day.zarr").rglob("*") if p.is_file() and p.as_posix().replace("/", ".").endswith(".1.0.0.0")
    )
    chunk.write_bytes(chunk.read_bytes()[:20])
    out = tmp_path / "out"
    report = reconstruct_dataset(unit, tmp_path / "day.zarr", out, workers=1, background_frames=0, pictures=False)
    assert report.rows == COUNT - 2 and [name for name, _ in report.failed] == ["day_000002", "day_000003"]
    assert "cannot be read" in report.failed[0][1]


def test_the_only_sensor_of_an_array_is_found_by_its_number_too(tmp_path):
    np.save(tmp_path / "one.npy", RGB[:, None])
    both = [[image for _, image in vts.frames(path)] for path in (tmp_path / "one.npy", tmp_path / "one.npy" / "0")]
    assert all(torch.equal(a, b) for a, b in zip(*both)) and len(both[1]) == COUNT


def test_a_library_that_is_missing_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)  # as where it is not installed
    (tmp_path / "day.h5").touch()
    with pytest.raises(ImportError, match=r"day\.h5: an HDF5 file, which needs h5py: pip install 'torchvts\[containers\]'"):
        vts.frames(tmp_path / "day.h5")


def test_an_encoding_without_colour_is_a_frame_that_cannot_be_read(tmp_path):
    class Message:
        encoding, data, height, width, step = "mono8", bytes(6), 2, 3, 3

    with pytest.raises(ValueError, match=r"expected an image in colour .* got the encoding 'mono8'"):
        _of_message(Message)
