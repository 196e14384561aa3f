"""Damaged and hostile files: they are read, or refused with a message that names the file, and nothing else happens.

Every kind of file that torchvts reads is damaged many times at random and a few times on purpose, and read in a child process whose
memory is bounded. The child must neither crash nor hang, run no code of the file, and stay within its memory; it may raise
ValueError, TypeError or OSError, and the message must name the file. A process that is killed while it saves leaves either the old
file or the new one, complete.

`make test` damages each file some dozens of times; in `make test-long` (TORCHVTS_TEST_PROFILE=long), where all tests of this
file are marked long, some thousands of times.
"""

import json
import os
import pickle
import random
import resource
import signal
import struct
import subprocess
import sys
import threading
import warnings
import zipfile
import zlib
from pathlib import Path

import attack_calls
import cv2
import numpy as np
import pytest
import torch
from conftest import LONG, ring_lights, write_film

import torchvts as vts
from torchvts.core.files import read_depth_png, write_atomically, write_depth_png
from torchvts.model.response_field import ResponseField, ResponseModel

pytestmark = [pytest.mark.long] * LONG
DAMAGES, OF_CLOUDS = (3000, 60) if LONG else (6, 1)
"""Damages of a file; of a point cloud, which a process of its own reads."""
CLOUDS = ("cloud.pcd", "text.pcd", "small.pcd", "cloud.ply", "text.ply") if LONG else ("small.pcd", "text.ply")
MEMORY = 2**30
"""Bytes of address space that reading one damaged file may take beyond what the process has."""
SENSOR = vts.Sensor("rig", 24, 32, 1.25)


def image():
    return torch.rand(3, 24, 32, generator=torch.Generator().manual_seed(0)) * 0.5 + 0.2


def by_lights():
    return vts.Calibration.from_lights(ring_lights(), SENSOR, image())


def by_response():
    field = ResponseField(0, -1, 10.0, ((0.3, 0, 0), (0, 0.3, 0)))
    return vts.Calibration.from_response(ResponseModel(field, None), SENSOR, image())


def network():
    return vts.NormalFromMLP(24, 32, image(), (4,))


def lookup():
    slope = torch.randn(100, 2, generator=torch.Generator().manual_seed(1))
    return vts.NormalFromLookup.fit(image(), slope @ torch.ones(2, 3) * 0.1, slope, bins=4)


def write_cloud(path, ascii_text=False):
    o3d = pytest.importorskip("torchvts.pose.read_cloud").open3d()
    points = np.random.default_rng(0).random((40, 3))
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.normals = o3d.utility.Vector3dVector(points)
    o3d.io.write_point_cloud(str(path), cloud, write_ascii=ascii_text)


def write_compressed_cloud(path):
    o3d = pytest.importorskip("torchvts.pose.read_cloud").open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.random.default_rng(0).random((40, 3))))
    o3d.io.write_point_cloud(str(path), cloud, compressed=True)


def read_cloud(path):
    from torchvts.pose.clouds import read_point_cloud

    return read_point_cloud(path)


def write_grey_film(path):
    write_film(path, [np.full((48, 64, 3), 40 * k, np.uint8) for k in range(5)])


def write_folder(path):
    """What is damaged is the file; the folder around it is whole."""
    folder = path.parent
    parts = {
        "catalog.csv": lambda: (folder / "catalog.csv").write_text("experiment_reldir,diameter(mm)\nball,6.0\n"),
        "background.png": lambda: vts.write_image(folder / "background.png", image()),
        "gelsight.png": lambda: vts.write_image(folder / "ball" / "gelsight.png", image()),
        "label.npz": lambda: np.savez(folder / "ball" / "label.npz", center=np.array([3.0, 4.0]), radius=np.array(2.0)),
        "labels.csv": lambda: (folder / "labels.csv").write_text(
            "experiment_reldir,diameter_mm,center_x_px,center_y_px,contact_radius_px\nball,6.0,3.0,4.0,2.0\n"
        ),
    }
    (folder / "ball").mkdir(exist_ok=True)
    for write in parts.values():
        write()


