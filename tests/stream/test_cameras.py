"""Cameras that stop, hang or come back, and readers of one's own."""

import threading
import time

import numpy as np
import pytest
import torch
from conftest import Frames, ring_lights

import torchvts as vts
from torchvts import stream as streams
from torchvts.cli.source import play
from torchvts.core.files import rgb_from_bgr
from torchvts.stream import StreamReport
from torchvts.stream.sources import SETTLING, LiveReader, check_reader, times_file

HEIGHT, WIDTH, PITCH = 48, 64, 0.5


def scene(press_mm=1.0):
    return vts.scenes.sphere_press(8.0, press_mm, (0, 0), HEIGHT, WIDTH, PITCH)


def unit():
    background = vts.scenes.render(vts.scenes.undeformed(scene()), ring_lights())[0]
    return vts.Calibration.from_lights(ring_lights(), vts.Sensor("rig", HEIGHT, WIDTH, PITCH), background)


def picture(press_mm=0.0):
    image = vts.scenes.render(scene(press_mm or 1.0) if press_mm else vts.scenes.undeformed(scene()), ring_lights())[0]
    return (image.permute(1, 2, 0).flip(2).numpy() * 255 + 0.5).astype(np.uint8)


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
    camera = Camera(SETTLING + 1, "hang")
    reader = LiveReader(lambda: camera)
    assert reader.read().shape == (HEIGHT, WIDTH, 3)
    reader.silent_s = 0.1
    with pytest.raises(OSError, match=r"source: made up has stopped: no frame for 0\.1 s"):
        reader.read()
    assert not camera.closed  # nobody can
    camera.unplugged.set()
    reader.close()
    assert camera.closed and reader.read() is None


def test_a_camera_that_hangs_can_be_closed():
    """Who waits for its next frame, here a thread, is told at once, not when it has been silent for long."""
    camera = Camera(SETTLING + 1, "hang")
    reader = LiveReader(lambda: camera)
    reader.silent_s = 3600.0
    assert reader.read().shape == (HEIGHT, WIDTH, 3)
    found = []
    waiting = threading.Thread(target=lambda: found.append(reader.read()))
    waiting.start()
    reader.close()
    waiting.join()
    assert found == [None]
    camera.unplugged.set()


def test_a_camera_comes_back():
    opened = []

    def plug():
        opened.append(Camera((SETTLING + 2, 0, SETTLING + 4)[len(opened)]))
        if len(opened) == 2:
            raise OSError("not there yet")
        return opened[-1]

    reader = LiveReader(plug, reconnect_s=600.0)
    numbers = [reader.take()[0] for _ in range(6)]
    assert numbers == [0, 1, 2, 3, 4, 5] and reader.reconnections == 1
    reader.close()
    with pytest.raises(OSError, match=r"has stopped \(it gives no more frames\) and did not come back within 0\.2 s"):
        LiveReader(lambda: Camera(0), reconnect_s=0.2).read()
    with pytest.raises(ValueError, match="reconnect_s: expected 0 with a reader of your own"):
        streams.TactileStream(Camera(9), unit(), reconnect_s=1.0)


@pytest.mark.parametrize("dtype", [np.int16, np.float32, np.bool_])
def test_frames_whose_range_is_unknown_are_refused(dtype):
    with pytest.raises(TypeError, match=r"pixels: expected an array of uint8 or uint16, got an array of "):
        rgb_from_bgr(picture().astype(dtype))
    with pytest.raises(TypeError, match="source: frame 0 of made up: expected an array of uint8 or uint16"):
        streams.TactileStream(Frames([picture().astype(dtype)] * 9), unit(), background_frames=0)
    assert torch.equal(rgb_from_bgr(picture().astype(np.uint16) * 257), rgb_from_bgr(picture()))


@pytest.mark.parametrize("fps", [0, float("nan"), None, "30"])
def test_a_rate_that_is_none_is_refused(fps):
    reader = Camera(9)
    reader.fps = fps
    with pytest.raises((ValueError, TypeError), match="source: fps: expected a number"):
        check_reader(reader)


class Playing(Frames):
    """A camera that gives these pictures at uneven times, and then no more."""

    live = True

    def read(self):
        time.sleep(0.002 if (found := super().read()) is None or found[0, 0, 0] % 2 else 0.01)
        return found


def record(pictures, path):
    """Record pictures that come at uneven times."""
    recorder, camera = streams.Recorder(path, 30.0), Playing(pictures)
    try:
        while (picture := camera.read()) is not None:
            recorder.add(picture)
    finally:
        recorder.close()
    return recorder


@pytest.mark.parametrize("name, kind", [("raw.mkv", np.uint8), ("raw", np.uint8), ("run.2", np.uint16)])
def test_what_a_camera_gave_is_read_again_bit_for_bit_with_its_times(tmp_path, name, kind):
    noise = np.random.default_rng(0).integers(0, np.iinfo(kind).max, (12, 48, 64, 3), kind, endpoint=True)
    recorder = record(noise, tmp_path / name)
    recorder.close()
    reader = streams.open_source(tmp_path / name)
    back = [reader.read() for _ in range(12)]
    assert reader.read() is None and np.array_equal(back, noise)
    assert len(reader.times) == 12 and reader.times == pytest.approx(recorder.times, abs=1e-6)
    assert np.ptp(np.diff(reader.times)) > 0.005 and reader.fps == pytest.approx(11 / recorder.times[-1], rel=1e-3)
    times_file(tmp_path / name).write_text("frame,time_s\n000000,0.5\n000001,0.2\n")
    with pytest.raises(ValueError, match=r"times\.csv: expected lines of frame,time_s, times that rise"):
        streams.open_source(tmp_path / name)


