"""Properties of every press, size and light: symmetries, units, order, finite gradients, threads, repetition, memory.

Hypothesis draws the examples, the same ones every time in `make test`. `make test-long` (TORCHVTS_TEST_PROFILE=long), where
all tests of this file are marked long, draws hundreds of new ones and sends 10,000 frames through each pipeline.
"""

import hashlib
import itertools
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import torch
from conftest import LONG, ring_lights
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

import torchvts as vts
from torchvts.model.response_field import ResponseModel

pytestmark = [pytest.mark.long] * LONG
SLOW = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.large_base_example]
QUICK = (Phase.explicit, Phase.generate)  # to make the failing example small takes longer than all of them
settings.register_profile(
    "short", max_examples=4, deadline=None, derandomize=True, database=None, suppress_health_check=SLOW, phases=QUICK
)
settings.register_profile("long", max_examples=300, deadline=None, database=None, suppress_health_check=SLOW)
settings.load_profile("long" if LONG else "short")
FRAMES = 10_000 if LONG else 100

HEIGHT, WIDTH, PITCH = 48, 64, 0.6
MODES = ("fast", "precise")

small = st.floats(-1.0, 1.0)
presses = st.builds(
    lambda press, x, y: vts.scenes.sphere_press(10.0, press, (5.0 * x, 3.0 * y), HEIGHT, WIDTH, PITCH, torch.float64),
    st.floats(0.4, 1.6), small, small,
)  # fmt: skip
lights_on_a_ring = st.builds(lambda turn: ring_lights(rotation_deg=turn, dtype=torch.float64), st.floats(0.0, 120.0))
sides = st.sampled_from([8, 9, 11, 13, 16, 17, 19, 23, 24, 29, 31])


def moved(lights, position=None, albedo=None):
    """The lights, their positions or albedo changed by a function."""
    at = lights.position_mm if position is None else position(lights.position_mm)
    return vts.PointLights(at, lights.albedo if albedo is None else albedo(lights.albedo)).requires_grad_(False)


def depth(image, lights, mode="precise", pitch=PITCH):
    sensor = vts.Sensor("rig", image.shape[2], image.shape[3], pitch)
    return vts.DepthPipeline.from_calibration(vts.Calibration.from_lights(lights, sensor), mode)(image).depth_mm


def gap_mm(one, two):
    return float((one - two).abs().max())


# ---- symmetries: image and lights move together, and the depth moves along ----


@given(presses, lights_on_a_ring, st.sampled_from(["x", "y"]), st.sampled_from(MODES))
def test_a_mirror_image_has_the_mirrored_depth(scene, lights, axis, mode):
    image, dim, k = vts.scenes.render(scene, lights), {"x": 3, "y": 2}[axis], {"x": 0, "y": 1}[axis]
    sign = torch.ones(3, dtype=torch.float64)
    sign[k] = -1.0
    mirrored = depth(image.flip(dim), moved(lights, lambda p: p * sign), mode)
    assert gap_mm(mirrored, depth(image, lights, mode).flip(dim)) < 1e-9


@given(presses, lights_on_a_ring, st.integers(1, 3), st.sampled_from(MODES))
def test_a_turned_image_has_the_turned_depth(scene, lights, quarters, mode):
    image = vts.scenes.render(scene, lights)

    def turn(position):  # of torch.rot90: x' = y, y' = -x
        for _ in range(quarters):
            position = torch.stack((position[:, 1], -position[:, 0], position[:, 2]), 1)
        return position

    turned = depth(image.rot90(quarters, (2, 3)), moved(lights, turn), mode)
    assert gap_mm(turned, depth(image, lights, mode).rot90(quarters, (2, 3))) < 1e-9


@given(st.floats(0.4, 1.2), lights_on_a_ring, st.integers(-6, 6), st.integers(-4, 4))
def test_a_shifted_press_has_the_shifted_depth(press_mm, lights, right, down):
    """By whole pixels, its lights with it; the grids on which zero is continued stay where they are, 0.031 mm at most here."""
    shift = torch.tensor([right * PITCH, down * PITCH, 0.0], dtype=torch.float64)
    here = vts.scenes.sphere_press(10.0, press_mm, (0.0, 0.0), HEIGHT, WIDTH, PITCH, torch.float64)
    there = vts.scenes.sphere_press(10.0, press_mm, tuple(shift[:2].tolist()), HEIGHT, WIDTH, PITCH, torch.float64)
    other = moved(lights, lambda p: p + shift)
    one, two = depth(vts.scenes.render(here, lights), lights), depth(vts.scenes.render(there, other), other)
    inner = one[..., 10:-10, 10:-10]
    assert gap_mm(two[..., 10 + down : HEIGHT - 10 + down, 10 + right : WIDTH - 10 + right], inner) < 0.04 * press_mm


