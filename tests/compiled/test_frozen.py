"""A frozen pipeline: the plain one's depth, compiled; a copy that nothing changes."""

import copy
import dataclasses
import functools
import multiprocessing
import pickle
import re
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import torch
from conftest import half_drawn, ring_lights, without_library
from torch.autograd import forward_ad

import torchvts as vts
from lab import frames
from torchvts.compiled import binding, library, plan
from torchvts.compiled import library as library_of
from torchvts.compiled.binding import LIBRARY
from torchvts.core.files import read_image
from torchvts.model.response_field import DepthBrightness, ResponseField, ResponseModel
from torchvts.skin import weight as skin_weight

scenes = vts.scenes
MODES = ("fast", "precise")
DEPTH_MM = 1e-5
"""Frozen and plain depth differ by no more."""

pytestmark = pytest.mark.skipif(library() is None and shutil.which("cc") is None, reason="no C compiler")


def long(*values):
    """A case of a grid that only make test-long runs."""
    return pytest.param(*values, marks=pytest.mark.long)


def agree(pipe, images, depth_mm=DEPTH_MM):
    """Compare a pipeline with itself frozen; returns both outputs."""
    frozen = pipe.freeze()
    assert frozen.compiled, frozen.not_compiled
    with torch.inference_mode():
        plain, expected = pipe(images), pipe.conditions(images)
    found, conditions = frozen.with_conditions(images)
    assert float((found.depth_mm - plain.depth_mm).abs().max()) <= depth_mm
    assert float((found.normal - plain.normal).abs().max()) <= 1e-4 + 2.0 * depth_mm / pipe.mm_per_pixel
    assert torch.allclose(conditions.light, expected.light, rtol=1e-4, atol=1e-4)
    assert torch.allclose(conditions.unseen_deg, expected.unseen_deg, rtol=1e-3, atol=1e-3)
    for mask, expected in ((found.deformed, plain.deformed), (found.contact, plain.contact)):
        assert int((mask ^ expected).sum()) <= 2  # a depth or pressure that rounding moves over its threshold
    return found, plain


def test_the_library_was_built():
    assert library() is not None, f"{LIBRARY} is missing: install again (make setup)"


def test_a_plan_holds_the_fields_that_the_library_says():
    kinds = plan.fields()
    assert {"i", "d"} < {kind for kind, _ in kinds.values()} <= {"i", "d", *plan.DTYPES}
    with pytest.raises(ValueError, match="values: expected fields of a plan, got nothing_like_it"):
        plan.plan_bytes({"nothing_like_it": 1}, {})
    with pytest.raises(KeyError):
        plan.plan_bytes({"height": 3}, {})
    with pytest.raises(TypeError, match=r"gain: expected a tensor of torch\.float32 on the CPU, got"):
        plan.plan_bytes(dict.fromkeys(kinds, 0) | {"light_of": None, "gain": torch.zeros(3, dtype=torch.float64)}, {})


# ---- the same depth ----


@functools.cache
def lights_unit(size, pitch, **sensor):
    """A unit by lights, its camera, and images: pressed, at the border, noise, flat."""
    lights = ring_lights()
    press = scenes.sphere_press(8.0, 1.0, (0.5, -0.3), *size, pitch)
    camera = {"noise_std": 0.003, "bits": 8}
    rest = scenes.render(scenes.undeformed(press), lights, **camera, seed=9).detach()
    cut = scenes.sphere_press(8.0, 0.8, (0.45 * size[1] * pitch, 0.0), *size, pitch)
    images = [
        scenes.render(scene, lights, **camera, seed=k).detach() for k, scene in enumerate((press, cut, scenes.undeformed(press)))
    ]
    noise = torch.rand(1, 3, *size, generator=torch.Generator().manual_seed(1))
    return vts.Calibration.from_lights(lights, vts.Sensor("rig", *size, pitch, **sensor), rest[0]), torch.cat([*images, noise])


