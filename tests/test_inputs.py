"""Inputs that gave wrong answers without a word, or ended in a crash or an error of another library: each with what failed."""

import inspect
import itertools
import json
import os
import resource
import signal
import subprocess
import sys
import threading
import time
import warnings
from pathlib import Path

import attack_calls
import numpy as np
import pytest
import test_refusals
import torch
from conftest import ring_lights

import torchvts as vts
from torchvts import stream as streams
from torchvts.core.files import load_tensors, read_frames, rgb_from_bgr, save_tensors, write_atomically
from torchvts.dataset import STATE, reconstruct_dataset
from torchvts.dataset.records import as_cell
from torchvts.stream.sources import LiveReader, check_reader
from torchvts.training.balls import fit_sphere

HEIGHT, WIDTH, PITCH = 48, 64, 0.5


def scene(press_mm=1.0):
    return vts.scenes.sphere_press(8.0, press_mm, (0, 0), HEIGHT, WIDTH, PITCH)


def unit():
    background = vts.scenes.render(vts.scenes.undeformed(scene()), ring_lights())[0]
    return vts.Calibration.from_lights(ring_lights(), vts.Sensor("rig", HEIGHT, WIDTH, PITCH), background)


def picture(press_mm=0.0):
    image = vts.scenes.render(scene(press_mm or 1.0) if press_mm else vts.scenes.undeformed(scene()), ring_lights())[0]
    return (image.permute(1, 2, 0).flip(2).numpy() * 255 + 0.5).astype(np.uint8)


# ---- cameras that stop ----


class Camera:
    """Gives so many frames; then it ends, fails or hangs."""

    name, live, fps = "made up", True, 30.0

    def __init__(self, frames, then="end"):
        self.frames, self.then, self.closed = frames, then, False
        self.unplugged = threading.Event()

    def read(self):
        self.frames -= 1
        if self.frames >= 0:
            return picture()
        if self.then == "fail":
            raise OSError("device is gone")
        if self.then == "hang":
            self.unplugged.wait()
        return None

    def close(self):
        self.closed = True


@pytest.mark.parametrize("then, reason", [("end", "it gives no more frames"), ("fail", "device is gone")])
def test_a_camera_that_stops_is_no_end_of_a_video(then, reason):
    camera = Camera(12, then)
    with streams.TactileStream(camera, unit(), background_frames=3) as stream, pytest.raises(OSError, match=reason) as caught:
        for _ in stream:
            pass
    assert str(caught.value).startswith("source: made up has stopped") and camera.closed
    with pytest.raises(OSError, match="source: made up has stopped"):  # among the first frames, too
        streams.TactileStream(Camera(7, then), unit(), background_frames=3)


def test_a_camera_that_hangs_has_stopped():
    camera = Camera(1, "hang")
    reader = LiveReader(lambda: camera)
    assert reader.read().shape == (HEIGHT, WIDTH, 3)
    reader.silent_s = 0.1
    with pytest.raises(OSError, match=r"source: made up has stopped: no frame for 0\.1 s"):
        reader.read()
    camera.unplugged.set()
    reader.close()


def test_a_camera_that_hangs_can_be_closed():
    """Who waits for its next frame, here a thread, is told at once, not when it has been silent for long."""
    camera = Camera(1, "hang")
    reader = LiveReader(lambda: camera)
    reader.silent_s = 3600.0
    newest = streams.NewestFrame(reader)
    assert newest.take()[2].shape == (HEIGHT, WIDTH, 3)
    newest.close()
    assert not newest._thread.is_alive() and newest.take() is None
    camera.unplugged.set()


def test_a_camera_comes_back():
    opened = []

    def plug():
        opened.append(Camera((2, 0, 9, 0)[len(opened)]))
        if len(opened) == 2:
            raise OSError("not there yet")
        return opened[-1]

    reader = LiveReader(plug, reconnect_s=600.0, sleep=lambda seconds: None)
    frames = [reader.read() for _ in range(6)]  # two, then 9 without the first 5
    assert all(frame.shape == (HEIGHT, WIDTH, 3) for frame in frames) and reader.reconnections == 1
    opened += [None] * 9
    with pytest.raises(OSError, match=r"has stopped \(it gives no more frames\) and did not come back within 0\.2 s"):
        LiveReader(lambda: Camera(0), reconnect_s=0.2, sleep=time.sleep).read()
    reader.close()
    with pytest.raises(ValueError, match="reconnect_s: expected 0 with a reader of your own"):
        streams.TactileStream(Camera(9), unit(), reconnect_s=1.0)


