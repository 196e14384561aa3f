"""The live view: what it records is read back by rerun's own reader; keys, re-zero, and how a camera is named and set."""

import math
import os
import re
import sys
import warnings

import cv2
import numpy as np
import pytest
import torch
from conftest import Frames, unit_and_camera, write_film

import torchvts as vts
from torchvts import stream as streams
from torchvts.stream.devices import found_cameras

PITCH = 0.25


@pytest.fixture(scope="module")
def unit(ring, small_sensor, small_press):
    return unit_and_camera(ring(), small_sensor, small_press)


@pytest.fixture(scope="module")
def press(unit, tmp_path_factory):
    """The calibration's file, and a video: 14 frames without contact, 4 pressed."""
    calibration, camera = unit
    folder = tmp_path_factory.mktemp("view")
    calibration.save(folder / "unit.safetensors")
    write_film(folder / "press.avi", [camera(1.0 if k >= 14 else 0.0) for k in range(18)])
    return [folder / "unit.safetensors", folder / "press.avi"]


def read_back(path):
    """Columns of a recording by entity and name, in the order of the frames, by rerun's reader."""
    chunk = pytest.importorskip("rerun.chunk")
    found = {}
    for part in chunk.RrdReader(path).store().stream().to_chunks():
        batch = part.to_record_batch()
        frames = batch.column("frame").to_pylist() if "frame" in batch.schema.names else [-1] * batch.num_rows
        for name in batch.schema.names:
            if ":" in name and not name.startswith("Image"):
                column = batch.column(name)
                found.setdefault((part.entity_path, name), {}).update({frame: column[k] for k, frame in enumerate(frames)})
    return {key: _Rows([rows[frame] for frame in sorted(rows)]) for key, rows in found.items()}


class _Rows(list):
    """Values that become Python's only when they are asked for."""

    def __getitem__(self, k):
        found = super().__getitem__(k)
        return [row.as_py() for row in found] if isinstance(k, slice) else found.as_py()

    def __iter__(self):
        return (self[k] for k in range(len(self)))


def test_poses_are_seen_in_the_live_view(press, run_script, tmp_path, monkeypatch):
    """The axes of the reference on the surface, from the frame after it on."""
    pytest.importorskip("rerun")
    call = ("track", *press, "--out", tmp_path, "--video", "none", "--save", tmp_path / "poses.rrd")
    done = run_script(*call)
    assert done.returncode == 0 and "rerun " in done.stdout, done.stderr
    columns = read_back(tmp_path / "poses.rrd")
    origins, ends = (columns["/surface/axes", f"Arrows3D:{name}"] for name in ("origins", "vectors"))
    assert len(origins) == len(ends) == 3
    for origin, arrows in zip(origins, ends, strict=True):
        assert np.allclose(origin, origin[0]) and np.abs(origin[0][:2]).max() < 0.2  # the ball lies in the middle
        assert np.allclose(arrows, 2.0 * np.eye(3), atol=0.1)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    done = run_script(*call, "--view")
    assert not sys.platform.startswith("linux") or (done.returncode == 2 and "--view: expected a screen" in done.stderr)


