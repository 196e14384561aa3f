"""Heights of contacts by brightness, and the pipeline that uses them where cliffs leave slopes without a say."""

import pytest
import torch

import torchvts as vts
from torchvts import gallery, metrics, scenes
from torchvts.pipeline import CliffPipeline, DepthPipeline

SIZE, PITCH = (120, 160), 0.25
RIGS = {
    "ring": [[25.0, 0.0, 30.0], [-12.5, 21.65, 30.0], [-12.5, -21.65, 30.0]],
    "turned": [[20.0, 12.0, 26.0], [-21.0, 11.0, 27.0], [2.0, -24.0, 25.0]],
}


def box(x_mm=0.0, y_mm=0.0, cos=1.0, sin=0.0, press_mm=1.0, tilt=0.0):
    def depth(x, y):
        u, v = cos * (x - x_mm) + sin * (y - y_mm), cos * (y - y_mm) - sin * (x - x_mm)
        return torch.where((u.abs() < 4) & (v.abs() < 3), press_mm + tilt * u, -1.0)

    return depth


def disc(x, y):
    return torch.where((x - 2) ** 2 + (y + 3) ** 2 < 16, 0.7 + 0.0 * x, -1.0)


STAMPS = {
    "box": box(),
    "box turned, off the middle": box(3.0, -2.0, 0.8, 0.6),
    "lower box": box(-2.0, 3.0, press_mm=0.8),
    "tilted box": box(tilt=0.1),
    "disc": disc,
}
WHOLE = {
    "ball": gallery.ball(10.0, 1.0, 1.0, 1.0),
    "deep ball": gallery.ball(6.0, 2.0, 0.0, 2.0),
    "roof": gallery.roof(1.0, 0.4, 30.0, 9.0, 0.0, 0.0),
    "stamp with flanks": gallery.stamp(3.5, 1.0, 2.0, 1.0, 1.0),
}


def lit(relief, rig="ring", noise_std=0.003, **more):
    lights = vts.PointLights(RIGS[rig], [1000.0] * 3)
    scene = scenes.surface(relief, *SIZE, PITCH)
    rest = scenes.render(scenes.at_rest(scene), lights, noise_std=noise_std, bits=8, seed=1)[0]
    calibration = vts.Calibration.from_lights(lights, vts.Sensor("rig", *SIZE, PITCH), rest)
    return scene, calibration, scenes.render(scene, lights, noise_std=noise_std, bits=8, **more)


def reconstruct(calibration, image, make=CliffPipeline.from_calibration):
    with torch.inference_mode():
        return make(calibration)(image)


def precise(calibration):
    return DepthPipeline.from_calibration(calibration, "precise")


def adaptive(calibration):
    return DepthPipeline.from_calibration(calibration, "auto", integrate=vts.AdaptiveIntegration(PITCH))


@pytest.mark.parametrize("rig", RIGS)
@pytest.mark.parametrize("name", STAMPS)
def test_a_stamp_stands_at_its_height(name, rig):
    scene, calibration, image = lit(STAMPS[name], rig)
    smooth, found = reconstruct(calibration, image, precise), reconstruct(calibration, image)
    before, after = (metrics.depth_error(out.depth_mm, scene.depth_mm, PITCH) for out in (smooth, found))
    assert after.rms_px < 0.2 * before.rms_px
    # a pixel on the wall that is taken for the wrong side is a whole wall wrong; away from the wall there is none
    wall = at_wall(scene.depth_mm)
    largest = [float((out.depth_mm - scene.depth_mm).abs()[~wall].max()) / PITCH for out in (smooth, found)]
    assert largest[1] < 0.1 * largest[0]
    assert int((found.contact ^ scene.contact).sum()) <= int((smooth.contact ^ scene.contact).sum())


def at_wall(depth_mm):
    highest = torch.nn.functional.max_pool2d(depth_mm, 3, 1, 1)
    lowest = -torch.nn.functional.max_pool2d(-depth_mm, 3, 1, 1)
    return highest - lowest > PITCH


@pytest.mark.parametrize("rig", RIGS)
@pytest.mark.parametrize("name", STAMPS)
def test_an_upright_stamp_is_right_to_its_last_pixel(name, rig):
    scene, calibration, image = lit(STAMPS[name], rig, noise_std=0.001)
    before, after = (
        metrics.depth_error(reconstruct(calibration, image, make).depth_mm, scene.depth_mm, PITCH)
        for make in (precise, CliffPipeline.from_calibration)
    )
    assert before.max_mm > 0.8 * float(scene.depth_mm.max())  # all of its height
    assert after.max_px < 0.1 * before.max_px


@pytest.mark.parametrize("name", WHOLE)
def test_what_slopes_tell_is_left_to_them(name):
    _, calibration, image = lit(WHOLE[name])
    for found, same in zip(reconstruct(calibration, image), reconstruct(calibration, image, adaptive), strict=True):
        assert torch.equal(found, same)