@functools.cache
def response_unit(size, pitch, products=2, cubes=-1):
    """A unit by a response field with a blur, a defect and a drift of the light, and its frames."""
    generator = torch.Generator().manual_seed(3)
    reach = 0.5 * max(size) * pitch
    count = 66 + {-1: -36, 2: 0}[products] + {-1: 0, 0: 10}[cubes]
    field = ResponseField(
        3, products, reach, tuple(tuple((0.3 * torch.randn(count, generator=generator)).tolist()) for _ in range(2)), cubes
    )
    rows = tuple(tuple((0.05 * torch.randn(6, generator=generator)).tolist()) for _ in range(3))
    by_depth = DepthBrightness(2, reach, rows, steeper=0.1, reference_mm=0.2)
    sensor = vts.Sensor("soft", *size, pitch, blur_px=1.0)
    background = 0.4 + 0.1 * torch.rand(3, *size, generator=generator)
    background[:, size[0] // 3, size[1] // 3] = 0.0  # a defect
    report = {"model": "response", "source": "given"}
    noise = torch.full((3,), 0.004)
    calibration = vts.Calibration(sensor, None, background, noise, True, report, ResponseModel(field, by_depth))
    y, x = torch.arange(size[0])[:, None] - 0.4 * size[0], torch.arange(size[1])[None, :] - 0.55 * size[1]
    spread = (0.2 * min(size)) ** 2
    bump = torch.exp(-(x * x + y * y) / spread)
    change = torch.stack([bump * x, -bump * x, bump * y]) / (2.0 * spread**0.5)
    levels = ((1, 0), (0.6, 0.05), (0.6, 0.2), (0, 0))
    frames = torch.stack([background * (1.0 + level * change) * (1.0 + drift) for level, drift in levels])
    noisy = frames + 0.004 * torch.randn(frames.shape, generator=generator)
    return calibration, (noisy.clamp(0.0, 1.0) * 255.0).round() / 255.0


def dotted(images, side):
    """Images with printed dots of a side, four sides apart, a third as bright."""
    dots = torch.zeros(images.shape[-2:])
    for y, x in ((y, x) for y in range(side, dots.shape[0] - side, 4 * side) for x in range(side, dots.shape[1] - side, 4 * side)):
        dots[y : y + side, x : x + side] = 1.0
    return (images * (1.0 - 0.65 * dots) * 255.0).round() / 255.0


def marked_unit(size, pitch, side=3):
    """A unit by a response field with printed dots, and its images."""
    calibration, images = response_unit(size, pitch)
    sensor = dataclasses.replace(calibration.sensor, markers=True)
    background = dotted(calibration.background, side)
    return vts.Calibration.from_response(calibration.response, sensor, background), dotted(images, side)


UNITS = {"lights": lights_unit, "response": response_unit}


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("kind", UNITS)
@pytest.mark.parametrize("size", [(99, 131), long((240, 320))], ids=str)
def test_frozen_and_plain_agree(kind, mode, size):
    calibration, images = UNITS[kind](size, 20.0 / size[1])
    found, _ = agree(vts.DepthPipeline.from_calibration(calibration, mode), images)
    assert bool(found.deformed[0].any())
    assert not bool(found.depth_mm[2 if kind == "lights" else 3].any())


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("kind", UNITS)
@pytest.mark.parametrize(
    "size", [(8, 8), (40, 8), (9, 11), (33, 47), *(long(s) for s in ((8, 40), (13, 17), (45, 63), (59, 79), (16, 640)))], ids=str
)
def test_odd_sizes(kind, mode, size):
    calibration, images = UNITS[kind](size, 12.0 / max(size))
    agree(vts.DepthPipeline.from_calibration(calibration, mode), images, 1e-4)  # slopes of so few pixels go up to 10


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    "more",
    [{"blur_px": 1.0}, {"gamma": 2.2}, {"markers": True}, {"light_position_mm": ((20, 0, 30), (-10, 17, 30), (-10, -17, 30))}],
    ids=lambda more: next(iter(more)),
)
def test_what_a_sensor_may_have(mode, more):
    calibration, images = lights_unit((96, 128), 0.25, **more)
    agree(vts.DepthPipeline.from_calibration(calibration, mode), images[:3])


@pytest.mark.parametrize("mode, level", [("fast", 0.75), ("precise", 0.45), long("fast", 0.45), long("precise", 0.75)])
def test_saturated_backgrounds_and_leds_that_have_dimmed(mode, level):
    lights = ring_lights(22.0, [15.0, 16.5, 18.0], rotation_deg=90.0, level=level)
    press, camera = scenes.sphere_press(8.0, 1.0, (0, 0), 120, 160, 0.25), {"noise_std": 0.004, "bits": 8}
    rest = scenes.render(scenes.undeformed(press), lights, **camera, seed=1).detach()
    assert bool((rest > 0.98).any())
    calibration = vts.Calibration.from_lights(lights, vts.Sensor("rig", 120, 160, 0.25, blur_px=0.8), rest[0])
    pipe = vts.DepthPipeline.from_calibration(calibration, mode)
    for factors in ((1.0, 1.0, 1.0), (0.9, 1.0, 1.0), (1.0, 0.75, 1.1)):
        dimmed = vts.PointLights(lights.position_mm, lights.albedo * torch.tensor(factors))
        # walls that block a light: where two slopes fit alike, rounding decides
        agree(pipe, scenes.render(press, dimmed, **camera, seed=2).detach(), 2e-3)