def folder_file(name):
    """A file of a gs_sdk folder, and its reading."""
    inside = Path("ball") / name if name in ("gelsight.png", "label.npz") else Path(name)

    def write(path):
        write_folder(path)
        path.write_bytes((path.parent / inside).read_bytes())

    def read(path):
        if path != path.parent / inside:
            (path.parent / inside).write_bytes(path.read_bytes())
        return vts.read_presses(path.parent)

    return write, read


READERS = {
    "unit.safetensors": (lambda path: by_lights().save(path), vts.Calibration.load),
    "field.safetensors": (lambda path: by_response().save(path), vts.Calibration.load),
    "lookup.safetensors": (lambda path: lookup().save(path), vts.NormalFromLookup.load),
    "network.safetensors": (lambda path: network().save(path), vts.NormalFromMLP.load),
    "nnmodel.pth": (lambda path: torch.save(network().gs_sdk_state(), path), lambda path: vts.NormalFromMLP.load(path, image())),
    "rig.yaml": (lambda path: vts.Sensor.load("gelsight_mini").save(path), vts.Sensor.load),
    "gs_sdk.yaml": (lambda path: path.write_text("ppmm: 0.0634\nimgh: 240\nimgw: 320\n"), vts.Sensor.load),
    "image.png": (lambda path: vts.write_image(path, image()), vts.read_image),
    "image.jpg": (lambda path: vts.write_image(path, image()), vts.read_image),
    "image.bmp": (lambda path: vts.write_image(path, image()), vts.read_image),
    "image.tif": (lambda path: vts.write_image(path, image()), vts.read_image),
    "depth.png": (lambda path: write_depth_png(path, image()[:1]), read_depth_png),
    "cloud.pcd": (write_cloud, read_cloud),
    "text.pcd": (lambda path: write_cloud(path, True), read_cloud),
    "small.pcd": (write_compressed_cloud, read_cloud),
    "cloud.ply": (write_cloud, read_cloud),
    "text.ply": (lambda path: write_cloud(path, True), read_cloud),
    "film.avi": (write_grey_film, lambda path: list(vts.frames(path))),
    "catalog.csv": folder_file("catalog.csv"),
    "labels.csv": folder_file("labels.csv"),
    "label.npz": folder_file("label.npz"),
    "gelsight.png": folder_file("gelsight.png"),
}


