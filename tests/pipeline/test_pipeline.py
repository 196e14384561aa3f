"""From image to depth: the paper's figure 3, a worn unit with low lights, and what a chain of modules promises."""

from functools import partial

import pytest
import torch
from torch import nn

import torchvts as vts
from lab import metrics
from torchvts import NormalModel
from torchvts.compensate import unchanged_light
from torchvts.integration import PerspectiveIntegration
from torchvts.pipeline import Shadows
from torchvts.scenes import objects

scenes = vts.scenes
PITCH = 0.0625
FULL = vts.Sensor("rig", 480, 640, PITCH)


def pipeline(lights, sensor, mode="precise", **options):
    return vts.DepthPipeline.from_calibration(vts.Calibration.from_lights(lights, sensor), mode, **options)


@pytest.mark.parametrize(
    "press_mm, mode, largest_px, rms_px",
    [
        *(pytest.param(1.0, *most, marks=pytest.mark.long) for most in (("fast", 0.35, 0.16), ("precise", 0.13, 0.03))),
        *[(2.0, "fast", 1.3, 0.58), (2.0, "precise", 0.19, 0.03)],
    ],
)
@pytest.mark.parametrize("rotation_deg", [10.0, pytest.param(75.0, marks=pytest.mark.long)])
def test_figure_3_of_the_paper(ring, press_mm, mode, largest_px, rms_px, rotation_deg):
    scene, lights = scenes.sphere_press(10.0, press_mm), ring(rotation_deg=rotation_deg)
    out = pipeline(lights, FULL, mode)(scenes.render(scene, lights))
    assert metrics.depth_error(out.depth_mm, scene.depth_mm, PITCH).max_px < largest_px
    assert metrics.depth_error(out.depth_mm, scene.depth_mm, PITCH, scene.contact).rms_px < rms_px
    assert metrics.mask_iou(out.deformed, scene.contact) > 0.985
    assert metrics.mask_iou(out.contact, scene.contact) > 0.83 and not bool((out.contact & ~out.deformed).any())


@pytest.fixture(
    scope="module",
    params=[
        pytest.param((0.45, False), id="saturated near the lights, which are known"),
        pytest.param((0.45, True), id="saturated near the lights", marks=pytest.mark.long),
        pytest.param((0.18, True), id="no saturation", marks=pytest.mark.long),
    ],
)
def worn_unit(request, ring):
    """Low lights, noise, 8 bits, a spotted skin: calibrated from its own background."""
    level, fitted = request.param
    lights = ring(22.0, [15.0, 16.5, 18.0], rotation_deg=90.0, level=level)
    camera = {"noise_std": 0.01, "bits": 8, "spots": scenes.skin_spots(480, 640)}
    background = scenes.render(scenes.undeformed(scenes.sphere_press()), lights, **camera, seed=1)[0]
    found = vts.fit_lights(background, FULL).lights if fitted else lights  # calibrate tries more; test_fit_lights has that
    return vts.Calibration.from_lights(found, FULL, background), lambda scene: scenes.render(scene, lights, **camera, seed=2)


def with_shadows(pipe):
    """The pipeline for LEDs so low that slopes block them."""
    pipe.refine = Shadows(pipe.refine, pipe.mm_per_pixel)
    return pipe


@pytest.mark.parametrize("press_mm, largest_px, rms_px", [pytest.param(1.0, 0.55, 0.12, marks=pytest.mark.long), (2.0, 0.85, 0.20)])
def test_a_worn_unit_with_low_lights(worn_unit, press_mm, largest_px, rms_px):
    calibration, camera = worn_unit
    scene = scenes.sphere_press(10.0, press_mm)
    out = vts.DepthPipeline.from_calibration(calibration, "precise")(camera(scene))
    assert metrics.mask_iou(out.deformed, scene.contact) > 0.985
    assert metrics.mask_iou(out.contact, scene.contact) > 0.83 and not bool((out.contact & ~out.deformed).any())
    assert metrics.depth_error(out.depth_mm, scene.depth_mm, PITCH).max_px < largest_px
    assert metrics.depth_error(out.depth_mm, scene.depth_mm, PITCH, scene.contact).rms_px < rms_px


