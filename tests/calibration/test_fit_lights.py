"""Point lights from one background: the fit, its stated uncertainty, and the choice of a model."""

import dataclasses
import functools
import json

import numpy as np
import pytest
import references
import torch
from conftest import calibrated

import torchvts as vts
from torchvts.calibration import by_lights
from torchvts.calibration.background import BackgroundPixels, paraboloid_start
from torchvts.calibration.levenberg import LevenbergMarquardt

scenes = vts.scenes
LOW = {"radius_mm": 22.0, "height_mm": [15.0, 16.5, 18.0], "level": 0.2}


def rest(lights, sensor, **camera):
    return scenes.render(
        scenes.undeformed(scenes.sphere_press(10, 1, (0, 0), sensor.height, sensor.width, sensor.mm_per_pixel)), lights, **camera
    )[0]


def angle_deg(one, two):
    return torch.rad2deg(torch.atan2(torch.linalg.cross(one, two, dim=1).norm(dim=1), (one * two).sum(1)))


def furthest_mm(one, two):
    return float((one.position_mm - two.position_mm).detach().abs().max())


@pytest.fixture(scope="module")
def low_rig(ring):
    return ring(**LOW)


@pytest.fixture(scope="module")
def small_background(low_rig, small_sensor):
    return rest(low_rig, small_sensor, noise_std=0.01, bits=8)


@pytest.fixture(scope="module")
def small_fit(small_background, small_sensor):
    return vts.fit_lights(small_background, small_sensor)


def test_low_lights_of_a_worn_unit(low_rig):
    sensor = vts.Sensor("rig", 240, 320, 0.125)
    fit = vts.fit_lights(rest(low_rig, sensor, noise_std=0.01, bits=8, spots=scenes.skin_spots(240, 320), seed=1), sensor)
    assert fit.converged
    assert furthest_mm(fit.lights, low_rig) < 0.04  # the aim is 0.1
    assert float((fit.lights.albedo.detach() / low_rig.albedo - 1).abs().max()) < 0.002


def test_the_stated_spread_is_the_true_one(low_rig, small_sensor):
    """Errors over stated standard deviations, of 24 directions and 72 coordinates."""
    directions, positions = [], []
    for seed in range(8):
        fit = vts.fit_lights(rest(low_rig, small_sensor, noise_std=0.01, bits=8, seed=seed), small_sensor)
        directions.append(angle_deg(fit.lights.direction.detach().double(), low_rig.direction.double()) / fit.direction_std_deg)
        positions.append((fit.lights.position_mm.detach() - low_rig.position_mm).double() / fit.position_std_mm)
    for score in (torch.stack(directions), torch.stack(positions)):
        assert 0.5 < float(score.square().mean().sqrt()) < 2.0


def random_start(seed):
    """Anywhere within 30 mm of the centre, 5 to 50 mm high, albedo within a factor of four."""
    draw = torch.rand(3, 4, generator=torch.Generator().manual_seed(seed))
    position = torch.stack((60 * draw[:, 0] - 30, 60 * draw[:, 1] - 30, 5 + 45 * draw[:, 2]), dim=1)
    return vts.PointLights(position, 200.0 * 4 ** (2 * draw[:, 3] - 1))


@pytest.fixture(scope="module")
def tiny(low_rig):
    sensor = vts.Sensor("rig", 48, 64, 0.625)
    background = rest(low_rig, sensor, noise_std=0.003, bits=8)
    return sensor, background, vts.fit_lights(background, sensor)


@pytest.mark.parametrize("seed", range(5))
def test_a_random_start_ends_at_the_same_lights_or_says_that_it_did_not(tiny, seed):
    sensor, background, reference = tiny
    fit = vts.fit_lights(background, sensor, start=random_start(seed))
    assert not fit.converged or furthest_mm(fit.lights, reference.lights) < 0.05


def test_the_closed_form_start_converges_within_twenty_steps(small_fit):
    assert small_fit.converged and len(small_fit.loss_history) <= 20
    assert small_fit.message.startswith("converged in ")
    assert small_fit.loss_history[-1] <= small_fit.loss_history[0]


def test_too_few_steps_are_reported_with_the_remedy(small_background, small_sensor, ring):
    fit = vts.fit_lights(small_background, small_sensor, start=ring(10.0, 30.0, 200.0), max_steps=1)
    assert not fit.converged and len(fit.loss_history) <= 2  # one on a coarse choice of pixels, one on all
    assert "stopped at 1 steps" in fit.message and "raise max_steps" in fit.message


