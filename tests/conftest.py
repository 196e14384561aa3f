"""Rigs, data and ways to call that the tests share."""

import contextlib
import io
import os
import runpy
import sys
import warnings
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import pytest
import torch

import torchvts as vts
from torchvts.cli import COMMANDS, main

ROOT = Path(__file__).resolve().parents[1]

torch.set_num_threads(1)  # small tensors: a second thread gains nothing, and waits for a core where another process runs


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