@given(presses, lights_on_a_ring, st.permutations(range(3)), st.sampled_from(MODES))
def test_channels_and_lights_may_change_places(scene, lights, order, mode):
    image = vts.scenes.render(scene, lights)
    other = moved(lights, lambda p: p[list(order)], lambda a: a[list(order)])
    assert gap_mm(depth(image[:, list(order)], other, mode), depth(image, lights, mode)) < 1e-9


# ---- the integrators ----


def random_gradient(height, width, seed, count=1):
    return torch.randn(count, 2, height, width, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


SOLVERS = {"PoissonDST": (3, vts.PoissonDST), "PoissonDCT": (2, vts.PoissonDCT), "PoissonBackground": (2, vts.PoissonBackground)}


@given(st.sampled_from(sorted(SOLVERS)), st.integers(3, 40), st.integers(3, 40), st.floats(0.01, 9.0), st.integers(0, 99))
def test_integration_keeps_sums_pitch_mirror_and_turn(name, height, width, pitch, seed):
    solve = SOLVERS[name][1]
    one, two = random_gradient(height, width, seed, 2).split(1)
    whole = solve()(one)
    if name != "PoissonBackground":  # whose level depends on where the gradient is zero
        assert gap_mm(solve()(one - 3.0 * two), whole - 3.0 * solve()(two)) < 1e-9
    assert gap_mm(solve(pitch)(one), pitch * whole) < 1e-9
    sign = torch.tensor([-1.0, 1.0], dtype=torch.float64).reshape(1, 2, 1, 1)
    assert gap_mm(solve()(sign * one.flip(3)), whole.flip(3)) < 1e-10
    turned = torch.cat((one[:, 1:], -one[:, :1]), 1).rot90(1, (2, 3))  # x' = y, y' = -x
    assert gap_mm(solve()(turned), whole.rot90(1, (2, 3))) < 1e-10


@given(st.sampled_from(sorted(SOLVERS)), st.integers(1, 40), st.integers(1, 40), st.sampled_from([torch.float32, torch.float64]))
def test_every_size_is_integrated_or_refused(name, height, width, dtype):
    least, solve = SOLVERS[name]
    gradient = random_gradient(height, width, 0).to(dtype)
    if min(height, width) < least:
        with pytest.raises(ValueError, match=rf"^gradient: expected H and W of at least {least}, got {height} x {width}"):
            solve()(gradient)
        return
    found = solve(0.5)(gradient)
    assert found.shape == (1, 1, height, width) and found.dtype == dtype and bool(torch.isfinite(found).all())
    assert gap_mm(found.double(), solve(0.5)(gradient.double())) < 2e-4 * max(1.0, float(found.abs().max()))


# ---- sizes, and finite gradients ----


def unit(by, height=HEIGHT, width=WIDTH, pitch=PITCH, dtype=torch.float32):
    """A calibrated unit whose background has spots and a dead pixel."""
    lights, sensor = ring_lights(dtype=dtype), vts.Sensor("rig", height, width, pitch)
    background = vts.model.lights.flat_image(lights, height, width, pitch)
    background = background * vts.scenes.skin_spots(height, width, 2, 1)[0].to(dtype)
    if by == "lights":
        return vts.Calibration.from_lights(lights, sensor, background)
    random = torch.Generator().manual_seed(3)
    family = vts.calibration.field.Family(1, 1, 20.0)
    field = family.field(0.1 * torch.randn(2, family.size(), generator=random, dtype=torch.float64))
    by_depth = vts.model.DepthBrightness(1, 20.0, 0.1 * torch.randn(3, 3, generator=random, dtype=torch.float64))
    return vts.Calibration.from_response(ResponseModel(field, by_depth), sensor, background)


def press_image(calibration, kind, seed=0):
    """A frame (1, 3, H, W): without contact, pressed, pressed at the border, with invalid pixels, or noise, black or white."""
    sensor = calibration.sensor
    field = min(sensor.field_mm)
    x = {"no contact": 0.0, "border": 0.5 * field}.get(kind, 0.1 * field)
    scene = vts.scenes.sphere_press(0.4 * field, 0.1 * field, (x, 0.0), sensor.height, sensor.width, sensor.mm_per_pixel)
    lights = ring_lights()
    image = vts.scenes.render(vts.scenes.undeformed(scene) if kind == "no contact" else scene, lights)
    random = torch.Generator().manual_seed(seed)
    if kind == "holes":
        chance = torch.rand(image.shape, generator=random)
        image = torch.where(chance < 0.05, 0.0, torch.where(chance > 0.95, 1.0, image))
    if kind == "noise":
        image = torch.rand(image.shape, generator=random)
    if kind in ("black", "white"):
        image = torch.full_like(image, float(kind == "white"))
    return image.to(calibration.background.dtype)


KINDS = ("no contact", "press", "border", "holes", "noise", "black", "white")


@given(sides, sides, st.sampled_from(["lights", "response"]), st.sampled_from(MODES), st.sampled_from(KINDS))
def test_odd_prime_and_tiny_images_work(height, width, by, mode, kind):
    calibration = unit(by, height, width)
    out = vts.DepthPipeline.from_calibration(calibration, mode)(press_image(calibration, kind))
    assert [tuple(t.shape[1:]) for t in out] == [(c, height, width) for c in (1, 2, 3, 1, 1)]
    assert all(bool(torch.isfinite(t).all()) for t in out)
    assert float((out.normal.norm(dim=1) - 1.0).abs().max()) < 1e-5 and bool((out.normal[:, 2] > 0).all())


BY_AND_MODE = [pytest.param(by, mode, marks=[] if (by == "lights") == (mode == "precise") else [pytest.mark.long])
               for by in ("lights", "response") for mode in MODES]  # fmt: skip
"""Each model and each mode once; make test-long has every pair."""


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("by, mode", BY_AND_MODE)
def test_gradients_by_the_image_are_finite(kind, by, mode):
    calibration = unit(by)
    pipe = vts.DepthPipeline.from_calibration(calibration, mode)
    image = press_image(calibration, kind).requires_grad_()
    out = pipe(image)
    total = out.depth_mm.sum() + out.gradient.sum() + out.normal.sum()
    if total.requires_grad:
        total.backward()
        assert bool(torch.isfinite(image.grad).all())
    else:
        assert not bool(out.contact.any())


@pytest.mark.parametrize("value", [0.0, 1e-30, 1e30])
@pytest.mark.parametrize("name", sorted(SOLVERS))
def test_gradients_through_integrators_are_finite(name, value):
    gradient = torch.full((1, 2, 12, 17), value, dtype=torch.float64).requires_grad_()
    SOLVERS[name][1]()(gradient).square().sum().backward()
    assert bool(torch.isfinite(gradient.grad).all())


@given(st.floats(0.3, 3.0), st.sampled_from(MODES))
def test_gradients_by_the_lights_are_finite(press_mm, mode):
    calibration = unit("lights")
    pipe = vts.DepthPipeline.from_calibration(calibration, mode).requires_grad_(True)
    scene = vts.scenes.sphere_press(10.0, press_mm, (0.0, 0.0), HEIGHT, WIDTH, PITCH)
    pipe(vts.scenes.render(scene, ring_lights())).depth_mm.sum().backward()
    assert all(bool(torch.isfinite(p.grad).all()) for p in pipe.parameters() if p.grad is not None)
    assert pipe.normals.lights.position_mm.grad is not None


# ---- threads, repetition, memory ----


def in_threads(jobs):
    """Results of functions that start at once, each in its own thread."""
    start, results, errors = threading.Barrier(len(jobs)), [None] * len(jobs), []

    def run(k):
        try:
            start.wait()
            results[k] = jobs[k]()
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=run, args=(k,)) for k in range(len(jobs))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    return results