def share_of_the_plain_inverse(lights, scene, noise_std):
    """RMS error of depth over that of the plain inverse; noise, 8 bits."""
    rest = scenes.render(scenes.undeformed(scene), lights, noise_std=noise_std, bits=8, seed=1)[0]
    image = scenes.render(scene, lights, noise_std=noise_std, bits=8, seed=2)
    sensor = FULL.resized(*scene.depth_mm.shape[2:])
    pipe = with_shadows(vts.DepthPipeline.from_calibration(vts.Calibration.from_lights(lights, sensor, rest), "precise"))
    ours = metrics.depth_error(pipe(image).depth_mm, scene.depth_mm, PITCH).rms_px
    pipe.normals.shadowed.flat.zero_()
    return ours / metrics.depth_error(pipe(image).depth_mm, scene.depth_mm, PITCH).rms_px


def long(*values):
    """A case of a grid that only make test-long runs."""
    return pytest.param(*values, marks=pytest.mark.long)


def punch(radius_mm, press_mm, tilt_deg):
    """A flat top, at whose foot is a wall beyond the plane of the lit lights, where no start near the shallow slope leads."""
    return scenes.surface(scenes.punch_depth(radius_mm, press_mm, tilt_deg, 1.1), 480, 640, PITCH)


def ball(press_mm=2.0, coarser=1):
    """Pressed so deep that a low light does not reach one wall."""
    return scenes.sphere_press(10.0, press_mm, (0, 0), 480 // coarser, 640 // coarser, coarser * PITCH)


@pytest.mark.parametrize(
    "out_mm, height_mm, turn_deg, level, scene, noise_std, share",
    [
        (22.0, [15.0, 16.5, 18.0], 90.0, 0.2, partial(ball, coarser=2), 0.003, 0.2),
        *(long(22.0, [15.0, 16.5, 18.0], 90.0, level, ball, 0.01, 0.2) for level in (0.18, 0.45)),
        # walls near the plane of the other two lights, on whose sides two slopes look alike: the wrong ones leave 0.5 to 0.7
        long(26.0, 15.0, 60.0, 0.2, ball, 0.003, 0.25),
        long(30.0, 18.0, 60.0, 0.2, ball, 0.005, 0.25),
        long(22.0, 12.0, 60.0, 0.2, partial(ball, 1.5), 0.003, 0.25),
        *(long(31.0, 18.0, 42.0, 0.21, partial(punch, *at), 0.003, 0.2) for at in ((4.8, 0.77, 2.6), (5.5, 1.0, 2.0))),
    ],
)
def test_a_blocked_light_leaves_a_share_of_the_error_of_the_plain_inverse(
    ring, out_mm, height_mm, turn_deg, level, scene, noise_std, share
):
    lights = ring(out_mm, height_mm, rotation_deg=turn_deg, level=level)
    assert share_of_the_plain_inverse(lights, scene(), noise_std) < share


def low_rig(scene, seed=0):
    """A unit under lights 13 mm high, its camera, and what its precise pipeline makes of an image."""
    angles = torch.deg2rad(torch.tensor([37.0, 157.0, 277.0], dtype=torch.float64))
    position = torch.stack((25 * angles.cos(), 25 * angles.sin(), torch.full_like(angles, 13.0)), dim=1).float()
    lights = vts.PointLights(position, torch.full((3,), 0.2 * (25**2 + 13**2) ** 1.5 / 13)).requires_grad_(False)
    camera = {"noise_std": 0.003, "bits": 8}
    rest = scenes.render(scenes.undeformed(scene), lights, **camera, seed=2 * seed)[0]
    sensor = vts.Sensor("rig", *scene.depth_mm.shape[2:], scene.mm_per_pixel)
    pipe = with_shadows(vts.DepthPipeline.from_calibration(vts.Calibration.from_lights(lights, sensor, rest), "precise"))
    return pipe, lambda shadows: scenes.render(scene, lights, **camera, seed=2 * seed + 1, shadows=shadows).detach()


@pytest.mark.parametrize("shape", [pytest.param("ball", marks=pytest.mark.long), "cone"])
def test_a_cast_shadow_is_no_contact_and_no_slope(shape):
    """Of the skin behind, which is undeformed; before, it was called contact, and the depth was 3 to 8 times as wrong."""
    size = (240, 320, 0.0625)
    scene = (
        scenes.sphere_press(6.0, 1.5, (0.5, -0.4), *size)
        if shape == "ball"
        else scenes.surface(scenes.cone_depth(50.0, 1.5, 0.5, (0, 0)), *size)
    )
    pipe, camera = low_rig(scene)
    plain, shadowed = pipe(camera(False)), pipe(camera(True))
    assert metrics.mask_iou(shadowed.deformed, scene.contact) > 0.95 and not bool((shadowed.contact & ~shadowed.deformed).any())
    assert metrics.mask_iou(shadowed.contact, scene.contact) > 0.95
    error, expected = (metrics.depth_error(out.depth_mm, scene.depth_mm, 0.0625).rms_px for out in (shadowed, plain))
    assert error < 1.5 * expected + 0.005


@pytest.mark.parametrize("place, radius_px", [((130, 190), 25), pytest.param((90, 175), 12, marks=pytest.mark.long)])
def test_dirt_that_keeps_a_light_off_leaves_a_fifth_of_the_error_of_the_plain_inverse(place, radius_px):
    scene = scenes.sphere_press(8.0, 1.2, (0.5, -0.4), 240, 320, 0.0625)
    pipe, camera = low_rig(scene)
    image = camera(False)
    y, x = torch.arange(240)[:, None] - place[0], torch.arange(320) - place[1]
    image[0, 1][x**2 + y**2 < radius_px**2] = 0.0
    ours = metrics.depth_error(pipe(image).depth_mm, scene.depth_mm, 0.0625).rms_px
    pipe.normals.shadowed.flat.zero_()
    assert ours < 0.2 * metrics.depth_error(pipe(image).depth_mm, scene.depth_mm, 0.0625).rms_px


@pytest.mark.parametrize("mode", ["fast", "precise"])
def test_a_pipeline_that_ran_in_inference_mode_still_gives_gradients(ring, small_sensor, small_press, mode):
    lights, scene = ring(), small_press(1.0)
    pipe = vts.DepthPipeline.from_calibration(vts.Calibration.from_lights(lights, small_sensor), mode)
    image = scenes.render(scene, lights).detach()
    with torch.inference_mode():
        before = pipe(image).depth_mm
    image.requires_grad_(True)
    after = pipe(image).depth_mm
    after.sum().backward()
    assert torch.allclose(before, after, rtol=0, atol=2e-6) and float(image.grad.abs().max()) > 0


def dimmed(lights, factors):
    return vts.PointLights(lights.position_mm, lights.albedo * torch.tensor(factors)).requires_grad_(False)


@pytest.mark.parametrize("mode, radius_mm, press_mm", [("fast", 10.0, 1.0), ("precise", 40.0, 2.0)])
@pytest.mark.parametrize("factors", [(0.6, 1.2, 0.9), pytest.param((0.5, 0.5, 0.5), marks=pytest.mark.long)])
def test_leds_that_have_dimmed_change_nothing(ring, small_sensor, small_press, factors, radius_mm, press_mm, mode):
    """Contacts of 5 and 40 % of the image."""
    lights, scene = ring(), small_press(press_mm, (2.0, 1.0), radius_mm)
    rest = scenes.render(scenes.undeformed(scene), lights, noise_std=0.004, bits=8, seed=1)[0]
    calibration = vts.Calibration.from_lights(lights, small_sensor, rest)
    before = scenes.render(scene, lights, noise_std=0.004, bits=8, seed=2)
    after = scenes.render(scene, dimmed(lights, factors), noise_std=0.004, bits=8, seed=2)
    pipe = vts.DepthPipeline.from_calibration(calibration, mode)
    undisturbed, levelled = (metrics.depth_error(pipe(image).depth_mm, scene.depth_mm, PITCH).rms_px for image in (before, after))
    assert levelled < 1.3 * undisturbed / min(1.0, *factors) ** 1.5  # noise is divided, too
    assert metrics.mask_iou(pipe(after).deformed, scene.contact) > 0.9
    nothing = pipe(scenes.render(scenes.undeformed(scene), dimmed(lights, factors), noise_std=0.004, bits=8, seed=3))
    assert not bool(nothing.contact.any())


@pytest.mark.parametrize("radius_mm, press_mm", [(8.0, 1.0), (12.0, 2.0)])
def test_a_tilted_punch_larger_than_half_of_the_image_is_no_other_light(ring, small_sensor, radius_mm, press_mm):
    lights, scene = ring(), scenes.surface(scenes.punch_depth(radius_mm, press_mm, 2.0, 1.0), 120, 160, 0.25)
    rest = scenes.render(scenes.undeformed(scene), lights, noise_std=0.004, bits=8, seed=1)[0]
    calibration = vts.Calibration.from_lights(lights, small_sensor, rest)
    image = scenes.render(scene, lights, noise_std=0.004, bits=8, seed=2)
    light = vts.Compensate.from_calibration(calibration).light_of(image)
    assert torch.equal(light, unchanged_light(image))


@pytest.mark.parametrize("touched, factor", [(0.0, 1.0), (0.0, 0.5), (0.4, 0.75), (0.4, 1.4)])
def test_a_response_field_levels_any_light(small_sensor, factor, touched):
    field = vts.model.response_field.ResponseField(0, -1, 10.0, ((0.3, 0, 0), (0, 0.3, 0)))
    model = vts.model.response_field.ResponseModel(field, None)
    background = 0.5 + 0.004 * torch.randn(3, 120, 160, generator=torch.Generator().manual_seed(0))
    image = background + 0.004 * torch.randn(3, 120, 160, generator=torch.Generator().manual_seed(1))
    rows = int(touched * 120)
    image[:, :rows] *= torch.linspace(0.6, 1.4, 160)
    image = image * torch.tensor([1.0, factor, 1.0])[:, None, None]
    compensate = vts.Compensate.from_calibration(vts.Calibration.from_response(model, small_sensor, background))
    undeformed = compensate(image.clamp(0.0, 1.0)[None])[0, :, rows + 5 :].mean(dim=(1, 2))
    assert (undeformed - 1.0).abs().max() < 0.006


def test_a_failed_led_is_no_other_light(ring, small_sensor, small_press):
    lights, scene = ring(), small_press(1.0)
    calibration = vts.Calibration.from_lights(lights, small_sensor)
    image = scenes.render(scene, lights)
    image[:, 1] = 0.0
    compensate = vts.Compensate.from_calibration(calibration)
    assert torch.equal(compensate.light_of(image), unchanged_light(image)) and compensate.lost(image).tolist() == [[0.0, 1.0, 0.0]]


@pytest.fixture(scope="module")
def mixed(ring, small_sensor, small_press):
    """Frames undeformed, hardly pressed and well pressed, and their lights."""
    lights = ring()
    presses = [scenes.undeformed(small_press()), small_press(1.5), small_press(0.05, (6, 4), 4.0), small_press(1.0, (-8, 3))]
    return lights, torch.cat([scenes.render(scene, lights, bits=8) for scene in presses])


@pytest.mark.parametrize("mode", ["fast", "precise"])
def test_images_in_double_precision_need_no_other_pipeline(mixed, small_sensor, mode):
    lights, frames = mixed
    pipe = pipeline(lights, small_sensor, mode)
    wide, usual = pipe(frames.double()), pipe(frames)
    assert wide.depth_mm.dtype == torch.float64 and torch.equal(wide.contact, usual.contact)
    assert (wide.depth_mm - usual.depth_mm).abs().max() < 1e-5


@pytest.mark.parametrize("mode", ["fast", "precise"])
def test_no_contact_is_exactly_zero(mixed, small_sensor, mode):
    lights, frames = mixed
    out = pipeline(lights, small_sensor, mode)(frames[:1])
    assert not bool(out.contact.any())
    assert out.depth_mm.abs().max() == 0 and out.gradient.abs().max() == 0
    assert torch.equal(out.normal, torch.tensor([0.0, 0.0, 1.0]).reshape(1, 3, 1, 1).expand_as(out.normal))


class Restless(NormalModel):
    """Normals that tilt further at every call, so that depth never settles."""

    uses_depth = True

    def __init__(self):
        super().__init__()
        self.calls = 0

    def forward(self, image, depth_mm=None):
        self.calls += 1
        normal = torch.zeros_like(image)
        normal[:, 0], normal[:, 2] = 0.1 * self.calls, 1.0
        return normal


@pytest.mark.filterwarnings("ignore::torch.jit.TracerWarning", "ignore:.torch.jit.trace:DeprecationWarning")
@pytest.mark.parametrize("mode", ["precise", pytest.param("fast", marks=pytest.mark.long)])
def test_a_traced_response_field_gives_the_same_depth_at_once(mode, mini_by_prior, mini_presses):
    """It ended in an internal error of PyTorch, by an optional buffer, then in tables that the first call alone made."""
    pipe = vts.DepthPipeline.from_calibration(mini_by_prior, mode)
    image, other = (mini_presses[1][k].image[None] for k in (0, 7))
    traced = torch.jit.trace(pipe, other)
    depth, expected = traced(image)[0], pipe(image).depth_mm
    assert expected.max() > 0.1 and (depth - expected).abs().max() < 1e-3  # the choices of the other image are kept


@pytest.mark.parametrize("passes", [1, 2, 8])
def test_precise_solves_as_often_as_the_model_says(mixed, small_sensor, passes):
    lights, frames = mixed
    normals = Restless()
    normals.passes = passes
    pipe = pipeline(lights, small_sensor, normals=normals)
    pipe(frames[1:2])
    assert pipe.normals.calls == passes


def test_three_passes_are_as_good_as_many(mixed, small_sensor):
    lights, frames = mixed
    pipe = pipeline(lights, small_sensor)
    three = pipe(frames[1:2]).depth_mm
    pipe.refine.passes = 20
    assert pipe.normals.passes == 3 and (pipe(frames[1:2]).depth_mm - three).abs().max() < 0.01 * small_sensor.mm_per_pixel


@pytest.mark.parametrize("center_mm", [(-20.0, -15.0), pytest.param((20.0, 0.0), marks=pytest.mark.long)])
def test_contact_that_the_image_border_cuts(ring, center_mm):
    lights, scene = ring(), scenes.sphere_press(10.0, 1.0, center_mm)
    out = pipeline(lights, FULL)(scenes.render(scene, lights))
    assert metrics.depth_error(out.depth_mm, scene.depth_mm, PITCH).max_px < 0.3


def differentiable(ring, mode):
    """16 x 20 pixels in float64, contact all over but for a margin that no step of a difference quotient moves."""
    lights = ring(dtype=torch.float64)
    scene = scenes.sphere_press(10.0, 2.0, (0, 0), 16, 20, 0.9, torch.float64)
    pipe = pipeline(lights, vts.Sensor("tiny", 16, 20, 0.9), mode)
    return pipe, scenes.render(scene, lights), lights


@pytest.mark.parametrize("mode", ["fast", "precise"])
def test_derivatives_of_the_chain_in_image_and_lights(ring, mode):
    pipe, image, lights = differentiable(ring, mode)
    pipe.requires_grad_(True)
    assert int(pipe(image).contact.sum()) > 30

    def depth(image, position, albedo):
        names = {"normals.lights.position_mm": position, "normals.lights.albedo": albedo}
        return torch.func.functional_call(pipe, names, (image,)).depth_mm

    inputs = [image.clone(), lights.position_mm.clone(), lights.albedo.clone()]
    assert torch.autograd.gradcheck(depth, [value.requires_grad_(True) for value in inputs], fast_mode=True)


def test_the_lights_of_a_pipeline_are_frozen_until_asked_for(ring, small_sensor, mixed):
    lights, frames = mixed
    pipe = pipeline(lights, small_sensor)
    assert not any(parameter.requires_grad for parameter in pipe.parameters())
    pipe.requires_grad_(True)
    pipe(frames[1:2]).depth_mm.sum().backward()
    assert all(
        p.grad is not None and float(p.grad.abs().max()) > 0 for p in (pipe.normals.lights.position_mm, pipe.normals.lights.albedo)
    )


class Spoilt(nn.Module):
    """Flat normals, spoilt by a function."""

    def __init__(self, spoil):
        super().__init__()
        self.spoil = spoil

    def forward(self, image):
        return self.spoil(torch.cat((0.0 * image[:, :2], 1.0 + 0.0 * image[:, 2:]), dim=1))


SPOILT = {
    "NaN": (lambda n: n.masked_fill(n > 0.5, float("nan")), ValueError, "finite values from Spoilt, got .* NaN or infinite"),
    "infinite": (lambda n: n / 0.0, ValueError, "finite values from Spoilt"),
    "slopes": (lambda n: n[:, :2], ValueError, r"normals: expected \(1, 3, .* from Spoilt, the shape of its input, got \(1, 2, "),
    "another size": (lambda n: n[..., ::2], ValueError, "from Spoilt, the shape of its input"),
    "float64": (lambda n: n.double(), TypeError, "normals: expected torch.float32 from Spoilt, .* got torch.float64: cast it back"),
    "colours": (lambda n: 0.5 * n + 0.5, ValueError, "coded as colours"),
    "colours to 255": (lambda n: 127.5 * n + 127.5, ValueError, "coded as colours"),
    "a pair": (lambda n: (n, n), TypeError, "normals: expected a tensor from Spoilt, got"),
}


@pytest.mark.parametrize("kind", SPOILT)
def test_what_a_learned_module_gives_is_checked(mixed, small_sensor, kind):
    lights, frames = mixed
    spoil, error, text = SPOILT[kind]
    pipe = pipeline(lights, small_sensor, "fast", normals=Spoilt(spoil))
    with pytest.raises(error, match=text):
        pipe(frames[1:2])
    assert bool(torch.isfinite(pipeline(lights, small_sensor, "fast", normals=Spoilt(lambda n: n))(frames[1:2]).depth_mm).all())


class Turned(nn.Module):
    """The calibrated normals, with other axes."""

    def __init__(self, model, turn):
        super().__init__()
        self.model, self.turn = model, turn

    def forward(self, image):
        return self.turn(self.model(image))


AXES = {
    "y up": (lambda n: n * torch.tensor([1.0, -1.0, 1.0])[:, None, None], "y seems to count upwards, or x to the left: negate"),
    "x and y swapped": (lambda n: n[:, [1, 0, 2]], "x and y seem swapped: give them in the order x, y, z"),
    "turned a quarter": (lambda n: n[:, [1, 0, 2]] * torch.tensor([1.0, -1.0, 1.0])[:, None, None], "and one of them turned over"),
    "n_z never written": (
        lambda n: n * torch.tensor([1.0, 1.0, 0.0])[:, None, None],
        "face away from the camera in 100% of the image",
    ),
    "z away": (lambda n: -n, "face away from the camera in 100% of the image: n_z is above 0 here: negate or set it"),
}


@pytest.mark.parametrize("case", AXES)
def test_axes_of_own_normals_that_are_likely_wrong_are_named_once(mixed, small_sensor, case):
    lights, frames = mixed
    turn, text = AXES[case]
    model = pipeline(lights, small_sensor, "fast").normals
    pipe = pipeline(lights, small_sensor, "fast", normals=Turned(model, turn))
    with pytest.warns(UserWarning, match=text):
        pipe(frames[1:2])
    pipe(frames[1:2])  # warnings are errors here
    right = pipeline(lights, small_sensor, "fast", normals=Turned(model, lambda n: n))
    assert torch.equal(right(frames[1:2]).depth_mm, pipeline(lights, small_sensor, "fast")(frames[1:2]).depth_mm)


class Calibrated(NormalModel):
    """The calibrated normals in a model of another's."""

    calibrated: bool = True

    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, image, depth_mm=None):
        return self.model(image)


