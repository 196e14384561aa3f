"""Rigs and data that the tests share."""

import os
from pathlib import Path

import pytest
import torch

import torchvts as vts

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
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    for folder in (os.environ.get("TORCHVTS_DATA"), beside):
        if folder and Path(folder).is_dir():
            return Path(folder)
    pytest.skip(f"no third-party images: set TORCHVTS_DATA, or put them in {beside}")
