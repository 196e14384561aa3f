"""Odd backgrounds and wrong priors: a calibration ends with a unit that can be used, or with a refusal that names its cause."""

import dataclasses
import itertools
import json

import cv2
import numpy as np
import pytest
import torch
from conftest import calibrated

import torchvts as vts
from lab.prior import fit_log_background
from torchvts.calibration.doubts import of_type
from torchvts.calibration.given_images import colour_share, colour_variation
from torchvts.model.response_field import CHANGE_SCALE, ResponseField, ResponseModel, SensorPrior
from torchvts.model.summary import expected

HEIGHT, WIDTH, PITCH = 90, 120, 0.15
SENSOR = vts.Sensor("drawn", HEIGHT, WIDTH, PITCH, gamma=1.0, blur_px=1.0)
BALL_MM = 6.0
RESPONSE = 0.7 * torch.tensor([[0.5, -0.25, -0.25], [0.0, 0.43, -0.43]])
"""Slopes per change of R, G and B."""


def axes():
    return torch.meshgrid(torch.linspace(-1, 1, HEIGHT), torch.linspace(-1, 1, WIDTH), indexing="ij")


def camera(light, seed=0):
    noise = 0.003 * torch.randn(light.shape, generator=torch.Generator().manual_seed(seed))
    return torch.round((light + noise).clamp(0, 1) * 255) / 255


def jpeg(image):
    _, data = cv2.imencode(".jpg", np.ascontiguousarray((255 * image.permute(1, 2, 0).numpy()).astype(np.uint8)), [1, 70])
    return torch.from_numpy(cv2.imdecode(data, 1)).permute(2, 0, 1).float() / 255


def smooth(seed):
    """A polynomial of degree 3 per channel."""
    y, x = axes()
    terms = torch.stack([x**i * y**j for i in range(4) for j in range(4 - i)])
    weight = 0.12 * torch.randn(3, len(terms), generator=torch.Generator().manual_seed(seed))
    return (0.45 + torch.einsum("ct,thw->chw", weight, terms)).clamp(0.05, 0.95)


def odd_lights():
    """Backgrounds that no near point lights give."""
    y, x = axes()
    r2 = torch.stack([(x - 0.4 * c) ** 2 + (y + 0.3 * c) ** 2 for c in (-1, 0, 1)])
    ramp = torch.stack((0.45 + 0.3 * x, 0.45 - 0.3 * y, 0.45 - 0.2 * x - 0.2 * y))
    hill = 0.6 - 0.2 * r2.clamp_max(2.0)
    flat, dark = hill.clone(), hill.clone()
    flat[1] = 0.4
    dark[2] = 0.03
    return {
        "bright edges": 0.2 + 0.2 * r2.clamp_max(2.5),
        "saddle": 0.45 + 0.2 * torch.stack((x * y, x * x - y * y, y * y - x * x)),
        "ramps": ramp,
        "steps": torch.where(ramp > 0.45, 0.7, 0.2),
        "pale": 0.7 + 0.06 * torch.stack((x, y, -x)),
        "one channel flat": flat,
        "one channel dark": dark,
        "LED in the image": (hill + 2.0 * torch.exp(-20 * ((x - 0.9) ** 2 + y**2))[None]).clamp_max(1.0),
        **{f"smooth {seed}": smooth(seed) for seed in range(4)},
    }


ODD = odd_lights()


def press(light, center_mm, seed, turned=False):
    """A ball on a skin that shows slopes as changes of light, all linear."""
    scene = vts.scenes.sphere_press(BALL_MM / 2, 0.5, center_mm, HEIGHT, WIDTH, PITCH)
    slope = -scene.gradient[0] if turned else scene.gradient[0]
    change = CHANGE_SCALE * torch.einsum("ck,khw->chw", torch.linalg.pinv(RESPONSE), slope)
    return camera(light * (1 + change).clamp_min(0.0), seed)


CENTERS_MM = [(x, y) for x in (-4.5, 0.0, 4.5) for y in (-3.0, 3.0)]


def presses(light, turned=False):
    return [vts.Press(press(light, c, 1 + k, turned), BALL_MM, f"press {k}") for k, c in enumerate(CENTERS_MM)]


def prior(light):
    field = ResponseField(0, -1, 0.5 * WIDTH * PITCH, tuple(map(tuple, RESPONSE.tolist())))
    return SensorPrior(ResponseModel(field, None), fit_log_background(light, PITCH), 0.5 * WIDTH * PITCH, "drawn")


def other_light():
    """The light of the prior's unit, unlike itself when turned or mirrored."""
    y, x = axes()
    return torch.stack((0.45 + 0.25 * x - 0.1 * y, 0.5 - 0.15 * x * x - 0.1 * y, 0.4 + 0.2 * y - 0.1 * x * y))