def test_slopes_of_an_own_model_that_is_calibrated_count_as_ours_do(ring, mixed, small_sensor):
    lights, frames = mixed
    noisy = frames + 0.02 * torch.randn(frames.shape, generator=torch.Generator().manual_seed(0))
    ours = pipeline(lights, small_sensor, "fast")
    theirs, unknown = (pipeline(lights, small_sensor, "fast", normals=wrap(ours.normals)) for wrap in (Calibrated, nn.Sequential))
    assert torch.equal(theirs(noisy).depth_mm, ours(noisy).depth_mm)
    assert not torch.equal(unknown(noisy).depth_mm, ours(noisy).depth_mm)


class OnImages(nn.Conv2d):
    input_domain = "image"


@pytest.mark.parametrize("wrap", [lambda m: m, nn.Sequential, nn.DataParallel], ids=["plain", "Sequential", "DataParallel"])
def test_what_a_plain_module_declares_is_heard(mixed, small_sensor, wrap):
    """A network of camera images behind compensated ones gave 2.6 mm for 0.6 in silence."""
    with pytest.raises(ValueError, match=r"(OnImages|Sequential|DataParallel) works on images as the camera"):
        pipeline(mixed[0], small_sensor, "fast", normals=wrap(OnImages(3, 3, 1)))