@pytest.mark.parametrize("mode", MODES)
def test_a_batch_of_a_led_that_has_failed_dirt_and_a_clean_frame(mode):
    """Each frame is measured as it is alone: none takes the light or the dirt of another."""
    calibration, images = lights_unit((48, 64), 0.5)
    batch = images[:1].repeat(3, 1, 1, 1)
    batch[0, 1] = 0.0
    batch[1, :, 20:22, 15:20] = 0.0
    pipe = vts.DepthPipeline.from_calibration(calibration, mode)
    agree(pipe, batch[1:], 2e-3)
    frozen = pipe.freeze()
    together = frozen(batch)
    assert bool(torch.isfinite(together.depth_mm).all())
    for k in range(3):
        assert all(torch.equal(one[k : k + 1], alone) for one, alone in zip(together, frozen(batch[k : k + 1]), strict=True))


def test_a_drawn_sensor():
    """All that presses tell of a skin is in its plan."""
    unit = half_drawn(0)
    balls = [unit.ball(5.0, 0.6, at_mm) for at_mm in ((-3.0, -2.0), (3.0, 2.0), (0.0, 0.0))]
    calibration = vts.calibrate(unit.background, unit.sensor, balls)
    images = torch.stack([unit.background, *(ball.image for ball in balls)])
    for mode in MODES:
        found, _ = agree(vts.DepthPipeline.from_calibration(calibration, mode), images, 1e-4)
        assert float(found.depth_mm[1:].amax((1, 2, 3)).min()) > 0.3


@pytest.mark.parametrize("mode", MODES)
def test_frames_with_a_blocked_light(mode):
    lights = ring_lights(22.0, [15.0, 16.5, 18.0], rotation_deg=90.0, level=0.18)
    press = scenes.sphere_press(10.0, 2.0, (0, 0), 120, 160, 0.25)
    rest = scenes.render(scenes.undeformed(press), lights, noise_std=0.003, bits=8, seed=1).detach()
    pipe = vts.DepthPipeline.from_calibration(vts.Calibration.from_lights(lights, vts.Sensor("rig", 120, 160, 0.25), rest[0]), mode)
    image = scenes.render(press, lights, noise_std=0.003, bits=8, seed=2).detach()
    assert bool(pipe.normals.shadowed.blocked(image).any())
    agree(pipe, image, 2e-3)


def test_the_shadows_of_a_user_run_in_pytorch():
    calibration, images = lights_unit((96, 128), 0.25)
    pipe = vts.DepthPipeline.from_calibration(calibration, "precise")
    pipe.refine = vts.pipeline.Shadows(pipe.refine, pipe.mm_per_pixel)
    frozen = pipe.freeze()
    assert not frozen.compiled and frozen.not_compiled == "refine is Shadows"
    assert torch.equal(frozen(images).depth_mm, pipe(images).depth_mm)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("side, size", [(3, (99, 131)), (9, (120, 161)), long(26, (300, 401))], ids=str)
def test_printed_markers(mode, side, size):
    calibration, images = marked_unit(size, 20.0 / size[1], side)
    assert calibration.markers.diameter_px > 0.5 * side
    found, _ = agree(vts.DepthPipeline.from_calibration(calibration, mode), images[:2])
    assert 0.1 < float(found.depth_mm.max()) < 2.0


@pytest.mark.parametrize("mode", MODES)
def test_a_pinhole_camera_and_other_integrators(mode):
    calibration, images = lights_unit((96, 128), 0.25)
    agree(vts.DepthPipeline.from_calibration(calibration, mode, integrate=vts.PoissonBackground(0.25)), images[:3])
    normals = vts.NormalFromIntensity.from_calibration(calibration, camera_height_mm=60.0)
    for blocks, named in (
        ({"normals": normals}, "normals.camera_height_mm is 60.0, not inf as elsewhere in the pipeline"),
        ({"integrate": vts.PoissonDST(0.25)}, "integrate is PoissonDST"),
    ):
        other = vts.DepthPipeline.from_calibration(calibration, mode, **blocks)
        frozen = other.freeze()
        assert not frozen.compiled and frozen.not_compiled == named and repr(frozen).endswith(f"in PyTorch: {named})")
        assert float((frozen(images[:2]).depth_mm - other(images[:2]).depth_mm).abs().max()) <= DEPTH_MM


