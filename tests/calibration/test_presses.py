"""Calibration from presses of balls nobody labelled: on sensors whose truth is a response field, lights, or neither.

Three synthetic units of 120 x 160 pixels at 0.125 mm, all with noise of 0.003 and 8 bits:
"field": light is background * (1 + what a known response field inverts), and the skin leaves the ball along a transition zone;
"curve": a ring of lights seen with vignetting, channels mixed, value = light^0.6 + 0.05: no point lights explain it;
"lights": a ring of point lights, as the paper has it.
"""

import dataclasses
import json
import math
import re

import pytest
import torch
from conftest import calibrated, ring_lights

import torchvts as vts
from lab import metrics
from lab.prior import PriorUnit, fit_log_background, fit_prior, score_prior
from torchvts.calibration.balls import guess_circle
from torchvts.calibration.contacts import read_contacts
from torchvts.calibration.posterior import Evidence, largest, prior_of
from torchvts.calibration.press_model import with_preprocessing
from torchvts.calibration.response_fit import fit_depth_brightness
from torchvts.model.response_field import CHANGE_SCALE, DepthBrightness, ResponseField, sine_from_slope

HEIGHT, WIDTH, PITCH = 120, 160, 0.125
SIZE = (HEIGHT, WIDTH, PITCH)
SENSOR = vts.Sensor("rig", *SIZE, gamma=1.0)
GIVEN = dataclasses.replace(SENSOR, light_position_mm=ring_lights().position_mm.tolist())  # spares the fit of the lights
BALL_MM = 6.0
CENTERS_MM = [(0, 0), (5, 3), (-5, 3), (5, -3), (-5, -3), (0, 4), (0, -4), (7, 0), (-7, 0), (2.5, 1.5), (9.3, 2), (-3, -7)]
DEPTHS_MM = [0.5, 0.4, 0.6, 0.45, 0.55, 0.5, 0.4, 0.6, 0.5, 0.35, 0.6, 0.5]
CUT = {10: "right", 11: "top"}  # by the image border
MIX = [[0.75, 0.2, 0.05], [0.1, 0.8, 0.1], [0.05, 0.25, 0.7]]
OTHER_MIX = [[0.72, 0.22, 0.06], [0.12, 0.76, 0.12], [0.04, 0.28, 0.68]]

pytestmark = pytest.mark.filterwarnings("ignore:.*torch.jit.script.*:DeprecationWarning")


def ball(center_mm=(0.0, 0.0), press_mm=0.5, ball_mm=BALL_MM):
    return vts.scenes.sphere_press(0.5 * ball_mm, press_mm, center_mm, *SIZE)


def soft_ball(center_mm=(0.0, 0.0), press_mm=0.5, ball_mm=BALL_MM):
    """A ball, and skin that falls away from it exponentially from 0.8 of its bare contact radius on, slope continuous."""
    radius = 0.5 * ball_mm
    edge = 0.8 * math.sqrt(radius**2 - (radius - press_mm) ** 2)
    height = math.sqrt(radius**2 - edge**2) - (radius - press_mm)
    fall = edge / math.sqrt(radius**2 - edge**2) / height

    def depth(x, y):
        r = torch.sqrt((x - center_mm[0]) ** 2 + (y - center_mm[1]) ** 2 + 1e-18)
        on_ball = torch.sqrt(radius**2 - r.clamp_max(edge) ** 2) - (radius - press_mm)
        return torch.where(r < edge, on_ball, height * torch.exp(-fall * (r - edge)))

    return vts.scenes.surface(depth, *SIZE)


def noisy(image, seed):
    noise = 0.003 * torch.randn(image.shape, generator=torch.Generator().manual_seed(seed))
    return torch.round((image + noise).clamp(0, 1) * 255) / 255