@pytest.mark.parametrize("name", ["normals", "gradient", "integrate"])
def test_a_block_that_is_put_in_afterwards_is_no_silent_spare(mixed, small_sensor, name):
    pipe = pipeline(mixed[0], small_sensor, "fast")
    with pytest.raises(AttributeError, match=f"{name}: expected to stay what the pipeline was made with"):
        setattr(pipe, name, nn.Identity())


def test_a_block_of_another_pitch_is_refused(mixed, small_sensor):
    with pytest.raises(ValueError, match=r"integrate: expected a pitch of 0.25 mm per pixel, got PoissonDST with 1"):
        pipeline(mixed[0], small_sensor, "fast", integrate=vts.PoissonDST())
    with pytest.raises(ValueError, match=r"integrate: expected a pitch of 0.25 mm per pixel, got PoissonDCT with 0.5"):
        PerspectiveIntegration(0.25, 20.0, vts.PoissonDCT(0.5))
    normals = vts.NormalFromIntensity(mixed[0], small_sensor.height, small_sensor.width, 0.5)
    with pytest.raises(ValueError, match=r"normals: expected a pitch of 0\.25 mm per pixel, got NormalFromIntensity with 0\.5"):
        pipeline(mixed[0], small_sensor, "fast", normals=normals)


@pytest.mark.parametrize("mode", ["fast", "precise"])
def test_half_precision_is_refused(mixed, small_sensor, mode):
    """By lights, depth was zero."""
    lights, frames = mixed
    with pytest.raises(TypeError, match=r"pipe: expected float32 or float64, got torch.float16: halve a network alone"):
        pipeline(lights, small_sensor, mode).half()(frames[1:2])