# ---- custom readers ----


@pytest.mark.parametrize("dtype", [np.int16, np.int32, np.int64, np.float32, np.bool_])
def test_frames_whose_range_is_unknown_are_refused(dtype):
    with pytest.raises(TypeError, match=r"pixels: expected an array of uint8 or uint16, got an array of "):
        rgb_from_bgr(picture().astype(dtype))
    frames = iter([picture().astype(dtype)] * 9)

    class Reader:
        name, live, fps = "mine", False, 30.0

        def read(self):
            return next(frames, None)

        def close(self):
            pass

    with pytest.raises(TypeError, match="source: frame 0 of mine: expected an array of uint8 or uint16"):
        streams.TactileStream(Reader(), unit(), background_frames=0)
    assert torch.equal(rgb_from_bgr(picture().astype(np.uint16) * 257), rgb_from_bgr(picture()))


@pytest.mark.parametrize("fps", [0, -30.0, float("nan"), float("inf"), None, "30"])
def test_a_rate_that_is_none_is_refused(fps):
    reader = Camera(9)
    reader.fps = fps
    with pytest.raises((ValueError, TypeError), match="source: fps: expected a number"):
        check_reader(reader)
    with pytest.raises((ValueError, TypeError), match="fps: expected a number"):
        streams.Recording(unit(), fps=fps)


# ---- results ----


@pytest.fixture
def run(tmp_path):
    import cv2

    unit().save(tmp_path / "unit.safetensors")
    (tmp_path / "in").mkdir()
    for name, press_mm in (("a", 1.0), ("b", 0.8)):
        (tmp_path / "in" / f"{name}.png").write_bytes(cv2.imencode(".png", picture(press_mm))[1].tobytes())

    def reconstruct(**options):
        given = {"pictures": False, "workers": 0, **options}
        return reconstruct_dataset(tmp_path / "unit.safetensors", tmp_path / "in", tmp_path / "out", **given)

    reconstruct.folder = tmp_path
    return reconstruct


def results(folder):
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file() and STATE not in path.parts}


def test_an_empty_result_is_not_done(run):
    assert run().rows == 2
    one = next((run.folder / "out").glob("a*"))
    content = one.read_bytes()
    one.write_bytes(b"")
    report = run()
    assert (report.rows, report.before) == (2, 1) and one.read_bytes() == content


@pytest.mark.parametrize("damage", [b"{", b"[]", b"{}", b'{"mark": [1, 2]}', b'{"mark": 3}', b"null", b"[" * 10_000, b"\xff\x00"])
def test_a_damaged_record_is_done_again(run, damage):
    run()
    for record in (run.folder / "out" / STATE / "frames").glob("a*.json"):
        mark = json.loads(record.read_bytes())["mark"]
        record.write_bytes(damage.replace(b"[1, 2]", json.dumps(mark).encode()))
    report = run()
    assert (report.rows, report.before) == (2, 1)


def test_overwriting_leaves_no_old_files_beside_new_ones(run):
    kind = "format" if "format" in inspect.signature(reconstruct_dataset).parameters else "depth"
    run(**{kind: "npy"})
    (run.folder / "out" / "notes.txt").write_text("the user's own")
    before = results(run.folder / "out")
    run(**{kind: "none"}, overwrite=True)
    assert before - results(run.folder / "out") == {"a_depth.npy", "b_depth.npy"}
    assert {"frames.csv", "notes.txt"} <= results(run.folder / "out")


def test_names_do_not_break_tables_and_links_do_not_end_a_run(run):
    source = run.folder / "in"
    content = (source / "a.png").read_bytes()
    for name in ("=1+1.png", "-2.png", "@x.png", "+3.png", "two\nlines.png", "cr\r.png", "tab\t.png"):
        (source / name).write_bytes(content)
    (source / "loop.png").symlink_to(source / "loop.png")
    (source / "loop").symlink_to(source / "loop")
    (source / "gone.png").symlink_to(source / "nowhere")
    report = run()
    assert report.rows == 9 and sorted(name for name, _ in report.failed) == ["gone.png", "loop.png"]
    lines = (run.folder / "out" / "frames.csv").read_text(encoding="utf-8").splitlines()
    assert len(lines) == 10 and {"'=1+1.png", "'-2.png", "'@x.png", "'+3.png", "two\\nlines.png", "cr\\r.png", "tab\\t.png"} <= {
        line.split(",")[0] for line in lines
    }
    assert (as_cell("=1"), as_cell("a=1"), as_cell("\t=1")) == ("'=1", "a=1", "\\t=1")