def true_field():
    """Sine along x from R against G and B, along y from G against B, varying linearly over the image."""
    base = 0.7 * torch.tensor([[0.5, -0.25, -0.25], [0.0, 0.43, -0.43]], dtype=torch.float64)
    rows = torch.zeros(2, 3, 3, dtype=torch.float64)
    rows[:, :, 0] = base
    rows[:, :, 1:] = 0.1 * torch.randn(2, 3, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return ResponseField(1, -1, 0.5 * WIDTH * PITCH, rows.reshape(2, 9).tolist())


def seen_by_field(scene, seed):
    """The smallest change of the three channels that the true field makes this sine of."""
    maps = true_field().maps(*SIZE).permute(2, 3, 1, 0)  # (H, W, 2, 3)
    sine = sine_from_slope(scene.gradient[0].double())
    change = CHANGE_SCALE * torch.einsum("hwki,ihw->khw", torch.linalg.pinv(maps), sine)
    y, x = torch.meshgrid(torch.linspace(-1, 1, HEIGHT), torch.linspace(-1, 1, WIDTH), indexing="ij")
    return noisy(torch.stack((0.45 + 0.1 * x, 0.4 - 0.1 * y, 0.42 - 0.1 * x * y)) * (1 + change.float()), seed)


def seen_by_curve(scene, seed, mix=MIX, vignetting=0.4, **lights):
    light = vts.scenes.render(scene, ring_lights(**lights), vignetting=vignetting)[0]
    return noisy(torch.einsum("ij,jhw->ihw", torch.tensor(mix), light) ** 0.6 + 0.05, seed)


def seen_by_other_curve(scene, seed):
    """Another unit of the same type: turned by 4 degrees, dimmer, mixing otherwise."""
    return seen_by_curve(scene, seed, OTHER_MIX, 0.35, rotation_deg=14.0, level=0.42)


def seen_by_lights(scene, seed, noise_std=0.003, bits=8, **lights):
    return vts.scenes.render(scene, ring_lights(**lights), noise_std=noise_std, bits=bits, seed=seed)[0]


CAMERAS = {"field": (seen_by_field, soft_ball), "curve": (seen_by_curve, ball), "lights": (seen_by_lights, ball)}


def background(camera=seen_by_curve):
    return camera(vts.scenes.undeformed(ball()), 99)


def take_presses(camera=seen_by_curve, shape=ball, count=12, deeper=1.0):
    places = list(zip(CENTERS_MM, DEPTHS_MM))[:count]
    return [vts.Press(camera(shape(c, deeper * d), k), BALL_MM, f"press {k}") for k, (c, d) in enumerate(places)]


def in_px(center_mm):
    return center_mm[0] / PITCH + (WIDTH - 1) / 2, center_mm[1] / PITCH + (HEIGHT - 1) / 2


@pytest.fixture(scope="module", params=["field", pytest.param("curve", marks=pytest.mark.long)])
def unit(request):
    """A unit's name, camera, kind of skin, presses and calibration."""
    camera, shape = CAMERAS[request.param]
    presses = take_presses(camera, shape)
    sensor = SENSOR if request.param == "curve" else GIVEN
    return request.param, camera, shape, presses, *calibrated(background(camera), sensor, presses)


@pytest.fixture(scope="module")
def good():
    """Six clean presses on the unit "curve"."""
    return take_presses(count=6)


@pytest.fixture(scope="module")
def rest():
    return background()


@pytest.fixture(scope="module")
def by_good(good, rest):
    return calibrated(rest, GIVEN, good)[0]


def depth_errors(calibration, camera, shape, mode, places):
    """Mean error inside the contact, mm, and mean angle on the ball two pixels inside of its rim, degrees, over presses."""
    pipe, depths, angles = vts.DepthPipeline.from_calibration(calibration, mode), [], []
    for k, (center, press, ball_mm) in enumerate(places):
        scene = shape(center, press, ball_mm)
        edge = 0.8 * math.sqrt(ball_mm * press - press**2) if shape is soft_ball else math.sqrt(ball_mm * press - press**2)
        y, x = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
        middle = in_px(center)
        inside = (((x - middle[0]) ** 2 + (y - middle[1]) ** 2) < (edge / PITCH - 2) ** 2)[None, None]
        out = pipe(camera(scene, 500 + k)[None])
        depths.append(float((out.depth_mm - scene.depth_mm).abs()[inside].mean()))
        angles.append(float(metrics.normal_angle_deg(out.normal, scene.normal, inside).mean()))
    return sum(depths) / len(depths), sum(angles) / len(angles)


HELD_OUT = [((1.5, -2), 0.5, 6.0), ((-4, 1), 0.4, 8.0), ((3, 3), 0.4, 5.0), ((-1, 4.5), 0.45, 7.0)]


# presses nobody labelled


def test_balls_are_found_without_labels(unit):
    """Centers to 0.7 px in the median and 1.5 px at worst, also of those cut by the border."""
    _, _, _, _, calibration, warned = unit
    rows = calibration.report["presses"]
    assert warned == [] and [row["name"] for row in rows] == [f"press {k}" for k in range(12)]
    assert all(row["used"] and row["reason"] == "" for row in rows)
    off = [math.dist(row["center_px"], in_px(center)) for row, center in zip(rows, CENTERS_MM)]
    assert float(torch.tensor(off).median()) < 0.7 and max(off) < 1.5, off
    assert all(off[k] < 1.0 for k in CUT), off


@pytest.mark.parametrize("center_mm", [(9.3, 2), (10.0, -1), (-3, -7), (0, 7.5), (3, 8)])
def test_the_first_guess_of_a_ball_cut_by_the_border_leaves_the_border_out(rest, center_mm):
    """Its outline along the image border is none of the ball's: with it the guess is 3 to 5 px off."""
    press = vts.Press(seen_by_curve(ball(center_mm, 0.6), 3), BALL_MM)
    (contact,) = read_contacts([press], rest, with_preprocessing(GIVEN, None))
    guess_circle(contact, GIVEN)
    assert contact.reason == "" and math.dist(contact.center_mm.tolist(), center_mm) / PITCH < 1.0


def test_contact_radii_are_found_without_labels(unit):
    name, _, _, _, calibration, _ = unit
    for row, depth in zip(calibration.report["presses"], DEPTHS_MM):
        bare = math.sqrt(BALL_MM * depth - depth**2) / PITCH
        # a bare ball ends at its rim; in a transition zone half the slope is lost a little outside of where the zone begins
        expected, tolerance = (0.88 * bare, 1.5) if name == "field" else (bare, 1.5)
        assert row["contact_radius_px"] == pytest.approx(expected, abs=tolerance)


def test_presses_give_a_response(unit):
    name, _, _, _, calibration, _ = unit
    report = calibration.report
    assert report["model"] == "response" and calibration.response is not None and calibration.lights is None
    assert report["reason"] == "from 12 presses"
    assert report["tried"] == [{"name": "presses", "error_deg": report["held_out_deg"], "doubts": report["doubts"]}]
    assert len(report["doubts"]) == 1 and report["doubts"][0].startswith("not checked: ") and report["not_metric"] == []
    assert report["own_deg"] < report["held_out_deg"] < 1.0 and report["own_deg"] < report["stated_deg"], name


@pytest.mark.parametrize("mode", ["fast", "precise"])
def test_other_balls_elsewhere_are_measured(unit, mode):
    """Within 0.03 mm (a quarter of a pixel, 7 % of the press) of the true depth, and 1.2 degrees of the true normals."""
    _, camera, shape, _, calibration, _ = unit
    depth_mm, angle_deg = depth_errors(calibration, camera, shape, mode, HELD_OUT)
    assert depth_mm < 0.03 and angle_deg < 1.2, (depth_mm, angle_deg)


def test_the_true_field_is_found_where_the_balls_were(unit):
    """Slopes that the fitted field makes of exact changes, held against the truth."""
    name, _, _, _, calibration, _ = unit
    if name != "field":
        pytest.skip("the other unit has no field for its truth")
    truth, found = true_field(), calibration.response.field
    assert found.half_mm == truth.half_mm
    maps, want = found.maps(*SIZE)[:3], truth.maps(*SIZE)
    inverse = torch.linalg.pinv(want.permute(2, 3, 1, 0))  # changes as they occur on this unit
    seen = (calibration.gain * calibration.background).double()  # of a relative change, what compensation leaves of it
    slope = torch.einsum("kahw,khw,hwkb->hwab", maps, seen, inverse)  # should give back each unit slope
    off = (slope - torch.eye(2, dtype=torch.float64)).abs()[20:-20, 20:-20]
    assert float(off.mean()) < 0.03 and float(off.max()) < 0.15, (float(off.mean()), float(off.max()))


def test_a_mirrored_unit_of_twice_the_size_is_calibrated_alike(by_good, good, rest):
    """Images flipped left to right, pitch and balls twice as large: the same slopes, flipped, and twice the depth."""
    double = dataclasses.replace(GIVEN, mm_per_pixel=2 * PITCH)
    flipped = [dataclasses.replace(p, image=p.image.flip(2), ball_diameter_mm=2 * BALL_MM) for p in good]
    other, _ = calibrated(rest.flip(2), double, flipped)
    for row, mirrored in zip(by_good.report["presses"], other.report["presses"]):
        assert mirrored["center_px"] == pytest.approx([WIDTH - 1 - row["center_px"][0], row["center_px"][1]], abs=0.1)
    left, right = by_good.response.field, other.response.field
    assert (left.degree, left.product_degree, 2 * left.half_mm) == (right.degree, right.product_degree, right.half_mm)
    image = seen_by_curve(ball((1.5, -2)), 77)
    one, two = (vts.DepthPipeline.from_calibration(c)(i[None]).depth_mm for c, i in ((by_good, image), (other, image.flip(2))))
    assert float((2 * one - two.flip(3)).abs().max()) < 0.02


def test_balls_of_several_sizes_go_together(rest):
    sizes = [5.0, 6.0, 7.0, 8.0, 9.0, 6.0]
    places = list(zip(CENTERS_MM, sizes))
    presses = [vts.Press(seen_by_curve(ball(c, 0.4, d), k), d, f"press {k}") for k, (c, d) in enumerate(places)]
    calibration, warned = calibrated(rest, GIVEN, presses)
    off = [math.dist(row["center_px"], in_px(center)) for row, (center, _) in zip(calibration.report["presses"], places)]
    assert warned == [] and max(off) < 0.7
    assert depth_errors(calibration, seen_by_curve, ball, "fast", HELD_OUT)[1] < 1.2


@pytest.mark.long
def test_where_point_lights_are_the_truth_a_response_of_presses_comes_near_them():
    sensor = dataclasses.replace(SENSOR, blur_px=1.0)
    calibration, _ = calibrated(background(seen_by_lights), sensor, take_presses(seen_by_lights))
    lights, _ = calibrated(background(seen_by_lights), sensor)
    assert calibration.report["model"] == "response" and lights.report["model"] == "point_lights"
    left, right = (depth_errors(c, seen_by_lights, ball, "precise", HELD_OUT)[1] for c in (calibration, lights))
    assert left < right + 0.5


# what the sensor's type says


@pytest.fixture(scope="module")
def prior():
    """From presses on the unit "curve" with a ball of 6 mm."""
    return fit_prior(background(), SENSOR, take_presses(), "unit A, ball of 6 mm")


def other_presses(count):
    """Of a ball of 9 mm on another unit."""
    places = [((1, -1), 0.4), ((-5, 3), 0.3), ((5, -3), 0.35), ((4, 3), 0.3), ((-4, -3), 0.4)][:count]
    return [vts.Press(seen_by_other_curve(ball(c, p, 9.0), 200 + k), 9.0, f"other {k}") for k, (c, p) in enumerate(places)]


@pytest.fixture(scope="module")
def prior_alone(prior):
    return calibrated(background(seen_by_other_curve), dataclasses.replace(SENSOR, prior=prior))


def test_a_prior_tells_what_it_was_fitted_on(prior):
    assert prior.source == "unit A, ball of 6 mm" and prior.response.gamma == 1.0 and prior.response.by_depth is not None
    assert prior.half_mm == pytest.approx(0.5 * WIDTH * PITCH)
    smooth = prior.background(*SIZE)
    assert float((smooth / background() - 1).abs().mean()) < 0.02


def test_a_prior_is_as_good_as_its_file_says(prior, prior_alone):
    (own,) = prior.held_out_deg
    images = [seen_by_curve(ball(c, p, 6.0), 900 + k) for k, (c, p) in enumerate([((2, 1), 0.4), ((-3, -2), 0.35), ((0, 3), 0.3)])]
    new = [vts.Press(image, 6.0, f"new {k}") for k, image in enumerate(images)]
    sensor = dataclasses.replace(SENSOR, prior=prior)
    assert score_prior(background(), sensor, new) < 1.5 * own < 6.0
    assert prior_alone[0].report["prior_deg"] == own
    unmeasured = dataclasses.replace(SENSOR, prior=dataclasses.replace(prior, held_out_deg=()))
    assert calibrated(background(seen_by_other_curve), unmeasured)[0].report["prior_deg"] is None


def test_the_error_of_too_few_presses_to_hold_out_is_stated_by_what_they_leave_open(prior, by_good, good, rest):
    one = good[:1]
    report = calibrated(rest, GIVEN, one)[0].report
    assert report["held_out_deg"] is None and 0.0 < report["own_deg"] < 5.0 and "prior_deg" not in report
    assert report["stated_deg"] > 1.2 * by_good.report["stated_deg"]
    assert calibrated(rest, dataclasses.replace(GIVEN, prior=prior), one)[0].report["prior_deg"] == prior.expected_deg


def test_a_sensor_without_a_prior_has_none_to_score():
    with pytest.raises(ValueError, match="sensor: expected one with a prior to score, 'presses' has none"):
        score_prior(background(), dataclasses.replace(SENSOR, name="presses"), take_presses()[:3])


@pytest.mark.long
def test_a_prior_of_two_units_lies_between_theirs_and_says_how_far_they_are_apart(prior):
    unit = PriorUnit(background(seen_by_other_curve), SENSOR, other_presses(5))
    joint = fit_prior(background(), SENSOR, take_presses(), "both", [unit])
    assert len(joint.held_out_deg) == 2 and joint.source == "both"
    by_joint, by_other = (
        score_prior(unit.background, dataclasses.replace(SENSOR, prior=one), unit.presses) for one in (joint, prior)
    )
    assert by_joint < by_other
    assert joint.held_out_deg[1] == pytest.approx(by_other, rel=0.3)


def test_a_prior_serves_another_unit_where_lights_are_not_pinned(prior, prior_alone):
    calibration, warned = prior_alone
    report = calibration.report
    assert warned == [] and report["model"] == "response" and calibration.response == prior.response
    assert "prior" in report["reason"]
    assert report["tried"] == [{"name": "prior", "error_deg": prior.expected_deg, "doubts": []}]
    json.dumps(report, allow_nan=False)
    assert calibration.sensor.prior is None  # the unit's own response is what counts from here on
    assert depth_errors(calibration, seen_by_other_curve, ball, "fast", HELD_OUT)[1] < 3.0


def test_lights_are_tried_where_the_prior_is_left_out(prior):
    image = background(seen_by_lights)
    sensor = dataclasses.replace(SENSOR, prior=dataclasses.replace(prior, log_background=fit_log_background(image, PITCH)))
    assert calibrated(image, sensor)[0].report["source"] == "prior"
    calibration, warned = calibrated(image, sensor.without_prior())
    assert warned == [] and calibration.report["model"] == "point_lights"
    assert "one image constrains the lights to" in calibration.report["reason"]


@pytest.mark.parametrize("count", [*(pytest.param(few, marks=pytest.mark.long) for few in (1, 3)), 5])
def test_presses_of_another_ball_do_no_harm_to_a_prior(prior, prior_alone, count):
    sensor = dataclasses.replace(GIVEN, prior=prior)
    calibration, warned = calibrated(background(seen_by_other_curve), sensor, other_presses(count))
    assert warned == [] and "from the sensor's prior and " in calibration.report["reason"]
    row = calibration.report["presses"][0]
    assert math.dist(row["center_px"], in_px((1, -1))) < 1.0
    assert row["contact_radius_px"] == pytest.approx(math.sqrt(9 * 0.4 - 0.16) / PITCH, abs=2.0)
    for mode in ("fast", "precise"):
        alone = depth_errors(prior_alone[0], seen_by_other_curve, ball, mode, HELD_OUT)
        after = depth_errors(calibration, seen_by_other_curve, ball, mode, HELD_OUT)
        assert all(b < 1.1 * a for a, b in zip(alone, after)), (alone, after)
        assert count < 5 or after[1] < 0.8 * alone[1]  # enough to be worth something


def test_a_prior_sees_a_wrong_diameter_in_a_single_press(prior):
    sensor = dataclasses.replace(GIVEN, prior=prior)
    wrong = dataclasses.replace(other_presses(1)[0], ball_diameter_mm=18.0)
    unit, said = calibrated(background(seen_by_other_curve), sensor, [wrong])
    assert any(re.search(r"by the sensor's prior the balls seem 0\.5\d times as wide as given", text) for text in said), said
    low, high = map(float, re.search(r"an mm_per_pixel of ([\d.]+) to ([\d.]+), would fit", unit.report["not_metric"][0]).groups())
    assert not unit.metric and low < PITCH / 0.55 < high


# known centers


def test_known_centers_are_kept_and_those_that_cannot_be_are_left_out(good, rest):
    known = [dataclasses.replace(p, center_px=in_px(c)) for p, c in zip(good, CENTERS_MM)]
    given = dataclasses.replace(good[0], center_px=[79.0, 60.0], contact_radius_px=12.0)
    odd = [dataclasses.replace(good[0], name=name, **one) for name, one in ODD.items()]
    calibration, warned = calibrated(rest, GIVEN, [given, *known[1:4], *good[4:], *odd])
    rows = calibration.report["presses"]
    for row in rows[6:]:
        assert not row["used"] and row["reason"] and any(text.startswith(f"{row['name']}: left out: ") for text in warned)
    assert len(warned) == len(odd)
    json.dumps(calibration.report, allow_nan=False)
    for row, press, depth in list(zip(rows, known, DEPTHS_MM))[1:4]:
        assert row["center_px"] == pytest.approx(press.center_px, abs=1e-9)
        assert row["contact_radius_px"] == pytest.approx(math.sqrt(BALL_MM * depth - depth**2) / PITCH, abs=1.5)
    assert rows[0]["center_px"] == pytest.approx([79.0, 60.0], abs=1e-9) and rows[0]["contact_radius_px"] == pytest.approx(12.0)


ODD = {
    "outside of the image": {"center_px": (1000.0, 1000.0)},
    "beside the contact": {"center_px": (5.0, 5.0)},
    "a radius below a pixel": {"center_px": in_px((0, 0)), "contact_radius_px": 0.1},
}


def test_a_single_press_with_an_impossible_center_is_refused(good, rest):
    with pytest.raises(ValueError, match="odd: "):
        calibrated(rest, GIVEN, [dataclasses.replace(good[0], name="odd", center_px=(1000.0, 1000.0))])


# bad presses


def two_balls():
    def depth(x, y):
        caps = [torch.sqrt((9.0 - (x - c) ** 2 - y**2).clamp_min(1e-12)) - 2.5 for c in (-4.0, 4.0)]
        return torch.maximum(*caps)

    return vts.scenes.surface(depth, *SIZE)


@pytest.fixture(scope="module")
def mixed(good, rest):
    """Six good presses, two in another light, and bad ones of every kind: rows by name, warnings, calibration, bad names."""
    image = seen_by_curve(ball((1, -2)), 31)
    contact = ball((1, -2)).contact[0, 0]
    tint = torch.tensor([1.3, 0.8, 1.2]).reshape(3, 1, 1)
    bad = {
        "the background": (rest, BALL_MM),
        "another background": (seen_by_curve(vts.scenes.undeformed(ball()), 5), BALL_MM),
        "a hair's touch": (seen_by_curve(ball((1, -2), 0.004, 2.0), 6), 2.0),
        "twice the diameter": (image, 2 * BALL_MM),
        "half the diameter": (seen_by_curve(ball((1, -2)), 11), 0.5 * BALL_MM),
        "a diameter in metres": (seen_by_curve(ball((1, -2)), 12), 0.001 * BALL_MM),
        "an absurd diameter": (seen_by_curve(ball((1, -2)), 13), 500.0),
        "saturated": (torch.where(contact, torch.ones_like(image), image), BALL_MM),
        "two balls": (seen_by_curve(two_balls(), 7), BALL_MM),
        "another scene": (torch.rand(image.shape, generator=torch.Generator().manual_seed(10)), BALL_MM),
        "other lights": (seen_by_lights(ball((1, -2)), 8), BALL_MM),
        "out of sight": (seen_by_curve(ball((13.0, 10.0)), 9), BALL_MM),
    }
    relit = {"other white balance": ((image * tint).clamp(0, 1), BALL_MM), "other exposure": ((image * 1.3).clamp(0, 1), BALL_MM)}
    presses = good[:3] + [vts.Press(*given, name) for name, given in (bad | relit).items()] + good[3:]
    calibration, warned = calibrated(rest, GIVEN, presses)
    return {row["name"]: row for row in calibration.report["presses"]}, warned, calibration, list(bad)


REASONS = {
    "the background": "no contact",
    "another background": "no contact",
    "a hair's touch": "no contact",
    "out of sight": "no contact",
    "twice the diameter": "but 12 mm was given: a wrong diameter, or skin that answers otherwise",
    "half the diameter": "3 mm",
    "a diameter in metres": "is its diameter in mm?",
    "an absurd diameter": "but 500 mm was given: a wrong diameter",
    "saturated": r"\d+% of the contact is saturated: lower the exposure",
    "two balls": "2 contacts in one image: press one ball at a time",
    "another scene": "another unit, other exposure, or the light has changed",
    "other lights": "but 6 mm was given: a wrong diameter, or skin that answers otherwise",
}


@pytest.mark.parametrize("kind", REASONS)
def test_a_bad_press_counts_little_or_nothing_and_says_why(mixed, kind):
    rows, warned, _, _ = mixed
    row = rows[kind]
    assert not row["used"] or row["weight"] < 0.15, row
    assert re.search(REASONS[kind], row["reason"]), row
    said = f"{kind}: {'' if row['used'] else 'left out: '}"
    assert [text for text in warned if text.startswith(said)] == [f"{said}{row['reason']}"]


def test_a_wrong_diameter_is_told_with_the_one_seen(mixed):
    seen = re.search(r"the ball seems ([\d.]+) mm wide, but 12 mm was given", mixed[0]["twice the diameter"]["reason"])
    assert seen and float(seen[1]) == pytest.approx(BALL_MM, rel=0.15)


def test_good_presses_among_bad_ones_are_used(mixed, good, by_good):
    rows, warned, calibration, bad = mixed
    used = [rows[name] for name in (*(press.name for press in good), "other white balance", "other exposure")]
    assert all(row["used"] and row["error_deg"] < 2.0 for row in used) and len(warned) == len(bad)
    json.dumps(calibration.report, allow_nan=False)
    angle = depth_errors(calibration, seen_by_curve, ball, "fast", HELD_OUT)[1]
    assert angle < 1.1 * depth_errors(by_good, seen_by_curve, ball, "fast", HELD_OUT)[1]


def test_lights_on_one_line_show_no_slopes_across_it():
    """Red left, green above, blue right: of a slope along y, colours do not say whether it rises or falls."""
    lights = vts.PointLights([[-25, 0, 30], [0, 0, 45], [25, 0, 30]], [900, 900, 900]).requires_grad_(False)

    def camera(scene, seed):
        return vts.scenes.render(scene, lights, noise_std=0.003, bits=8, seed=seed)[0]

    with pytest.warns(
        vts.CalibrationWarning, match=r"slopes along [89]\d degrees from x are found 0\.\d\d times as large .* one line"
    ):
        unit = vts.calibrate(background(camera), GIVEN, take_presses(camera, count=4))
    assert not unit.metric


@pytest.mark.parametrize("count, times", [(3, 1.5), *(pytest.param(*odd, marks=pytest.mark.long) for odd in ((3, 0.53), (9, 1.5)))])
def test_one_wrong_diameter_costs_no_good_press_and_hardly_moves_a_ball(rest, count, times):
    presses = take_presses(count=10)
    kept, odd = presses[:count], dataclasses.replace(presses[9], ball_diameter_mm=times * BALL_MM, name="odd")
    alone, _ = calibrated(rest, GIVEN, kept)
    calibration, warned = calibrated(rest, GIVEN, [*kept[:2], odd, *kept[2:]])
    rows = {row["name"]: row for row in calibration.report["presses"]}
    assert [name for name, row in rows.items() if row["weight"] < 0.5] == ["odd"] and rows["odd"]["weight"] < 0.1
    assert [text for text in warned if text.startswith("odd: counts 0.0") and "of a press: by the other " in text]
    assert calibration.metric and not calibration.report["not_metric"]  # the warning is no reason to doubt the depth
    for row in alone.report["presses"]:
        assert rows[row["name"]]["center_px"] == pytest.approx(row["center_px"], abs=0.5)


def test_a_prior_sees_which_of_three_diameters_is_wrong(prior):
    sensor = dataclasses.replace(GIVEN, prior=prior)
    presses = other_presses(3)
    presses[1] = dataclasses.replace(presses[1], ball_diameter_mm=1.5 * presses[1].ball_diameter_mm)
    calibration, _ = calibrated(background(seen_by_other_curve), sensor, presses)
    right, wrong, other = (row["weight"] for row in calibration.report["presses"])
    assert wrong < 0.2 and min(right, other) > 0.9


def test_only_bad_presses_are_an_error_that_names_each(rest):
    empty = [vts.Press(rest, 6.0, "first"), vts.Press(seen_by_curve(vts.scenes.undeformed(ball()), 5), 6.0)]
    for call in (lambda: vts.calibrate(rest, GIVEN, empty), lambda: fit_prior(rest, SENSOR, empty)):
        with pytest.raises(ValueError, match=r"^presses: none can be used: first: no contact.*; presses\[1\]: no contact"):
            call()


@pytest.mark.parametrize("times", [pytest.param(0.5, marks=pytest.mark.long), 1.5])
def test_two_presses_that_contradict_each_other_are_not_metric(good, rest, times):
    wrong = dataclasses.replace(good[4], ball_diameter_mm=times * BALL_MM)
    unit, _ = calibrated(rest, GIVEN, [good[0], wrong])
    assert not unit.metric and any("by each other the balls seem" in doubt for doubt in unit.report["not_metric"])


@pytest.mark.parametrize("call", [vts.calibrate, fit_prior])
def test_a_bad_image_is_refused_by_its_place(good, rest, call):
    small = dataclasses.replace(good[0], name="", image=good[0].image[:, :100])
    with pytest.raises(ValueError, match=r"^presses\[2\]: image: expected \(3, 120, 160\) .* got \(3, 100, 160\): resize it"):
        call(rest, GIVEN, [*good[:2], small])


@pytest.fixture(scope="module")
def known(good, rest):
    """The contacts of two presses whose balls are labelled."""
    places = list(zip(CENTERS_MM, DEPTHS_MM))[:2]
    labelled = [
        dataclasses.replace(press, center_px=in_px(center), contact_radius_px=math.sqrt(BALL_MM * depth - depth**2) / PITCH)
        for press, (center, depth) in zip(good, places)
    ]
    return read_contacts(labelled, rest, with_preprocessing(GIVEN, None))


def test_few_presses_move_what_a_prior_says_of_depth_by_little(known):
    family = largest(10.0)
    field = Evidence(family, known).posterior(prior_of(family, known)).field
    prior = DepthBrightness(0, 10.0, ((0.05,), (0.0,), (-0.05,)))
    free = fit_depth_brightness(known, field, PITCH).tensor()
    start = torch.nn.functional.pad(prior.tensor(), (0, 5))
    moved = (fit_depth_brightness(known, field, PITCH, prior).tensor() - start).norm()
    assert moved > 0 and moved < 0.5 * (free - start).norm()


@pytest.mark.parametrize("count", [1, 2, pytest.param(5, marks=pytest.mark.long)])
def test_what_is_no_ball_counts_little_and_by_a_single_press_nothing_is_metric(good, rest, count):
    flat = vts.Press(
        seen_by_curve(vts.scenes.surface(vts.scenes.cylinder_depth(3.0, 1.0, 6.0, 25.0, (1.0, -2.0)), *SIZE), 40),
        BALL_MM,
        "a cylinder",
    )
    unit, said = calibrated(rest, GIVEN, [*good[:count], flat])
    (named,) = (text for text in said if text.startswith("a cylinder: "))
    assert "degrees from those of a ball of any size" in named and unit.metric == (count > 1)
    assert count == 1 or unit.report["presses"][-1]["weight"] < 0.05