def test_a_view_without_a_screen_writes_what_rerun_reads(press, run_script, tmp_path, monkeypatch):
    pytest.importorskip("rerun")
    monkeypatch.setattr("torchvts.viz.MOST_POINTS", 160)
    done = run_script("view", *press, "--save", tmp_path / "ball.rrd")
    assert done.returncode == 0, done.stderr
    assert "18 frames, 0 dropped" in done.stdout and "rerun " in done.stdout
    columns = read_back(tmp_path / "ball.rrd")
    deepest = [row[0] for row in columns["/curves/deepest_mm", "Scalars:scalars"]]
    area = [row[0] for row in columns["/curves/area_mm2", "Scalars:scalars"]]
    assert len(deepest) == len(area) == 18 and max(deepest[:14]) < 0.05 and max(area[:14]) == 0.0
    assert deepest[15:] == pytest.approx([1.0] * 3, abs=0.08)
    circle = math.pi * (10.0**2 - 9.0**2)
    assert area[15:] == pytest.approx([circle] * 3, rel=0.3)  # pixels of 0.25 mm
    points = np.asarray(columns["/surface", "Mesh3D:vertex_positions"][-1]).reshape(-1, 3)
    assert len(points) == 120 * 160 and points[:, 2].max() == pytest.approx(deepest[-1], rel=1e-5)
    top = points[points[:, 2].argmax()]
    assert np.abs(top[:2]).max() < 1.0  # the ball is in the middle
    assert np.ptp(points[:, 0]) == pytest.approx(159 * PITCH) and np.ptp(points[:, 1]) == pytest.approx(119 * PITCH)
    triangles = np.asarray(columns["/surface", "Mesh3D:triangle_indices"][0])
    assert triangles.shape == (2 * 119 * 159, 3) and triangles.max() == len(points) - 1
    a, b, c = (points[triangles[:, k]] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()  # they face the camera
    strips = columns["/image/contact", "LineStrips2D:strips"]
    assert all(not row for row in strips[:14]) and len(strips[-1]) == 1
    radius = np.hypot(*(np.asarray(strips[-1][0]) - (80.0, 60.0)).T)
    assert radius.mean() * PITCH == pytest.approx(math.sqrt(100.0 - 81.0), rel=0.2)
    depth = np.asarray(columns["/depth", "DepthImage:buffer"][-1][0], np.uint8).view(np.float32)
    assert len(depth) == 120 * 160 and depth.max() == pytest.approx(deepest[-1], rel=1e-6)
    assert columns["/surface", "Transform3D:scale"][0] == [[1.0, 1.0, 3.0]]


def test_keys_take_snapshots_record_and_end(press, run_script, tmp_path, monkeypatch):
    pytest.importorskip("rerun")
    out, to = os.pipe()
    keys = streams.Keys(out)
    monkeypatch.setattr("torchvts.cli.view.Keys", lambda: keys)
    os.write(to, b"s\nr\nzq")  # all at the first frame: q ends it
    done = run_script("view", *press, "--save", tmp_path / "a.rrd", "--out", tmp_path / "out")
    os.close(out), os.close(to)
    assert done.returncode == 0 and "1 frames" in done.stdout, done.stderr
    result = vts.read_result(tmp_path / "out" / "frame_000000.npz")
    assert result.depth_mm.shape == (1, 1, 120, 160) and (tmp_path / "out" / "frame_000000.png").stat().st_size > 10_000
    assert f"wrote {tmp_path / 'a.rrd'}" in done.stdout  # r ended the recording that --save had begun
    assert len(read_back(tmp_path / "a.rrd")["/curves/area_mm2", "Scalars:scalars"]) == 1


def test_a_recording_begins_and_ends_where_it_is_asked_for(unit, tmp_path, small_press):
    pytest.importorskip("rerun")
    scene = small_press(1.0)
    output = vts.DepthOutput(scene.depth_mm, scene.gradient, scene.normal, scene.contact, scene.contact)
    with streams.LiveView(PITCH, save=tmp_path / "first.rrd") as view:
        for number in range(6):
            if number == 2:
                view.record(None)
            if number == 4:
                view.record(tmp_path / "second.rrd")
            view.add(streams.TactileFrame(number, number / 30.0, torch.zeros(3, 120, 160), output))
    for name in ("first", "second"):
        columns = read_back(tmp_path / f"{name}.rrd")
        assert len(columns["/curves/area_mm2", "Scalars:scalars"]) == 2
        assert len(columns["/surface", "Mesh3D:triangle_indices"]) == 1  # what never changes is in each file
    with pytest.raises(ValueError, match=r"save: expected a name ending in .rrd, got 'a.mp4'"):
        streams.LiveView(PITCH, save=tmp_path / "a.mp4")
    with pytest.raises(ValueError, match="save: expected a file, or the viewer, got neither"):
        streams.LiveView(PITCH)


def test_what_is_missing_is_said_in_one_line(press, run_script, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "rerun", None)
    done = run_script("view", *press, "--save", "a.rrd")
    assert done.returncode == 2 and done.stderr.strip().splitlines() == [
        "torchvts: error: rerun-sdk: expected it for the live view, got none: pip install 'torchvts[view]'"
    ]
    monkeypatch.undo()
    monkeypatch.setattr("torchvts.cli.view.require_rerun", lambda: None)
    monkeypatch.setattr("torchvts.cli.view.has_screen", lambda: False)
    done = run_script("view", *press)
    assert done.returncode == 2 and "expected --save FILE.rrd, for this machine has no screen" in done.stderr


def test_keys_are_letters_of_standard_input():
    out, to = os.pipe()
    with streams.Keys(out) as keys:
        assert keys.pressed() == []
        os.write(to, b"Z\n r")
        assert keys.pressed() == ["z", "r"] and keys.pressed() == []
        os.close(to)
        assert keys.pressed() == [] and keys.pressed() == []  # the end of a pipe is no key, and does not wait
    os.close(out)


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="terminals")
def test_a_key_in_a_terminal_needs_no_enter_and_the_terminal_is_as_before():
    import termios

    user, terminal = os.openpty()
    before = termios.tcgetattr(terminal)
    keys = streams.Keys(terminal)
    try:
        os_getpgrp = os.tcgetpgrp
        os.tcgetpgrp = lambda fd: os.getpgrp()  # a pseudo-terminal of a test is nobody's foreground
        with keys:
            os.write(user, b"s")
            assert keys.pressed() == ["s"]
            assert not termios.tcgetattr(terminal)[3] & termios.ICANON
    finally:
        os.tcgetpgrp = os_getpgrp
    assert termios.tcgetattr(terminal) == before
    with streams.Keys(terminal) as keys:  # of another session: it cannot say whose keys these are
        assert keys.pressed() == []
    os.close(user), os.close(terminal)