def test_a_recorded_stream_gives_the_same_depth_again(tmp_path):
    camera = Playing([picture()] * 20 + [picture(0.5 + 0.05 * k) for k in range(10)])
    live = []
    ended = pytest.raises(OSError, match="it gives no more frames")
    with ended, streams.TactileStream(camera, unit(), background_frames=12, record=tmp_path / "raw") as stream:
        live += stream
    assert [path.name for path in sorted((tmp_path / "raw").iterdir())][-2:] == ["000024.png", "times.csv"]
    with streams.TactileStream(tmp_path / "raw", unit(), background_frames=12) as stream:
        again = list(stream)
    assert [frame.time_s for frame in again] == pytest.approx(stream.reader.times) and len(again) == 25
    assert live[-1].output.depth_mm.max() > 0.5 and torch.equal(live[-1].output.depth_mm, again[-1].output.depth_mm)


def test_what_cannot_be_recorded_is_refused(tmp_path):
    with pytest.raises(ValueError, match="record: expected a camera, got made up: it is a recording already"):
        streams.TactileStream(Frames([]), unit(), record=tmp_path / "raw.mkv")
    (tmp_path / "used").mkdir()
    (tmp_path / "used" / "000000.png").touch()
    with pytest.raises(ValueError, match="expected a folder without images"):
        streams.TactileStream(Playing([]), unit(), record=tmp_path / "used")
    (tmp_path / "used.mkv").write_text("an earlier recording")
    with pytest.raises(ValueError, match=r"used\.mkv: expected a new name, got a file that is there already"):
        streams.TactileStream(Playing([]), unit(), record=tmp_path / "used.mkv")
    assert (tmp_path / "used.mkv").read_text() == "an earlier recording"
    with pytest.raises(ValueError, match=r"expected 8 bits and an even size for .mkv, got uint8 \(47, 64\): name a folder"):
        record(np.zeros((1, 47, 64, 3), np.uint8), tmp_path / "odd.mkv")
    assert not (tmp_path / "odd.mkv").exists()


@pytest.mark.parametrize("name", ["raw.mkv", "raw"])
def test_a_recording_that_does_not_fit_on_the_disk_is_an_error(tmp_path, name, small_files):
    noise = np.random.default_rng(0).integers(0, 255, (20, 48, 64, 3), dtype=np.uint8)
    with small_files(8192), pytest.raises(OSError, match="cannot be written: "):
        record(noise, tmp_path / name)


def test_on_a_full_disk_what_can_be_read_is_kept_with_its_times_and_what_is_lost_is_said(tmp_path, small_files):
    noise = np.random.default_rng(0).integers(0, 255, (40, 48, 64, 3), dtype=np.uint8)
    with small_files(150_000), pytest.raises(OSError, match="of 40 frames can be read back and are kept: is the disk full"):
        record(noise, tmp_path / "raw.mkv")
    reader = streams.open_source(tmp_path / "raw.mkv")
    assert np.array_equal(reader.read(), noise[0]) and len(reader.times) == 40
    times_file(tmp_path / "other.mkv").mkdir()
    with small_files(150_000), pytest.raises(OSError, match=r"of 40 frames can be read back and are kept: .*; .*times.csv"):
        record(noise, tmp_path / "other.mkv")


def test_recordings_of_several_sensors_have_one_clock(tmp_path):
    begun = time.time()
    for name in ("left.mkv", "right"):
        record([picture()] * 3, tmp_path / name)
    left, right = (
        [[float(v) for v in line.split(",")] for line in times_file(tmp_path / name).read_text().split()[1:]]
        for name in ("left.mkv", "right")
    )
    assert begun <= left[0][2] < left[-1][2] < right[0][2] <= time.time()
    assert right[-1][2] - right[0][2] == pytest.approx(right[-1][1], abs=1e-5)


def test_a_camera_that_stops_leaves_the_frames_until_then(tmp_path):
    """They were lost, and the summary too, where Ctrl-C kept them."""
    camera = Playing([picture()] * 20 + [picture(0.5)] * 10)
    taken = []
    with streams.TactileStream(camera, unit(), background_frames=12, record=tmp_path / "raw.mkv") as stream:
        lost = play(stream, lambda frame: taken.append(frame.number) is None)
        assert isinstance(lost, OSError) and "gives no more frames" in str(lost)
        assert taken and StreamReport(stream).table()
    assert len(list(vts.frames(tmp_path / "raw.mkv"))) == 25


@pytest.mark.parametrize("realtime", [False, True])
def test_two_sensors_in_one_process_on_one_clock(realtime):
    films = [[picture()] * 12 + [picture(mm)] * 6 for mm in (0.6, 1.2)]
    alone = [[frame.output.depth_mm for frame in streams.TactileStream(Frames(film), unit())] for film in films]
    before = time.monotonic()
    with (
        streams.TactileStream(Frames(films[0]), unit(), realtime=realtime) as one,
        streams.TactileStream(Frames(films[1]), unit(), realtime=realtime) as other,
    ):
        pairs = list(zip(one, other))
        stamps = [(one.started_s + a.time_s, other.started_s + b.time_s) for a, b in pairs]
    after = time.monotonic()
    for k, (stream, depths) in enumerate(zip((one, other), alone)):
        assert before <= stream.started_s <= after and [stamp[k] for stamp in stamps] == sorted(stamp[k] for stamp in stamps)
        if realtime:  # when each frame was there; which are dropped depends on the machine
            assert all(before <= stamp[k] <= after for stamp in stamps)
        else:
            assert all(torch.equal(pair[k].output.depth_mm, depth) for pair, depth in zip(pairs, depths, strict=True))
            assert float(depths[-1].max()) == pytest.approx((0.6, 1.2)[k], abs=0.06)
