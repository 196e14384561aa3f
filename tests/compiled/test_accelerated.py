"""Compiled kernels against the PyTorch reference that they stand for."""

import shutil
import threading

import pytest
import torch

import torchvts as vts
from torchvts.accelerated import kernels, reference_only
from torchvts.accelerated.blocks import Compensate, Drift, NormalFromResponse
from torchvts.accelerated.derived import response_lines
from torchvts.accelerated.gate import usable
from torchvts.model.response_field import DepthBrightness, ResponseField, ResponseModel

scenes = vts.scenes

pytestmark = pytest.mark.skipif(kernels.library() is None and shutil.which("cc") is None, reason="no C compiler")


def both(call, *arguments):
    """What compiled kernels and PyTorch reference make of one call."""
    with reference_only():
        reference = call(*arguments)
    return call(*arguments), reference


def test_the_loops_were_built():
    assert kernels.library() is not None, f"{kernels.LIBRARY} is missing: install again (make setup)"


@pytest.mark.parametrize("size", [(48, 64), (240, 320), (45, 63), (2, 2), (3, 7), (16, 5), (1, 9)])
@pytest.mark.parametrize("module", [vts.PoissonDCT, vts.PoissonBackground])
def test_depth_of_any_size(module, size):
    solver = module(0.3)
    if min(size) < 2:
        with pytest.raises(ValueError, match="expected H and W of at least 2"):
            solver(torch.zeros(1, 2, *size))
        return
    gradient = torch.randn(3, 2, *size, generator=torch.Generator().manual_seed(size[0]))
    gradient[1, :, : size[0] // 2] = 0.0
    gradient[2] = 0.0
    compiled, reference = both(solver, gradient)
    assert float((compiled - reference).abs().max()) < 3e-7 * (1.0 + float(reference.abs().max())) * max(size) ** 0.5


@pytest.mark.parametrize("camera_height_mm", [float("inf"), 60.0])
@pytest.mark.parametrize("height_mm", [15.0, 40.0])
def test_normals_on_undeformed_skin_and_at_a_depth(ring, height_mm, camera_height_mm):
    """Of moderate slopes, of slopes that block lights, and of images that no slope makes."""
    lights = ring(25.0, height_mm)
    scene = scenes.sphere_press(10.0, 3.0, (2.0, -1.0), 60, 80, 0.4)
    block = vts.NormalFromIntensity(lights, 60, 80, 0.4, camera_height_mm=camera_height_mm)
    seen = scenes.render(scene, lights, noise_std=0.003, seed=1).repeat(2, 1, 1, 1)
    seen[1] = 0.6 * seen[1] + 0.1
    depth = scene.depth_mm + torch.tensor([0.0, 0.5]).reshape(2, 1, 1, 1)
    bound = 1e-3 if height_mm < 20.0 else 3e-6  # single pixels, near the plane of the lit lights, make much of the last bit
    for given in (None, depth, depth[:1]):
        for image in (seen, seen.transpose(2, 3).contiguous().transpose(2, 3)):
            compiled, reference = both(block, image, given)
            apart = (compiled - reference).abs().flatten()
            assert float(apart.quantile(0.999)) < 3e-5 and float(apart.max()) < bound
            assert float((compiled.norm(dim=1) - 1.0).abs().max()) < 1e-6


def test_a_frame_of_every_mode(ring):
    """Contact to the bit, depth to 2e-6 mm; two frames pressed, one undeformed, one cut by the border."""
    lights = ring()
    places = [(1.0, (0.0, 0.0)), (0.0, (0.0, 0.0)), (0.6, (-3.0, 4.0)), (1.5, (18.0, 2.0))]
    presses = [scenes.sphere_press(10.0, max(mm, 0.1), at, 120, 160, 0.25) for mm, at in places]
    frames = torch.cat(
        [
            scenes.render(press if mm else scenes.undeformed(press), lights, noise_std=0.003, bits=8, seed=k)
            for k, (press, (mm, _)) in enumerate(zip(presses, places, strict=True))
        ]
    ).detach()
    rest = scenes.render(scenes.undeformed(presses[0]), lights, noise_std=0.003, bits=8, seed=9).detach()
    calibration = vts.Calibration.from_lights(lights, vts.Sensor("rig", 120, 160, 0.25), rest[0])
    for mode in ("fast", "precise", "auto"):
        pipe = vts.DepthPipeline.from_calibration(calibration, mode)
        for some in (frames, frames[:1], frames[1:2]):
            compiled, reference = both(pipe, some)
            assert torch.equal(compiled.contact, reference.contact)
            assert float((compiled.depth_mm - reference.depth_mm).abs().max()) < 2e-6
            assert float((compiled.gradient - reference.gradient).abs().max()) < 1e-5
            assert float((compiled.normal - reference.normal).abs().max()) < 1e-5
    assert bool(calibration.model_image.min() > 0) and compiled.contact.shape == (1, 1, 120, 160)


@pytest.mark.parametrize("size", [(240, 320), (181, 200), (483, 640)])
def test_means_on_a_grid(size):
    image = torch.randn(2, 3, *size, generator=torch.Generator().manual_seed(0))
    compiled, reference = both(Drift().samples, image)
    assert compiled.shape == reference.shape and float((compiled - reference).abs().max()) < 1e-6


def test_channels_left_out(ring):
    lights, scene = ring(20.0, 12.0), scenes.sphere_press(10.0, 3.0, (0, 0), 60, 80, 0.4)
    block = vts.NormalFromIntensity(lights, 60, 80, 0.4)
    seen = scenes.render(scene, lights, noise_std=0.002, bits=8, seed=1).detach()
    apart = block.shadowed.without_dark(seen)
    assert bool((apart < 0).any()) and torch.equal(apart.clamp_min(0), seen.masked_fill(apart < 0, 0))
    shiny = vts.NormalFromIntensity(vts.PointLights(lights.position_mm, lights.albedo, [0.9] * 3), 60, 80, 0.4)
    steep = scene.depth_mm * 1.5  # where the lobe is strong, what is left out is left out still
    brighter = torch.where(apart < 0, apart * 0.8, apart)
    assert torch.equal(shiny(apart, steep), shiny(brighter, steep))
    for depth in (None, scene.depth_mm):
        compiled, reference = both(block.solve, apart, depth, torch.zeros(1, 2, 60, 80))
        assert float((compiled - reference).abs().max()) < 2e-5
        assert float((compiled - block(seen, depth)).abs().max()) > 0.1


def test_what_loops_may_not_touch():
    plain = torch.zeros(1, 2, 8, 8)
    assert usable(plain, plain)
    with reference_only():
        assert not usable(plain)
    assert not usable(plain, plain.double())
    assert not usable(plain.half())
    assert not usable(plain.to("meta"))
    recorded = plain.clone().requires_grad_(True)
    assert not usable(recorded)
    with torch.no_grad():
        assert usable(recorded)


def test_batches_that_do_not_fit_are_refused(ring):
    block = vts.NormalFromIntensity(ring(), 48, 64, 0.5)
    image = torch.full((5, 3, 48, 64), 0.4)
    for count in (0, 2):
        with pytest.raises(ValueError, match=f"depth_mm: expected 5 frames like compensated, or one for all, got {count}"):
            block(image, torch.zeros(count, 1, 48, 64))
        with pytest.raises(ValueError, match=f"expected: expected 5 frames like compensated, or one for all, got {count}"):
            block.solve(image, None, torch.zeros(count, 2, 48, 64))
    dark = image.clone()
    dark[:, 0, :20] = 0.0
    compiled, reference = both(block.solve, dark, None, torch.zeros(1, 2, 48, 64))
    assert float((compiled - reference).abs().max()) < 1e-4
    assert block(image[:0]).shape == (0, 3, 48, 64) and vts.PoissonBackground(0.1)(torch.zeros(0, 2, 48, 64)).shape == (
        0,
        1,
        48,
        64,
    )


def test_defaults_of_torch_do_not_reach_the_loops(ring, small_sensor, small_press):
    lights = ring()
    pipe = vts.DepthPipeline.from_calibration(vts.Calibration.from_lights(lights, small_sensor), "precise")
    image = scenes.render(small_press(1.0), lights).detach()
    alone = pipe(image)
    try:
        torch.set_default_dtype(torch.float64)
        assert all(map(torch.equal, pipe(image), alone))
    finally:
        torch.set_default_dtype(torch.float32)
    with torch.device("meta"):
        assert all(map(torch.equal, pipe(image), alone))


def test_traces_see_operators():
    from torch._subclasses.fake_tensor import FakeTensorMode
    from torch.fx.experimental.proxy_tensor import make_fx

    gradient = torch.randn(1, 2, 12, 16, generator=torch.Generator().manual_seed(0))
    traced = make_fx(lambda part: vts.poisson_background(part, 0.1))(gradient)
    assert torch.allclose(traced(gradient), vts.poisson_background(gradient, 0.1), atol=1e-6)
    with FakeTensorMode():
        assert vts.poisson_background(torch.randn(1, 2, 12, 16), 0.1).shape == (1, 1, 12, 16)


def test_tangents_pass_through_operators():
    """Forward differentiation records nothing on the tensor itself, so kernels would lose it in silence."""
    solver = vts.PoissonDCT(0.1)
    gradient, tangent = torch.randn(2, 1, 2, 12, 16, generator=torch.Generator().manual_seed(0))
    depth, change = torch.func.jvp(solver, (gradient,), (tangent,))
    assert torch.allclose(depth, solver(gradient), atol=1e-6)
    assert float((change - solver(tangent)).abs().max()) < 1e-5  # it is linear


def test_without_them_all_works(monkeypatch, ring, small_sensor, small_press):
    lights = ring()
    pipe = vts.DepthPipeline.from_calibration(vts.Calibration.from_lights(lights, small_sensor), "precise")
    image = scenes.render(small_press(1.0), lights).detach()
    compiled = pipe(image).depth_mm
    monkeypatch.setattr(kernels, "library", lambda: None)
    assert not usable(image)
    assert torch.allclose(pipe(image).depth_mm, compiled, rtol=0, atol=2e-6)


def test_a_library_that_is_missing_or_left_over_is_not_used(monkeypatch, tmp_path):
    library = kernels.LIBRARY
    monkeypatch.setattr(kernels, "LIBRARY", tmp_path / library.name)
    try:
        kernels.library.cache_clear()
        assert kernels.library() is None
        shutil.copytree(library.parent, tmp_path, dirs_exist_ok=True)
        kernels.library.cache_clear()
        assert kernels.library() is not None
        (tmp_path / "kernels.h").write_text("/* changed since */")
        kernels.library.cache_clear()
        with pytest.warns(UserWarning, match="built from other sources than lie beside it, so it is not used: install again"):
            assert kernels.library() is None
    finally:
        kernels.library.cache_clear()


@pytest.fixture(scope="module")
def response_unit():
    """A unit calibrated by a response field with products, a blur and a drift of the light, and its frames."""
    generator = torch.Generator().manual_seed(3)
    field = ResponseField(3, 2, 8.0, tuple(tuple((0.3 * torch.randn(66, generator=generator)).tolist()) for _ in range(2)))
    rows = tuple(tuple((0.05 * torch.randn(6, generator=generator)).tolist()) for _ in range(3))
    by_depth = DepthBrightness(2, 8.0, rows, steeper=0.1, reference_mm=0.2)
    sensor = vts.Sensor("soft", 120, 160, 0.1, blur_px=1.0)
    background = 0.4 + 0.1 * torch.rand(3, 120, 160, generator=generator)
    background[:, 40, 50] = 0.0  # a defect
    calibration = vts.Calibration(
        sensor,
        None,
        background,
        torch.full((3,), 0.004),
        True,
        {"model": "response", "source": "given"},
        ResponseModel(field, by_depth),
    )
    y, x = torch.arange(120.0)[:, None] - 50.0, torch.arange(160.0)[None, :] - 90.0
    bump = torch.exp(-(x * x + y * y) / 600.0)
    change = torch.stack([bump * x / 60.0, -bump * x / 60.0, bump * y / 60.0])
    frames = torch.stack([background * (1.0 + level * change) * (1.0 + drift) for level, drift in ((1, 0), (0.6, 0.05), (0, 0))])
    noisy = frames + 0.004 * torch.randn(frames.shape, generator=generator)
    return calibration, (noisy.clamp(0.0, 1.0) * 255.0).round() / 255.0


@pytest.mark.parametrize("mode", ["fast", "precise", "auto"])
def test_a_frame_by_response_fields(response_unit, mode):
    calibration, frames = response_unit
    pipe = vts.DepthPipeline.from_calibration(calibration, mode)
    assert bool(pipe(frames).deformed[0].any())
    for some in (frames, frames[:1], frames[1:]):
        compiled, reference = both(pipe, some)
        assert torch.equal(compiled.deformed, reference.deformed) and torch.equal(compiled.contact, reference.contact)
        assert float((compiled.depth_mm - reference.depth_mm).abs().max()) < 1e-6
        assert float((compiled.normal - reference.normal).abs().max()) < 2e-5


@pytest.mark.parametrize("mode", ["fast", "precise"])
@pytest.mark.parametrize("shade", [0.1, 0.12, 0.2])
def test_a_frame_in_a_shade(response_unit, shade, mode):
    """A shade, with an edge or without one, moves no skin, and hides none that has moved."""
    calibration, frames = response_unit
    x = torch.arange(160.0)
    pipe = vts.DepthPipeline.from_calibration(calibration, mode)
    shades = torch.stack([1.0 - shade * (x > 80.0), 1.0 - shade * torch.sigmoid((x - 80.0) / 8.0)])
    compiled, reference = both(pipe, (frames[:, None] * shades[:, None, None]).flatten(0, 1))
    assert torch.equal(compiled.deformed, reference.deformed)
    assert int((compiled.contact ^ reference.contact).sum()) <= 1  # a pressure that rounding moves over the threshold
    assert float((compiled.depth_mm - reference.depth_mm).abs().max()) < 1e-6
    assert bool(compiled.deformed[:4].flatten(1).any(dim=1).all()) and not bool(compiled.deformed[4:].any())


def test_loops_follow_what_is_loaded(response_unit):
    """The tables of the kernels are made of a block's maps, and made again when these change."""
    calibration, frames = response_unit
    block = NormalFromResponse.from_calibration(calibration)
    ratio = Compensate.from_calibration(calibration)(frames)
    before = block(ratio)
    state = {name: 0.5 * value for name, value in block.state_dict().items()}
    block.load_state_dict(state)
    compiled, reference = both(block, ratio)
    assert float((compiled - reference).abs().max()) < 2e-6 and float((compiled - before).abs().max()) > 0.01
    block.maps.copy_(torch.rand(block.maps.shape, generator=torch.Generator().manual_seed(0)))  # no polynomial at all
    compiled, reference = both(block, ratio)
    assert torch.equal(compiled, reference)


@pytest.mark.parametrize("size", [(240, 320), (45, 63), (7, 9)])
@pytest.mark.parametrize("blur_px", [0.0, 0.6, 1.0, 2.5])
def test_compensated_images(size, blur_px):
    generator = torch.Generator().manual_seed(size[0])
    gain, image = 0.5 + torch.rand(3, *size, generator=generator), torch.rand(2, 3, *size, generator=generator)
    defects = torch.rand(size, generator=generator) > 0.98
    for offset in (None, 0.03 * gain, torch.rand(3, *size, generator=generator)):
        for given in ((gain, offset), (None, offset)):
            block = Compensate(*given, defects=defects, blur_px=blur_px, drift=Drift())
            compiled, reference = both(block, image)
            assert float((compiled - reference).abs().max()) < 1e-6


def test_small_batches_take_one_thread_and_large_ones_all(ring):
    """Whatever the number of threads, results are the same, and torch's number of threads is what it was."""
    lights = ring()
    scene = scenes.sphere_press(10.0, 1.0, (0, 0), 240, 320, 0.1)
    calibration = vts.Calibration.from_lights(lights, vts.Sensor("rig", 240, 320, 0.1))
    pipe = vts.DepthPipeline.from_calibration(calibration)
    inside, workers = [], set()
    pipe.mask.register_forward_hook(lambda *_: inside.append(torch.get_num_threads()))
    pipe.mask.register_forward_hook(lambda *_: workers.add(threading.get_ident()))
    image = scenes.render(scene, lights, noise_std=0.003, bits=8, seed=1).detach()
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        alone, five = pipe(image), pipe(image.repeat(5, 1, 1, 1))
        assert inside[0] == 1 and len(inside) == 6 and torch.get_num_threads() == 2
        assert len(workers) == 2 and torch.equal(five.depth_mm, alone.depth_mm.expand(5, -1, -1, -1))
        with pytest.raises(ValueError, match="images"):
            pipe(image[0])
        with pytest.raises(ValueError, match="images"):
            pipe(2.0 * image)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("orders", [(2, -1, -1), (1, 0, 2), (2, -1, 1), (4, 2, 0)])
def test_normals_by_every_order_of_products(orders):
    generator = torch.Generator().manual_seed(sum(orders) + 9)
    degree, product, cubic = orders
    size = terms_of(*orders)
    rows = tuple(tuple((0.3 * torch.randn(size, generator=generator)).tolist()) for _ in range(2))
    by_depth = DepthBrightness(1, 5.0, ((0.05, 0.01, 0.0),) * 3, steeper=0.3, reference_mm=0.4)
    block = NormalFromResponse(ResponseField(degree, product, 5.0, rows, cubic), by_depth, 40, 60, 0.2)
    image, depth = 1.0 + 0.1 * torch.randn(2, 3, 40, 60, generator=generator), torch.rand(2, 1, 40, 60, generator=generator)
    assert response_lines(block) is not None
    for given in (None, depth):
        compiled, reference = both(block, image, given)
        assert float((compiled - reference).abs().max()) < 2e-6


def terms_of(degree, product, cubic):
    """Coefficients of one slope of a field of these degrees."""
    return sum(count * (d + 1) * (d + 2) // 2 for count, d in ((3, degree), (6, product), (10, cubic)) if d >= 0)


def test_heights_that_have_no_fast_transform():
    """A prime factor above 64: torch solves."""
    solver = vts.PoissonBackground(0.1)
    gradient = torch.randn(1, 2, 67, 20, generator=torch.Generator().manual_seed(0))
    assert kernels.poisson_plan(67, 20) is None and kernels.poisson_plan(61, 20) is not None
    compiled, reference = both(solver, gradient)
    assert torch.equal(compiled, reference)