def damaged(content, rng):
    """The bytes, damaged by chance."""
    data = bytearray(content)
    kind = rng.randrange(7)
    if kind == 0:
        return bytes(data[: rng.randrange(len(data))])
    if kind == 1:  # the head, where sizes stand
        for _ in range(rng.randint(1, 4)):
            data[rng.randrange(min(len(data), 200))] ^= 1 << rng.randrange(8)
    elif kind == 2:
        for _ in range(rng.randint(1, 20)):
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    elif kind == 3:
        start = rng.randrange(len(data))
        data[start : start + rng.randint(1, 64)] = bytes(rng.choice((0, 255)) for _ in range(rng.randint(0, 64)))
    elif kind == 4:  # numbers in texts
        digits = [i for i, letter in enumerate(data) if 48 <= letter <= 57]
        for place in sorted(rng.sample(digits, min(len(digits), 2)), reverse=True):
            data[place : place + 1] = rng.choice((b"99999999999999", b"-1", b"0", b"nan", b"1e400", b"", b"4294967297"))
    elif kind == 5:
        start, end = sorted(rng.randrange(len(data)) for _ in range(2))
        data += data[start:end]
    else:
        place = rng.randrange(min(len(data), 400))
        data[place : place + 4] = rng.choice((b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\xff\xff\xff\x7f", b"\0\0\0\0"))
    return bytes(data)


def child(saved_folder, damaged_folder, claims_folder, count, seed):
    """Kill savers, then read damaged files and files with false claims, and print each outcome. Runs in a process of its own."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    kill_savers(saved_folder)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
    read_damaged(Path(damaged_folder), count, seed)
    for label, (name, _) in CLAIMS.items():
        print(json.dumps([label, None]), end=" ", flush=True)
        print(json.dumps(outcome(READERS[name][1], Path(claims_folder) / label / name)), flush=True)


def damages_of(name, count):
    return min(count, OF_CLOUDS * (name in CLOUDS)) if name.endswith((".pcd", ".ply")) else count


def read_damaged(folder, count, seed):
    for name in READERS:
        read = READERS[name][1]
        content = (folder / name).read_bytes()
        rng = random.Random(f"{seed} {name}")
        for number in range(damages_of(name, count)):
            path = folder / f"damaged_{name}"
            if name in ("catalog.csv", "labels.csv", "label.npz", "gelsight.png"):
                path = folder / f"gs_sdk_{name}" / name
            path.write_bytes(damaged(content, rng))
            print(json.dumps([name, number]), end=" ", flush=True)
            print(json.dumps(outcome(read, path)), flush=True)


def outcome(read, path):
    """What reading a file led to: kind of the error, its text, and the text's length."""
    try:
        read(path)
    except (ValueError, TypeError, OSError) as error:
        return [type(error).__name__, str(error)[:500], len(str(error))]
    except BaseException as error:
        return [f"UNEXPECTED {type(error).__name__}", str(error)[:500], len(str(error))]
    return ["read", "", 0]


def write_whole_files(folder):
    for name in READERS:
        if name in ("catalog.csv", "labels.csv", "label.npz", "gelsight.png"):
            (folder / f"gs_sdk_{name}").mkdir()
            READERS[name][0](folder / f"gs_sdk_{name}" / name)
            (folder / name).write_bytes((folder / f"gs_sdk_{name}" / name).read_bytes())
        else:
            READERS[name][0](folder / name)


def write_claims(folder):
    for label, (name, content) in CLAIMS.items():
        (folder / label).mkdir()
        if name == "catalog.csv":
            write_folder(folder / label / name)
        with (folder / label / name).open("wb") as stream:
            if content is None:
                stream.truncate(2**40)
            else:
                stream.write(content)


ENVIRONMENT = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}


@pytest.fixture(scope="module")
def printed(tmp_path_factory):
    """The lines that a child process prints, which kills savers, and reads damaged files and those with false claims."""
    folders = saved, damaged, claims = [tmp_path_factory.mktemp(name) for name in ("saved", "damaged", "claims")]
    write_whole_files(damaged)
    write_claims(claims)
    program = f"import test_fuzz\ntest_fuzz.child(*{list(map(str, folders))!r}, {DAMAGES}, 0)"
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", program],
        env=ENVIRONMENT, capture_output=True, text=True, errors="replace", timeout=3600, check=False,
    )  # fmt: skip
    lines = done.stdout.splitlines()
    assert done.returncode == 0, f"the child died after {lines[-1:]} (files in {saved.parent}): {done.stderr[-2000:]}"
    return lines


@pytest.fixture(scope="module")
def outcomes(printed):
    """What reading came to: (name, number or None, kind of error, text, length of the text) for each file."""
    lines = [line.split("] ", 1) for line in printed if line.startswith('["')]
    return [(*json.loads(head + "]"), *json.loads(tail)) for head, tail in lines]


def test_damaged_files_are_refused_with_a_message(outcomes):
    damaged_files = [row for row in outcomes if row[1] is not None]
    assert len(damaged_files) == sum(damages_of(name, DAMAGES) for name in READERS)
    wrong = [
        row
        for row in damaged_files
        if row[2].startswith("UNEXPECTED") or row[4] > 5000 or (row[2] != "read" and not names_its_file(row[3], "damaged"))
    ]
    assert wrong == []
    assert sum(row[2] != "read" for row in damaged_files) > 0.1 * len(damaged_files)  # the damage does harm


def test_claims_beyond_all_memory_are_refused_with_a_message(outcomes):
    claims = [row for row in outcomes if row[1] is None]
    assert [row[0] for row in claims] == list(CLAIMS)
    wrong = [
        row for row in claims if row[2] not in ("ValueError", "TypeError") or row[4] > 5000 or not names_its_file(row[3], "claims")
    ]
    assert wrong == []