def test_gloss_is_found_on_a_glossy_skin_and_named(ring, small_sensor):
    """A matt skin under a camera whose black is 0.3 grey levels above 0 looks the same, and depth differs by a tenth."""
    gloss = [0.2, 0.3, 0.25]
    lights = ring(22.0, [15.0, 16.5, 18.0], level=0.2, gloss=gloss)
    with pytest.warns(vts.CalibrationWarning, match="gloss of 0.3.*one image cannot tell"):
        unit = vts.calibrate(rest(lights, small_sensor, noise_std=0.003, bits=8), small_sensor)
    assert unit.lights.gloss.tolist() == pytest.approx(gloss, abs=0.05) and furthest_mm(unit.lights, lights) < 0.3
    assert unit.lights.glossy and unit.metric


@pytest.mark.parametrize("camera", [{"vignetting": 0.2}, pytest.param({}, marks=pytest.mark.long)])
def test_gloss_is_not_invented_on_a_matt_skin(low_rig, small_sensor, camera):
    fit = vts.fit_lights(rest(low_rig, small_sensor, noise_std=0.003, **camera), small_sensor)
    assert fit.lights.gloss.tolist() == [0.0, 0.0, 0.0]


def test_vignetting_widens_the_stated_spread(low_rig, small_sensor):
    clean, dim = (vts.fit_lights(rest(low_rig, small_sensor, noise_std=0.003, vignetting=v), small_sensor) for v in (0.0, 0.2))
    assert bool((dim.direction_std_deg > 10 * clean.direction_std_deg).all()) and bool((dim.misfit > 0.01).all())
    error = angle_deg(dim.lights.direction.detach().double(), low_rig.direction.double())
    assert bool((error < 3 * dim.direction_std_deg).all())


def test_the_response_of_the_camera_is_part_of_the_model(ring, small_sensor):
    lights = ring()
    image = rest(lights, small_sensor, noise_std=0.003, bits=8, gamma=2.2)
    fit = vts.fit_lights(image, vts.Sensor("rig", 120, 160, 0.25, gamma=2.2))
    assert fit.converged and furthest_mm(fit.lights, lights) < 0.3


def seen(scene, lights, vignetting=0.0, ambient=0.0, gamma=1.0, noise_std=0.003, bits=8):
    """A camera with ambient light, which is added to what the lens lets through."""
    light = scenes.render(scene, lights, vignetting=vignetting) + ambient
    image = light ** (1.0 / gamma) + noise_std * torch.randn(light.shape, generator=torch.Generator().manual_seed(3))
    levels = 2**bits - 1
    return torch.round(image.clamp(0, 1) * levels) / levels


def largest_px(calibration, lights, **camera):
    """Largest error of depth of a ball pressed by 1 mm, in pixels."""
    scene = scenes.sphere_press(10.0, 1.0, (0, 0), 120, 160, 0.25)
    with torch.inference_mode():
        out = vts.DepthPipeline.from_calibration(calibration, "precise")(seen(scene, lights, **camera))
    return float((out.depth_mm - scene.depth_mm).abs().max()) / 0.25


@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_the_camera_is_found_and_the_depth_does_not_feel_it(low_rig, small_sensor, gamma):
    flat = scenes.undeformed(scenes.sphere_press(10, 1, (0, 0), 120, 160, 0.25))
    calibration = vts.calibrate(seen(flat, low_rig, gamma=gamma)[0], small_sensor)  # a warning is an error
    report = calibration.report
    assert report["model"] == "point_lights" and calibration.sensor.gamma == gamma and not calibration.lights.glossy
    assert furthest_mm(calibration.lights, low_rig) < 0.1
    assert largest_px(calibration, low_rig, gamma=gamma) < 0.3
    assert json.loads(json.dumps(report)) == report


@pytest.mark.parametrize("camera", [{"vignetting": 0.05}, pytest.param({"ambient": 0.1}, marks=pytest.mark.long)])
def test_what_lights_do_not_explain_is_said(low_rig, small_sensor, camera):
    """The fit is of lights alone: a lens that darkens the corners, or stray light, leaves a misfit, and depth is not metric."""
    flat = scenes.undeformed(scenes.sphere_press(10, 1, (0, 0), 120, 160, 0.25))
    unit, warned = calibrated(seen(flat, low_rig, **camera)[0], small_sensor)
    assert any("the lights leave a smooth misfit of" in text for text in warned)
    assert not unit.metric and max(unit.report["misfit"]) > 0.008 and "misfit of" in unit.report["reason"]


def test_ambient_light_survives_the_file(tmp_path, low_rig, small_sensor):
    flat = scenes.undeformed(scenes.sphere_press(10, 1, (0, 0), 120, 160, 0.25))
    image, ambient = seen(flat, low_rig, ambient=0.1)[0], torch.tensor([0.09, 0.1, 0.11])
    calibration = vts.Calibration.from_lights(low_rig, small_sensor, image, ambient=ambient)
    calibration.save(tmp_path / "unit.safetensors")
    loaded = vts.Calibration.load(tmp_path / "unit.safetensors")
    assert torch.equal(loaded.ambient, calibration.ambient) and torch.equal(loaded.offset, calibration.offset)
    rested = vts.Compensate.from_calibration(loaded)(seen(flat, low_rig, ambient=0.1))
    assert float((rested[0] - loaded.flat).abs().max()) < 1e-5