def test_autocast_reaches_an_own_network_and_nothing_else(mixed, small_sensor):
    lights, frames = mixed
    torch.manual_seed(0)  # of another network the axes may seem wrong
    network = nn.Conv2d(3, 3, 1)
    with torch.no_grad():
        network.bias.copy_(torch.tensor([0.0, 0.0, 2.0]))
    pipe = pipeline(lights, small_sensor, "fast", normals=network).requires_grad_(False)
    with torch.autocast("cpu", torch.bfloat16):
        assert network(frames[1:2]).dtype == torch.bfloat16
        low = pipe(frames[1:2])
    assert {part.dtype for part in low[:3]} == {torch.float32}
    full = pipe(frames[1:2])
    assert float((low.gradient - full.gradient).abs().max()) < 0.05


class MaskOfImage(vts.ContactMask):
    """A mask of one's own, of the compensated image alone."""

    def forward(self, compensated):
        return super().forward(compensated)


def test_a_mask_may_take_the_image_alone(ring, mixed, small_sensor):
    lights, frames = mixed
    usual = pipeline(lights, small_sensor, "fast")
    given = (usual.mask.flat,)
    blocks = {"mm_per_pixel": small_sensor.mm_per_pixel, "mode": "fast"}
    chain = (usual.compensate, usual.normals, usual.gradient, usual.integrate)
    masks = (vts.ContactMask(*given), MaskOfImage(*given))
    found, own = (vts.DepthPipeline(chain[0], mask, *chain[1:], **blocks).eval()(frames[1:2]).deformed for mask in masks)
    assert metrics.mask_iou(found, own) > 0.9


