"""How free skin of a unit decays and from which pressure an object touches it, from presses of balls."""

import dataclasses

import pytest
import torch
from conftest import LONG, unlabelled

import torchvts as vts
from lab.drawn_sensors import drawn_sensor
from torchvts.scenes import objects
from torchvts.skin.pressure import CONTACT_DECAY_MM


@pytest.mark.parametrize(
    "reach_mm, expected_mm",
    [(0.18, 0.2), pytest.param(0.28, 0.3, marks=pytest.mark.long), pytest.param(0.69, CONTACT_DECAY_MM, marks=pytest.mark.long)],
)
def test_a_unit_shows_how_its_skin_decays(reach_mm, expected_mm, tmp_path):
    """Light presses too are as large as they are then; with one L for all units contact was 1.3 to 5 times too large."""
    unit = dataclasses.replace(drawn_sensor(0), reach_mm=reach_mm)
    calibration = vts.calibrate(unit.background, unit.sensor, unlabelled(unit.balls[::2]))
    assert calibration.contact_decay_mm == pytest.approx(expected_mm, abs=0.03)
    calibration.save(tmp_path / "unit.safetensors")
    loaded = vts.Calibration.load(tmp_path / "unit.safetensors")
    assert (loaded.contact_share, loaded.contact_decay_mm) == (calibration.contact_share, calibration.contact_decay_mm)
    pipe = vts.DepthPipeline.from_calibration(loaded)
    for diameter_mm, press_mm in ((3.0, 0.3), (10.0, 0.3), (6.0, 0.2), (6.0, 0.5))[: None if LONG else 2]:
        press = unit.press(objects.sphere(diameter_mm / 2), objects.pose(shift_mm=(1.0, -0.5), press_mm=press_mm), "", 7)
        with torch.inference_mode():
            found = pipe(press.image[None]).contact
        ratio = float(found.sum() / press.scene.contact.sum())
        assert 0.8 < ratio < 1.3