@pytest.mark.skipif(sys.platform == "win32", reason="limits of processes")
@pytest.mark.parametrize("name", ["depth.npy", "unit.safetensors", "image.png", "rig.yaml"])
def test_a_full_disk_is_reported_with_the_name(tmp_path, name):
    write = {
        "depth.npy": lambda path: write_array(path),
        "unit.safetensors": unit().save,
        "image.png": lambda path: vts.write_image(path, torch.rand(3, 200, 200)),
        "rig.yaml": lambda path: vts.Sensor.load("gelsight_mini").save(path, ["# " + "x" * 5000]),
    }[name]
    limits, ignored = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))  # a file may have no more bytes: what a full disk does too
    try:
        with pytest.raises(OSError, match=rf"{name}: cannot be written: (File too large|10000 requested)"):
            write(tmp_path / name)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, ignored)
    assert list(tmp_path.iterdir()) == []


def write_array(path):
    with write_atomically(path) as temporary:
        np.save(temporary, np.zeros(10_000))


# ---- names and sources ----


def test_names_that_are_not_utf_8(tmp_path):
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/f\xff"))
    try:
        folder.mkdir()
    except OSError:
        pytest.skip("this file system takes UTF-8 names only")
    name = os.fsdecode(b"n\xfe")
    image = torch.rand(3, 8, 8).mul(255).round() / 255
    vts.write_image(folder / f"{name}.png", image)
    assert torch.allclose(vts.read_image(folder / f"{name}.png"), image)
    assert [frame.shape for _, frame in read_frames(folder)] == [(3, 8, 8)]
    assert streams.open_source(folder).read().shape == (8, 8, 3)
    unit().save(folder / f"{name}.safetensors")
    assert vts.Calibration.load(folder / f"{name}.safetensors").sensor.name == "rig"
    vts.Sensor.load("gelsight_mini").save(folder / f"{name}.yaml")
    assert vts.Sensor.load(folder / f"{name}.yaml").height == 240
    (folder / f"{name}.avi").write_bytes(b"RIFF")
    for read in (lambda path: list(read_frames(path)), streams.open_source):
        with pytest.raises(
            ValueError, match=r"video: expected a name in UTF-8, which OpenCV needs, got '.*\\udcfe\.avi': rename it"
        ):
            read(folder / f"{name}.avi")
    with pytest.raises(ValueError, match="video: expected a name in UTF-8"):
        streams.VideoFile(folder / "out.avi", 10.0)


@pytest.mark.parametrize(
    ("source", "error"),
    [
        (-1, ValueError), (2**31, ValueError), (10**400, ValueError), (True, TypeError), ("9" * 20, ValueError), (1.5, TypeError),
        ("9" * 100_000, ValueError), ("\u00b2", FileNotFoundError), ("\u0663", FileNotFoundError),
    ],
)  # fmt: skip
def test_a_source_that_is_none_is_refused(source, error):
    with pytest.raises(error, match=r"^source: expected "):
        streams.open_source(source)


# ---- numbers in files ----


