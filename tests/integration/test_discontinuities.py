"""Integration across cliffs, its test for them, contact at the image border, and pinhole cameras."""

import math
from itertools import pairwise

import numpy as np
import pytest
import references
import torch
from torch import nn

import torchvts as vts
from lab import metrics
from torchvts import scenes
from torchvts.integration import PerspectiveIntegration, discontinuities, integrate_perspective
from torchvts.integration.discontinuities import across_walls, discontinuity_share
from torchvts.normals import NormalFromIntensity

SIZE, PITCH = (120, 160), 0.25


def prism(profile, length_mm=12.0, angle_deg=20.0):
    """A ridge of the given profile across, cut off vertically at both ends."""

    def depth(x, y):
        angle = math.radians(angle_deg)
        along, across = x * math.cos(angle) + y * math.sin(angle), y * math.cos(angle) - x * math.sin(angle)
        return torch.where(along.abs() < 0.5 * length_mm, profile(across), -1.0)

    return depth


@pytest.mark.filterwarnings("ignore:background. it fits a skin with a gloss")
@pytest.mark.parametrize(
    "name, largest_rms_px", [("cube_edge_d1", 0.2), pytest.param("cylinder_R4_d1", 0.35, marks=pytest.mark.long)]
)
def test_walls_in_a_pipeline(data, name, largest_rms_px):
    """The weight of slopes reaches beyond a wall: the ring that it adds once made the ends worse, 0.80 -> 1.36 px."""
    folder, sensor = data / "tacto" / "orthographic", vts.Sensor.load("tacto", height=240, width=320)
    rest, image = (nn.functional.avg_pool2d(vts.read_image(folder / f"{which}.png"), 2) for which in ("background", name))
    calibration = vts.calibrate(rest, sensor)
    truth_px = torch.from_numpy(np.load(folder / f"{name}_depth.npz")["depth_px"])[None]
    truth_px = 0.5 * nn.functional.avg_pool2d(truth_px, 2)[0]
    plain, adaptive = (
        vts.DepthPipeline.from_calibration(calibration, "fast", **more)(image[None]).depth_mm
        for more in ({}, {"integrate": vts.AdaptiveIntegration(sensor.mm_per_pixel)})
    )
    rms_px = [float((depth[0, 0] / sensor.mm_per_pixel - truth_px).square().mean().sqrt()) for depth in (plain, adaptive)]
    assert rms_px[1] < min(largest_rms_px, 0.5 * rms_px[0]), rms_px


CLIFFS = {
    "wedge": prism(lambda t: 3.0 - t.abs()),
    "flat wedge": prism(lambda t: 1.5 - 0.5 * t.abs(), 16.0, -65.0),
    "cylinder": prism(lambda t: torch.sqrt((36.0 - t**2).clamp_min(1e-9)) - 4.5),
}
SMOOTH = {
    "sphere": lambda: scenes.sphere_press(10.0, 2.0, (0, 0), *SIZE, PITCH, torch.float64),
    "sphere cut by the border": lambda: scenes.sphere_press(10.0, 1.0, (19.0, -13.0), *SIZE, PITCH, torch.float64),
    "sine": lambda: scenes.surface(scenes.sine_depth(0.2, 4.0, 9.0), *SIZE, PITCH, torch.float64),
    "capsule": lambda: scenes.surface(scenes.cylinder_depth(), height=120, width=160, mm_per_pixel=PITCH, dtype=torch.float64),
    "cone": lambda: scenes.surface(scenes.cone_depth(), height=120, width=160, mm_per_pixel=PITCH, dtype=torch.float64),
}
every_cliff = pytest.mark.parametrize("name", CLIFFS)
every_smooth = pytest.mark.parametrize("name", SMOOTH)


def cliff(name):
    return scenes.surface(CLIFFS[name], *SIZE, PITCH, torch.float64)


