"""Rigs, data and ways to call that the tests share."""

import contextlib
import dataclasses
import functools
import io
import json
import os
import runpy
import signal
import sys
import warnings
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import cv2
import matplotlib
import numpy as np
import pytest
import safetensors.torch
import torch

import torchvts as vts
from lab.drawn_sensors import DrawnSensor, drawn_sensor
from torchvts import compiled
from torchvts.cli import COMMANDS, main
from torchvts.core.files import checksum, load_tensors

ROOT = Path(__file__).resolve().parents[1]

torch.set_num_threads(1)  # small tensors: a second thread gains nothing, and waits for a core where another process runs


LONG = os.environ.get("TORCHVTS_TEST_PROFILE") == "long"
"""Whether make test-long runs, which draws more examples."""


@pytest.fixture(scope="session", autouse=True)
def _coarse_pictures():
    """Pictures have few dots to the inch, and surfaces of few points: whole ones take a second each. make test-long draws them."""
    with pytest.MonkeyPatch.context() as patch:
        if not LONG:
            patch.setattr("torchvts.viz.MOST_POINTS", 40)
            patch.setitem(matplotlib.rcParams, "savefig.dpi", 60)
        yield


@contextlib.contextmanager
def without_library():
    """Within it, there is no compiled library, as where no C compiler was at hand."""
    users = [
        m for name, m in sys.modules.items() if name.startswith("torchvts.") and getattr(m, "library", None) is compiled.library
    ]
    with contextlib.ExitStack() as stack:
        for user in users:
            stack.enter_context(mock.patch.object(user, "library", lambda: None))
        yield


def ring_lights(radius_mm=31.0, height_mm=40.0, rotation_deg=10.0, level=0.45, gloss=None, dtype=torch.float32):
    """Three lights on a ring, 120 degrees apart, that give a matt flat skin ``level`` at the image centre."""
    heights = torch.tensor(height_mm, dtype=torch.float64).expand(3)
    angle = torch.deg2rad(torch.tensor([rotation_deg + 120.0 * k for k in range(3)], dtype=torch.float64))
    position = torch.stack((radius_mm * angle.cos(), radius_mm * angle.sin(), heights), dim=1)
    albedo = level * (radius_mm**2 + heights**2) ** 1.5 / heights
    return vts.PointLights(position.to(dtype), albedo.to(dtype), gloss).requires_grad_(False)


@pytest.fixture(scope="session")
def ring():
    return ring_lights


@pytest.fixture(scope="session")
def small_sensor():
    """A quarter of the rows and columns of 640 x 480, the same 40 x 30 mm field."""
    return vts.Sensor(name="rig", height=120, width=160, mm_per_pixel=0.25)


@pytest.fixture(scope="session")
def small_press():
    """A ball of radius 10 mm, pressed in by ``press_mm``, on the small sensor."""

    def press(press_mm=1.0, center_mm=(0.0, 0.0), radius_mm=10.0, dtype=torch.float32):
        return vts.scenes.sphere_press(radius_mm, press_mm, center_mm, 120, 160, 0.25, dtype)

    return press


TINY_SENSOR = vts.Sensor("rig", 48, 64, 0.6)
TINY_LIGHTS = ((20.0, 9.0, 25.0), (-18.0, 13.0, 25.0), (-2.0, -22.0, 25.0))


def tiny_image(k):
    """Frame ``k`` of the tiny sensor, (3, 48, 64): a ball that differs from frame to frame, and no contact where ``k`` < 0."""
    height, width, pitch = TINY_SENSOR.height, TINY_SENSOR.width, TINY_SENSOR.mm_per_pixel
    lights = vts.PointLights(TINY_LIGHTS, [600.0] * 3)
    scene = vts.scenes.sphere_press(6.0 + k % 5, 0.5 + 0.01 * (k % 50), (0.1 * (k % 30) - 1.5, 0), height, width, pitch)
    return vts.scenes.render(scene if k >= 0 else vts.scenes.undeformed(scene), lights, noise_std=0.002, bits=8, seed=abs(k))[0]


