"""Streams: what is read, what is refused, what is dropped, other light, and what is left on disk."""

import contextlib
import csv
import itertools
import json
import math
import re
import signal
import sys
import threading
import warnings
from collections import deque
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
import torch
from conftest import Frames, unit_and_camera, write_film

import torchvts as vts
from torchvts import stream as streams
from torchvts.calibration import by_lights
from torchvts.core.files import rgb_from_bgr
from torchvts.pipeline import unit_pipeline
from torchvts.stream.numbered import Played
from torchvts.stream.sources import SETTLING, LiveReader, times_file

PITCH = 0.25


@pytest.fixture(scope="module")
def unit(ring, small_sensor, small_press):
    return unit_and_camera(ring(), small_sensor, small_press)


@pytest.fixture(autouse=True)
def _the_same_noise_in_any_order_of_tests(unit):
    unit[1].restart()


@pytest.fixture(scope="module")
def video(unit, tmp_path_factory):
    """15 frames without contact, 10 pressed, 10 without."""
    _, camera = unit
    camera.restart()
    pictures = [camera(1.0 if 15 <= k < 25 else 0.0) for k in range(35)]
    return write_film(tmp_path_factory.mktemp("video") / "press.avi", pictures)


def images(pictures):
    return torch.stack([rgb_from_bgr(picture) for picture in pictures])


def test_the_background_is_the_mean_without_the_noise(unit):
    calibration, camera = unit
    image = streams.find_background(images([camera() for _ in range(12)]))
    assert (image - calibration.background).abs().mean() < 0.0015


@pytest.mark.parametrize(
    "frames, message",
    [
        (lambda camera: [camera(0.0, 1.0 - 0.004 * k) for k in range(12)], "the light changes by"),
        (lambda camera: [camera(0.5 if k > 8 else 0.0) for k in range(12)], "differs from the others"),
        (lambda camera: [camera(1.0) for _ in range(12)], "something touches the skin"),
        (lambda camera: [camera() for _ in range(2)], "at least 3 frames"),
    ],
)
def test_first_frames_with_contact_or_other_light_are_refused(unit, frames, message):
    _, camera = unit
    with pytest.raises(ValueError, match=message):
        streams.find_background(images(frames(camera)))