SLOW = ("pale", "smooth 1", "smooth 2", "smooth 3")
"""Up to ten seconds each: lights of every kind are tried for pale ones in any case, for smooth ones where nothing else is given.
The first of the smooth ones, which is quicker, stands for the others."""

NOT_WHOLE = "one channel dark"


def odd_cases():
    """Each background as it is, two as JPEG; with a prior, presses, none or both. The slow are long, most with either too."""
    backgrounds = [*((name, False) for name in ODD), ("smooth 0", True), ("pale", True)]
    for (name, compressed), given in itertools.product(backgrounds, itertools.product((False, True), repeat=2)):
        if all(given):
            quick = name == NOT_WHOLE
        elif any(given):
            quick = name == "smooth 0" and not compressed
        else:
            quick = name not in SLOW and not compressed
        yield pytest.param(name, compressed, *given, marks=[] if quick else [pytest.mark.long])


@pytest.mark.parametrize("name, compressed, with_prior, with_presses", [*odd_cases()])
def test_an_odd_background_gives_a_unit_that_can_be_used_or_a_refusal(name, compressed, with_prior, with_presses):
    light = ODD[name]
    background = jpeg(camera(light)) if compressed else camera(light)
    sensor = dataclasses.replace(SENSOR, prior=prior(other_light()) if with_prior else None)
    try:
        calibration, _ = calibrated(background, sensor, presses(light) if with_presses else ())
    except ValueError as error:
        assert not with_presses and not with_prior, error
        assert "background: " in str(error) and ("give presses" in str(error) or "no coloured lights" in str(error))
        return
    json.dumps(calibration.report, allow_nan=False)
    assert float(calibration.defects.double().mean()) < 0.05
    with torch.inference_mode():
        out = vts.DepthPipeline.from_calibration(calibration, "fast")(press(light, (1.0, 1.0), 50)[None])
    assert all(bool(torch.isfinite(values).all()) for values in (out.depth_mm, out.normal))
    if with_presses:
        assert calibration.report["source"] == "presses"
        assert 0.35 < float(out.depth_mm.amax()) < 0.65  # 0.5


def test_a_fit_that_fails_says_so_and_has_no_figures():
    background = camera(ODD["one channel dark"] * torch.tensor([1.0, 1.0, 0.8]).reshape(3, 1, 1))
    fit = vts.fit_lights(background, SENSOR)
    if fit.failed:
        assert not fit.converged and "channel B" in fit.message
    far = vts.fit_lights(camera(ODD["bright edges"]), SENSOR)
    assert not far.converged and "falls off as under no near point light" in far.message
    assert bool(torch.isfinite(far.lights.position_mm).all())
    assert float(far.lights.position_mm.detach().norm(dim=1).max()) < 31.0 * 0.5 * WIDTH * PITCH


# a record that cannot be used


def test_a_calibration_that_cannot_be_used_is_refused_when_it_is_made(ring):
    good = vts.Calibration.from_lights(ring(), SENSOR)
    with pytest.raises(ValueError, match="background: expected finite values, got NaN or infinite"):
        dataclasses.replace(good, background=good.background * torch.nan)
    with pytest.raises(ValueError, match=r"noise_std: expected finite values above 0, got \[inf"):
        dataclasses.replace(good, noise_std=torch.full((3,), torch.inf))
    with pytest.raises(ValueError, match="lights, response: expected one of them, got none"):
        dataclasses.replace(good, lights=None)
    with pytest.raises(ValueError, match="lights, response: expected one of them, got both"):
        dataclasses.replace(good, response=ResponseModel.zero())
    with pytest.raises(ValueError, match="background: expected light above the noise, got at most 0"):
        vts.Calibration.from_response(ResponseModel.zero(), SENSOR, torch.zeros(3, HEIGHT, WIDTH))


# wrong priors


CHANGED = {
    "turned by 180 degrees": lambda image: image.flip(1, 2),
    "mirrored left to right": lambda image: image.flip(2),
    "mirrored top to bottom": lambda image: image.flip(1),
    "has its channels swapped to the order B, G, R": lambda image: image.flip(0),
    "turned by 180 degrees and has its channels swapped to the order B, G, R": lambda image: image.flip(0, 1, 2),
}


@pytest.mark.parametrize("change", CHANGED)
def test_a_turned_mirrored_or_swapped_background_is_named(change):
    sensor = dataclasses.replace(SENSOR, prior=prior(other_light()))
    image = CHANGED[change](camera(other_light()))
    _, warned = calibrated(image, sensor)
    assert any(f"it {change if change[:3] == 'has' else 'is ' + change} (" in text for text in warned), warned


