"""Compiled kernels against the PyTorch reference that they stand for."""

import shutil
import threading
from itertools import pairwise

import pytest
import torch

import torchvts as vts
from torchvts.accelerated import kernels, memory, reference_only
from torchvts.accelerated.blocks import (
    Compensate,
    ContactFromDepth,
    Drift,
    LargestChange,
    MaskedGradient,
    NormalFromResponse,
    ZeroBackground,
)
from torchvts.accelerated.derived import response_lines
from torchvts.accelerated.gate import usable
from torchvts.core.geometry import gradient_of_depth
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
def test_depth_of_any_window(module, size):
    generator = torch.Generator().manual_seed(size[0])
    solver = module(0.3)
    if min(size) < 2:
        with pytest.raises(ValueError, match="expected H and W of at least 2"):
            solver(torch.zeros(1, 2, *size))
        return
    for top, left, height, width in windows(size, generator):
        gradient = torch.randn(3, 2, height, width, generator=generator)
        gradient[1, :, : height // 2] = 0.0
        gradient[2] = 0.0
        compiled, reference = both(solver, gradient, (top, left), size)
        assert float((compiled - reference).abs().max()) < 3e-7 * (1.0 + float(reference.abs().max())) * max(size) ** 0.5


def windows(size, generator):
    """All of an image, its corners and sides, and parts inside."""
    height, width = size
    yield 0, 0, height, width
    for _ in range(12):
        rows, columns = (2 + int(torch.randint(max(1, n - 1), (1,), generator=generator)) for n in size)
        rows, columns = min(rows, height), min(columns, width)
        for top in {0, (height - rows) // 2, height - rows}:
            for left in {0, (width - columns) // 2, width - columns}:
                yield top, left, rows, columns


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
    for rows, columns, window in ((slice(0, 60), slice(0, 80), None), (slice(8, 41), slice(16, 77), (8, 16))):
        for given in (None, depth[:, :, rows, columns], depth[:1, :, rows, columns]):
            for image in (seen[:, :, rows, columns], seen.transpose(2, 3).contiguous().transpose(2, 3)[:, :, rows, columns]):
                compiled, reference = both(block, image, given, window)
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


def test_the_largest_change():
    one, other = torch.randn(2, 3, 1, 7, 11, generator=torch.Generator().manual_seed(0))
    compiled, reference = both(LargestChange(), one, other)
    assert torch.equal(compiled, reference) and compiled.shape == (3,)
    assert bool(kernels.largest_change(one, torch.full_like(one, torch.nan)).isnan().all())


def test_a_failed_led(ring):
    lights = ring()
    scene = scenes.sphere_press(10.0, 1.0, (0, 0), 120, 160, 0.25)
    calibration = vts.Calibration.from_lights(lights, vts.Sensor("rig", 120, 160, 0.25))
    image = scenes.render(scene, lights, noise_std=0.003, bits=8, seed=1).detach() * torch.tensor([1.0, 0.0, 1.0]).reshape(3, 1, 1)
    compiled, reference = both(vts.ContactMask.from_calibration(calibration), image)
    assert torch.equal(compiled, reference) and bool(compiled.any())


def test_channels_left_out(ring):
    lights, scene = ring(20.0, 12.0), scenes.sphere_press(10.0, 3.0, (0, 0), 60, 80, 0.4)
    block = vts.NormalFromIntensity(lights, 60, 80, 0.4)
    seen = scenes.render(scene, lights, noise_std=0.002, bits=8, seed=1).detach()
    apart = block.shadowed.without_dark(seen, (0, 0))
    assert bool((apart < 0).any()) and torch.equal(apart.clamp_min(0), seen.masked_fill(apart < 0, 0))
    shiny = vts.NormalFromIntensity(vts.PointLights(lights.position_mm, lights.albedo, [0.9] * 3), 60, 80, 0.4)
    steep = scene.depth_mm * 1.5  # where the lobe is strong, what is left out is left out still
    brighter = torch.where(apart < 0, apart * 0.8, apart)
    assert torch.equal(shiny(apart, steep), shiny(brighter, steep))
    for depth in (None, scene.depth_mm):
        compiled, reference = both(block.solve, apart, depth, None, torch.zeros(1, 2, 60, 80))
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
            block.solve(image, None, None, torch.zeros(count, 2, 48, 64))
    dark = image.clone()
    dark[:, 0, :20] = 0.0
    compiled, reference = both(block.solve, dark, None, None, torch.zeros(1, 2, 48, 64))
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
    depth = pipe(image).depth_mm
    try:
        torch.set_default_dtype(torch.float64)
        assert torch.equal(pipe(image).depth_mm, depth)
    finally:
        torch.set_default_dtype(torch.float32)
    with torch.device("meta"):
        assert torch.equal(pipe(image).deformed, pipe.deformed(pipe.compensate(image)))
        assert torch.equal(pipe(image).depth_mm, depth)


def test_traces_see_operators():
    from torch._subclasses.fake_tensor import FakeTensorMode
    from torch.fx.experimental.proxy_tensor import make_fx

    gradient = torch.randn(1, 2, 12, 16, generator=torch.Generator().manual_seed(0))
    traced = make_fx(lambda part: vts.poisson_background(part, 0.1))(gradient)
    assert torch.allclose(traced(gradient), vts.poisson_background(gradient, 0.1), atol=1e-6)
    with FakeTensorMode():
        assert vts.poisson_background(torch.randn(1, 2, 12, 16), 0.1).shape == (1, 1, 12, 16)


@pytest.mark.parametrize("size", [(48, 64), (2, 4000), (1, 81)])
def test_contact_of_what_is_no_number(size):
    block = vts.ContactMask(torch.full((3, *size), 0.5), torch.full((3,), 0.01))
    for place in (slice(0, size[1] // 3), slice(size[1] // 2, size[1] // 2 + 1)):
        image = torch.full((1, 3, *size), 0.5) + 0.01 * torch.randn(1, 3, *size, generator=torch.Generator().manual_seed(0))
        image[0, 1, :, place] = torch.nan
        if size[0] >= 48:
            compiled, reference = both(block, image)
            assert torch.equal(compiled, reference)
        else:
            assert block(image.nan_to_num(0.5)).shape == (1, 1, *size)


def test_tangents_pass_through_operators():
    """Forward differentiation records nothing on the tensor itself, so kernels would lose it in silence."""
    solver = vts.PoissonDCT(0.1)
    gradient, tangent = torch.randn(2, 1, 2, 12, 16, generator=torch.Generator().manual_seed(0))
    depth, change = torch.func.jvp(solver, (gradient,), (tangent,))
    assert torch.allclose(depth, solver(gradient), atol=1e-6)
    assert float((change - solver(tangent)).abs().max()) < 1e-5  # it is linear


def test_threads_share_a_pipeline(ring, small_sensor, small_press):
    lights = ring()
    calibration = vts.Calibration.from_lights(lights, small_sensor)
    pipe = vts.DepthPipeline.from_calibration(calibration)
    image = scenes.render(small_press(1.0), lights, noise_std=0.003, bits=8, seed=1).detach()
    alone, found = pipe(image), []

    def work():
        found.extend(pipe(image) for _ in range(30))

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 120
    assert all(torch.equal(out.contact, alone.contact) for out in found)
    assert max(float((out.depth_mm - alone.depth_mm).abs().max()) for out in found) < 1e-6


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


def rough_presses(size, count, seed):
    """Depth, gradient and deformed skin of frames as no sensor gives them: noise on top of balls, holes, and a frame without."""
    generator = torch.Generator().manual_seed(seed)
    height, width = size
    y, x = torch.arange(height)[:, None], torch.arange(width)[None, :]
    depth = torch.zeros(count, 1, *size)
    for frame in range(count - 1):
        middle = torch.rand(2, generator=generator) * torch.tensor([height, width])
        squared = (y - middle[0]) ** 2 + (x - middle[1]) ** 2
        depth[frame, 0] = (1.0 - squared / (0.3 * min(size) + 2.0) ** 2).clamp_min(-0.1 * frame)
    depth += 0.01 * torch.randn(depth.shape, generator=generator)
    deformed = (depth > 0.05) & (torch.rand(depth.shape, generator=generator) > 0.01)
    return depth, 0.2 * torch.randn(count, 2, *size, generator=generator) * deformed, deformed


@pytest.mark.parametrize("size", [(48, 64), (240, 320), (121, 163), (45, 63), (2, 3), (1, 9), (3, 1), (480, 70)])
def test_zero_in_the_background(size):
    block = ZeroBackground()
    depth, _, deformed = rough_presses(size, 4, size[0])
    compiled, reference = both(block, depth, deformed)
    assert float((compiled - reference).abs().max()) < 1e-6
    compiled, reference = both(block, depth, torch.ones_like(deformed))
    assert float((compiled - reference).abs().max()) < 1e-6


@pytest.mark.parametrize("mm_per_pixel", [0.02, 0.0634, 0.2])
@pytest.mark.parametrize("size", [(48, 64), (240, 320), (45, 63), (2, 3), (1, 9), (9, 1)])
def test_contact_from_depth(size, mm_per_pixel):
    """As it is in the pipeline: depth and deformed skin are windows of whole images."""
    block = ContactFromDepth(mm_per_pixel)
    depth, _, deformed = rough_presses((size[0] + 8, size[1] + 16), 4, size[0])
    slopes = gradient_of_depth(depth, mm_per_pixel) * deformed
    part = (slice(None), slice(None), slice(8, None), slice(16, None))
    compiled, reference = both(block, depth[part], slopes[part], deformed[part])
    assert compiled.shape == reference.shape and compiled.dtype == torch.bool
    assert int((compiled != reference).sum()) <= 1e-4 * compiled.numel()


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
    assert "PoissonBackground" in str(pipe) and bool(pipe(frames).deformed[0].any())
    for some in (frames, frames[:1], frames[1:]):
        compiled, reference = both(pipe, some)
        assert torch.equal(compiled.deformed, reference.deformed) and torch.equal(compiled.contact, reference.contact)
        assert float((compiled.depth_mm - reference.depth_mm).abs().max()) < 1e-6
        assert float((compiled.normal - reference.normal).abs().max()) < 2e-5


@pytest.mark.parametrize("mode", ["fast", "precise"])
@pytest.mark.parametrize("shade", [0.1, 0.12, 0.2])
def test_a_frame_in_a_shade(response_unit, shade, mode):
    """Levels of one part of the skin, the cells that have the colour of slopes, and depth held at zero.

    What the shade leaves tilts depth by 2.6 mm where 0.3 mm are pressed.
    """
    calibration, frames = response_unit
    x = torch.arange(160.0)
    pipe = vts.DepthPipeline.from_calibration(calibration, mode)
    shades = torch.stack([1.0 - shade * (x > 80.0), 1.0 - shade * torch.sigmoid((x - 80.0) / 8.0)])
    compiled, reference = both(pipe, (frames[:, None] * shades[:, None, None]).flatten(0, 1))
    assert torch.equal(compiled.deformed, reference.deformed) and torch.equal(compiled.contact, reference.contact)
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
    pipe.deformed.register_forward_hook(lambda *_: inside.append(torch.get_num_threads()))
    pipe.deformed.register_forward_hook(lambda *_: workers.add(threading.get_ident()))
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


@pytest.mark.parametrize("size", [(48, 64), (45, 63), (2, 2), (1, 9), (9, 1), (1, 1)])
def test_slopes_of_depth(size):
    """Of windows of larger images."""
    depth, _, deformed = rough_presses((size[0] + 8, size[1] + 16), 3, size[0])
    part = (slice(None), slice(None), slice(8, None), slice(16, None))
    compiled, reference = both(MaskedGradient(0.1), depth[part], deformed[part])
    assert compiled.shape == reference.shape and float((compiled - reference).abs().max()) < 2e-5


@pytest.mark.parametrize(
    "hold",
    [
        pytest.param(lambda out: out[:, :, 1:], id="a view"),
        pytest.param(lambda out: torch.from_numpy(out.numpy()), id="an array"),
        pytest.param(torch.from_dlpack, id="dlpack"),
        pytest.param(lambda out: out.detach(), id="an alias"),
    ],
)
def test_memory_that_somebody_holds_is_not_used_again(hold):
    first = memory.empty((1, 1, 7, 9), torch.float32).fill_(3.0)
    held = hold(first)
    del first
    memory.empty((1, 1, 7, 9), torch.float32).fill_(5.0)
    assert (held == 3.0).all()


def test_nobody_waits_for_kept_memory():
    """A fork while another thread is at the table leaves it locked for ever in the child."""
    with memory._lock:
        assert memory.empty((1, 1, 7, 9), torch.float32).shape == (1, 1, 7, 9)


def test_memory_that_other_processes_see_is_not_used_again():
    first = memory.empty((1, 1, 7, 9), torch.float32).share_memory_()
    place = first.data_ptr()
    del first
    assert memory.empty((1, 1, 7, 9), torch.float32).data_ptr() != place


@pytest.mark.parametrize("orders", [(2, -1, -1), (1, 0, 2), (2, -1, 1), (4, 2, 0)])
def test_normals_by_every_order_of_products(orders):
    generator = torch.Generator().manual_seed(sum(orders) + 9)
    degree, product, cubic = orders
    size = terms_of(*orders)
    rows = tuple(tuple((0.3 * torch.randn(size, generator=generator)).tolist()) for _ in range(2))
    by_depth = DepthBrightness(1, 5.0, ((0.05, 0.01, 0.0),) * 3, steeper=0.3, reference_mm=0.4)
    block = NormalFromResponse(ResponseField(degree, product, 5.0, rows, cubic), by_depth, 40, 60, 0.2)
    image, depth = 1.0 + 0.1 * torch.randn(2, 3, 24, 33, generator=generator), torch.rand(2, 1, 24, 33, generator=generator)
    assert response_lines(block) is not None
    for given in (None, depth):
        compiled, reference = both(block, image, given, (8, 16))
        assert float((compiled - reference).abs().max()) < 2e-6


def terms_of(degree, product, cubic):
    """Coefficients of one slope of a field of these degrees."""
    return sum(count * (d + 1) * (d + 2) // 2 for count, d in ((3, degree), (6, product), (10, cubic)) if d >= 0)


@pytest.mark.parametrize("mode", ["fast", "precise"])
def test_a_frame_in_one_call_equals_its_blocks(response_unit, mode):
    calibration, frames = response_unit
    pipe = vts.DepthPipeline.from_calibration(calibration, mode)
    batch = frames.repeat(6, 1, 1, 1)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        found = pipe.compiled(batch)
    finally:
        torch.set_num_threads(before)
    for k in range(3):
        alone, blocks = pipe.compiled(frames[k : k + 1]), pipe.depth_of(frames[k : k + 1])
        for one, other, many in zip(alone, blocks, found, strict=True):
            assert torch.equal(one, other) and torch.equal(many[k::3], one.expand(6, -1, -1, -1))


def test_one_call_follows_blocks_that_change(response_unit):
    """Buffers written to, settings, and blocks replaced, watched or given by the user."""
    calibration, frames = response_unit
    pipe, image = vts.DepthPipeline.from_calibration(calibration), frames[:1]
    results = [pipe.compiled(image)]
    for buffer in (pipe.deformed.per_noise, pipe.deformed.offset):
        buffer.mul_(0.5)
    results.append(pipe.compiled(image))
    pipe.gradient.max_slope = 0.05
    results.append(pipe.compiled(image))
    pipe.normals.maps = 0.5 * pipe.normals.maps
    results.append(pipe.compiled(image))
    blocks = pipe.depth_of(image)
    assert all(torch.equal(one, other) for one, other in zip(results[-1], blocks, strict=True))
    changed = [not all(map(torch.equal, *pair)) for pair in pairwise(results)]
    assert changed == [True] * 3
    seen = []
    handle = pipe.zero.register_forward_hook(lambda *_: seen.append(1))
    assert pipe.compiled(image) is None and torch.equal(pipe(image).depth_mm, blocks.depth_mm) and seen == [1]
    handle.remove()
    assert pipe.compiled(image) is not None
    pipe.compensate.linear.append(torch.nn.Identity())
    assert pipe.compiled(image) is None
    pipe.compensate.linear = torch.nn.Sequential()
    assert pipe.compiled(image) is not None
    assert pipe.compiled(image.clone().requires_grad_()) is None and pipe.compiled(image.double()) is None
    pipe.zero = torch.nn.Sequential(pipe.zero)
    assert pipe.compiled(image) is None


def test_one_call_refuses_what_the_blocks_refuse(response_unit):
    calibration, frames = response_unit
    pipe = vts.DepthPipeline.from_calibration(calibration)
    for value, message in ((1.01, r"expected values in \[0, 1\]"), (-0.01, "clamp it"), (float("nan"), "expected finite values")):
        image = frames[:2].clone()
        image[1, 2, -1, -1] = value
        with pytest.raises(ValueError, match=f"images: .*{message}"):
            pipe(image)
    with pytest.raises(ValueError, match="100 x 160"):
        pipe(frames[:, :, :100])


def test_memory_of_outputs_that_nobody_holds_is_used_again():
    shape = (3, 1, 17, 19)
    first = memory.empty(shape, torch.float32)
    place, view = first.data_ptr(), first[1:].numpy()
    del first
    assert memory.empty(shape, torch.float32).data_ptr() != place
    view[:] = 7.0
    del view
    with torch.inference_mode():
        again = memory.empty(shape, torch.float32)
    assert again.data_ptr() == place and again.is_contiguous() and again.shape == shape
    large = memory.empty((memory.MOST_BYTES + 4,), torch.bool)
    assert large.shape == (memory.MOST_BYTES + 4,)


def test_heights_that_have_no_fast_transform():
    """A prime factor above 64: torch solves."""
    solver = vts.PoissonBackground(0.1)
    gradient = torch.randn(1, 2, 67, 20, generator=torch.Generator().manual_seed(0))
    assert kernels.poisson_plan(67, 20) is None and kernels.poisson_plan(61, 20) is not None
    compiled, reference = both(solver, gradient)
    assert torch.equal(compiled, reference)