def test_first_frames_show_how_noisy_undeformed_skin_is(unit):
    """White noise averages out in cells; the grain of compression, here of 8 x 8 pixels, does not."""
    calibration, camera = unit
    spreads = []
    for noise, grain in ((0.001, 0.0), (0.02, 0.0), (0.001, 10.0)):
        generator = np.random.default_rng(0)

        def picture(noise=noise, grain=grain, generator=generator):
            plain = camera(noise=noise)
            blocks = grain * generator.standard_normal((plain.shape[0] // 8, plain.shape[1] // 8, 3)).repeat(8, 0).repeat(8, 1)
            return (plain + blocks).clip(0, 255).astype(np.uint8)

        pipe = streams.Recording(calibration, first=images([picture() for _ in range(12)])).pipe
        spreads.append(pipe._pipe.mask.least_spread)
        assert not pipe(images([picture()])).deformed.any()
    assert spreads[0] < 0.005 and 0.01 < spreads[1] < 0.06 < spreads[2]


def test_white_noise_in_the_first_frames_costs_no_depth(unit, small_press):
    """It was taken for that of whole cells: depth lay up to twice as far off as without first frames."""
    calibration, camera = unit
    first = images([camera(noise=0.01) for _ in range(12)])
    frame, errors = images([camera(0.5, noise=0.01)]), []
    for given in (None, first):
        depth = streams.Recording(calibration, "precise", given)(frame).depth_mm
        errors.append(float((depth - small_press(0.5).depth_mm).square().mean().sqrt()))
    assert errors[1] < 1.1 * errors[0], errors


def check_press(stream, small_press):
    frames = list(stream)
    assert [frame.number for frame in frames] == list(range(35))
    assert [bool(frame.output.contact.any()) for frame in frames] == [15 <= k < 25 for k in range(35)]
    for frame in frames:
        if not 15 <= frame.number < 25:
            assert frame.output.depth_mm.abs().max() == 0
    scene = small_press(1.0)
    assert (frames[20].output.depth_mm - scene.depth_mm).abs().max() < 0.1
    assert frames[20].time_s == pytest.approx(20 / 30)
    assert stream.dropped == 0
    return frames


def test_a_video_gives_contact_and_depth(unit, video, small_press):
    with streams.TactileStream(video, unit[0], mode="precise") as stream:
        check_press(stream, small_press)
    times = stream.stages.median_ms()
    assert {"read", "rectify", "depth"} <= set(times)
    assert stream.metric


def test_a_folder_gives_the_same_and_calibrates_itself(unit, small_sensor, small_press, tmp_path):
    _, camera = unit
    for k in range(35):
        cv2.imwrite(str(tmp_path / f"{k:03d}.png"), camera(1.0 if 15 <= k < 25 else 0.0))
    with streams.TactileStream(str(tmp_path), small_sensor, mode="precise") as stream:
        assert "constrains the lights" in str(stream.calibration) and stream.metric
        check_press(stream, small_press)


def test_a_given_calibration_is_held_against_the_first_frames(unit):
    calibration, camera = unit
    with pytest.raises(ValueError, match="first frames show contact"):
        streams.TactileStream(Frames([camera(0.5) for _ in range(12)]), calibration)
    for level in (0.5, 1.3):
        with streams.TactileStream(Frames([camera(0.0, level) for _ in range(12)]), calibration) as stream:
            assert not any(bool(frame.output.contact.any()) for frame in stream)
            assert stream.conditions.light[0, :, 0].tolist() == pytest.approx([level] * 3, abs=0.01)
    doubted = pytest.warns(UserWarning, match=r"frame 0: .*are in doubt")
    with streams.TactileStream(Frames([255 - camera() for _ in range(13)]), calibration) as stream, doubted:
        list(stream)
    with pytest.raises(ValueError, match="background_frames: expected at least 12 frames from made up, got 4"):
        streams.TactileStream(Frames([camera() for _ in range(4)]), calibration)
    with pytest.raises(TypeError, match="sensor_or_calibration: expected a Sensor or a Calibration, got str"):
        streams.TactileStream(Frames([]), "gelsight_mini")


def dimming(k):
    return 1.0 - 0.1 * min(1.0, max(0, k - 12) / 300)


def hunting(k):
    """Exposure that hunts."""
    return 1.0 + 0.35 * math.sin(0.7 * k) - 0.1


@pytest.mark.parametrize("brightness", [pytest.param(dimming, marks=pytest.mark.long), hunting])
def test_each_frame_is_measured_in_its_own_light(unit, small_press, brightness):
    calibration, camera = unit
    truth = small_press(1.0)

    def run(brightness):
        pictures = (camera(1.0 if k >= 20 else 0.0, brightness(k) if k >= 12 else 1.0) for k in range(40))
        with streams.TactileStream(Frames(pictures), calibration) as stream:
            frames = [(f.output.contact.any(), (f.output.depth_mm - truth.depth_mm).square().mean().sqrt()) for f in stream]
        contact, errors = zip(*frames)
        return any(contact[:20]), sum(errors[20:]) / 20, stream

    _, still_error, _ = run(lambda k: 1.0)
    contact, error, stream = run(brightness)
    assert not contact and error < 1.3 * still_error
    assert stream.conditions.light[0, :, 0].tolist() == pytest.approx([brightness(39)] * 3, abs=0.02) and stream.doubt == ""


def test_a_step_of_the_light_is_in_the_table_and_a_dead_led_is_in_doubt(unit):
    calibration, camera = unit
    dead = np.array([1.0, 1.0, 0.0])  # of blue, green, red
    pictures = [camera(0.0, 0.7 if 20 <= k < 40 else 1.0) for k in range(50)] + [
        (camera() * dead).astype(np.uint8) for _ in range(5)
    ]
    with warnings.catch_warnings(record=True) as caught, streams.TactileStream(Frames(pictures), calibration) as stream:
        warnings.simplefilter("always")
        report = streams.StreamReport(stream)
        lines = [report.add(frame)[0] for frame in stream]
    assert [float(row[4][0]) for row in report.rows[:50]] == pytest.approx([1.0] * 20 + [0.7] * 20 + [1.0] * 10, abs=0.01)
    assert ["IN DOUBT" in line for line in lines] == [False] * 50 + [True] * 5
    assert "in doubt: 5 of 55 frames (column doubt of frames.csv), the first 50: channel R is black" in report.table()
    assert len([w for w in caught if "channel R is black" in str(w.message)]) == 1


def test_flickering_cells_are_no_movement_and_a_growing_contact_is(unit):
    _, camera = unit
    pressed, free = (images([camera(mm, noise=0.0)])[0] for mm in (0.5, 0.0))
    generator = torch.Generator().manual_seed(0)
    dark = torch.zeros(1, 1, 120, 160)
    dark[..., 20:26, 30:60] = 0.08  # five cells that flicker, as compression makes dark ones do
    flicker = free + dark * torch.randn(12, 1, 1, 1, generator=generator)
    streams.find_background(flicker.clamp(0, 1))
    growing = [torch.lerp(free, pressed, k / 11) + 0.002 * torch.randn(free.shape, generator=generator) for k in range(12)]
    with pytest.raises(ValueError, match="differs from the others"):
        streams.find_background(torch.stack(growing).clamp(0, 1))


def test_unusable_frames_are_named_and_left_out(unit, run_stream, unit_file, tmp_path):
    _, camera = unit
    folder = tmp_path / "frames"
    folder.mkdir()
    for k in range(26):
        cv2.imwrite(str(folder / f"{k:03d}.png"), camera(1.0 if k >= 20 else 0.0))
    black = np.zeros((120, 160, 3), np.uint8)
    bad = {
        14: (black, "one colour everywhere"),
        15: (camera().astype(np.uint16) * 16, "12 bits stored in 16"),
        16: (camera()[:100], r"expected \(120, 160\) like the first, got \(100, 160\)"),
        17: (camera()[::-1], "mirrored top to bottom"),
        18: (cv2.resize(camera()[17:-17, 23:-23], (160, 120)), "shows less than the background"),
        21: (np.full_like(black, 255), "one colour everywhere"),
    }
    for k, (picture, _) in bad.items():
        cv2.imwrite(str(folder / f"{k:03d}.png"), picture)
    (folder / "019.png").write_bytes(b"no image")
    done = run_stream(unit_file, folder, "--out", tmp_path / "out", "--video", "none")
    assert done.returncode == 1, done.stderr
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert [number for number, _ in summary["left_out_because"]] == [14, 15, 16, 17, 18, 19, 21]
    assert (summary["frames"], summary["left_out"]) == (19, 7) and "7 left out, named above" in done.stdout
    reasons = dict(summary["left_out_because"]) | {19: "not an image"}
    for k, (_, part) in bad.items():
        assert re.search(part, reasons[k]), (k, reasons[k])
        assert (done.stdout + done.stderr).count(f"frame {k} left out: ") == 1
    rows = (tmp_path / "out" / "frames.csv").read_text().splitlines()[1:]
    assert len(rows) == 26 and "12 bits stored in 16" in rows[15]
    assert [float(row.split(",")[2]) > 0 for row in rows if "left out" not in row] == [False] * 14 + [True] * 5


@pytest.mark.parametrize("change", [0.3, -0.25])
def test_a_large_contact_is_no_other_view(unit, change):
    check = streams.FrameCheck(unit[0].background)
    frame = unit[0].background[None].clone()
    frame[:, 0, 5:115, 5:155] *= 1 + change
    frame[:, 1, 5:115, 5:155] *= 1 - change
    assert check(frame) == ""


@pytest.mark.parametrize("change", [0.3, -0.3])
def test_a_flat_contact_on_an_even_background_is_no_other_crop(change):
    """The middle of the frame is as even as the background: so is that of any crop of it, and nothing decides."""
    generator = torch.Generator().manual_seed(0)
    background = torch.tensor([0.5, 0.4, 0.6])[:, None, None] * (1.0 + 0.01 * torch.randn(3, 120, 160, generator=generator))
    frame = background[None].clone()
    frame[:, :, 17:103, 23:137] *= 1.0 + change
    assert streams.FrameCheck(background.clamp(0.0, 1.0))(frame.clamp(0.0, 1.0)) == ""


def test_black_lines_are_named_and_those_of_the_background_are_not(unit):
    """One black row was a contact on nine tenths of the skin."""
    background, frame = unit[0].background, unit[0].background[None].clone()
    frame[:, :, 70] = 0.0
    assert "the frame has 1 rows or columns that are black or of one colour" in streams.FrameCheck(background)(frame)
    assert streams.FrameCheck(frame[0])(frame) == ""
    frame = background[None].clone()
    frame[:, :, 90:] = 0.0  # a transfer that ended early
    assert "30 rows or columns that are black or of one colour: it was cut short" in streams.FrameCheck(background)(frame)
    frame[:, :, 90:] = 128.0 / 255.0  # what decoders of JPEG put there
    assert "30 rows or columns that are black or of one colour: it was cut short" in streams.FrameCheck(background)(frame)


def test_frames_whose_names_have_blanks_keep_their_times(tmp_path):
    for k in range(3):
        vts.write_image(tmp_path / f"img {k}.png", torch.full((3, 8, 8), 0.1 * k))
    times_file(tmp_path).write_text("frame,time_s\n" + "".join(f"img {k},{0.4 * k}\n" for k in range(3)))
    assert streams.sources.FileReader(tmp_path).times == pytest.approx([0.0, 0.4, 0.8])


def test_both_scripts_give_the_same_depth_for_a_video(unit, run_stream, run_script, small_sensor, tmp_path):
    _, camera = unit
    video = write_film(
        tmp_path / "press.avi", [camera(1.0 if 15 <= k < 20 else 0.0, 1.0 - 0.002 * max(0, k - 12)) for k in range(24)]
    )
    times_file(video).write_text("frame,time_s\n" + "".join(f"{k:06d},{0.4 * k}\n" for k in range(24)))  # slower than it says
    places = tuple(map(tuple, unit[0].lights.position_mm.tolist()))  # known: a fit for each script would take seconds
    rig = replace(small_sensor, light_position_mm=places)
    rig.save(tmp_path / "rig.yaml")
    sensor, saved = ("--sensor", tmp_path / "rig.yaml"), tmp_path / "unit.safetensors"
    options = ("--out", tmp_path / "stream", "--video", "none", "--save-calibration", saved)
    done = run_stream(video, *sensor, *options)
    by_sensor = run_script("reconstruct", video, *sensor, "--out", tmp_path / "sensor", "--no-pictures")
    by_file = run_script("reconstruct", saved, video, "--out", tmp_path / "file", "--no-pictures")
    own = run_script("calibrate", video, *sensor, "--out", tmp_path / "own.safetensors")
    for command in (done, by_sensor, by_file, own):  # lights that are the sensor file's
        assert command.returncode == 1 and command.stdout.splitlines()[-1].startswith("next: depth is NOT METRIC"), command.stderr
    assert "first frames not used" not in by_file.stdout + by_sensor.stdout
    assert saved.read_bytes() == (tmp_path / "own.safetensors").read_bytes()
    streamed = [row.split(",") for row in (tmp_path / "stream" / "frames.csv").read_text().splitlines()[1:]]
    for folder in ("sensor", "file"):
        rows = [row.split(",") for row in (tmp_path / folder / "frames.csv").read_text().splitlines()[1:]]
        assert [float(row[1]) for row in rows] == pytest.approx([float(row[3]) for row in streamed], abs=1e-6)
        assert [float(row[2]) for row in rows] == pytest.approx([float(row[2]) for row in streamed], abs=1e-4)
        assert [float(row[1]) > 0 for row in rows] == [15 <= k < 20 for k in range(24)]
    with streams.TactileStream(video, rig) as stream:
        depth = {frame.number: frame.output.depth_mm for frame in stream}
    for k in (3, 16, 19):
        assert float((vts.read_result(tmp_path / "file" / f"press_{k:06d}.npz").depth_mm - depth[k]).abs().max()) < 1e-5


def test_backgrounds_of_several_images_and_own_presses(unit, run_script, small_sensor, tmp_path):
    _, camera = unit
    small_sensor.save(tmp_path / "rig.yaml")
    for k, mm in enumerate((0.0, 0.0, 1.0)):
        cv2.imwrite(str(tmp_path / f"{k}.png"), camera(mm))
    names = [tmp_path / f"{k}.png" for k in range(3)]
    background = streams.read_background(names, small_sensor)
    truth = unit[0].background
    assert float((background - truth).abs().max()) < 0.03  # the press is gone
    press = ("--press", tmp_path / "2.png", "20")
    done = run_script(
        "calibrate", *names, *press, "--sensor", tmp_path / "rig.yaml", "--out", tmp_path / "unit.safetensors", "--candidates"
    )
    assert done.returncode == 0 and "| 2.png |" in done.stdout, done.stderr
    sensor = ("--sensor", tmp_path / "rig.yaml", "--out", tmp_path / "out")
    done = run_script("reconstruct", names[2], *sensor, "--background", *names, *press, "--no-pictures", "--format", "none")
    assert done.returncode == 0 and "2.png: deepest " in done.stdout, done.stderr
    for arguments, part in (
        ((names[2], *sensor), "--background: expected images without contact, got none"),
        (
            (names[2], *sensor, "--background", names[0], "--press", names[2], "wide"),
            "press: expected the diameter of the ball in mm",
        ),
        ((names[2], "--out", tmp_path / "out"), "expected a calibration file and an input"),
    ):
        done = run_script("reconstruct", *arguments)
        assert done.returncode != 0 and part in done.stderr, done.stderr
    pressed = write_film(tmp_path / "pressed.avi", [camera(1.0) for _ in range(12)])
    with pytest.raises(ValueError, match=r"pressed\.avi: background: the first 12 frames show structure"):
        streams.read_background([pressed], small_sensor)
    for paths, error, message in (
        ([pressed, names[0]], ValueError, "background: expected images or one video, got 2 files"),
        ([], ValueError, "background: expected one image or more, or a video, got none"),
        (names[0], TypeError, "background: expected"),
        ([tmp_path / "none.png"], FileNotFoundError, "no such image"),
        ([tmp_path / "none.avi"], FileNotFoundError, "no such file"),
    ):
        with pytest.raises(error, match=message):
            streams.read_background(paths, small_sensor)


def test_a_calibration_is_used_as_it_is_without_first_frames(unit):
    calibration, camera = unit
    with streams.TactileStream(Frames([camera(0.5) for _ in range(4)]), calibration, background_frames=0) as stream:
        assert all(bool(frame.output.contact.any()) for frame in stream)
    with pytest.raises(ValueError, match="background_frames: expected at least 3, got 0"):
        streams.TactileStream(Frames([]), calibration.sensor, background_frames=0)


@pytest.fixture(scope="module")
def marked(unit, small_sensor):
    """The unit with printed markers, and what they leave of the light (H, W)."""
    calibration, _ = unit
    dots = torch.ones(120, 160)
    for y, x in itertools.product(range(6, 120, 12), range(6, 160, 12)):
        dots[y - 2 : y + 3, x - 2 : x + 3] = 0.2
    sensor = replace(small_sensor, markers=True)
    return vts.Calibration.from_lights(calibration.lights, sensor, calibration.background * dots), dots


@pytest.mark.parametrize("first", [12, 0])
def test_printed_markers_do_not_pass_for_other_light(unit, marked, first):
    (_, camera), (known, dots) = unit, marked
    assert known.markers is not None
    pictures = ((camera(1.0 if k >= 14 else 0.0) * dots[..., None].numpy() + 0.5).astype(np.uint8) for k in range(20))
    with streams.TactileStream(Frames(pictures), known, background_frames=first) as stream:
        contact = [bool(frame.output.contact.any()) for frame in stream]
    assert contact == [False] * 14 + [True] * 6
    assert stream.conditions.light[0, :, 0].tolist() == pytest.approx([1.0] * 3, abs=0.01) and stream.doubt == ""


def test_a_network_sees_no_markers(marked, tmp_path):
    known, dots = marked
    network = vts.NormalFromMLP(120, 160, torch.full((3, 120, 160), 0.5), (8,), seed=1)
    network.save(tmp_path / "network.safetensors")
    pipe = unit_pipeline(known, "fast", tmp_path / "network.safetensors")
    assert float(pipe.frame_of((known.background * dots)[None])[1].abs().max()) < 0.05  # 0.5 where dots are seen


def test_first_frames_of_another_view_are_named_as_such(unit):
    calibration, camera = unit
    with pytest.raises(ValueError, match="the first frames cannot be used: the frame is turned by 180 degrees"):
        streams.TactileStream(Frames([camera()[::-1, ::-1].copy() for _ in range(20)]), calibration)
    with pytest.raises(ValueError, match="the first frames cannot be used: the frame has its channels swapped"):
        streams.TactileStream(Frames([camera()[..., ::-1].copy() for _ in range(20)]), calibration)


class Scripted:
    """A camera that gives a frame each time the test lets it; ``asked`` counts how often it was asked."""

    name, live, fps = "scripted", True, 30.0

    def __init__(self, error=None):
        self.allowed, self.asked = threading.Semaphore(0), threading.Semaphore(0)
        self.error, self.count, self.closed = error, 0, False

    def read(self):
        self.asked.release()
        self.allowed.acquire()
        if self.error is not None:
            raise self.error
        self.count += 1
        return np.full((2, 2, 3), self.count, np.uint8)

    def give(self, frames):
        for _ in range(frames):
            self.allowed.release()
            self.asked.acquire()  # asked for the next one: this one is laid down

    def close(self):
        self.closed = True


def test_who_comes_late_finds_only_the_newest_frame():
    camera = Scripted()
    reader = LiveReader(lambda: camera)
    camera.asked.acquire()
    camera.give(SETTLING - 1)
    camera.allowed.release()  # the last one while exposure settles: no other is asked for
    reader.drop_late()
    camera.asked.acquire()
    for number in range(3):  # fast: each frame is taken before the next
        camera.give(1)
        assert reader.take()[0] == number
    assert reader.dropped == 0
    camera.give(4)  # slow: four come meanwhile
    number, _, pixels = reader.take()
    assert (number, int(pixels[0, 0, 0]), reader.dropped) == (6, SETTLING + 7, 3)
    camera.allowed.release()
    reader.close()
    assert camera.closed and not reader._thread.is_alive()


def test_what_the_reader_raises_reaches_who_takes():
    camera = Scripted(ArithmeticError("unforeseen"))
    camera.allowed.release()
    reader = LiveReader(lambda: camera)
    with pytest.raises(ArithmeticError, match="unforeseen"):
        reader.take()
    reader.close()


def test_a_recording_is_played_at_its_rate():
    pictures = [np.full((2, 2, 3), k, np.uint8) for k in range(5)]
    reader = LiveReader(lambda: Played(Frames(pictures[2:]), deque(pictures[:2])))
    reader.drop_late()
    found = list(iter(reader.take, None))
    assert [number for number, _, _ in found] == [int(pixels[0, 0, 0]) for _, _, pixels in found] and found[-1][0] == 4
    assert all(time_s >= number / Frames.fps for number, time_s, _ in found) and len(found) + reader.dropped == 5
    reader.close()


def test_who_comes_back_to_a_stream_goes_on_with_the_next_frame(unit):
    calibration, camera = unit
    with streams.TactileStream(Frames([camera() for _ in range(8)]), calibration, background_frames=3) as stream:
        assert next(iter(stream)).number == 0
        assert [frame.number for frame in stream] == [1, 2, 3, 4, 5, 6, 7]


def test_realtime_takes_every_frame_where_there_is_time(unit):
    calibration, camera = unit
    with streams.TactileStream(Frames([camera() for _ in range(16)]), calibration, realtime=True) as stream:
        numbers = [frame.number for frame in stream]
    assert numbers == sorted(set(numbers)) and numbers[-1] == 15
    assert len(numbers) + stream.dropped == 16
    assert not any(thread.name == "torchvts-reader" for thread in threading.enumerate())


@pytest.mark.parametrize("suffix", [".avi", ".mp4", ".webm"])
def test_a_video_file_is_whole_or_not_there(tmp_path, suffix):
    path = tmp_path / f"out{suffix}"
    picture = np.zeros((32, 64, 3), np.uint8)
    with pytest.raises(RuntimeError), streams.VideoFile(path, 30.0) as video:
        video.write(picture)
        raise RuntimeError("in the middle")
    assert list(tmp_path.iterdir()) == []
    with streams.VideoFile(path, 30.0) as video:
        pass
    assert list(tmp_path.iterdir()) == []
    with streams.VideoFile(path, 30.0) as video:
        for _ in range(3):
            video.write(picture)
        assert not path.exists()
    assert len(list(vts.frames(path))) == 3
    with pytest.raises(ValueError, match=r"like the first, got \(16, 64\)"), streams.VideoFile(path, 30.0) as video:
        video.write(picture)
        video.write(picture[:16])
    with pytest.raises(ValueError, match=r"video: expected a name ending in .webm, .mp4, .avi, .mkv, got 'a.gif'"):
        streams.VideoFile(tmp_path / "a.gif", 30.0)


@pytest.mark.parametrize("suffix", [".avi", ".mp4", ".webm"])
def test_a_video_that_does_not_fit_on_the_disk_is_an_error(tmp_path, suffix, small_files):
    noise = np.random.default_rng(0).integers(0, 255, (20, 48, 64, 3), dtype=np.uint8)
    told = pytest.raises(OSError, match=rf"video: .*film\{suffix}: cannot be written: \d+ of 20 frames")
    with small_files(8192), told, streams.VideoFile(tmp_path / f"film{suffix}", 30.0) as film:
        for picture in noise:
            film.write(picture)
    assert list(tmp_path.iterdir()) == []


def test_a_video_that_fails_is_told_and_the_figures_are_kept(run_stream, unit_file, video, tmp_path, small_files):
    with small_files(400_000):
        done = run_stream(unit_file, video, "--out", tmp_path, "--video", "avi")
    assert done.returncode == 2 and "overlay.avi: cannot be written: " in done.stderr
    assert len((tmp_path / "frames.csv").read_text().splitlines()) == 36 and not (tmp_path / "overlay.avi").exists()


def test_a_sheet_shows_six_frames_in_contact_in_one_range(small_press):
    sheet = streams.Sheet(PITCH, metric=False)
    with pytest.raises(ValueError, match="sheet: expected frames with contact, got none"):
        sheet.figure()
    for number in range(200):
        scene = small_press(0.2 + 0.004 * number)
        contact = scene.contact if number % 2 else torch.zeros_like(scene.contact)
        output = vts.DepthOutput(scene.depth_mm, scene.gradient, scene.normal, contact, contact)
        sheet.add(streams.TactileFrame(number, number / 30.0, torch.zeros(3, 120, 160), output))
    assert len(sheet._kept) <= 48
    figure = sheet.figure()
    *panels, bar = figure.axes
    assert figure.get_suptitle() == "6 of 100 frames in contact, NOT METRIC"
    assert len(panels) == 6 and "NOT METRIC" in bar.get_ylabel()
    limits = {panel.get_images()[0].get_clim() for panel in panels}
    assert len(limits) == 1 and limits.pop() == pytest.approx((0.0, 0.2 + 0.004 * 199), abs=0.05)
    times = [float(panel.get_title().split()[0]) for panel in panels]
    assert times[0] == pytest.approx(1 / 30, abs=0.01) and np.ptp(np.diff(times)) < 0.3


def test_lights_that_do_not_fit_the_image_give_only_their_directions(ring, small_press):
    lights, scene = ring(60.0, 60.0), small_press(0.5)
    sensor = vts.Sensor("rig", 120, 160, PITCH, light_position_mm=tuple(map(tuple, lights.position_mm.tolist())))
    x = torch.linspace(-1.0, 1.0, 160)
    uneven = torch.stack((0.6 + 0.4 * x, 0.6 - 0.4 * x, 0.5 + 0.4 * (1 - x**2)))[None, :, None]  # LEDs that spread badly
    rest, image = (vts.scenes.render(s, lights) * uneven for s in (vts.scenes.undeformed(scene), scene))
    with pytest.warns(vts.CalibrationWarning, match="not this unit's lights, and depth is not metric"):
        calibration = vts.calibrate(rest[0], sensor)
    assert calibration.report["source"] == "stand_in" and "NOT METRIC" in str(calibration) and not calibration.metric
    out = vts.DepthPipeline.from_calibration(calibration)(image)
    assert float(out.depth_mm.max()) == pytest.approx(0.5, rel=0.25)
    with pytest.warns(vts.CalibrationWarning):
        even = vts.calibrate(vts.scenes.render(vts.scenes.undeformed(scene), lights)[0], sensor)
    assert even.lights is not None and not even.metric


@pytest.fixture
def run_stream(run_script):
    """``torchvts stream``."""
    return partial(run_script, "stream")


@pytest.fixture(scope="module")
def unit_file(unit, tmp_path_factory):
    path = tmp_path_factory.mktemp("unit") / "unit.safetensors"
    unit[0].save(path)
    return path


@pytest.fixture(scope="module")
def commands(run_script, unit_file, video, tmp_path_factory):
    """What stream, track and reconstruct print and write of the video: name -> (how it ended, folder)."""
    options = {"stream": ("--video", "avi"), "track": ("--video", "none"), "reconstruct": ("--no-pictures",)}
    folders = {name: tmp_path_factory.mktemp(name) for name in options}
    return {
        name: (run_script(name, unit_file, video, "--out", folders[name], *more), folders[name]) for name, more in options.items()
    }


def test_the_script_writes_overlay_summary_and_frames(commands):
    done, out = commands["stream"]
    assert done.returncode == 0, done.stderr
    assert "35 frames, 0 dropped" in done.stdout and re.search(
        r"^median ms: read [\d.]+, rectify .* write [\d.]+$", done.stdout, re.M
    )
    assert (out / "sheet.png").stat().st_size > 10_000
    summary = json.loads((out / "summary.json").read_text())
    assert summary["frames"] == 35 and summary["contact_frames"] == 10 and summary["deepest_mm"] == pytest.approx(1.0, abs=0.1)
    assert {"read", "depth", "draw", "write"} <= set(summary["stages_ms"])
    assert len((out / "frames.csv").read_text().splitlines()) == 36
    assert len(list(vts.frames(out / "overlay.avi"))) == 35


def test_track_writes_a_row_for_each_frame_after_the_reference(commands):
    done, out = commands["track"]
    assert done.returncode == 1 and "frame 15: the reference" in done.stdout, done.stderr
    assert "19 frames, 10 lost, 1 keyframe, 0 loops closed" in done.stdout
    with (out / "poses.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["frame"]) for row in rows] == list(range(16, 35))
    assert float(rows[0]["time_s"]) == pytest.approx(16 / 30, abs=1e-5)
    assert [bool(row["lost"]) for row in rows] == [k >= 25 for k in range(16, 35)]
    assert "9 frames known less well than to 1 degree and 0.15 mm" in done.stdout and {row["converged"] for row in rows} == {"0"}
    seen = r"medians: x not seen, y not seen, z [\d.]+ mm; turns about x not seen, y not seen, z not seen degrees"
    assert re.search(seen, done.stdout), done.stdout  # the ball may have rolled, and with it the point of it that lay at the origin
    poses = np.array([[float(row[f"T{i}{j}"]) for i in range(3) for j in range(4)] for row in rows]).reshape(-1, 3, 4)
    assert np.allclose(poses[:9], np.eye(4)[:3], atol=0.1)  # mm; the ball stays where it is
    turns = poses[:, :, :3]
    assert np.allclose(turns @ turns.transpose(0, 2, 1), np.eye(3), atol=1e-6)
    assert all("rotation about z" in row["ambiguous"] and float(row["std_z_mm"]) > 0 for row in rows[:9])
    assert all(float(row["std_rz_deg"]) > 10.0 for row in rows[:9])  # unknown
    summary = json.loads((out / "summary.json").read_text())
    expected = {"frames": 19, "lost": 10, "left_out": 0, "converged": 0, "keyframes": 1, "reference_frame": 15, "metric": True}
    assert {name: summary[name] for name in expected} == expected and summary["lost_because"] == {"no contact": 10}
    assert summary["largest_drift_deg"] == 0.0 and sum(summary["unknown_motions"].values()) == 9


def test_a_key_of_a_summary_has_one_meaning_in_all_commands(commands):
    says = {name: json.loads((out / "summary.json").read_text()) for name, (_, out) in commands.items()}
    tables = {
        name: len((out / ("poses.csv" if name == "track" else "frames.csv")).read_text().splitlines()) - 1
        for name, (_, out) in commands.items()
    }
    assert commands["reconstruct"][0].returncode == 0
    assert {name: summary["frames"] for name, summary in says.items()} == tables
    shared = {"source", "source_fps", "left_out", "left_out_because", "sensor", "metric", "mm_per_pixel", "calibration_note"}
    counted = {"frames", "lost", "converged", "keyframes"}
    for one, other in itertools.combinations(says.values(), 2):
        assert all(one[key] == other[key] for key in one.keys() & other.keys() - counted)
    assert shared <= says["stream"].keys() & says["track"].keys()


def test_track_refuses_a_reference_that_cannot_be_used_and_counts_bad_frames(unit, run_script, unit_file, tmp_path):
    _, camera = unit
    (tmp_path / "film").mkdir()
    for k in range(20):
        cv2.imwrite(str(tmp_path / "film" / f"{k:03d}.png"), camera(1.0 if k >= 15 else 0.0) * (k != 17))
    call = ("track", unit_file, tmp_path / "film", "--out", tmp_path / "out", "--video", "none")
    for arguments, error in (
        (("--reference", tmp_path / "film" / "017.png"), "017.png: the frame has one colour everywhere"),
        (("--threads", "0"), "--threads: expected at least 1, got 0"),
        (("--least-mm2", "-1"), "--least-mm2: expected a number above 0"),
    ):
        done = run_script(*call, *arguments)
        assert done.returncode == 2 and error in done.stderr and not (tmp_path / "out").exists(), done.stderr
    done = run_script("track", unit_file, tmp_path / "none.avi", "--out", unit_file)
    assert done.returncode == 2 and "got that of a file" in done.stderr, done.stderr  # before the source is opened
    done = run_script(*call)
    assert done.returncode == 1 and "1 frame left out, named above" in done.stdout, done.stderr
    done = run_script(*call, "--least-mm2", "1000")
    assert done.returncode == 2 and "expected a contact to track, got none" in done.stderr


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_what_came_before_ctrl_c_is_kept(run_stream, unit_file, video, tmp_path, monkeypatch, number):
    draw = streams.Overlay.__call__

    def interrupted(overlay, frame, lines=()):
        if frame.number == 20:
            signal.raise_signal(number)
        return draw(overlay, frame, lines)

    monkeypatch.setattr(streams.Overlay, "__call__", interrupted)
    before = signal.getsignal(number)
    done = run_stream(unit_file, video, "--out", tmp_path, "--video", "avi")
    assert done.returncode == 0 and "interrupted" in done.stdout, done.stderr
    assert len(list(vts.frames(tmp_path / "overlay.avi"))) == 20
    assert not list(tmp_path.glob(".overlay*")) and (tmp_path / "summary.json").is_file()
    assert signal.getsignal(number) == before


@pytest.mark.filterwarnings("ignore:frame .* are in doubt")
def test_the_golf_ball_appears_and_vanishes(data):
    video = data / "wedge_video" / "golf_ball.avi"
    with streams.TactileStream(video, vts.Sensor.load("gelsight_wedge")) as stream:
        assert "NOT METRIC" in str(stream.calibration)
        rows = [(float(f.output.depth_mm.abs().max()), int(f.output.contact.sum())) for f in stream]
    assert len(rows) == 63
    assert max(rows[:12]) == (0.0, 0)  # before
    assert min(depth for depth, _ in rows[25:40]) > 0.4 and min(area for _, area in rows[25:40]) > 17_000
    assert max(depth for depth, _ in rows[-6:]) < 0.02 and max(area for _, area in rows[-6:]) < 200  # after


@pytest.mark.parametrize(
    "most_steps", [1, pytest.param(None, marks=pytest.mark.long)]
)  # all of them take seconds, and end as the first
def test_a_sensor_of_which_no_more_than_pitch_and_corners_is_known_is_told_what_to_press(
    data, run_stream, tmp_path, monkeypatch, most_steps
):
    if most_steps:
        monkeypatch.setattr(by_lights, "fit_lights", partial(by_lights.fit_lights, max_steps=most_steps))
    wedge = vts.Sensor.load("gelsight_wedge")
    vts.Sensor("mine", 150, 200, 0.18, corners_px=wedge.corners_px).save(tmp_path / "mine.yaml")
    video = next((data / "wedge_video").glob("*.avi"))
    done = run_stream(video, "--sensor", tmp_path / "mine.yaml")
    assert done.returncode == 2 and "calibration's background" not in done.stderr and "background-frames 0" not in done.stderr
    assert "how sensor 'mine' is lit cannot be found in its first 12 frames alone: press a ball of known diam" in done.stderr
    done = run_stream(video, "--sensor", tmp_path / "mine.yaml", "--device", "gpu")
    assert done.returncode == 2 and "device: expected cpu, cuda" in done.stderr


def test_a_narrow_image_can_be_a_background():
    narrow = replace(vts.Sensor.load("digit"), height=320, width=88, raw_size_px=(), turn_deg=0, mirror=False)
    held = 0.5 + 0.002 * torch.randn(4, 3, 320, 88, generator=torch.Generator().manual_seed(0))
    assert streams.find_background(held, narrow).shape == (3, 320, 88)


def test_presses_of_a_known_sensor_are_no_background(mini_presses):
    background, presses = mini_presses
    sensor = vts.Sensor.load("gelsight_mini")
    generator = torch.Generator().manual_seed(0)

    def held(image):
        return (image[None] + 0.002 * torch.randn(12, *image.shape, generator=generator)).clamp(0, 1)

    streams.find_background(held(background), sensor)
    refused = 0
    for press in presses[::4]:
        try:
            streams.find_background(held(press.image), sensor)
        except ValueError as error:
            refused += "something touches the skin" in str(error)
    assert refused >= len(presses[::4]) - 1


@pytest.mark.parametrize("code, suffix, is_lossy", [("mp4v", ".mp4", True), ("FFV1", ".mkv", False)])
def test_blocks_of_a_lossy_video_are_said_to_be_possible(data, tmp_path, code, suffix, is_lossy):
    background, generator = cv2.imread(str(data / "digit_a" / "background.png")), np.random.default_rng(0)
    pictures = [(background + 0.6 * generator.standard_normal(background.shape)).clip(0, 255).round() for _ in range(16)]
    film = write_film(tmp_path / f"film{suffix}", [picture.astype(np.uint8) for picture in pictures], code=code)
    digit = vts.Sensor.load("digit")
    unit = vts.calibrate(vts.read_image(data / "digit_a" / "background.png"), digit)
    told = r"by at most [0-3]\.\d of 255: .*; up to 4 of 255 may be blocks of a lossy video, which hide faint contacts: record"
    refused = pytest.raises(ValueError, match=told) if is_lossy else contextlib.nullcontext()
    for given in (digit, unit):
        with refused, streams.TactileStream(film, given) as stream:
            assert len(list(stream)) == 16


@pytest.mark.parametrize("size", [(640, 480), pytest.param((3280, 2464), marks=pytest.mark.long)])
def test_a_raw_video_of_a_mini_runs_without_a_camera(data, run_stream, tmp_path, size):
    pictures = np.stack([cv2.imread(str(data / "gelsight_mini_c" / f"frame_{k}.jpg")) for k in range(1, 50)])
    free = np.median(pictures, 0)
    generator = np.random.default_rng(0)
    sequence = [(free + 0.6 * generator.standard_normal(free.shape)).clip(0, 255).round().astype(np.uint8) for _ in range(16)]
    sequence[14:14] = [pictures[k] for k in (0, 10, 20)]
    video = write_film(tmp_path / "raw.avi", [cv2.resize(picture, size) for picture in sequence])
    done = run_stream(video, "--sensor", "gelsight_mini", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    rows = [row.split(",") for row in (tmp_path / "out" / "frames.csv").read_text().splitlines()[1:]]
    assert min(float(row[3]) for row in rows[14:17]) > 0.3 and max(float(row[3]) for row in rows[:14] + rows[17:]) < 0.02
