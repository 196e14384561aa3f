"""Sensors drawn at random: the truth is a surface that hangs free around its contact, and a seed gives the same sensor again."""

import math

import pytest
import torch
from conftest import half_drawn

from lab.drawn_sensors import OBJECTS, drawn_sensor
from lab.metrics import normal_angle_deg
from torchvts import DepthPipeline, poisson_background
from torchvts.calibration import Press, by_presses, calibrate
from torchvts.scenes import hanging_skin, objects


@pytest.fixture(scope="module")
def unit():
    return drawn_sensor(3)


def test_free_skin_falls_exponentially_beside_a_straight_edge():
    # beside a half plane pressed by 1 the membrane is exp(-x / reach)
    edge = torch.full((1, 1, 12, 200), -1.0, dtype=torch.float64)
    edge[..., :20] = 1.0
    scene = hanging_skin(edge, 0.8, 0.05, sweeps=300)
    x = 0.05 * torch.arange(100, dtype=torch.float64)
    assert float((scene.depth_mm[0, 0, 6, 19:119] - torch.exp(-x / 0.8)).abs().max()) < 1e-3
    assert torch.equal(scene.contact, edge > 0)


def test_skin_solves_the_obstacle_problem():
    height_mm, pitch, reach = 5.0, 0.1, 0.6
    ball = objects.press(objects.sphere(height_mm), objects.pose(press_mm=0.6), 80, 100, pitch, 1e-4, torch.float64)
    target = torch.where(ball.contact, ball.depth_mm, -1.0)
    scene = hanging_skin(target, reach, pitch, sweeps=400)
    z = scene.depth_mm
    laplacian = (z[..., 1:-1, 2:] + z[..., 1:-1, :-2] + z[..., 2:, 1:-1] + z[..., :-2, 1:-1] - 4 * z[..., 1:-1, 1:-1]) / pitch**2
    pressure = z[..., 1:-1, 1:-1] - reach**2 * laplacian
    free = ~scene.contact[..., 1:-1, 1:-1]
    assert float(pressure[free].abs().max()) < 1e-2 and float(pressure.min()) > -1e-2
    assert bool((z >= target - 1e-12).all())
    assert bool((~ball.contact & scene.contact).sum() == 0) and 0 < int(scene.contact.sum()) < int(ball.contact.sum())


@pytest.mark.parametrize("name", OBJECTS)
def test_depth_agrees_with_its_gradient_and_touches_only_where_it_is_deformed(name):
    unit = half_drawn(3)
    scene = next(pressed for pressed in unit.objects if pressed.name == name).scene
    middle = scene.depth_mm - scene.depth_mm.mean()
    again = poisson_background(scene.gradient, unit.sensor.mm_per_pixel)
    # central differences and the trapezoid rule differ at the edges of walls only
    assert float((again - again.mean() - middle).square().mean().sqrt()) < 0.02 * float(scene.depth_mm.max())
    assert bool((scene.depth_mm[scene.contact] > 0.02).all()) and 0.005 < float(scene.contact.float().mean()) < 0.5
    assert float(scene.depth_mm.max()) > 0.3


def test_a_seed_gives_the_same_sensor(unit):
    again = drawn_sensor.__wrapped__(3)  # beside the cache
    assert again is not unit and again.sensor == unit.sensor
    assert torch.equal(again.background, unit.background)
    first, second = (one.press(objects.capsule(), objects.pose(press_mm=0.4), seed=7).image for one in (unit, again))
    assert torch.equal(first, second)
    assert drawn_sensor(3) is unit


def test_labels_of_balls_are_exact(unit):
    press = unit.ball(5.0, 0.5, (2.0, -1.0), seed=5)
    pitch = unit.sensor.mm_per_pixel
    scene = unit.press(objects.sphere(2.5), objects.pose(shift_mm=(2.0, 1.0), press_mm=0.5), seed=5).scene
    rows, columns = torch.nonzero(scene.contact[0, 0], as_tuple=True)
    assert (float(columns.double().mean()), float(rows.double().mean())) == pytest.approx(press.center_px, abs=0.1)
    assert press.contact_radius_px == pytest.approx(math.sqrt(len(rows) / math.pi))
    assert press.contact_radius_px * pitch < math.sqrt(2.5**2 - 2.0**2)  # the skin leaves the ball before the undeformed plane


@pytest.mark.parametrize(
    "unit_of, seed, most_missing_mm, most_share",
    [
        (half_drawn, 3, 0.055, 0.99),
        *(pytest.param(drawn_sensor, *of, 0.97, marks=pytest.mark.long) for of in ((3, 0.055), (5, 0.085))),
    ],
)
def test_the_second_pass_learned_from_balls_carries_over_to_other_objects(unit_of, seed, most_missing_mm, most_share):
    """Better in the mean than the first, and on no object worse by 5 %: a second pass that balls teach shapes would be.
    Depth counts from the undeformed skin, so skin that hangs free around the object must not be left out."""
    unit = unit_of(seed)
    calibrated = by_presses(unit.background, unit.sensor, unit.balls, None, False)[0]
    errors = {}
    for mode in ("fast", "precise"):
        pipe = DepthPipeline.from_calibration(calibrated, mode)
        with torch.inference_mode():
            found = [pipe.freeze()(pressed.image[None]) for pressed in unit.objects]
        pairs = list(zip(found, unit.objects, strict=True))
        errors[mode] = [float(normal_angle_deg(out.normal, p.scene.normal, p.scene.contact).mean()) for out, p in pairs]
        missing = [float((p.scene.depth_mm - out.depth_mm)[p.scene.contact].mean()) for out, p in pairs]
        assert 0.0 < sum(missing) / len(missing) < most_missing_mm  # without the tail 0.076 and 0.112
    assert sum(errors["precise"]) < most_share * sum(errors["fast"]) and sum(errors["fast"]) / len(OBJECTS) < 4.5
    assert all(second < 1.05 * first for first, second in zip(errors["fast"], errors["precise"], strict=True))


@pytest.mark.long
def test_undeformed_skin_stays_where_it_is_by_one_press():
    """Point lights would be right on the ball, but undeformed skin would seem 0.3 mm deep as soon as its light changes."""
    unit = drawn_sensor(14)
    ball = unit.ball(4.0, 0.5, (0.8, -0.6))
    calibration = calibrate(unit.background, unit.sensor, [Press(ball.image, 4.0, "ball")])
    assert calibration.report["model"] == "response"
    pressed = unit.press(objects.capsule(), objects.pose(press_mm=0.4))
    out = DepthPipeline.from_calibration(calibration)(pressed.image[None])
    assert float(out.depth_mm.min()) > -0.05


@pytest.mark.long
def test_a_wider_blur_that_balls_like_better_is_not_taken():
    # twice the blur lowers the error on held-out balls by more than a tenth, and flattens the edges of everything else
    unit = drawn_sensor(2)
    cal = calibrate(unit.background, unit.sensor, unit.balls)
    pipe, errors = DepthPipeline.from_calibration(cal, "precise"), []
    for pressed in unit.objects:
        out = pipe(pressed.image[None])
        errors.append(float(normal_angle_deg(out.normal, pressed.scene.normal, pressed.scene.contact).mean()))
    assert cal.sensor.blur_px <= 1.0
    assert sum(errors) / len(errors) < 2.3  # 2.52 with twice the blur