def names_its_file(text, folder):
    return f"{os.sep}{folder}" in text and not text.startswith("[Errno")


# ---- claims ----


def png_that_claims(width, height):
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    rows = zlib.compress(bytes(3 * 20000 + 1) * 400, 9)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def safetensors_that_claims(shape, offsets, metadata="{}"):
    head = json.dumps({"__metadata__": {"torchvts": metadata}, "x": {"dtype": "F32", "shape": shape, "data_offsets": offsets}})
    return struct.pack("<Q", len(head)) + head.encode() + bytes(64)


def pcd_that_claims(points, data="binary"):
    return (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {data}\n"
    ).encode() + bytes(120)


def ply_that_claims(points, data="binary_little_endian"):
    names = "".join(f"property float {axis}\n" for axis in "xyz")
    return f"ply\nformat {data} 1.0\nelement vertex {points}\n{names}end_header\n".encode() + bytes(120)


def npz_that_claims(path):
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }".ljust(117) + b"\n"
    with zipfile.ZipFile(path, "w") as archive:
        for name in ("center", "radius"):
            archive.writestr(f"{name}.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(16))


LAUGHS = "\n".join(
    ["a0: &a0 [ha, ha, ha]", *(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 30)), "name: *a29"]
)
TAGS = {
    "object": "!!python/object/apply:os.system ['touch {canary}']",
    "new": "!!python/object/new:os.system ['touch {canary}']",
    "name": "name: !!python/name:os.system\nheight: !!python/object/apply:os.mkdir ['{canary}']",
    "module": "name: !!python/module:os",
}
CLAIMS = {
    "png": ("image.png", png_that_claims(100_000, 100_000)),
    "png that claims all": ("image.png", png_that_claims(2**31 - 1, 2**31 - 1)),
    "depth": ("depth.png", png_that_claims(60_000, 60_000)),
    "bmp": ("image.bmp", b"BM" + struct.pack("<IHHIIiiHHIIiiII", 100, 0, 0, 54, 40, 100_000, -100_000, 1, 24, 0, 0, 0, 0, 0, 0)),
    "jpg": ("image.jpg", b"\xff\xd8\xff\xc0\x00\x11\x08\xff\xff\xff\xff\x03\x01\x22\x00\x02\x11\x01\x03\x11\x01" + bytes(100)),
    "a tensor of 2^60": ("unit.safetensors", safetensors_that_claims([2**30, 2**30], [0, 2**62])),
    "a tensor that overlaps": ("unit.safetensors", safetensors_that_claims([2**40], [0, 64])),
    "a head of 2^60": ("unit.safetensors", struct.pack("<Q", 2**60) + b"{}"),
    "metadata deep": ("unit.safetensors", safetensors_that_claims([16], [0, 64], "[" * 100_000)),
    "pcd of 10^12": ("cloud.pcd", pcd_that_claims(10**12)),
    "pcd of 10^12, text": ("cloud.pcd", pcd_that_claims(10**12, "ascii")),
    "pcd of 10^12, compressed": ("cloud.pcd", pcd_that_claims(10**12, "binary_compressed")),
    "pcd of -1": ("cloud.pcd", pcd_that_claims(-1)),
    "ply of 10^12": ("cloud.ply", ply_that_claims(10**12)),
    "ply of 10^12, text": ("cloud.ply", ply_that_claims(10**12, "ascii")),
    "laughs": ("rig.yaml", LAUGHS.encode()),
    "yaml deep": ("rig.yaml", b"name: " + b"[" * 50_000),
    "yaml of keys": ("rig.yaml", b"".join(b"k%d: 1\n" % k for k in range(8_000))),
    "yaml of many bytes": ("rig.yaml", b"# \n" * 50_000),
    "laughs of gs_sdk": ("gs_sdk.yaml", LAUGHS.encode()),
    "a table of one line": ("catalog.csv", b"x" * 2**25),
    "a pickle for weights": ("nnmodel.pth", pickle.dumps({"fc1.weight": [1.0]})),
    **{
        f"a terabyte of {name}": (name, None)
        for name in ("image.png", "rig.yaml", "catalog.csv", "unit.safetensors", "nnmodel.pth")
    },
}