def test_rezero_takes_the_next_frames_as_background(unit):
    calibration, camera = unit
    stain = np.ones((120, 160, 3))
    stain[30:60, 40:80, 0] = 0.85  # the skin is worn: a channel is darker there from now on
    pictures = [camera() for _ in range(14)] + [camera(0.0, stain) for _ in range(20)] + [camera(1.0, stain) for _ in range(3)]
    false, after, pressed = [], [], []
    with streams.TactileStream(Frames(pictures), calibration) as stream:
        for number, _, _, output in stream:
            if number == 16:
                stream.rezero()
            kept = false if number in (15, 16) else pressed if number >= 34 else after if number > 30 else []
            kept.append((float(output.depth_mm.abs().max()), float(output.depth_mm.max())))
        assert stream.calibration is not calibration and bool((stream.calibration.lights.albedo == calibration.lights.albedo).all())
    assert min(most for most, _ in false) > 0.05 and max(most for most, _ in after) < 0.02
    assert [deepest for _, deepest in pressed] == pytest.approx([1.0] * 3, abs=0.1)


def test_rezero_in_contact_is_refused_and_the_background_stays(unit):
    calibration, camera = unit
    pictures = [camera() for _ in range(14)] + [camera(1.0 if k > 4 else 0.0) for k in range(14)]
    with streams.TactileStream(Frames(pictures), calibration) as stream, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        depths = []
        for number, _, _, output in stream:
            depths.append(float(output.depth_mm.max()))
            if number == 13:
                stream.rezero()
        assert stream.calibration is calibration and depths[-1] == pytest.approx(1.0, abs=0.1)
        with pytest.raises(ValueError, match="frames: "):
            stream.rezero(1)
    assert any("re-zero refused, the background stays" in str(warning.message) for warning in caught)