@pytest.mark.parametrize("size, mode", [((240, 320), "precise"), long((480, 640), "fast")], ids=str)
def test_the_real_mini(data, size, mode):
    unit = frames.mini(data, size)
    found, _ = agree(vts.DepthPipeline.from_calibration(unit.calibration, mode), unit.image)
    assert float(found.depth_mm.max()) > 0.2


@pytest.mark.parametrize("name, rest", [("gelslim_markers", "ref.jpg"), ("wyh_wedge_markers", "background.png")])
def test_real_markers(data, name, rest):
    """Presses of skins with printed dots, whose response nobody knows: by that of a Mini, only their filling is tested."""
    background, *images = (read_image(path) for path in [data / name / rest, *sorted((data / name).glob("*"))[-3:]])
    sensor = vts.Sensor(name, *background.shape[1:], 0.05, markers=True)
    unit = vts.Calibration.from_response(vts.Sensor.load("gelsight_mini").prior.response, sensor, background)
    found, plain = agree(vts.DepthPipeline.from_calibration(unit), torch.stack(images))
    assert float((found.depth_mm - plain.depth_mm).abs().max()) <= 1e-6 < float(found.depth_mm.max())


# ---- a copy ----


@pytest.fixture(scope="module")
def unit():
    return lights_unit((96, 128), 0.25)


def test_nothing_changes_a_frozen_pipeline(unit):
    calibration, images = unit
    for mode in MODES:
        pipe = vts.DepthPipeline.from_calibration(calibration, mode)
        frozen = pipe.freeze()
        before = frozen(images)
        with torch.no_grad():
            for tensor in (*pipe.parameters(), *pipe.buffers()):
                if tensor.is_floating_point():
                    tensor.data = 0.5 * tensor.data
                else:
                    tensor.zero_()
        pipe.mask.sigmas, pipe.mask.rise, pipe.solve.zero.decay_mm, pipe.contact.share = 50.0, (9.0, 10.0), 9.0, 0.9
        pipe.solve.integrate.mm_per_pixel = 7.0
        for name, value in (("mode", "fast"), ("mm_per_pixel", 7.0)):
            with pytest.raises(AttributeError, match=f"^{name}: expected to stay what the pipeline was made with"):
                setattr(pipe, name, value)
        pipe.mask.weight = lambda evidence: 0.0 * evidence
        pipe.compensate.register_forward_hook(lambda *_: torch.zeros(1))
        pipe.solve = None
        assert all(torch.equal(one, other) for one, other in zip(frozen(images), before, strict=True))
        for name in ("mode", "compiled", "_plan", "anything"):
            with pytest.raises(AttributeError, match=f"{name}: a frozen pipeline cannot change"):
                setattr(frozen, name, None)
        assert copy.deepcopy(frozen) is frozen


SETTINGS = {
    "mask.sigmas": 12.0, "mask.rise": (2.0, 5.0), "mask.cells": 40, "mask.grey_share": 0.6, "mask.failed": 0.2,
    "mask.least_spread": 0.02, "mask.weights": [0.25, 0.5, 0.25], "mask.by_colour": False,
    "solve.zero.cells": 20, "solve.zero.waves": 5, "solve.zero.face": 0.4, "solve.zero.decay_mm": 0.7,
    "solve.zero.smooth_mm": 0.8, "solve.zero.stiff": 3.0, "solve.zero.pit": 0.0, "solve.zero.pit_share": 0.2,
    "contact.share": 0.6, "contact.large": 0.5, "contact.deep": 0.5, "contact.rim_mm": 1.0,
    "contact.fall": 0.2, "contact.pull": 0.01, "contact.pulling": 0.2, "contact.least_depth": 0.3, "contact.cell": 3,
    "contact.least_deep": 0.1, "contact.decay_mm": 0.3, "contact.blur_mm": 0.2, "contact.kink": 0.5, "contact.by_frame": False,
    "refine.passes": 4, "solve.gradient.max_slope": 0.2, "normals.shadowed.brightness_noises": 30.0,
    "compensate.clean.0.std_px": 0.0, "compensate.clean.0.weights": [0.25, 0.5, 0.25],
    "compensate.relight.every": 5, "compensate.relight.alike": 0.1, "compensate.relight.exact": 0.02,
    "compensate.relight.most_lost": 0.2, "compensate.relight.damping": 0.3, "compensate.relight.better": 3.0,
    "compensate.relight.scales": [0.1, 0.02],
    "compensate.relight.black": 0.3,
    "compensate.relight.saturation_light": 0.5,
}  # fmt: skip
"""Settings of blocks that a user may change."""