@pytest.fixture(scope="session")
def unit(tmp_path_factory):
    """The file of a calibration of the tiny sensor."""
    path = tmp_path_factory.mktemp("unit") / "unit.safetensors"
    vts.Calibration.from_lights(vts.PointLights(TINY_LIGHTS, [600.0] * 3), TINY_SENSOR, tiny_image(-1)).save(path)
    return path


def calibrated(background, sensor, presses=()):
    """A calibration, and what it warned of."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        calibration = vts.calibrate(background, sensor, presses)
    return calibration, [str(one.message) for one in caught if issubclass(one.category, vts.CalibrationWarning)]


def unlabelled(presses, **changes):
    """Presses nobody has labelled, and with what else is to change."""
    return [dataclasses.replace(press, center_px=None, contact_radius_px=None, **changes) for press in presses]


@functools.cache
def half_drawn(seed):
    """The drawn sensor of a seed with half of its rows and columns: a calibration of it takes a quarter of the time."""
    whole = drawn_sensor(seed)
    sensor = whole.sensor
    size = {"height": sensor.height // 2, "width": sensor.width // 2, "mm_per_pixel": 2 * sensor.mm_per_pixel}
    return DrawnSensor(seed, dataclasses.replace(sensor, **size), whole.optics, whole.reach_mm)


def unit_and_camera(lights, sensor, press):
    """A calibrated unit, and its camera: press in mm and brightness to a picture (H, W, 3) B, G, R, 8 bits, with noise."""
    scenes = {0.0: vts.scenes.undeformed(press()), 0.5: press(0.5), 1.0: press(1.0)}
    rendered, taken = {mm: vts.scenes.render(scene, lights)[0] for mm, scene in scenes.items()}, []

    def camera(press_mm=0.0, brightness=1.0, noise=0.004):
        generator = np.random.default_rng(len(taken))
        taken.append(press_mm)
        image = rendered[press_mm].permute(1, 2, 0).flip(2).numpy() * brightness
        image = image + noise * generator.standard_normal(image.shape, dtype=np.float32)
        return (image.clip(0, 1) * 255 + 0.5).astype(np.uint8)

    camera.restart = taken.clear
    return vts.Calibration.from_lights(lights, sensor, rendered[0.0]), camera


class Frames:
    """A reader of pictures (H, W, 3) B, G, R made up front."""

    name, live, fps = "made up", False, 30.0

    def __init__(self, pictures):
        self._pictures = iter(pictures)

    def read(self):
        return next(self._pictures, None)

    def close(self):
        self._pictures = iter(())


def bgr(image):
    """An image (3, H, W) in [0, 1] as cameras give it: (H, W, 3) B, G, R, 8 bits."""
    return np.ascontiguousarray((image * 255).round().byte().flip(0).permute(1, 2, 0).numpy())


def write_film(path, pictures, fps=30.0, code="MJPG"):
    """Write pictures (H, W, 3) B, G, R as a video; returns its path."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*code), fps, pictures[0].shape[1::-1])
    for picture in pictures:
        writer.write(picture)
    writer.release()
    return path