def test_a_label_that_claims_a_terabyte_is_refused(tmp_path):
    write_folder(tmp_path / "catalog.csv")
    npz_that_claims(tmp_path / "ball" / "label.npz")
    with pytest.raises(ValueError, match=r"label\.npz: not a label of gs_sdk, or cut short"):
        vts.read_presses(tmp_path)


# ---- what would run ----


@pytest.mark.parametrize("tag", TAGS)
def test_yaml_runs_nothing(tmp_path, tag):
    canary, path = tmp_path / "canary", tmp_path / "rig.yaml"
    path.write_text(TAGS[tag].replace("{canary}", str(canary)))
    with pytest.raises(ValueError, match=r"rig\.yaml: not a YAML file: could not determine a constructor"):
        vts.Sensor.load(path)
    assert not canary.exists()


class Touch:
    """Pickled, it makes a file when it is loaded."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (Path.touch, (Path(self.path),))


@pytest.mark.parametrize("protocol", [0, 2, 4])
@pytest.mark.parametrize("wrap", [lambda x: x, lambda x: {"state_dict": {"fc1.weight": x}}])
@pytest.mark.parametrize("way", ["pickle", "torch"])
def test_weights_run_nothing(tmp_path, protocol, wrap, way):
    canary, path = tmp_path / "canary", tmp_path / "nnmodel.pth"
    if way == "torch":
        torch.save(wrap(Touch(canary)), path, pickle_protocol=max(2, protocol))
    else:
        path.write_bytes(pickle.dumps(wrap(Touch(canary)), protocol))
    with pytest.raises(ValueError, match=r"nnmodel\.pth: expected a state dict of torch.save"):
        vts.NormalFromMLP.load(path, image())
    with pytest.raises(ValueError, match=r"safetensors: not a safetensors file"):
        vts.Calibration.load(path.rename(tmp_path / "unit.safetensors"))
    assert not canary.exists()


# ---- hostile paths ----


def special(tmp_path, kind, suffix):
    path = tmp_path / f"special{suffix}"
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "loop":
        path.symlink_to(path)
    elif kind == "nowhere":
        path.symlink_to(tmp_path / "gone")
    return Path(f"{path}\0.png") if kind == "NUL" else path


@pytest.mark.parametrize("kind", ["folder", "pipe", "device", "loop", "nowhere", "NUL"])
@pytest.mark.parametrize(
    "name", ["unit.safetensors", "nnmodel.pth", "rig.yaml", "gs_sdk.yaml", "image.png", "depth.png", "cloud.pcd"]
)
def test_what_is_no_plain_file_is_refused(tmp_path, kind, name):
    path = special(tmp_path, kind, Path(name).suffix)
    kind_of_error, text, _ = outcome(READERS[name][1], path)
    assert kind_of_error in ("FileNotFoundError", "ValueError") and "special" in text and not text.startswith("[Errno"), text


@pytest.mark.parametrize("kind", ["folder", "device", "loop", "NUL"])
@pytest.mark.parametrize("name", ["unit.safetensors", "rig.yaml", "image.png", "depth.png", "network.safetensors"])
def test_nothing_is_written_over_what_is_no_plain_file(tmp_path, kind, name):
    path = special(tmp_path, kind, Path(name).suffix)
    before = sorted(tmp_path.iterdir())
    if kind in ("folder", "NUL"):
        with pytest.raises((OSError, ValueError)):
            READERS[name][0](path)
    else:  # the link itself gives way to the file, what it led to stays
        READERS[name][0](path)
        assert path.is_file() and not path.is_symlink()
    assert sorted(tmp_path.iterdir()) == before


# ---- saving ----


def savers():
    """Two contents of each kind that is saved."""
    return {
        "unit.safetensors": [by_lights().save, by_response().save],
        "rig.yaml": [vts.Sensor("one", 24, 32, 1.25).save, vts.Sensor.load("gelsight_mini").save],
        "image.png": [lambda path: vts.write_image(path, image()), lambda path: vts.write_image(path, 1.0 - image())],
        "depth.png": [lambda path: write_depth_png(path, image()[:1]), lambda path: write_depth_png(path, -image()[:1])],
        "frames.csv": [lambda path: write_text(path, "a\n" * 2000), lambda path: write_text(path, "b\n" * 3000)],
        "cloud.ply": [lambda path: save_cloud(path, 200), lambda path: save_cloud(path, 90)],
        "cloud.pcd": [lambda path: save_cloud(path, 200), lambda path: save_cloud(path, 90)],
    }


def write_text(path, text):
    with write_atomically(path) as temporary, temporary.open("w", encoding="utf-8") as stream:
        for start in range(0, len(text), 1000):
            stream.write(text[start : start + 1000])


def save_cloud(path, count):
    from torchvts.pose.clouds import write_point_cloud

    write_point_cloud(path, torch.rand(count, 3, generator=torch.Generator().manual_seed(count)))


def kill_savers(folder):
    """For each kind of file, a fork that saves over an old one and is killed where the new one would take its place.

    Runs in a process that has no threads; prints each kind.
    """
    for kind, (save, save_over) in savers().items():
        path = Path(folder) / kind
        save(path)
        old, writer = path.read_bytes(), os.fork()
        if writer == 0:
            Path.replace = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
            save_over(path)
            os._exit(1)
        assert os.WTERMSIG(os.waitpid(writer, 0)[1]) == signal.SIGKILL, kind
        assert path.read_bytes() == old, kind
        (left,) = [scratch for scratch in Path(folder).iterdir() if scratch != path]
        assert left.name.startswith(f".{path.stem}-") and left.suffix == path.suffix and left.stat().st_size > 0, left
        left.unlink()
        path.unlink()
        print(f"{kind} is whole", flush=True)


def test_a_kill_in_the_middle_of_a_save_leaves_a_whole_file(printed):
    assert [line for line in printed if line.endswith(" is whole")] == [f"{kind} is whole" for kind in savers()]


def test_what_a_killed_writer_leaves_is_no_frame(tmp_path):
    vts.write_image(tmp_path / "a.png", image())
    (tmp_path / ".b-0123abcd.png").write_bytes(b"\x89PNG")
    assert [name for name, _ in vts.frames(tmp_path)] == ["a"]
    reader = vts.stream.open_source(tmp_path)
    assert reader.read() is not None and reader.read() is None


def test_an_error_in_the_middle_of_a_save_leaves_the_old_file(tmp_path):
    path = tmp_path / "unit.safetensors"
    by_lights().save(path)
    old = path.read_bytes()
    with pytest.raises(RuntimeError, match="stop"), write_atomically(path) as temporary:
        temporary.write_bytes(b"half")
        raise RuntimeError("stop")
    assert path.read_bytes() == old and list(tmp_path.iterdir()) == [path]


def test_threads_that_save_leave_the_umask_alone(tmp_path):
    mask = os.umask(0o027)
    try:
        threads = [
            threading.Thread(target=lambda k=k: [write_text(tmp_path / f"{k}.csv", "x\n") for _ in range(50)]) for k in range(8)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert {path.stat().st_mode & 0o777 for path in tmp_path.iterdir()} == {0o640} and len(list(tmp_path.iterdir())) == 8
    finally:
        assert os.umask(mask) == 0o027


# ---- calls ----


def test_a_sample_of_bad_calls():
    """Of every public callable, with values that nobody should give: only TypeError, ValueError and OSError come out, in time."""
    attack_calls.stop_slow_calls()
    before = Path.cwd()
    warnings.simplefilter("ignore")
    try:
        wrong = [(case, found) for case, make in attack_calls.attack(10_000 if LONG else 300, "a sample") if (found := make())]
    finally:
        os.chdir(before)
    assert wrong == []