OF_BOTH = ("mask.", "contact.", "solve.zero.")
"""Blocks that units of both kinds have: with a field is enough."""


@pytest.mark.parametrize(
    "kind, name",
    [("response", name) for name in SETTINGS]
    + [long("lights", name) if name.startswith(OF_BOTH) else ("lights", name) for name in SETTINGS],
)
def test_settings_changed_before_are_obeyed_or_refused(kind, name):
    calibration, images = response_unit((60, 80), 0.32) if kind == "response" else lights_unit((60, 80), 0.4, blur_px=1.0)
    pipe = vts.DepthPipeline.from_calibration(calibration, "precise")
    place, _, key = name.rpartition(".")
    block = dict(pipe.named_modules()).get(place.replace("normals", "solve.normals"))
    if block is None or not hasattr(block, key):
        pytest.skip("no such setting")
    setattr(block, key, SETTINGS[name])
    not_compiled = pipe.freeze().not_compiled
    if not_compiled:
        assert name.split(".")[0] in not_compiled
    else:
        agree(pipe, images[:1])


class Own(vts.ContactMask):
    """A mask of one's own."""


def of_own_class(pipe):
    pipe.mask.__class__ = Own


def with_a_method(pipe):
    pipe.solve.zero.offset = lambda *arguments: type(pipe.solve.zero).offset(pipe.solve.zero, *arguments)


def with_a_hook(pipe):
    pipe.compensate.register_forward_hook(lambda *_: None)


def with_another_pitch(pipe):
    pipe.solve.integrate.mm_per_pixel *= 2.0


def with_another_order(pipe):
    pipe.compensate.clean = torch.nn.ModuleList([vts.compensate.compensate.Blur(1.0), vts.compensate.compensate.Blur(1.0)])


def in_double(pipe):
    pipe.double()


OWN = {
    "mask is Own": of_own_class,
    "solve.zero.offset is replaced": with_a_method,
    "compensate has a hook": with_a_hook,
    "integrate.mm_per_pixel is 0.5, not 0.25 as elsewhere in the pipeline": with_another_pitch,
    "compensate.clean is Blur, Blur": with_another_order,
    "is torch.float64 on cpu": in_double,
}


@pytest.mark.parametrize("reason", OWN)
def test_what_is_not_compiled_is_named_and_runs_in_pytorch(unit, reason):
    calibration, images = unit
    pipe = vts.DepthPipeline.from_calibration(calibration, "fast")
    OWN[reason](pipe)
    frozen = pipe.freeze()
    assert not frozen.compiled and reason in frozen.not_compiled and reason in repr(frozen)
    images = images[:2]  # that of noise takes longer than the others
    found, expected = frozen(images), pipe(images)
    assert torch.allclose(found.depth_mm, expected.depth_mm, rtol=0.0, atol=DEPTH_MM)
    assert torch.allclose(frozen.with_conditions(images)[1].light, pipe.conditions(images).light, atol=1e-4)
    assert not found.depth_mm.is_inference()


class Facing(torch.nn.Module):
    """Normals of a kind from images: facing the camera."""

    def forward(self, image):
        return torch.nn.functional.normalize(torch.cat((image[:, :2] - 0.5, torch.ones_like(image[:, :1])), dim=1), dim=1)


def test_a_network_in_training_is_frozen_in_eval_mode(unit):
    calibration, images = unit
    network = torch.nn.Sequential(Facing(), torch.nn.Dropout(0.5))
    frozen = vts.DepthPipeline.from_calibration(calibration, normals=network).freeze()
    assert network.training and torch.equal(frozen(images).depth_mm, frozen(images).depth_mm)