@pytest.mark.parametrize("by, mode", BY_AND_MODE)
def test_threads_may_share_a_pipeline(by, mode):
    calibration = unit(by)
    pipe = vts.DepthPipeline.from_calibration(calibration, mode)
    images = [press_image(calibration, kind) for kind in ("press", "border", "no contact", "holes")]
    with torch.inference_mode():
        alone = [vts.DepthPipeline.from_calibration(calibration, mode)(image) for image in images]

        def job(k):
            with torch.inference_mode():  # each thread has its own mode
                return [pipe(images[k]) for _ in range(FRAMES // 50)]

        for k, found in enumerate(in_threads([lambda k=k: job(k) for k in range(len(images))])):
            assert all(torch.equal(a, b) for out in found for a, b in zip(out, alone[k], strict=True))


def test_threads_may_make_the_first_calls_of_a_pipeline():
    """Each prepares its compiled call: none may lose the memory of its own when another's takes the place beside the pipeline."""
    calibration = unit("response", 24, 32, 2.0 * PITCH)
    images = [press_image(calibration, kind) for kind in ("press", "border", "no contact", "holes")]
    alone = [vts.DepthPipeline.from_calibration(calibration)(image) for image in images]
    for _ in range(8 if LONG else 4):
        pipe = vts.DepthPipeline.from_calibration(calibration)
        found = in_threads([lambda k=k, pipe=pipe: [pipe(images[k]) for _ in range(3)] for k in range(len(images))])
        assert all(torch.equal(a, b) for k, outs in enumerate(found) for out in outs for a, b in zip(out, alone[k], strict=True))


@pytest.mark.parametrize("name", sorted(SOLVERS))
def test_threads_may_share_an_integrator_for_several_sizes(name):
    """It keeps the tables of the last size: another thread's must not come between.

    To some last bits: under load one FFT in 50,000 of 12 x 16 values ends in another.
    """
    solve = SOLVERS[name][1](0.5)
    gradients = [
        random_gradient(h, w, 1).to(t) for h, w in ((12, 16), (13, 16), (32, 24), (31, 7)) for t in (torch.float32, torch.float64)
    ]
    alone = [SOLVERS[name][1](0.5)(gradient) for gradient in gradients]

    def job(k):
        return [solve(gradients[(k + turn) % 8]) for turn in range(FRAMES // 5)]

    for k, found in enumerate(in_threads([lambda k=k: job(k) for k in range(6)])):
        for turn, z in enumerate(found):
            expected = alone[(k + turn) % 8]
            assert z.dtype == expected.dtype
            assert (z - expected).abs().max() <= 8 * torch.finfo(z.dtype).eps * expected.abs().max()


def digest(mode, by, kinds=KINDS if LONG else ("press", "holes")):
    """A hash of all bits that a pipeline gives."""
    calibration = unit(by)
    pipe = vts.DepthPipeline.from_calibration(calibration, mode)
    with torch.inference_mode():
        found = [t for kind in kinds for t in pipe(press_image(calibration, kind))]
    return hashlib.sha256(b"".join(t.numpy().tobytes() for t in found)).hexdigest()


def test_the_same_frames_give_the_same_bits():
    ways = list(itertools.product(MODES, ("lights", "response")))[:: 1 if LONG else 3]
    here = [digest(*way) for way in ways]
    program = f"import torch, test_properties as t\ntorch.set_num_threads(1)\nprint(*[t.digest(*way) for way in {ways}])"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", program], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == here


def resident_bytes():
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.skipif(not Path("/proc/self/statm").is_file(), reason="no /proc here")
@pytest.mark.parametrize("by", ["lights", pytest.param("response", marks=pytest.mark.long)])
@pytest.mark.parametrize("mode", MODES if LONG else ["precise"])
def test_memory_stays_flat_over_many_frames(by, mode):
    calibration = unit(by, 24, 32, 2.0 * PITCH)
    pipe = vts.DepthPipeline.from_calibration(calibration, mode)
    images = [press_image(calibration, kind) for kind in ("no contact", "press", "border", "holes")]
    with torch.inference_mode():
        for k in range(40):  # tables are made, pools fill
            pipe(images[k % len(images)])
        before = resident_bytes()
        for k in range(FRAMES):
            pipe(images[k % len(images)])
    # if one output of each frame were kept, that would be 25 kB a frame
    assert resident_bytes() - before < (3e6 + 100.0 * FRAMES if LONG else 1e6)
