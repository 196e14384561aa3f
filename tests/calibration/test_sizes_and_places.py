"""What presses contradict and what they do not cover: pitch and diameters, one wrong ball, skin where none was pressed."""

import dataclasses
import re

import pytest
import torch
from conftest import LONG, calibrated, half_drawn, unlabelled

import torchvts as vts
from lab.drawn_sensors import drawn_sensor
from torchvts.calibration import CalibrationWarning
from torchvts.model import press_next, stated_error_deg
from torchvts.scenes import objects


def drawn():
    """A drawn sensor; not drawn before a test asks for it."""
    return half_drawn(0)


def bare(presses=None):
    """Presses nobody labelled; some of the sensor's balls where none are given."""
    return unlabelled(drawn().balls[: 6 if LONG else 4] if presses is None else presses)


def calibrate(sensor, presses):
    return calibrated(drawn().background, sensor, presses)


@pytest.fixture(scope="module")
def whole():
    return calibrate(drawn().sensor, bare())


def test_right_sizes_are_not_complained_of(whole):
    calibration, warned = whole
    assert not warned and all(row["used"] for row in calibration.report["presses"])


@pytest.mark.parametrize("mistake", ["twice the pitch", pytest.param("radii for diameters", marks=pytest.mark.long)])
def test_sizes_that_all_presses_contradict_are_refused_and_forced(mistake):
    unit = drawn_sensor(1)
    sensor, presses = unit.sensor, bare(unit.balls[: 6 if LONG else 3])
    if mistake == "twice the pitch":
        sensor = dataclasses.replace(sensor, mm_per_pixel=2 * sensor.mm_per_pixel)
    else:
        presses = [dataclasses.replace(press, ball_diameter_mm=0.5 * press.ball_diameter_mm) for press in presses]
    with pytest.raises(
        ValueError,
        match=r"narrower than their balls, got 1\.\d\d \+- 0\.\d\d times as wide.*mm_per_pixel.*too large.*, or radii were given",
    ):
        vts.calibrate(unit.background, sensor, presses)
    with pytest.warns(CalibrationWarning, match=r"contacts narrower than their balls, got 1\."):
        vts.calibrate(unit.background, sensor, presses, force=True)


@pytest.mark.long
def test_what_nothing_could_check_is_said_and_no_warning():
    smaller = [dataclasses.replace(press, ball_diameter_mm=0.8 * press.ball_diameter_mm) for press in bare()]
    unit, warned = calibrate(drawn().sensor, smaller)
    (said,) = unit.report["doubts"]
    assert (
        not warned
        and unit.metric
        and said.startswith("not checked: the scale rests on the diameters and the mm_per_pixel that were given")
    )
    assert float(re.search(r"up to ([\d.]+) would fit the contacts", said)[1]) > 1.2 * drawn().sensor.mm_per_pixel
    pipe = vts.DepthPipeline.from_calibration(unit)
    depths = [float(pipe(press.image[None]).depth_mm.max()) for press in smaller]
    said_mm = map(float, re.search(r"by which the presses are ([\d.]+) to ([\d.]+) mm deep: is that so", said).groups())
    assert list(said_mm) == pytest.approx([min(depths), max(depths)], rel=0.1)