@pytest.mark.parametrize("gains", [(0.97, 1.0, 1.0), (0.98, 0.98, 0.98), (1.03, 1.0, 0.99)])
def test_lamps_that_have_changed_lift_nothing(gains):
    _, calibration, image = lit(WHOLE["ball"])
    changed = (image * torch.tensor(gains).reshape(3, 1, 1)).clamp_max(1.0)
    found, same = reconstruct(calibration, changed), reconstruct(calibration, changed, adaptive)
    assert torch.equal(found.depth_mm, same.depth_mm)


@pytest.mark.parametrize("rig", RIGS)
def test_heights_come_with_honest_deviations(rig):
    scores = []
    for seed in range(6):
        scene, calibration, image = lit(box(1.5 * seed - 4, 2.0 - seed, press_mm=0.3 + 0.2 * seed), rig, seed=10 + seed)
        pipe = precise(calibration)
        with torch.inference_mode():
            seen = pipe.compensate(image)
            up = vts.normal_from_gradient(torch.zeros_like(scene.gradient))
            told = vts.HeightFromBrightness.from_calibration(calibration)(seen, up, 0 * scene.depth_mm, scene.contact)
        inside = scene.contact & torch.isfinite(told.lift_std_mm)
        assert bool(inside.any())
        miss = (told.lift_mm - scene.depth_mm)[inside].mean() / told.lift_std_mm[inside].mean()
        scores.append(abs(float(miss)))
        assert float(told.lift_std_mm[inside].mean()) < 0.2
    assert max(scores) < 3.0


def test_frames_of_a_batch_do_not_influence_one_another():
    _, calibration, stamp = lit(box())
    ball = lit(WHOLE["ball"])[2]
    rest = lit(lambda x, y: -1.0 + 0.0 * x)[2]
    frames = torch.cat((stamp, rest, ball))
    whole = reconstruct(calibration, frames)
    for k in range(3):
        for one, several in zip(reconstruct(calibration, frames[k : k + 1]), whole, strict=True):
            assert torch.allclose(one[0].double(), several[k].double(), atol=1e-5)
    assert not whole.contact[1].any()


def test_gradients_go_through_where_brightness_decides():
    _, calibration, image = lit(box(tilt=0.1))
    image.requires_grad_(True)
    depth = CliffPipeline.from_calibration(calibration)(image).depth_mm
    assert float(depth.detach().max()) > 0.9
    (slope,) = torch.autograd.grad(depth.square().sum(), image)
    assert bool(torch.isfinite(slope).all()) and bool((slope != 0).any())


def test_tacto_keeps_what_its_slopes_tell(data):
    folder = data / "tacto" / "orthographic"
    sensor = vts.Sensor.load("tacto")
    calibration = vts.calibrate(vts.read_image(folder / "background.png"), sensor)
    heights, pipe = vts.HeightFromBrightness.from_calibration(calibration), precise(calibration)
    for name in ("sphere_R10_d2", "sphere_R5_d1_off"):
        image = vts.read_image(folder / f"{name}.png")[None]
        with torch.inference_mode():
            out = pipe(image)
            told = heights(pipe.compensate(image), out.normal, out.depth_mm, out.contact)
        lift = told.lift_mm[torch.isfinite(told.lift_std_mm)]
        assert lift.abs().max() < 0.1  # spheres of 2 mm and 1 mm, by brightness alone


def test_depths_known_from_elsewhere_say_how_high_a_contact_stands():
    scene = scenes.surface(box(tilt=0.1), *SIZE, PITCH, torch.float64)
    told = scene.depth_mm + 0.2
    depth = vts.integrate_cliffs(scene.gradient, PITCH, scene.contact, None, told, scene.contact.double())
    assert (depth - told)[scene.contact].abs().max() < 0.02
    assert depth[~scene.contact].abs().max() == 0
    without = vts.integrate_cliffs(scene.gradient, PITCH, scene.contact, None, told, torch.zeros_like(told))
    assert torch.equal(without, vts.integrate_cliffs(scene.gradient, PITCH, scene.contact))
    with pytest.raises(ValueError, match=r"known_mm, known_weight: expected both or neither"):
        vts.integrate_cliffs(scene.gradient, PITCH, known_mm=told)


def test_gradients_go_through_with_depths_known():
    gradient = torch.zeros(1, 2, 9, 10, dtype=torch.float64)
    gradient[:, :, 2:7, 2:8] = 0.1 * torch.rand(1, 2, 5, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    gradient.requires_grad_(True)
    contact = gradient.detach()[:, :1] != 0
    known, weight = torch.full((1, 1, 9, 10), 0.5, dtype=torch.float64), contact.double()
    solver = vts.CliffIntegration(1.0, max_passes=1, residual=1e-12, max_iterations=500)
    depth = solver.solve(gradient, contact, None, known, weight).depth_mm
    (slope,) = torch.autograd.grad(depth[0, 0, 4, 5], gradient)
    assert torch.isfinite(slope).all() and float(slope.abs().max()) > 0.01