def noisy(scene, std=0.02, seed=0):
    noise = torch.randn(scene.gradient.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return scene.gradient + std * noise * scene.contact


def integrate(gradient):
    """With walls in every frame."""
    return PITCH * across_walls(gradient)


def largest_px(depth, scene):
    return metrics.depth_error(depth, scene.depth_mm, PITCH).max_px


@every_cliff
@pytest.mark.parametrize("std", [0.02, *(pytest.param(std, marks=pytest.mark.long) for std in (0.0, 0.05))])
def test_a_cliff_costs_at_most_a_tenth_of_poissons_error(name, std):
    scene = cliff(name)
    gradient = noisy(scene, std)
    assert largest_px(vts.AdaptiveIntegration(PITCH)(gradient), scene) < 0.1 * largest_px(
        vts.poisson_background(gradient, PITCH), scene
    )


@every_smooth
@pytest.mark.parametrize("std", [0.02, pytest.param(0.0, marks=pytest.mark.long)])
def test_smooth_presses_lose_nothing(name, std):
    scene = SMOOTH[name]()
    gradient = noisy(scene, std)
    smooth, robust = vts.poisson_background(gradient, PITCH), integrate(gradient)
    errors = [metrics.depth_error(depth, scene.depth_mm, PITCH) for depth in (smooth, robust)]
    assert errors[1].rms_px < 1.15 * errors[0].rms_px
    assert errors[1].max_px < 1.25 * errors[0].max_px


@pytest.mark.parametrize("noise_std", [pytest.param(0.002, marks=pytest.mark.long), 0.01])
def test_a_wedge_from_an_image_of_eight_bits(noise_std, ring):
    scene = scenes.surface(CLIFFS["wedge"], *SIZE, PITCH)
    rest = scenes.render(scenes.undeformed(scene), ring(), noise_std=noise_std, bits=8, seed=1)[0]
    calibration = vts.Calibration.from_lights(ring(), vts.Sensor("rig", *SIZE, PITCH), rest)
    image = scenes.render(scene, ring(), noise_std=noise_std, bits=8)
    error = {}
    for block in (None, vts.AdaptiveIntegration(PITCH)):
        pipe = vts.DepthPipeline.from_calibration(calibration, "precise", integrate=block)
        error[type(block)] = largest_px(pipe(image).depth_mm, scene)
    assert error[vts.AdaptiveIntegration] < error[type(None)] / 3


def test_it_equals_dense_weighted_least_squares_at_its_own_weights(monkeypatch):
    for name, value in (("PASSES", 100), ("SETTLED_PX", 1e-7), ("RESIDUAL", 1e-9)):
        monkeypatch.setattr(discontinuities, name, value)
    scene = scenes.surface(prism(lambda t: 2.0 - t.abs(), 5.0, 0.0), 15, 18, 0.5, torch.float64)
    gradient = noisy(scene)
    depth = 0.5 * across_walls(gradient)
    twin = references.cliffs(gradient[0].numpy(), scene.contact[0, 0].numpy(), 0.5, 0.05, 2.0, 0.1, depth[0, 0].numpy())
    assert np.abs(depth[0, 0].numpy() - twin).max() < 1e-6


@every_cliff
def test_depth_is_zero_on_undeformed_skin(name):
    scene = cliff(name)
    depth = integrate(noisy(scene))
    beside = nn.functional.max_pool2d(scene.contact.float(), 5, 1, 2) == 0
    assert depth[beside].abs().max() == 0


def test_no_contact_and_all_contact():
    assert integrate(torch.zeros(1, 2, 9, 12)).abs().max() == 0
    tilt = torch.full((1, 2, 9, 12), 0.1, dtype=torch.float64)
    assert (integrate(tilt) - vts.poisson_background(tilt, PITCH)).abs().max() < 1e-3


def test_a_flipped_image_gives_flipped_depth():
    gradient = noisy(cliff("wedge"))
    flipped = -gradient.flip(2, 3)
    difference = integrate(flipped) - integrate(gradient).flip(2, 3)
    assert difference.abs().max() < 0.05 * PITCH


def test_a_gradient_flows_back_with_the_weights_held(monkeypatch):
    gradient = noisy(cliff("wedge")).requires_grad_()
    depth = vts.AdaptiveIntegration(PITCH)(gradient)
    (slope,) = torch.autograd.grad((depth * torch.sin(torch.arange(160.0, dtype=torch.float64))).sum(), gradient)
    assert bool(torch.isfinite(slope).all()) and slope.abs().max() > 0
    # with weights held, depth is linear in the gradient: its product with the derivative is the depth itself
    monkeypatch.setattr(discontinuities, "RESIDUAL", 1e-9)
    depth = integrate(gradient)
    (along,) = torch.autograd.grad(depth.sum(), gradient)
    assert float((along * gradient.detach()).sum()) == pytest.approx(float(depth.detach().sum()), rel=1e-6)


@every_smooth
@pytest.mark.parametrize("std", [0.0, 0.04])
def test_the_sign_of_cliffs_is_silent_on_smooth_presses(name, std):
    gradient = noisy(SMOOTH[name](), std)
    assert float(discontinuity_share(gradient, vts.poisson_background(gradient, PITCH), PITCH)) < 0.0005


@every_cliff
@pytest.mark.parametrize("std", [0.0, 0.04])
def test_the_sign_of_cliffs_fires_on_cliffs(name, std):
    gradient = noisy(cliff(name), std)
    assert float(discontinuity_share(gradient, vts.poisson_background(gradient, PITCH), PITCH)) > 0.003


def test_adaptive_integration_is_poisson_on_smooth_frames_and_robust_on_others():
    smooth, frames = SMOOTH["sphere"]().gradient, [cliff(name).gradient for name in CLIFFS]
    depth = vts.AdaptiveIntegration(PITCH)(torch.cat((smooth, *frames)))
    assert (depth[:1] - vts.poisson_background(smooth, PITCH)).abs().max() < 1e-12
    assert torch.equal(depth[1:], torch.cat([integrate(frame) for frame in frames]))


def smooth_hill(x, y):
    """Not zero anywhere, tilted, no symmetry."""
    return 2.0 + 0.8 * torch.exp(-((x - 3) ** 2 + (y + 2) ** 2) / 30) + 0.03 * x - 0.02 * y + 0.2 * torch.sin(0.4 * x + 0.2 * y)


def test_perspective_integration_has_order_two():
    errors = []
    for n in (32, 64, 128):
        scene = scenes.surface(smooth_hill, n, n, 24.0 / n, torch.float64, camera_height_mm=30.0)
        error = integrate_perspective(scene.gradient, 24.0 / n, 30.0)
        # the level of depth is not in the gradient: compare in log distance, where it is an added constant
        error = torch.log(30.0 - error) - torch.log(30.0 - scene.depth_mm)
        errors.append(float((error - error.mean()).square().mean().sqrt()))
    for coarse, fine in pairwise(errors):
        assert math.log2(coarse / fine) == pytest.approx(2.0, abs=0.15)


@pytest.mark.parametrize(
    "camera_height_mm, center_mm", [(26.0, (8.0, -5.0)), pytest.param(40.0, (0.0, 0.0), marks=pytest.mark.long)]
)
def test_a_pinhole_is_as_good_as_an_orthographic_camera(camera_height_mm, center_mm, ring):
    """From the image: 0.2 px where the orthographic chain errs by 1.3 to 5 px."""
    scene = scenes.sphere_press(10.0, 2.0, center_mm, 240, 320, 0.125, camera_height_mm=camera_height_mm)
    calibration = vts.Calibration.from_lights(ring(), vts.Sensor("rig", 240, 320, 0.125))
    image = scenes.render(scene, ring())
    normals = NormalFromIntensity.from_calibration(calibration, camera_height_mm)
    through = PerspectiveIntegration(0.125, camera_height_mm)
    right = vts.DepthPipeline.from_calibration(calibration, "precise", normals=normals, integrate=through)(image)
    wrong = vts.DepthPipeline.from_calibration(calibration, "precise")(image)
    error = [metrics.depth_error(out.depth_mm, scene.depth_mm, 0.125).max_px for out in (right, wrong)]
    assert error[0] < 0.3 and error[0] < error[1] / 3


def test_a_surface_that_hides_parts_of_itself_from_a_pinhole_is_refused():
    with pytest.raises(ValueError, match="camera_height_mm: the points seen from 15 mm were not found"):
        scenes.surface(lambda x, y: 4.0 * torch.exp(-((x - 10.0) ** 2 + y**2)), *SIZE, PITCH, camera_height_mm=15.0)


def test_perspective_derivatives():
    gradient = 0.3 * torch.randn(1, 2, 5, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda g: integrate_perspective(g, 0.5, 20.0), gradient.requires_grad_())


@pytest.mark.parametrize("slope", [0.35, 0.25])
def test_a_ramp_stands_on_its_low_end(slope):
    """Cliffs on three sides, as high at one end as the ramp is; upside down it would hang from there."""
    ramp = vts.scenes.surface(lambda x, y: torch.where((y.abs() < 2.5) & (x.abs() < 3), (x + 3) * slope, -1.0), 120, 160, 0.1)
    smooth = (vts.poisson_background(ramp.gradient, 0.1) - ramp.depth_mm).abs().max()
    assert (vts.AdaptiveIntegration(0.1)(ramp.gradient) - ramp.depth_mm).abs().max() < 0.02 * smooth