@pytest.mark.parametrize("pitch_off", [0.9, pytest.param(1.1, marks=pytest.mark.long)])
def test_depth_by_presses_goes_with_the_square_of_a_wrong_pitch(whole, pitch_off):
    sensor = dataclasses.replace(drawn().sensor, mm_per_pixel=pitch_off * drawn().sensor.mm_per_pixel)
    other, _ = calibrate(sensor, bare())
    right, wrong = (
        [float(vts.DepthPipeline.from_calibration(unit)(press.image[None]).depth_mm.max()) for press in drawn().balls[:5:2]]
        for unit in (whole[0], other)
    )
    ratio = sorted(b / a for a, b in zip(right, wrong, strict=True))[len(right) // 2]
    assert ratio == pytest.approx(pitch_off**2, rel=0.05)


def test_presses_far_from_each_other_do_not_contradict_each_other():
    """Three presses at three corners say nothing of each other's places."""
    half = torch.tensor([drawn().sensor.width / 2, drawn().sensor.height / 2])
    outward = sorted(drawn().balls, key=lambda press: -float((torch.tensor(press.center_px) - half).norm()))
    calibration, _ = calibrate(drawn().sensor, bare(outward[:3]))
    assert all(row["used"] for row in calibration.report["presses"])


def test_the_order_of_presses_does_not_matter(whole):
    calibration, _ = calibrate(drawn().sensor, bare()[::-1])
    ours, theirs = (torch.tensor(one.response.field.coefficient) for one in (calibration, whole[0]))
    assert torch.allclose(ours, theirs, atol=1e-6)


def test_skin_without_presses_is_known_and_said():
    left = [press for press in bare(drawn().balls) if dict(places())[press.name][0] < drawn().sensor.width / 2]
    calibration, _ = calibrate(drawn().sensor, left)
    place, error_deg = press_next(calibration)
    assert place[0] > drawn().sensor.width / 2
    assert error_deg > calibration.report["own_deg"]
    there = stated_error_deg(calibration, torch.full((1, 3, drawn().sensor.height, drawn().sensor.width), 1.2))[0, 0, place[1]]
    assert float(there[place[0]]) > 1.2 * float(there[drawn().sensor.width // 4])


def places():
    return [(press.name, press.center_px) for press in drawn().balls]


@pytest.mark.parametrize("seed", [2, *(pytest.param(seed, marks=pytest.mark.long) for seed in (0, 1, 3, 4, 5))])
def test_what_is_calibrated_can_be_saved_and_loaded(seed, tmp_path):
    """Odd presses among good ones: darker, saturated, twice, of another size, no contact. A refusal is an answer too."""
    generator = torch.Generator().manual_seed(seed)
    presses = []
    for k in torch.randperm(len(drawn().balls), generator=generator)[: 1 + seed].tolist():
        press = bare(drawn().balls)[k]
        odd = int(torch.randint(7, (1,), generator=generator))
        image = (
            (press.image, press.image * 0.3, (press.image * 1.8).clamp(0, 1), drawn().background)[odd] if odd < 4 else press.image
        )
        size = press.ball_diameter_mm * (0.6 if odd == 4 else 1.0)
        presses += [dataclasses.replace(press, image=image, ball_diameter_mm=size, name=f"{press.name}, {odd}")] * (
            2 if odd == 5 else 1
        )
    try:
        calibration, _ = calibrate(drawn().sensor, presses)
    except ValueError as error:
        assert str(error).startswith(("presses: ", "background: "))
        return
    calibration.save(tmp_path / "unit.safetensors")
    loaded = vts.Calibration.load(tmp_path / "unit.safetensors")
    assert loaded.report == calibration.report and torch.equal(loaded.background, calibration.background)


def by_balls(unit, diameter, depth, count=3):
    """A calibration by bare presses of balls; diameter and depth as shares of the short side and of the diameter."""
    wide, high = (n * unit.sensor.mm_per_pixel for n in (unit.sensor.width, unit.sensor.height))
    short, places = min(wide, high), ((-0.2, -0.2), (0.2, -0.15), (-0.15, 0.2), (0.2, 0.2))[:count]
    presses = [
        unit.ball(diameter * short, depth * diameter * short, (x * wide, y * high), f"ball {k}", k)
        for k, (x, y) in enumerate(places)
    ]
    return vts.calibrate(unit.background, unit.sensor, bare(presses))


def slopes_over_true(calibration, press):
    """Slopes in the contact of a press, over the true ones, by least squares."""
    with torch.no_grad():
        out = vts.DepthPipeline.from_calibration(calibration, "fast")(press.image[None])
    found, true = (slope[press.scene.contact.expand_as(slope)] for slope in (out.gradient, press.scene.gradient))
    return float((found * true).sum() / true.square().sum())


@pytest.mark.parametrize(
    ("unit_of", "diameter", "depth"), [(half_drawn, 0.35, 0.03), (drawn_sensor, 0.1, 0.25)], ids=["shallow", "tiny"]
)
def test_balls_that_are_shallow_or_tiny_teach_the_slopes_of_larger_objects(unit_of, diameter, depth):
    """The former show no steep skin, and blur takes from the rims of both. Tiny ones need all pixels of the sensor."""
    unit = unit_of(0)
    pressed = unit.press(objects.capsule(1.5, 4.0), objects.pose(20.0, (1.0, 1.0), 0.6))
    ratio = slopes_over_true(by_balls(unit, diameter, depth), pressed)
    assert 0.75 < ratio < 1.45


def test_presses_in_another_gamma_are_named_and_make_bounds_wider(whole):
    """They leave depth in mm: what a gamma may have done to it is a number."""
    unit = half_drawn(0)
    presses = [dataclasses.replace(press, image=press.image.clamp_min(0.0) ** 0.85) for press in bare()]
    with pytest.warns(CalibrationWarning, match="light differs from the background's by .*another gamma"):
        calibration = vts.calibrate(unit.background, unit.sensor, presses)
    assert calibration.metric and calibration.report["uneven"] > 2.0 * whole[0].report["uneven"]
    press, bounds = unit.press(objects.capsule(1.5, 4.0), objects.pose(20.0, (1.0, 1.0), 0.6)), []
    for one in (whole[0], calibration):
        with torch.no_grad():
            out = vts.ConfidentPipeline.from_calibration(one, "fast")(press.image[None])
        bounds.append(float(out.depth_95_mm[press.scene.contact].mean()))
    off = (out.depth_mm - press.scene.depth_mm).abs()[press.scene.contact]
    assert bounds[1] > 1.2 * bounds[0] and float((off < out.depth_95_mm[press.scene.contact]).float().mean()) > 0.95