def test_a_camera_is_named_by_index_path_or_device(tmp_path):
    nodes, links = tmp_path / "sys" / "class" / "video4linux", tmp_path / "dev" / "v4l" / "by-id"
    links.mkdir(parents=True)
    for number, name, device in ((0, "Mini R0B 2871", "a"), (1, "Mini R0B 2871", "a"), (2, "DIGIT", "b"), (10, "DIGIT", "c")):
        (nodes / f"video{number}").mkdir(parents=True)
        (nodes / f"video{number}" / "name").write_text(name + "\n")
        (tmp_path / device).mkdir(exist_ok=True)
        (nodes / f"video{number}" / "device").symlink_to(tmp_path / device)
    for number, serial in ((2, "D20543"), (10, "D20601")):
        (links / f"usb-Facebook_DIGIT_{serial}-video-index0").symlink_to(f"../../video{number}")
    assert streams.find_camera("3") == 3 and streams.find_camera("/dev/video12") == 12 and streams.find_camera("/dev/null") is None
    assert streams.find_camera("mini r0b", tmp_path) == 0 and streams.find_camera("d20601", tmp_path) == 10
    assert streams.find_camera("video.avi", tmp_path) is None and streams.find_camera("rtsp://camera/1", tmp_path) is None
    two = r"2 'DIGIT' \(usb-Facebook_DIGIT_D20543-video-index0\); 10 'DIGIT' \(usb-Facebook_DIGIT_D20601-video-index0\)"
    with pytest.raises(ValueError, match=f"expected the name of one camera, got 'DIGIT', which several have: {two}: give the"):
        streams.find_camera("DIGIT", tmp_path)
    assert re.fullmatch(f"cameras here: 0 'Mini R0B 2871'; {two}", found_cameras(tmp_path))
    with pytest.raises(FileNotFoundError, match="got D20543: no such file or folder, and no such camera; cameras here: "):
        streams.open_source("D20543")


def test_settings_of_no_camera_are_refused(press, run_script):
    done = run_script("stream", *press, "--fps", 30)
    assert (
        done.returncode == 2
        and "settings: size, rate, exposure and white balance are those of a camera of this machine" in done.stderr
    )
    with pytest.raises(OSError, match="expected a camera with index 97"):
        streams.Camera(97, streams.CameraSettings(fps=30.0))


class Driver:
    """A driver that gives large frames at their rate in MJPG only, in place of OpenCV's capture: no camera is needed."""

    def __init__(self, _):
        self.values = {cv2.CAP_PROP_FPS: 30.0, cv2.CAP_PROP_AUTO_EXPOSURE: 3.0, cv2.CAP_PROP_AUTO_WB: 1.0}
        self.values |= {cv2.CAP_PROP_WB_TEMPERATURE: 4600.0}

    def isOpened(self):
        return True

    def set(self, key, value):
        manual = self.values[cv2.CAP_PROP_AUTO_WB] == 0.0
        if key == cv2.CAP_PROP_FPS and value > 5.0 and cv2.CAP_PROP_FOURCC not in self.values:
            value = 5.0
        if key != cv2.CAP_PROP_WB_TEMPERATURE or manual:
            self.values[key] = value
        return True

    def get(self, key):
        return self.values.get(key, 0.0)

    def release(self):
        pass


def test_what_is_asked_of_a_camera(monkeypatch):
    monkeypatch.setattr(cv2, "VideoCapture", Driver)
    full = streams.Camera(0, streams.CameraSettings((3280, 2464), 25.0, 120.0, 5000.0))  # a warning would be an error: all is taken
    slow = streams.Camera(0, streams.CameraSettings((640, 480), 5.0))
    assert full.fps == 25.0 and full._capture.get(cv2.CAP_PROP_FOURCC) == cv2.VideoWriter.fourcc(*"MJPG")
    assert (full._capture.get(cv2.CAP_PROP_EXPOSURE), full._capture.get(cv2.CAP_PROP_WB_TEMPERATURE)) == (120.0, 5000.0)
    assert slow._capture.get(cv2.CAP_PROP_FOURCC) == 0.0  # uncompressed, since that is fast enough