def test_a_prior_on_a_background_that_is_not_its_own_is_not_metric(tmp_path):
    sensor = dataclasses.replace(SENSOR, prior=prior(other_light()))
    own, _ = calibrated(camera(other_light()), sensor)
    other, _ = calibrated(camera(other_light()).flip(1, 2), sensor)
    other.save(tmp_path / "unit.safetensors")
    kept = vts.Calibration.load(tmp_path / "unit.safetensors")
    assert own.report["not_metric"] == [] and own.metric
    assert "turned by 180 degrees" in kept.report["not_metric"][0] and not kept.metric
    assert expected(kept).startswith("depth is NOT METRIC")


@pytest.mark.parametrize("gain", [(1.0, 1.0, 1.0), (0.7, 1.2, 0.9)])
@pytest.mark.parametrize("shift_px", [(0, 0), (6, 0), (-6, 4)])
def test_another_unit_of_the_same_type_is_not_named(gain, shift_px):
    sensor = dataclasses.replace(SENSOR, prior=prior(other_light()))
    light = other_light().roll(shift_px, (2, 1))[:, 4:-4, 6:-6] + 0.02 * smooth(3)[:, 4:-4, 6:-6]
    light = torch.nn.functional.interpolate(light[None], (HEIGHT, WIDTH), mode="bilinear")[0]
    assert of_type(camera(light * torch.tensor(gain).reshape(3, 1, 1)), sensor) == []


def test_a_pattern_of_another_type_is_named():
    sensor = dataclasses.replace(SENSOR, prior=prior(other_light()))
    for name in ("smooth 1", "saddle", "bright edges", "pale"):
        assert of_type(camera(ODD[name]), sensor), name


def test_presses_that_contradict_the_prior_calibrate_without_it():
    light = ODD["smooth 1"]
    given = presses(light, turned=True)[:4]
    foreign = dataclasses.replace(SENSOR, prior=prior(other_light()))
    dropped, warned = calibrated(camera(light), foreign, given)
    assert "calibrated from 4 presses without the sensor's prior: " in dropped.report["reason"]
    assert any("calibrated from 4 presses without the sensor's prior: " in text for text in warned)
    assert all(row["used"] for row in dropped.report["presses"])
    wrong = dataclasses.replace(SENSOR, prior=prior(light))  # its background fits, its slopes have the other sign
    dropped, warned = calibrated(camera(light), wrong, given)
    assert "without the sensor's prior: by the prior " in dropped.report["reason"]


# refusals that name their cause


def white_press(center_mm, seed):
    """White light from all sides: the skin is darker where it is pressed in."""
    y, _ = axes()
    light = (0.62 + 0.02 * y).expand(3, -1, -1) * torch.tensor([0.99, 1.0, 1.005]).reshape(3, 1, 1)
    scene = vts.scenes.sphere_press(BALL_MM / 2, 0.5, center_mm, HEIGHT, WIDTH, PITCH)
    return camera(light * (1 - 0.8 * scene.depth_mm[0]), seed), camera(light, 99)


def test_white_light_is_refused_by_presses_and_by_the_background():
    given = [vts.Press(white_press(c, k)[0], BALL_MM) for k, c in enumerate(CENTERS_MM)]
    background = white_press((0, 0), 0)[1]
    no_colours = "this sensor has no coloured lights: photometric depth is not possible"
    for sensor in (SENSOR, dataclasses.replace(SENSOR, prior=prior(other_light()))):
        with pytest.raises(ValueError, match=rf"presses: expected contacts that change the colour of the skin, .*: {no_colours}"):
            calibrated(background, sensor, given)
        with pytest.raises(ValueError, match=rf"background: expected light whose colour varies .*: {no_colours}"):
            calibrated(background, sensor)
    grey = background.mean(0, keepdim=True).expand(3, -1, -1)
    with pytest.raises(ValueError, match=r"background: expected an image in colour, .* a greyscale image\?"):
        calibrated(grey, SENSOR)


def test_coloured_lights_that_are_pale_are_not_called_white():
    light = ODD["pale"]
    assert colour_variation(camera(light)) > 0.05
    assert all(colour_share(one.image, camera(light)) > 0.8 for one in presses(light))
    assert colour_share(camera(light, 1), camera(light, 2)) is None  # no contact


def test_corners_of_a_background_are_no_defects():
    """A median that counts zeros beyond the border calls them so."""
    unit = vts.Calibration.from_response(ResponseModel.zero(), SENSOR, camera(other_light()))
    assert not bool(unit.defects.any())
    dead = camera(other_light())
    dead[:, 40:42, 50:52] = 0.0
    assert int(vts.Calibration.from_response(ResponseModel.zero(), SENSOR, dead).defects.sum()) == 4