TACTO_MM = torch.tensor([[-17.3205, -10.0, 17.0], [17.3205, -10.0, 17.0], [0.0, 20.0, 17.0]])  # manifest.json, v up


@pytest.mark.parametrize("binning", [4, pytest.param(1, marks=pytest.mark.long)])
def test_tacto(data, binning):
    folder = data / "tacto" / "orthographic"
    background = torch.nn.functional.avg_pool2d(vts.read_image(folder / "background.png"), binning)
    fit = vts.fit_lights(background, vts.Sensor.load("tacto", height=480 // binning, width=640 // binning))
    stated = json.loads((folder / "manifest.json").read_text())["lights"]
    pixels = torch.tensor([light["position_px_col_row_height"] for light in stated])
    truth = (pixels - torch.tensor([319.5, 239.5, 0.0])) * 0.0625
    assert torch.allclose(truth, TACTO_MM, atol=1e-3)
    assert fit.converged and float((fit.lights.position_mm.detach() - truth).abs().max()) < 0.5


@pytest.mark.parametrize("unit", ["gelsight_mini_b", pytest.param("gelsight_mini_a", marks=pytest.mark.long)])
def test_a_real_sensor_does_not_pin_point_lights_and_says_so(data, unit):
    background = torch.nn.functional.avg_pool2d(vts.read_image(data / unit / "background.png"), 2)
    sensor = dataclasses.replace(vts.Sensor.load("gelsight_mini", height=120, width=160), prior=None)
    fit = vts.fit_lights(background, sensor)
    assert float(fit.direction_std_deg.max()) > 5.0
    assert not fit.converged or "calibrate with presses or known lights" in fit.message
    with pytest.warns(vts.CalibrationWarning, match="background: "):
        vts.calibrate(background, sensor)


def test_a_clean_background_warns_of_nothing(small_background, small_sensor):
    calibration = vts.calibrate(small_background, small_sensor)  # a warning is an error
    assert calibration.report["converged"] is True and calibration.report["source"] == "background"
    assert json.loads(json.dumps(calibration.report)) == calibration.report
    assert calibration.metric and calibration.report["doubts"] == []


@pytest.mark.parametrize("press_mm, center_mm", [(1.0, (0, 0)), (0.5, (8, 5))])
def test_contact_in_the_background_is_noticed(low_rig, small_sensor, press_mm, center_mm, tmp_path):
    scene = scenes.sphere_press(10.0, press_mm, center_mm, 120, 160, 0.25)
    image = scenes.render(scene, low_rig, noise_std=0.005, bits=8)[0]
    with pytest.warns(vts.CalibrationWarning, match=r"background: .*% of the image differs .* contact in the calibration image\?"):
        calibration = vts.calibrate(image, small_sensor)
    calibration.save(tmp_path / "unit.safetensors")
    kept = vts.Calibration.load(tmp_path / "unit.safetensors")
    assert not kept.metric and any("contact in the calibration image?" in doubt for doubt in kept.report["not_metric"])


def test_lights_that_did_not_converge_are_not_metric(small_background, small_sensor, monkeypatch):
    monkeypatch.setattr(by_lights, "fit_lights", functools.partial(by_lights.fit_lights, max_steps=3))
    with pytest.warns(vts.CalibrationWarning, match="stopped at 3 steps"):
        calibration = vts.calibrate(small_background, small_sensor)
    assert not calibration.metric and "stopped at 3 steps" in calibration.report["not_metric"][0]


def test_saturated_spots_under_low_lights_are_not_taken_for_contact(ring, small_sensor):
    lights = ring(22.0, [15.0, 16.5, 18.0], level=0.45)
    image = rest(lights, small_sensor, noise_std=0.005, bits=8)
    assert 0.02 < float((image > 0.995).float().mean()) < 0.2
    calibration = vts.calibrate(image, small_sensor)  # a warning is an error
    assert furthest_mm(calibration.lights, lights) < 0.1


def test_lights_that_the_sensor_file_gives_keep_their_place(low_rig, small_background):
    known = tuple(map(tuple, low_rig.position_mm.tolist()))
    sensor = vts.Sensor("rig", 120, 160, 0.25, light_position_mm=known)
    with pytest.warns(vts.CalibrationWarning, match="given by the sensor file; .* nothing has measured this unit's own"):
        calibration = vts.calibrate(small_background, sensor)
    assert torch.equal(calibration.lights.position_mm, torch.tensor(known)) and not calibration.metric
    assert float((calibration.lights.albedo / low_rig.albedo - 1).abs().max()) < 0.002
    assert calibration.report["source"] == "sensor_file"


def test_a_fit_keeps_the_dtype_of_the_image(tiny):
    sensor, background, _ = tiny
    assert vts.fit_lights(background.double(), sensor).lights.position_mm.dtype == torch.float64


def derived(residual):
    """Residuals and their derivatives by forward mode, of a function of independent rows."""

    def linearised(values):
        values = values.detach()
        along = torch.eye(values.shape[1], dtype=values.dtype)
        columns = [torch.func.jvp(residual, (values,), (axis.expand(values.shape),))[1] for axis in along]
        return residual(values), torch.stack(columns, 1)

    return linearised


def test_levenberg_marquardt_solves_independent_problems():
    """Rosenbrock's valley twice, from its usual start and from another."""
    parameter = torch.tensor([[-1.2, 1.0], [2.0, -3.0]], dtype=torch.float64, requires_grad=True)
    optimiser = LevenbergMarquardt(parameter)

    def residual(values):
        return torch.stack((10 * (values[:, 1] - values[:, 0] ** 2), 1 - values[:, 0]), dim=1)

    losses = torch.stack([optimiser.step(residual, derived(residual)) for _ in range(40)])
    assert torch.allclose(parameter.detach(), torch.ones(2, 2, dtype=torch.float64), atol=1e-10)
    assert losses[0, 0] == pytest.approx(0.5 * (4.4**2 + 2.2**2))
    assert bool((losses[1:] <= losses[:-1]).all()), "a step that would raise the loss is not taken"


def test_levenberg_marquardt_weighs_residuals():
    target, weight = torch.tensor([[1.0, 2.0, 9.0]], dtype=torch.float64), torch.tensor([[3.0, 1.0, 0.0]], dtype=torch.float64)
    parameter = torch.zeros(1, 1, dtype=torch.float64, requires_grad=True)
    optimiser = LevenbergMarquardt(parameter)
    for _ in range(20):
        optimiser.step(lambda values: values - target, derived(lambda values: values - target), weight)
    assert parameter.item() == pytest.approx(1.25, abs=1e-10)


def test_levenberg_marquardt_survives_a_flat_direction_and_infinite_residuals():
    parameter = torch.tensor([[5.0, 3.0]], dtype=torch.float64, requires_grad=True)
    optimiser = LevenbergMarquardt(parameter)

    def residual(values):
        return torch.log(values[:, :1])  # not a number left of zero, where the first step would go

    for _ in range(60):
        optimiser.step(residual, derived(residual))
    assert parameter[0, 0].item() == pytest.approx(1.0, abs=1e-8) and parameter[0, 1].item() == 3.0


def test_a_faint_lobe_is_decided_on_all_pixels():
    """On the few pixels of the first loop both misfits are rough: the lobe of a dim rig was dropped there, lights 0.48 mm off."""
    angle = np.radians(np.array([20.0, 140.0, 260.0]))
    lights = np.stack([30.0 * np.cos(angle), 30.0 * np.sin(angle), np.full(3, 25.0)], axis=1)
    up = np.broadcast_to(np.array([0.0, 0.0, 1.0])[:, None, None], (3, 120, 160))
    light = references.metallic_roughness_image(np.zeros((120, 160)), up, lights, np.ones(3), 0.25)
    background = torch.from_numpy(np.round(255 * (0.08 * light / light[:, 60:61, 80:81]) ** (1 / 2.2)) / 255).float()
    fit = vts.fit_lights(background, vts.Sensor("rendered", 120, 160, 0.25, gamma=2.2))
    assert bool((fit.lights.gloss > 0.05).all())
    assert float((fit.lights.position_mm.detach() - torch.from_numpy(lights)).norm(dim=1).max()) < 0.1


@pytest.mark.parametrize("gloss", [None, 0.1, 0.0, -0.05, 2.0])
def test_the_derivatives_of_a_background_are_those_of_its_model(tiny, gloss):
    pixels = BackgroundPixels.of(tiny[1].double(), tiny[0])
    parameter = paraboloid_start(pixels)
    if gloss is not None:
        parameter = torch.cat((parameter, torch.full((3, 1), gloss, dtype=torch.float64)), dim=1)
    found, expected = pixels.linearised(parameter), derived(pixels.residual)(parameter)
    assert torch.equal(found[0], expected[0])
    assert (found[1] - expected[1]).abs().max() <= 1e-12 * expected[1].abs().max()


def test_a_channel_that_is_black_in_half_of_the_background_is_named(small_background, small_sensor):
    dark = small_background.clone()
    dark[2, :, : dark.shape[2] * 6 // 10] = 0.0
    with pytest.raises(ValueError, match="expected light in channel B, got one that is black in 60% of the image"):
        vts.calibrate(dark, small_sensor)
