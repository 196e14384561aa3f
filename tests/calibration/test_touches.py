"""Calibration from touches by unknown objects: the curl gives a field up to its scale."""

import dataclasses
import random
import types
import warnings

import pytest
import torch

import torchvts as vts
from lab import metrics, score
from torchvts.calibration.touches import BRIGHTNESS_POWER
from torchvts.model.response_field import ResponseField, ResponseModel, SensorPrior, fit_log_background

PITCH, HEIGHT, WIDTH = 0.125, 120, 160
SENSOR = vts.Sensor("touched", HEIGHT, WIDTH, PITCH, gamma=1.0)
KNOWN_LIGHTS = dataclasses.replace(SENSOR, light_position_mm=((8.0, 0.0, 9.0), (-4.0, 7.0, 9.0), (-4.0, -7.0, 9.0)))
"""The same with lights that need no fit, for what does not depend on them."""
MIX = torch.tensor([[0.35, -0.05], [-0.2, 0.3], [-0.1, -0.33]])
"""Change of R, G, B per slope: three LEDs around the skin."""


def seen(scene, noise=0.002, seed=0):
    """What a skin whose change of light is linear in its slope shows."""
    generator = torch.Generator().manual_seed(seed)
    change = torch.einsum("cs,bshw->bchw", MIX, scene.gradient.float())
    image = 0.45 * (1.0 + change)[0] + noise * torch.randn(3, HEIGHT, WIDTH, generator=generator)
    return (image.clamp(0, 1) * 255).round() / 255


def letters():
    return vts.scenes.letters_press("VTS", 0.3, height=HEIGHT, width=WIDTH, mm_per_pixel=PITCH, bevel_mm=0.7)


def ball(x_mm=0.0, y_mm=0.0, press_mm=0.5, radius_mm=6.0):
    return vts.scenes.sphere_press(radius_mm, press_mm, (x_mm, y_mm), HEIGHT, WIDTH, PITCH)


@pytest.fixture(scope="module")
def rest():
    return seen(vts.scenes.undeformed(ball()), seed=99)


@pytest.fixture(scope="module")
def touches():
    places = [(-3.0, 1.0), (4.0, -2.0), (0.5, 3.0), (-5.0, -3.0)]
    images = [seen(ball(x, y, press), seed=k) for k, ((x, y), press) in enumerate(zip(places, (0.3, 0.5, 0.4, 0.6)))]
    return [*images, seen(letters(), seed=7)]


def calibrate(*arguments, **named):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", vts.CalibrationWarning)
        return vts.calibrate(*arguments, **named)


@pytest.fixture(scope="module")
def of_known_depth(rest, touches):
    """A calibration by touches of which one has no contact and one a known depth."""
    return calibrate(rest, KNOWN_LIGHTS, touches=[vts.Touch(touches[1], 0.5, "on the stage"), rest, *touches[2:]])


def angle(calibration, scene, mode="precise"):
    out = vts.DepthPipeline.from_calibration(calibration, mode)(seen(scene, seed=50)[None])
    inside = torch.nn.functional.avg_pool2d(scene.contact.float(), 9, 1, 4) > 0.999
    return float(metrics.normal_angle_deg(out.normal, scene.normal, inside).mean())


def test_touches_and_one_press_give_the_field(rest, touches):
    calibration = calibrate(rest, SENSOR, [vts.Press(seen(ball(1.0, -1.0), seed=20), 12.0)], touches)
    assert calibration.report["model"] == "response" and any(row["model"] == "touches" for row in calibration.report["candidates"])
    assert calibration.report["reason"].split(":")[0] in (
        "from the touches and 1 press",
        "the touches, on which 1 press does not improve",
    )
    assert angle(calibration, ball(2.0, 2.0, 0.6)) < 1.5


def test_a_known_depth_gives_the_scale(of_known_depth):
    assert "the scale by 1 known depths" in of_known_depth.report["reason"]
    assert of_known_depth.report["source"] == "touches" and angle(of_known_depth, ball(2.0, 2.0, 0.6)) < 3.0


def test_the_direction_of_the_field_is_that_of_the_truth(of_known_depth):
    maps = of_known_depth.response.field.maps(HEIGHT, WIDTH, PITCH) / 0.3  # slope per relative change
    assert torch.allclose(maps, maps.mean((2, 3), keepdim=True), atol=0.02)  # as even as the skin
    product = maps.mean((2, 3)).t() @ MIX.double()  # the identity if it is the inverse
    assert torch.allclose(product / product.diagonal().mean(), torch.eye(2, dtype=torch.float64), atol=0.08)


def test_contacts_press_inward(of_known_depth, touches):
    out = vts.DepthPipeline.from_calibration(of_known_depth, "fast")(touches[0][None])
    assert float(out.depth_mm.max()) > 0.2 > -0.05 > float(out.depth_mm.min()) - 0.1


def test_with_a_prior_touches_are_not_used_and_a_warning_says_so(rest, touches):
    truth = torch.linalg.pinv(MIX.double()) * 0.3
    rows = tuple(tuple(row) for row in truth.tolist())
    response = ResponseModel(ResponseField(0, -1, 10.0, rows), None)
    prior = SensorPrior(response, fit_log_background(rest, PITCH), 10.0, "made up")
    sensor = dataclasses.replace(SENSOR, gamma=None, prior=prior)
    with pytest.warns(vts.CalibrationWarning, match="touches: not used: they add nothing to the sensor's prior"):
        calibration = vts.calibrate(rest, sensor, touches=touches)
    assert calibration.report["source"] == "prior" and calibration.response == response