def test_precise_needs_normals_that_take_the_depth(ring, small_sensor):
    with pytest.raises(
        ValueError, match=r"mode: 'precise' hands the depth back to the normals, but Conv2d does not take it: use 'fast'"
    ):
        pipeline(ring(), small_sensor, "precise", normals=nn.Conv2d(3, 3, 1))


class ZeroOfBorder(nn.Module):
    """Depth counted from the median of the border; ``lost`` forgets to give a map back."""

    def __init__(self, lost: bool):
        super().__init__()
        self.lost = lost

    def forward(self, depth_mm: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
        border = torch.cat((depth_mm[..., 0, :], depth_mm[..., -1, :], depth_mm[..., 0], depth_mm[..., -1]), dim=-1)
        zero = border.median(dim=-1).values[..., None, None]
        return zero if self.lost else depth_mm - zero


def test_another_zero_takes_its_place(mixed, small_sensor):
    lights, frames = mixed
    pipe = pipeline(lights, small_sensor, "fast")
    pipe.solve.zero = ZeroOfBorder(lost=False)
    depth = pipe(frames).depth_mm
    assert float((pipe.solve.zero(depth, depth) - depth).abs().max()) < 1e-6 < 0.1 < float(depth.max())
    assert torch.allclose(torch.jit.script(pipe)(frames).depth_mm, depth, atol=1e-6)
    frozen = pipe.freeze()
    assert frozen.not_compiled == "solve.zero is ZeroOfBorder" and torch.equal(frozen(frames).depth_mm, depth)
    pipe.solve.zero = ZeroOfBorder(lost=True)
    with pytest.raises(ValueError, match=r"^zero: expected depth \[.*\] like that of integrate, got \[\d+, 1, 1, 1\]"):
        pipe(frames)


def test_another_integrator_takes_its_place(mixed, small_sensor):
    lights, frames = mixed
    pipe = pipeline(lights, small_sensor, "fast", integrate=vts.PoissonDST(small_sensor.mm_per_pixel))
    out, frame = pipe(frames[1:2]), pipe.frame_of(frames[1:2])[0]
    by_hand = pipe.solve.zero(vts.poisson_dst(out.gradient, small_sensor.mm_per_pixel), frame.weight)
    assert (out.depth_mm - by_hand).abs().max() == 0


def test_spots_and_dead_pixels_are_compensated(ring, small_sensor, small_press):
    lights, scene = ring(), small_press(1.0)
    spots = scenes.skin_spots(120, 160)
    background, image = (scenes.render(s, lights, spots=spots)[0] for s in (scenes.undeformed(scene), scene))
    cal = vts.Calibration.from_lights(lights, small_sensor, background)
    clean = pipeline(lights, small_sensor)(scenes.render(scene, lights)).depth_mm
    assert int(cal.defects.sum()) >= 25
    assert (vts.DepthPipeline.from_calibration(cal, "precise")(image[None]).depth_mm - clean).abs().max() < 0.03 * 0.25


def test_the_response_of_the_camera_is_undone(ring, small_press, gamma=2.2):
    lights, scene = ring(), small_press(1.0)
    sensor = vts.Sensor("rig", 120, 160, 0.25, gamma=gamma)
    linear = pipeline(lights, vts.Sensor("rig", 120, 160, 0.25))(scenes.render(scene, lights)).depth_mm
    assert (pipeline(lights, sensor)(scenes.render(scene, lights, gamma=gamma)).depth_mm - linear).abs().max() < 1e-5


def test_defects_take_the_value_of_their_neighbours():
    defects = torch.zeros(6, 7, dtype=torch.bool)
    defects[0, 0] = defects[3, 3] = defects[3, 4] = True
    x, y = torch.arange(7.0).expand(6, 7), torch.arange(6.0)[:, None].expand(6, 7)
    image = (2 * x + 3 * y).expand(1, 3, 6, 7).clone()
    broken = torch.where(defects, -99.0, image)
    repaired = vts.Compensate(defects=defects)(broken)
    assert torch.equal(repaired[..., ~defects], image[..., ~defects])
    # at (3, 3): left neighbour, right one beyond the second defect, above, below
    assert repaired[0, 0, 3, 3] == (image[0, 0, 3, 2] + image[0, 0, 3, 5] + image[0, 0, 2, 3] + image[0, 0, 4, 3]) / 4
    # in the corner the border comes first to the left and above: right and below stand in for them
    assert repaired[0, 0, 0, 0] == (2 * image[0, 0, 0, 1] + 2 * image[0, 0, 1, 0]) / 4


def test_a_dimmed_led_costs_nothing_on_rigs_that_saturate():
    height_mm, out_mm, albedo, noise_std = 15.0, 24.0, 450.0, 0.005
    angles = torch.deg2rad(torch.tensor([0.0, 120.0, 240.0]))
    position = torch.stack((out_mm * angles.cos(), out_mm * angles.sin(), torch.full((3,), height_mm)), dim=1)
    lights = vts.PointLights(position, [albedo] * 3)
    scene = vts.scenes.sphere_press(10.0, 1.0, (0, 0), 120, 160, 0.25)
    rest = vts.scenes.render(vts.scenes.undeformed(scene), lights, noise_std=noise_std, bits=8, seed=1)[0].detach()
    assert float((rest > 0.98).any(dim=0).double().mean()) > 0.01
    calibration = vts.Calibration.from_lights(lights, vts.Sensor("rig", 120, 160, 0.25), rest)
    pipe = vts.DepthPipeline.from_calibration(calibration, "precise")
    errors = []
    for gain in (1.0, 0.9):
        lights = vts.PointLights(position, [albedo, gain * albedo, albedo])
        with torch.inference_mode():
            out = pipe(vts.scenes.render(scene, lights, noise_std=noise_std, bits=8))
        errors.append(metrics.depth_error(out.depth_mm, scene.depth_mm, 0.25))
    assert errors[1].rms_px < 1.3 * errors[0].rms_px
    assert errors[1].max_px < 1.3 * errors[0].max_px


def test_vmap_is_refused_with_a_sentence(ring):
    pipe = pipeline(ring(), vts.Sensor("rig", 48, 64, 0.5), "fast")
    with pytest.raises(RuntimeError, match=r"images: expected a batch of frames, got a frame of torch\.func\.vmap: call it on the"):
        torch.func.vmap(lambda image: pipe(image[None]).depth_mm[0])(torch.rand(2, 3, 48, 64))


def test_skin_that_hangs_far_around_an_object_counts(ring):
    """A soft gel: no skin in view is undeformed, and spreads of all of it hid 0.17 of 1 mm."""
    height, width, pitch, lights = 96, 128, 0.14, ring(14.0, 14.0)
    reached = objects.press(objects.stamp("XO", 4.6), objects.pose(30.0, (0.5, 0.3), 1.0), height, width, pitch, fillet_mm=1e-4)
    scene = vts.scenes.hanging_skin(torch.where(reached.contact, reached.depth_mm, -1.0), 2.0, pitch)
    image, rest = (vts.scenes.render(s, lights, noise_std=0.003, bits=8).detach() for s in (scene, vts.scenes.undeformed(scene)))
    unit = vts.Calibration.from_lights(lights, vts.Sensor("soft", height, width, pitch), rest[0])
    depth = vts.DepthPipeline.from_calibration(unit)(image).depth_mm
    assert -0.12 < float((depth - scene.depth_mm)[scene.contact].mean()) < 0.0