@pytest.mark.parametrize("word", ["nan", "1e999", "1_0", ""])
def test_a_cloud_with_other_coordinates_than_numbers_is_refused(tmp_path, word):
    from torchvts.pose.clouds import read_point_cloud

    head = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    (tmp_path / "cloud.ply").write_text(f"{head}0 1 2\n3 {word} 5\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"cloud\.ply: no points could be read: "):
        read_point_cloud(tmp_path / "cloud.ply")


def test_a_binary_cloud_with_coordinates_that_are_not_finite_is_refused(tmp_path):
    from torchvts.pose.clouds import read_point_cloud

    names = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex 2\n{names}end_header\n".encode()
    (tmp_path / "cloud.ply").write_bytes(head + np.array([0, 1, 2, 3, np.nan, 5], np.float32).tobytes())
    with pytest.raises(ValueError, match=r"cloud\.ply: .* expected finite coordinates"):
        read_point_cloud(tmp_path / "cloud.ply")


def test_a_flipped_bit_of_a_table_is_refused(tmp_path):
    save_tensors(
        tmp_path / "t.safetensors", {"a": torch.arange(8.0), "b": torch.ones(2, dtype=torch.bool)}, {"kind": "x", "n": 1.5}
    )
    content = (tmp_path / "t.safetensors").read_bytes()
    tensors, described = load_tensors(tmp_path / "t.safetensors")
    refused = 0
    for place, bit in itertools.product(range(0, len(content), 5), (0, 3)):
        (tmp_path / "t.safetensors").write_bytes(content[:place] + bytes([content[place] ^ 1 << bit]) + content[place + 1 :])
        try:
            found, told = load_tensors(tmp_path / "t.safetensors")
        except ValueError:
            refused += 1
        else:  # a bit of the padding, or of how a character is written
            assert told == described and all(torch.equal(found[name], tensors[name]) for name in tensors)
    assert refused > 1.9 * len(content) / 5


# ---- values ----


def test_a_sphere_is_fitted_in_few_steps_whatever_is_asked_for():
    press = vts.scenes.sphere_press(10.0, 1.0, (0, 0), 60, 80, 0.4, torch.float64)
    with pytest.raises(ValueError, match="steps: expected at most 2147483647, got"):
        fit_sphere(press.depth_mm, 0.4, press.contact, 10**400)
    few, many = (fit_sphere(press.depth_mm, 0.4, press.contact, steps) for steps in (20, 2**31 - 1))
    assert few.radius_mm == pytest.approx(10.0, abs=1e-9) and many.radius_mm == pytest.approx(few.radius_mm, abs=1e-12)
    with pytest.raises(ValueError, match="depth_mm: expected finite values of at most 1e6 mm"):
        fit_sphere(press.depth_mm * 1e300, 0.4, press.contact)


@pytest.mark.parametrize("change", ["lights", "noise_std", "ambient", "background"])
def test_a_calibration_of_nan_is_refused(change):
    good = unit()
    if change == "lights":
        lights = ring_lights()
        with torch.no_grad():
            lights.position_mm[0, 0] = float("nan")
        value = lights
    else:
        value = torch.full_like(getattr(good, change), float("nan")) if change != "ambient" else torch.full((3,), float("nan"))
    import dataclasses

    with pytest.raises(ValueError, match=rf"{change}.*: expected .*finite"):
        dataclasses.replace(good, **{change: value})


def test_a_sample_of_bad_calls():
    """Some of the 10,000 of test_attack."""
    attack_calls.stop_slow_calls()
    before = Path.cwd()
    warnings.simplefilter("ignore")
    try:
        wrong = [(case, found) for case, make in attack_calls.attack(600, "a sample") if (found := make())]
    finally:
        os.chdir(before)
    assert wrong == []


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_refused_by_every_name(dtype, tmp_path):
    """Or taken, where a tensor is only a few numbers."""
    complaints = []
    for name, entry in test_refusals.TABLE.items():
        for argument, value in entry.good.items():
            if name in ("Press", "Touch"):  # calibrate refuses their images
                continue
            if not entry.run or not isinstance(value, torch.Tensor) or not value.is_floating_point():
                continue
            call = test_refusals.made(name)
            try:
                call(**{**test_refusals.filled(entry, tmp_path, call), argument: value.to(dtype)})
            except TypeError as error:
                if f"got {dtype}" not in str(error) or "expected" not in str(error):
                    complaints.append(f"{name}({argument}): {error}")
            except Exception as error:
                complaints.append(f"{name}({argument}): {type(error).__name__}: {error}")
            else:
                if value.dim() > 2:
                    complaints.append(f"{name}({argument}): accepted")
    assert complaints == []


# ---- OpenCV ----


def test_the_opencv_at_hand_has_all_that_is_used():
    """opencv-contrib-python-headless and opencv-python differ in windows and contributed modules only; neither is used."""
    import re

    import cv2

    sources = (Path(vts.__file__).parent).rglob("*.py")
    names = {name for path in sources for name in re.findall(r"\bcv2\.([A-Za-z_][A-Za-z_0-9]*)", path.read_text(encoding="utf-8"))}
    assert {"imdecode", "imencode", "VideoCapture"} <= names
    assert [name for name in sorted(names) if not hasattr(cv2, name)] == []
    assert names & {"imshow", "namedWindow", "waitKey", "ximgproc", "xphoto", "aruco", "optflow"} == set()


@pytest.mark.long
def test_a_process_survives_sources_that_crashed_it():
    """Inside OpenCV, where no exception helps."""
    program = (
        "import torchvts as vts\n"
        "for source in (-1, -2**31, 2**31, b'\\xff.avi'.decode(errors='surrogateescape'), '99999999999999999999'):\n"
        "    try:\n        vts.stream.open_source(source)\n"
        "    except (OSError, ValueError) as error:\n        print(type(error).__name__)\n"
    )
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", program], capture_output=True, text=True)
    assert done.returncode == 0 and len(done.stdout.split()) == 5, done.stderr[-500:]