@pytest.fixture
def small_files():
    """Within it a file may have no more bytes, as on a full disk."""
    resource = pytest.importorskip("resource")

    @contextlib.contextmanager
    def limited(most):
        limits, ignored = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, limits[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
            signal.signal(signal.SIGXFSZ, ignored)

    return limited


@pytest.fixture(scope="session")
def data():
    """The folder of third-party images."""
    beside = ROOT.parent / "shared" / "data"
    for folder in (os.environ.get("TORCHVTS_DATA"), beside):
        if folder and Path(folder).is_dir():
            return Path(folder)
    pytest.skip(f"no third-party images: set TORCHVTS_DATA, or put them in {beside}")


@pytest.fixture(scope="session")
def mini_presses(data):
    """Background and presses of a GelSight Mini, with the labelled centers."""
    return vts.read_presses(data / "gelsight_mini_a")


@pytest.fixture(scope="session")
def mini_by_prior(mini_presses):
    """The GelSight Mini calibrated from its background by the shipped prior."""
    return vts.calibrate(mini_presses[0], vts.Sensor.load("gelsight_mini"))


class Done(NamedTuple):
    """How a command or script ended, and what it printed."""

    returncode: int
    stdout: str
    stderr: str


def pytest_terminal_summary(terminalreporter):
    """How many tests want data that are not here, or a package that is not installed."""
    skipped = terminalreporter.stats.get("skipped", [])
    reasons = [report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr) for report in skipped]
    for_want = sum("no third-party images" in reason for reason in reasons)
    if for_want:
        terminalreporter.write_line(f"{for_want} tests on real sensors skipped for want of data: set TORCHVTS_DATA")
    for reason in sorted({reason for reason in reasons if "no third-party images" not in reason}):
        terminalreporter.write_line(f"{reasons.count(reason)} skipped: {reason.removeprefix('Skipped: ')}")


def call_script(name, *arguments):
    """Run ``torchvts <name> ...``, or ``python scripts/<name>.py ...`` for what is no subcommand, but in this process.

    A process of its own would load torch again, which takes seconds. Warnings go to stderr and raise nothing.
    """
    path = ROOT / "scripts" / f"{name}.py"
    out, err = (io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True) for _ in range(2))

    def show(message, category, filename, lineno, file=None, line=None):
        sys.stderr.write(warnings.formatwarning(message, category, filename, lineno, line))

    code = 0
    threads = torch.get_num_threads()
    command = ["torchvts", name] if name in COMMANDS else [str(path)]
    with contextlib.ExitStack() as stack:
        stack.enter_context(warnings.catch_warnings())
        warnings.resetwarnings()
        warnings.simplefilter("ignore", DeprecationWarning)
        warnings.simplefilter("ignore", ResourceWarning)
        stack.enter_context(mock.patch.object(warnings, "showwarning", show))
        stack.enter_context(mock.patch.object(sys, "argv", [*command, *map(str, arguments)]))
        stack.enter_context(mock.patch.object(sys, "path", [str(path.parent), *sys.path]))
        stack.callback(os.chdir, Path.cwd())
        os.chdir(ROOT)
        stack.enter_context(torch.set_grad_enabled(torch.is_grad_enabled()))
        stack.enter_context(torch.random.fork_rng(devices=[]))
        stack.enter_context(contextlib.redirect_stdout(out))
        stack.enter_context(contextlib.redirect_stderr(err))
        try:
            if name in COMMANDS:
                code = main()
            else:
                runpy.run_path(str(path), run_name="__main__")
        except SystemExit as stop:
            if isinstance(stop.code, str):
                sys.stderr.write(f"{stop.code}\n")
            code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
        finally:
            torch.set_num_threads(threads)
    return Done(code, *(stream.buffer.getvalue().decode() for stream in (out, err)))


@pytest.fixture(scope="session")
def run_script():
    """``run_script("calibrate", *arguments)``: see :func:`call_script`."""
    return call_script


def rewritten(path, change_tensors=None, change_metadata=None):
    """A calibration file with something changed, also to what no calibration writes, and a checksum that fits."""
    tensors, metadata = load_tensors(path)
    (change_tensors or (lambda t: None))(tensors)
    (change_metadata or (lambda m: None))(metadata)
    described = {**metadata, "checksum": checksum(tensors, metadata)}
    safetensors.torch.save_file(tensors, str(path), {"torchvts": json.dumps(described)})


def refused_when_rewritten(path, message, **changes):
    """A calibration file with something changed is refused, and the message begins with its name."""
    rewritten(path, **changes)
    with pytest.raises(ValueError, match=message) as caught:
        vts.Calibration.load(path)
    assert str(caught.value).startswith(f"{path}: ")