def test_touches_without_a_scale_are_refused(rest, touches):
    with pytest.raises(ValueError, match=r"^touches: expected something that gives their scale.*Touch\(image, depth_mm\)"):
        calibrate(rest, KNOWN_LIGHTS, touches=touches)


def test_flat_touches_are_refused(rest):
    # slopes in one direction only: any row of the field does for them
    x = torch.linspace(-3.14, 3.14, WIDTH).clamp(-2.0, 2.0)
    ridge = types.SimpleNamespace(
        gradient=torch.stack((0.3 * torch.sin(1.57 * x), 0 * x))[None, :, None].expand(1, 2, HEIGHT, WIDTH)
    )
    with pytest.raises(ValueError, match=r"^touches: .*spread of directions"):
        calibrate(rest, KNOWN_LIGHTS, touches=[vts.Touch(seen(ridge), 0.4)])


def test_a_touch_without_contact_is_left_out(rest, touches):
    with pytest.warns(vts.CalibrationWarning, match=r"touches\[1\]: left out: no contact"):
        calibration = vts.calibrate(rest, KNOWN_LIGHTS, touches=[vts.Touch(touches[1], 0.5), rest, *touches[2:]])
    rows = calibration.report["touches"]
    assert [row["used"] for row in rows] == [True, False, True, True, True] and rows[1]["reason"].startswith("no contact")


def test_only_touches_without_contact_are_an_error(rest):
    with pytest.raises(ValueError, match=r"^touches: none can be used: .*no contact"):
        calibrate(rest, KNOWN_LIGHTS, touches=[rest])


def test_real_touches(data):
    """Presses on a GelSight Mini used as touches; one of them gives the scale."""
    sensor = vts.Sensor.load("gelsight_mini").without_prior()
    folder = vts.gs_sdk.read_calibration_folder(data / "gelsight_mini_a")
    ball = next(press for press in folder.presses if press.name == "6.310mm/14")
    others = [press.image() for press in folder.presses if press is not ball][::3][:10]
    calibration = calibrate(folder.background, sensor, [vts.Press(ball.image(), ball.ball_diameter_mm)], others)
    judged = [press for press in vts.read_presses(data / "gelsight_mini_a")[1] if press.contact_radius_px is not None]
    pipe = vts.DepthPipeline.from_calibration(calibration, "precise")
    scores = []
    for press in judged:
        out = pipe(press.image[None])
        scores.append(score.score_press(press, out.depth_mm, out.normal, sensor.mm_per_pixel).normal_deg)
    assert sum(scores) / len(scores) < 5.5


def under_stray_light(scene, seed):
    """As seen, under LEDs that fade towards the border, with light from everywhere, which does not depend on slopes."""
    x, y = vts.core.geometry.pixel_grid_mm(HEIGHT, WIDTH, PITCH)
    direct = 0.5 * torch.exp(-(x**2 + y**2) / 120.0)
    generator = torch.Generator().manual_seed(seed)
    change = torch.einsum("cs,bshw->bchw", MIX, scene.gradient.float())[0]
    image = direct * (1.0 + change) + 0.12 + 0.002 * torch.randn(3, HEIGHT, WIDTH, generator=generator)
    return (image.clamp(0, 1) * 255).round() / 255


def test_brightness_gives_the_scale_where_light_is_stray(monkeypatch):
    """The curl does not show how the scale varies over the image; where light is stray, the background's brightness does."""
    rest = under_stray_light(vts.scenes.undeformed(ball()), 99)
    places = [(-4.0, 1.0), (5.0, -2.0), (0.5, 3.0), (-6.0, -3.5), (6.0, 4.0)]
    touches = [under_stray_light(ball(x, y, 0.5), k) for k, (x, y) in enumerate(places)]
    press = vts.Press(under_stray_light(ball(0.5, -0.5), 20), 12.0)
    judged = [ball(x, y, 0.5) for x, y in ((-6.5, 3.5), (6.5, -4.0), (0.0, 0.0))]
    found = {}
    for power in (0.0, BRIGHTNESS_POWER):
        monkeypatch.setattr("torchvts.calibration.touches.BRIGHTNESS_POWER", power)
        pipe = vts.DepthPipeline.from_calibration(calibrate(rest, KNOWN_LIGHTS, [press], touches), "fast")
        found[power] = 0.0
        for k, scene in enumerate(judged):
            inside = torch.nn.functional.avg_pool2d(scene.contact.float(), 9, 1, 4) > 0.999
            normal = pipe(under_stray_light(scene, 50 + k)[None]).normal
            found[power] += float(metrics.normal_angle_deg(normal, scene.normal, inside).mean()) / len(judged)
    assert found[BRIGHTNESS_POWER] < 0.6 * found[0.0]


def test_three_presses_without_a_prior_start_as_touches(data):
    """Without a start these three gave 8.4 degrees."""
    sensor = vts.Sensor.load("gelsight_mini").without_prior()
    background, presses = vts.read_presses(data / "gelsight_mini_a")
    drawn = random.Random(0).sample(presses, 3)
    calibration = calibrate(background, sensor, [vts.Press(press.image, press.ball_diameter_mm) for press in drawn])
    assert any("field by curl" in row["model"] for row in calibration.report["candidates"])
    pipe = vts.DepthPipeline.from_calibration(calibration, "precise")
    scores = []
    for press in presses[::3]:
        if press.contact_radius_px is not None and press not in drawn:
            out = pipe(press.image[None])
            scores.append(score.score_press(press, out.depth_mm, out.normal, sensor.mm_per_pixel).normal_deg)
    assert sum(scores) / len(scores) < 5.5