def test_a_method_of_a_class_that_is_replaced_is_named(unit, monkeypatch):
    monkeypatch.setattr(vts.ContactFromDepth, "above", lambda self, depth, pressure, pitch_mm: pressure)
    assert vts.DepthPipeline.from_calibration(unit[0]).freeze().not_compiled == "contact.above is replaced"


def test_constants_are_those_of_the_modules(unit, monkeypatch):
    calibration, images = unit
    before = vts.DepthPipeline.from_calibration(calibration).freeze()(images[:1])
    monkeypatch.setattr(skin_weight, "LEAST_DEPTH", 0.3)
    after = vts.DepthPipeline.from_calibration(calibration).freeze()(images[:1])
    assert int(after.deformed.sum()) < int(before.deformed.sum())


def test_without_the_library_all_is_in_pytorch(unit):
    calibration, images = unit
    pipe = vts.DepthPipeline.from_calibration(calibration, "precise")
    with without_library():
        frozen = pipe.freeze()
    assert "there is no compiled library" in frozen.not_compiled
    assert float((frozen(images).depth_mm - pipe.freeze()(images).depth_mm).abs().max()) <= DEPTH_MM


def test_maps_that_are_no_polynomials_are_named():
    calibration, images = response_unit((60, 80), 0.25)
    pipe = vts.DepthPipeline.from_calibration(calibration)
    pipe.normals.maps.copy_(torch.rand(pipe.normals.maps.shape, generator=torch.Generator().manual_seed(0)))
    assert pipe.freeze().not_compiled == "normals has maps that are no polynomials along rows"
    assert pipe.freeze()(images).depth_mm.shape == (4, 1, 60, 80)


# ---- inputs and outputs ----


def test_gradients_are_refused(unit):
    calibration, images = unit
    pipe = vts.DepthPipeline.from_calibration(calibration)
    frozen = pipe.freeze()
    recorded = images.clone().requires_grad_(True)
    with pytest.raises(ValueError, match=r"images: expected none that record gradients: .* call the pipeline itself"):
        frozen(recorded)
    with torch.no_grad():
        assert not frozen(recorded).depth_mm.requires_grad
    with pytest.raises(ValueError, match=r"pipe: expected parameters that record no gradient, got .*lights.position_mm"):
        pipe.requires_grad_(True).freeze()
    assert not frozen(images).depth_mm.requires_grad
    frozen(images).depth_mm.clone().requires_grad_(True).sum().backward()  # no inference tensor


