"""What calibrations doubt: widths of contacts, saturated light in a background, and how far a prior checks the scale."""

import dataclasses
import re

import pytest
import torch
from conftest import calibrated, half_drawn, unlabelled

import torchvts as vts
from lab.drawn_sensors import drawn_sensor
from torchvts.calibration import CalibrationWarning
from torchvts.calibration.contacts import used
from torchvts.calibration.doubts import of_sizes, width_of
from torchvts.calibration.press_model import by_presses
from torchvts.calibration.resting import beside_presses
from torchvts.scenes import objects
from torchvts.stream.background import with_background

UNIT = half_drawn(0)


def bare(presses, times=1.0):
    named = [dataclasses.replace(p, ball_diameter_mm=times * p.ball_diameter_mm, name=f"ball {k}") for k, p in enumerate(presses)]
    return unlabelled(named)


@pytest.mark.long  # test_sizes_that_all_presses_contradict has one quick case
@pytest.mark.parametrize("times, expected", [(1.0, 0.63), (0.8, 0.77), (0.5, 1.2)])
def test_the_width_of_contacts_knows_nothing_of_the_given_diameter(times, expected):
    """Halved diameters double it; located contact radii stop at 0.95 of the ball's."""
    whole = drawn_sensor(0)
    unit, contacts = by_presses(whole.background, whole.sensor, bare(whole.balls[:6], times), None)
    wide, std = width_of(unit.response.field, used(contacts), whole.sensor.mm_per_pixel)
    assert wide == pytest.approx(expected, abs=0.1) and 0.05 <= std < 0.15


@pytest.mark.parametrize(
    "height_mm, diameter_mm",
    [
        pytest.param(objects.bottle_cap(), 12.0, id="cap"),
        pytest.param(objects.stamp(), 6.0, id="stamp", marks=pytest.mark.long),
    ],
)
def test_what_is_no_ball_is_not_metric(height_mm, diameter_mm):
    """Alone it contradicts no other press, but the error to expect is larger than its slopes."""
    press = UNIT.press(height_mm, objects.pose(press_mm=0.3), seed=5)
    with pytest.warns(CalibrationWarning, match="they tell nothing of slopes: were they of a ball"):
        unit = vts.calibrate(UNIT.background, UNIT.sensor, [vts.Press(press.image, diameter_mm)])
    assert not unit.metric and vts.calibrate(UNIT.background, UNIT.sensor, bare(UNIT.balls[:1])).metric


def test_saturated_light_whose_edge_moves_is_no_contact_in_the_background():
    """A red LED in the image: with a little more exposure its saturated spot is wider."""
    y, x = torch.meshgrid(torch.arange(240.0), torch.arange(320.0), indexing="ij")
    spot = 1.5 * torch.exp(-((x - 200).square() + (y - 80).square()) / 800.0)
    glare = torch.stack((spot, 0.2 * spot, 0.1 * spot))
    small = [torch.nn.functional.interpolate(i[None], (240, 320))[0] for i in (UNIT.background, *(p.image for p in UNIT.balls[:3]))]
    presses = [vts.Press((image + glare).clamp(0, 1), 6.0) for image in small[1:]]
    assert beside_presses((small[0] + 1.6 * glare).clamp(0, 1), presses) == ""


def test_sizes_are_doubted_by_the_spread_of_units_and_of_presses():
    def contacts(*gains):
        return [dataclasses.replace(EMPTY, metrics={"gain": gain}) for gain in gains]

    EMPTY = by_presses(UNIT.background, UNIT.sensor, bare(UNIT.balls[:1]), None)[1][0]
    assert of_sizes(contacts(1.3, 1.35, 1.4), 0.05) == [] and of_sizes(contacts(0.75), 0.05) == []
    (doubt,) = of_sizes(contacts(1.8, 1.9, 2.0), 0.05)
    low, high = map(float, re.search(r"mm_per_pixel of ([\d.]+) to ([\d.]+), would fit", doubt.text).groups())
    assert doubt.of_scale and low < 0.095 < high and "the balls seem 0.53 times as wide" in doubt.text


def test_a_wrong_background_is_named_with_its_place():
    unit, warned = calibrated(UNIT.balls[0].image, UNIT.sensor, bare(UNIT.balls[4:8]))
    (said,) = [text for text in warned if "was a press given as the background?" in text]
    place = torch.tensor([float(v) for v in re.search(r"pixel \((\d+), (\d+)\)", said).groups()])
    center, radius = torch.tensor(UNIT.balls[0].center_px), UNIT.balls[0].contact_radius_px
    assert float((place - center).norm()) < 1.3 * radius
    assert not unit.metric and said in unit.report["not_metric"]


def test_a_new_background_keeps_what_is_known_of_the_field():
    """A stream takes its own: the bounds of its frames rest on the covariance, their contact on what presses showed of it."""
    unit, _ = by_presses(UNIT.background, UNIT.sensor, bare(UNIT.balls[:3]), None)
    unit = dataclasses.replace(unit, contact_share=0.5, contact_decay_mm=0.3)
    again = with_background(unit, UNIT.background)
    assert torch.equal(again.covariance, unit.covariance)
    assert (again.contact_share, again.contact_decay_mm) == (0.5, 0.3)