BAD = {  # beside what test_refusals has
    "another size": (lambda x: x[..., :-1], ValueError, r"images: expected 96 x 128 like the calibration, got 96 x 127"),
    "infinite": (lambda x: x + torch.inf, ValueError, "images: expected finite values"),
    "double": (lambda x: x.double(), TypeError, r"images: expected torch.float32 on the CPU, got torch.float64 on cpu: use .float"),
    "on meta": (lambda x: x.to("meta"), TypeError, "meta"),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_images_are_refused(unit, kind):
    make, error, text = BAD[kind]
    frozen = vts.DepthPipeline.from_calibration(unit[0]).freeze()
    for call in (frozen, frozen.with_conditions):
        with pytest.raises(error, match=text):
            call(make(unit[1]))


def test_images_with_a_tangent_are_refused(unit):
    frozen = vts.DepthPipeline.from_calibration(unit[0]).freeze()
    with forward_ad.dual_level(), pytest.raises(ValueError, match="images: expected none with a tangent"):
        frozen(forward_ad.make_dual(unit[1], torch.ones_like(unit[1])))


def test_a_frame_of_vmap_is_refused_with_a_sentence(unit):
    frozen = vts.DepthPipeline.from_calibration(unit[0]).freeze()
    with pytest.raises(RuntimeError, match=r"images: expected a batch of frames, got a frame of torch\.func\.vmap: call it on the"):
        torch.func.vmap(lambda image: frozen(image[None]).depth_mm[0])(unit[1])


def test_images_may_lie_anywhere_in_memory(unit):
    calibration, images = unit
    frozen = vts.DepthPipeline.from_calibration(calibration, "precise").freeze()
    expected = frozen(images)
    wide = torch.zeros(len(images), 3, 99, 135)
    wide[:, :, 1:-2, 2:-5] = images
    imaginary = torch.complex(images, -images).conj().imag
    assert imaginary.is_neg()
    negated = torch._neg_view(-images)
    assert negated.is_neg() and negated.is_contiguous()
    for same in (images.contiguous(memory_format=torch.channels_last), wide[:, :, 1:-2, 2:-5], imaginary, negated):
        assert not same.is_contiguous() or same.is_neg()
        assert all(torch.equal(one, other) for one, other in zip(frozen(same), expected, strict=True))
    assert frozen(images[:0]).depth_mm.shape == (0, 1, 96, 128) and frozen.with_conditions(images[:0])[1].light.shape == (0, 3, 6)
    with torch.inference_mode():
        assert torch.equal(frozen(images).depth_mm, expected.depth_mm)


@pytest.mark.parametrize("kind", UNITS)
def test_defaults_of_torch_change_nothing(kind, tmp_path):
    calibration, images = UNITS[kind]((96, 128), 0.25)
    pipe = vts.DepthPipeline.from_calibration(calibration, "precise")
    expected = pipe.freeze()(images)
    calibration.save(tmp_path / "unit.safetensors")

    def loaded():
        return vts.DepthPipeline.from_calibration(vts.Calibration.load(tmp_path / "unit.safetensors"), "precise")(images)

    before = loaded()
    try:
        torch.set_default_dtype(torch.float64)
        assert all(map(torch.equal, pipe.freeze()(images), expected))
        again = loaded()
        assert again.depth_mm.dtype == torch.float32
        assert float((again.depth_mm - before.depth_mm).abs().max()) < DEPTH_MM
        assert vts.PointLights([[20, 9, 30], [-18, 13, 30], [-2, -22, 30]], [900, 900, 900]).albedo.dtype == torch.float32
    finally:
        torch.set_default_dtype(torch.float32)
    with torch.device("meta"):
        assert all(map(torch.equal, pipe.freeze()(images), expected))
    with torch.inference_mode():
        assert all(map(torch.equal, pipe.freeze()(images), expected))


def test_outputs_are_new_tensors(unit):
    calibration, images = unit
    frozen = vts.DepthPipeline.from_calibration(calibration).freeze()
    held = [frozen(images[k % 4 : k % 4 + 1]) for k in range(34)]
    kept = [[part.clone() for part in out] for out in held]
    for part in frozen(images):
        part.zero_()
    assert all(torch.equal(one, other) for out, was in zip(held, kept, strict=True) for one, other in zip(out, was, strict=True))
    memory = [part.untyped_storage().data_ptr() for out in held for part in out]
    assert len(set(memory)) == len(memory)
    assert all(part.is_contiguous() for part in held[0])


# ---- threads and processes ----


@pytest.fixture
def threads():
    """Sets how many threads torch uses, until the test ends."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.mark.parametrize("kind", UNITS)
def test_any_number_of_threads_gives_equal_bits(kind, threads):
    calibration, images = UNITS[kind]((96, 128), 0.25)
    frozen = vts.DepthPipeline.from_calibration(calibration, "precise").freeze()
    alone = [frozen(image[None]) for image in images]
    for count in (1, 2, 3, 7):
        threads(count)
        together = frozen(images.repeat(2, 1, 1, 1))
        for k, expected in enumerate(alone * 2):
            assert all(torch.equal(one[k : k + 1], other) for one, other in zip(together, expected, strict=True))
        assert torch.get_num_threads() == count


def test_several_callers_at_once(unit, threads):
    calibration, images = unit
    frozen = vts.DepthPipeline.from_calibration(calibration, "precise").freeze()
    alone, found, before = frozen(images), [], threading.enumerate()
    threads(2)
    callers = [threading.Thread(target=lambda: found.extend(frozen(images) for _ in range(5))) for _ in range(4)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert len(found) == 20
    assert all(torch.equal(one, other) for out in found for one, other in zip(out, alone, strict=True))
    assert set(threading.enumerate()) <= set(before)


INTERRUPTED = """
import os, signal, sys, threading, time, torch
signal.signal(signal.SIGINT, signal.default_int_handler)  # shells let commands in the background ignore it
import torchvts as vts
torch.set_num_threads(2)
lights = vts.PointLights([[20, 9, 30], [-18, 13, 30], [-2, -22, 30]], [900, 900, 900])
unit = vts.Calibration.from_lights(lights, vts.Sensor("rig", 96, 128, 0.25))
frozen = vts.DepthPipeline.from_calibration(unit).freeze()
assert frozen.compiled
scene = vts.scenes.sphere_press(8.0, 1.0, (0, 0), 96, 128, 0.25)
images = vts.scenes.render(scene, lights).detach().repeat(8, 1, 1, 1)
start = time.perf_counter(); expected = frozen(images); whole = time.perf_counter() - start
generator, interrupted = torch.Generator().manual_seed(0), 0
for k in range(30):
    delay = 1.2 * whole * float(torch.rand((), generator=generator))
    timer = threading.Timer(delay, os.kill, (os.getpid(), signal.SIGINT))
    try:
        timer.start()
        out = frozen(images)
        timer.join()
        time.sleep(0.001)
    except KeyboardInterrupt:
        interrupted += 1
    try:
        timer.join()
        time.sleep(0.001)
    except KeyboardInterrupt:
        pass
    for _ in range(500):  # one that was starting when the signal came ends by itself
        left = [t for t in threading.enumerate() if t.name.startswith("torchvts")]
        if not left: break
        time.sleep(0.01)
    assert not left, "a thread was left"
assert torch.get_num_threads() == 2
assert all(torch.equal(a, b) for a, b in zip(frozen(images), expected))
print("interrupted", interrupted)
"""


def test_ctrl_c_in_the_middle_of_a_batch():
    """30 times: no thread is left, no memory is freed under one, the next batch is right."""
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", INTERRUPTED], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    assert int(done.stdout.split()[-1]) > 12


def _depth(frozen, images, found):
    found.put(frozen(images).depth_mm.numpy().tobytes())


@pytest.mark.parametrize("how", ["fork", pytest.param("spawn", marks=pytest.mark.long)])
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_other_processes(unit, how, threads):
    if how not in multiprocessing.get_all_start_methods():
        pytest.skip(f"no {how} on this system")
    calibration, images = unit
    frozen = vts.DepthPipeline.from_calibration(calibration, "precise").freeze()
    expected = frozen(images).depth_mm
    threads(2)
    frozen(images)
    context = multiprocessing.get_context(how)
    found = context.Queue()
    child = context.Process(target=_depth, args=(frozen, images, found))
    child.start()
    depth = found.get(timeout=120)
    child.join()
    assert depth == expected.numpy().tobytes() and child.exitcode == 0
    again = pickle.loads(pickle.dumps(frozen))
    assert again.compiled and torch.equal(again(images).depth_mm, expected)


# ---- the library ----


def test_a_library_that_is_missing_or_left_over_is_not_used(monkeypatch, tmp_path):
    module = sys.modules["torchvts.compiled.binding"]
    monkeypatch.setattr(module, "LIBRARY", tmp_path / LIBRARY.name)
    try:
        library_of.cache_clear()
        assert library_of() is None
        shutil.copytree(LIBRARY.parent, tmp_path, dirs_exist_ok=True)
        library_of.cache_clear()
        assert library_of() is not None
        (tmp_path / "kernels.h").write_text("/* changed since */")
        library_of.cache_clear()
        with pytest.warns(UserWarning, match="built from other sources than lie beside it, so it is not used: install again"):
            assert library_of() is None
    finally:
        library_of.cache_clear()


def test_heights_without_a_fast_transform():
    calibration, images = lights_unit((67, 80), 0.3)
    frozen = vts.DepthPipeline.from_calibration(calibration).freeze()
    assert frozen.not_compiled == "height: it has a prime factor above 64, for which there is no fast cosine transform"
    assert frozen(images).depth_mm.shape == (4, 1, 67, 80)


PRIVATE = re.compile(r"torch\._|_version\b(?<!__version)|_functorch|use_count|_higher_order_ops|_inductor|forward_ad\._")


def test_no_private_name_of_torch_is_used():
    root = Path(vts.__file__).parent
    found = []
    for path in sorted(root.rglob("*.py")):
        for number, line in enumerate(path.read_text().splitlines(), 1):
            code = line.partition("#")[0].replace("format_version", "").replace("__version__", "").replace("codebase_version", "")
            if PRIVATE.search(code):
                found.append(f"{path.relative_to(root)}:{number}: {line.strip()}")
    assert found == []


def test_a_library_that_does_not_load_is_said_so(tmp_path, monkeypatch):
    damaged = tmp_path / "libtorchvts.so"
    damaged.write_bytes(b"no library")
    monkeypatch.setattr(binding, "LIBRARY", damaged)
    assert binding.library.__wrapped__() is None and "cannot be loaded" in binding.why_no_library()
    damaged.unlink()
    assert "no C compiler" in binding.why_no_library()
