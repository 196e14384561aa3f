"""What every block promises: scripts, batches, dtypes, pickles, state dicts, Sequential, errors that name the argument."""

import copy
import functools
import io
import pickle

import pytest
import torch
from conftest import ring_lights
from torch import nn

import torchvts as vts
from torchvts.core.geometry import normal_from_gradient
from torchvts.integration import PerspectiveIntegration
from torchvts.model import FillMarkers

HEIGHT, WIDTH, PITCH = 48, 64, 0.6
SENSOR = vts.Sensor("rig", HEIGHT, WIDTH, PITCH)


@functools.cache
def calibration(dtype):
    lights = ring_lights(dtype=dtype)
    undeformed = vts.scenes.undeformed(vts.scenes.sphere_press(10.0, 1.0, (0, 0), HEIGHT, WIDTH, PITCH, dtype))
    background = vts.scenes.render(undeformed, lights, spots=vts.scenes.skin_spots(HEIGHT, WIDTH, 5, 5))[0]
    return vts.Calibration.from_lights(lights, SENSOR, background)


@functools.cache
def images(dtype):
    presses = [
        vts.scenes.sphere_press(10.0, press, (x, 0), HEIGHT, WIDTH, PITCH, dtype) for press, x in ((2.0, 0), (1.0, 5), (0.5, -9))
    ]
    frames = [vts.scenes.render(press, ring_lights(dtype=dtype)) for press in presses]
    return torch.cat([*frames, calibration(dtype).background[None]])


def gradient(dtype):
    return torch.randn(4, 2, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(dtype)


def depth(dtype):
    """A ball pressed in and the skin around it, on a tilt, with a little noise."""
    presses = [vts.scenes.sphere_press(10.0, press, (x, 0), HEIGHT, WIDTH, PITCH, dtype) for press, x in ((2.0, 0), (0.5, 2))]
    tilt = 0.1 * torch.linspace(-1.0, 1.0, WIDTH, dtype=torch.float64).to(dtype)
    return torch.cat([press.depth_mm + tilt + 1e-3 * gradient(dtype)[:1, :1] for press in presses])


class Beside(nn.Module):
    """A block of two inputs, the second of which stays: 1 around the middle of the image, 0 at its border."""

    def __init__(self, block, kind):
        super().__init__()
        self.block = block
        weight = torch.zeros(1, 1, HEIGHT, WIDTH, dtype=torch.float64)
        weight[..., 10:-10, 14:-14] = 1.0
        self.register_buffer("second", nn.functional.avg_pool2d(weight, 5, 1, 2).to(kind) if kind != torch.bool else weight > 0.0)

    def forward(self, depth_mm: torch.Tensor) -> torch.Tensor:
        return self.block(depth_mm, self.second.expand(depth_mm.shape[0], -1, -1, -1))


class DotsOf(nn.Module):
    """Tensors of the motion of dots in frames of undeformed depth."""

    def __init__(self, block, kind):
        super().__init__()
        self.block = block
        self.register_buffer("depth", torch.zeros(1, 1, HEIGHT, WIDTH, dtype=kind))

    def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        moved = self.block(images, self.depth)
        return moved.displacement_mm, moved.covariance_mm2, moved.seen


DOTTED = vts.scenes.DottedSkin(HEIGHT, WIDTH, PITCH, 6.0, 2.4, noise_std=0.002)


def dotted(dtype):
    drags = [vts.scenes.Drag(radius_mm=9.0, shift_mm=(x, -0.5), turn_deg=3.0, reach_mm=9.0) for x in (0.3, 1.0, 1.5)]
    return torch.stack([DOTTED.image(drag, seed) for seed, drag in enumerate([*drags, None])]).to(dtype)


def skin_motion(dtype):
    unit = vts.Calibration.from_lights(DOTTED.lights, SENSOR, DOTTED.image())
    return DotsOf(vts.SkinMotion.from_calibration(unit).to(dtype), dtype)


def part(name):
    return lambda dtype: getattr(vts.DepthPipeline.from_calibration(calibration(dtype), "fast"), name)


def pipe(mode):
    return lambda dtype: vts.DepthPipeline.from_calibration(calibration(dtype), mode)


def response(dtype):
    random = torch.Generator().manual_seed(3)
    family = vts.calibration.field.Family(1, 1, 20.0)
    field = family.field(0.1 * torch.randn(2, family.size(), generator=random, dtype=torch.float64))
    by_depth = vts.model.DepthBrightness(1, 20.0, 0.1 * torch.randn(3, 3, generator=random, dtype=torch.float64))
    model = vts.model.response_field.ResponseModel(field, by_depth)
    return vts.Calibration.from_response(model, SENSOR, calibration(dtype).background)


def response_pipe(mode):
    return lambda dtype: vts.DepthPipeline.from_calibration(response(dtype), mode)


def lookup(dtype):
    slope = torch.randn(500, 2, generator=torch.Generator().manual_seed(1))
    return vts.NormalFromLookup.fit(calibration(torch.float32).background, slope @ torch.ones(2, 3) * 0.1, slope).to(dtype)


def network(dtype):
    return vts.NormalFromMLP(HEIGHT, WIDTH, calibration(torch.float32).background).requires_grad_(False).to(dtype)


def rectify(dtype):
    """Frames of 48 x 64 seen from aside, of which 24 x 32 pixels are made."""
    corners = ((5.0, 3.0), (60.0, 8.0), (58.0, 44.0), (2.0, 40.0))
    return vts.Rectify(vts.Sensor("camera", 24, 32, 0.6, corners_px=corners, raw_size_px=((HEIGHT, WIDTH),))).to(dtype)


CASES = {
    "Rectify": (rectify, images, "raw"),
    "Compensate": (part("compensate"), images, "image"),
    "ContactMask": (part("mask"), images, "compensated"),
    "NormalFromIntensity": (part("normals"), images, "compensated"),
    "NormalFromResponse": (lambda dtype: vts.NormalFromResponse.from_calibration(response(dtype)), images, "compensated"),
    "NormalFromLookup": (lookup, images, "compensated"),
    "NormalFromMLP": (network, images, "compensated"),
    "FillMarkers": (lambda dtype: FillMarkers(5.0), images, "image"),
    "GradientFromNormal": (lambda dtype: vts.GradientFromNormal(), lambda dtype: normal_from_gradient(gradient(dtype)), "normal"),
    "PoissonDST": (lambda dtype: vts.PoissonDST(PITCH), gradient, "gradient"),
    "PoissonDCT": (lambda dtype: vts.PoissonDCT(PITCH), gradient, "gradient"),
    "PoissonBackground": (lambda dtype: vts.PoissonBackground(PITCH), gradient, "gradient"),
    "PerspectiveIntegration": (lambda dtype: PerspectiveIntegration(PITCH, 400.0), gradient, "gradient"),
    "AdaptiveIntegration": (lambda dtype: vts.AdaptiveIntegration(PITCH), lambda dtype: gradient(dtype)[:2], "gradient"),
    "ZeroBackground": (lambda dtype: Beside(vts.skin.ZeroBackground(PITCH), dtype), depth, "depth_mm"),
    "SkinMotion": (skin_motion, dotted, "images"),
    "ContactFromDepth": (lambda dtype: Beside(vts.ContactFromDepth(PITCH), torch.bool), depth, "depth_mm"),
    "DepthPipeline fast": (pipe("fast"), images, "images"),
    "DepthPipeline precise": (pipe("precise"), images, "images"),
    "DepthPipeline response fast": (response_pipe("fast"), images, "images"),
    "DepthPipeline response precise": (response_pipe("precise"), images, "images"),
}
FREE = ("gradient", "normal", "depth_mm")
SIZED = [name for name, (_, _, argument) in CASES.items() if argument not in FREE and name not in ("FillMarkers", "Rectify")]
IN_PYTHON = ("AdaptiveIntegration",)
"""Blocks whose solver is Python code, which no script holds."""
SCRIPTED = [name for name in CASES if name not in IN_PYTHON]
every_block = pytest.mark.parametrize("name", CASES)


def test_no_public_block_is_missing_among_the_cases():
    rooms = (vts, vts.normals, vts.integration)
    names = {name: getattr(room, name) for room in rooms for name in room.__all__ if hasattr(room, name)}
    public = {name for name, kind in names.items() if isinstance(kind, type) and issubclass(kind, nn.Module)}
    bases = {"Integrator", "NormalModel", "WrappedNormals"}
    others = {"PointLights", "ConfidentPipeline"}  # no image in, or a pipeline in a pipeline
    assert public - bases - others == {name.split()[0] for name in CASES} & public


@functools.cache
def made(name, dtype):
    make, example, _ = CASES[name]
    return make(dtype), example(dtype)


def build(name, dtype=torch.float32):
    """A block and an example of its input, a copy for each test."""
    block, example = made(name, dtype)
    return copy.deepcopy(block), example.clone()


def outputs(result):
    return list(result) if isinstance(result, tuple) else [result]


def assert_same(one, two, tolerance=0.0):
    for left, right in zip(outputs(one), outputs(two), strict=True):
        assert left.dtype == right.dtype and left.shape == right.shape
        assert float((left.double() - right.double()).abs().max()) <= tolerance


# The optimiser of TorchScript unfolds a pipeline to 100,000 lines, at 2 to 20 s for the first call.
QUICKLY_OPTIMISED = [name for name in SCRIPTED if "Pipeline" not in name or name == "DepthPipeline fast"]


@pytest.mark.parametrize(
    "dtype, tolerance",
    [(torch.float64, 1e-11), pytest.param(torch.float32, 2e-4, marks=pytest.mark.long)],
    ids=["double", "single"],
)
@pytest.mark.parametrize(
    "name, optimised",
    [(name, name in QUICKLY_OPTIMISED) for name in SCRIPTED]
    + [pytest.param(name, True, marks=pytest.mark.long) for name in SCRIPTED if name not in QUICKLY_OPTIMISED],
)
def test_torchscript_gives_what_eager_gives(name, optimised, dtype, tolerance):
    """The script, and what its file holds."""
    block, example = build(name, dtype)
    expected, script, stream = block(example), torch.jit.script(block), io.BytesIO()
    with torch.jit.optimized_execution(optimised):
        assert_same(script(example), expected, tolerance)
    torch.jit.save(script, stream)
    stream.seek(0)
    with torch.jit.optimized_execution(False):  # it is the same code
        assert_same(torch.jit.load(stream)(example), expected, tolerance)


@pytest.mark.long
@pytest.mark.parametrize("name", ["ZeroBackground", "ContactFromDepth"])  # test_export has ContactMask
def test_torch_export_gives_what_eager_gives_of_any_batch(name):
    block, example = build(name)
    shapes = ({0: torch.export.Dim("batch", min=1, max=16)},)
    program = torch.export.export(block, (example,), dynamic_shapes=shapes).module()
    for some in (example, example[:1]):
        assert_same(program(some), block(some), 1e-6)


@every_block
def test_items_of_a_batch_are_independent(name):
    block, example = build(name, torch.float64)
    single = [outputs(block(item[None])) for item in example]
    assert_same(tuple(torch.cat(column) for column in zip(*single)), tuple(outputs(block(example))), 1e-12)


@every_block
def test_the_dtype_is_kept_and_single_precision_follows_double_precision(name):
    (single, example), (double, exact) = build(name), build(name, torch.float64)
    tolerance = 2e-3 if name in IN_PYTHON else 2e-4  # their solves end at a residual of 1e-3; it depends on the processor
    for block, given in ((single, example), (double, exact)):
        assert {tensor.dtype for tensor in outputs(block(given))} <= {given.dtype, torch.bool}
    for left, right in zip(outputs(single(example)), outputs(double(exact)), strict=True):
        if left.dtype == torch.bool:  # a pixel may lie on a threshold
            assert float((left ^ right).double().mean()) < 2e-3
            continue
        assert float((left.double() - right.double()).abs().max()) < tolerance * max(1.0, float(right.double().abs().max()))


@every_block
def test_a_block_survives_pickle_deepcopy_and_state_dict_and_leaves_its_input_alone(name):
    block, example = build(name)
    before, expected, other = example.clone(), block(example), copy.deepcopy(block)
    assert torch.equal(example, before)
    assert_same(pickle.loads(pickle.dumps(block))(example), expected)
    assert_same(other(example), expected)
    for tensor in other.state_dict().values():
        tensor.zero_()
    other.load_state_dict(block.state_dict())
    assert_same(other(example), expected)


@every_block
def test_no_nan_and_no_gradient_asked_for(name):
    """Of the example, of black pixels, and of black pixels beside others."""
    block, example = build(name)
    for given in (example, 0.0 * example, torch.cat((0.0 * example[:, :, :24], example[:, :, 24:]), dim=2)):
        for tensor in outputs(block(given)):
            assert bool(torch.isfinite(tensor).all()) and not tensor.requires_grad


@every_block
def test_a_non_contiguous_input_changes_nothing(name):
    block, example = build(name)
    assert_same(block(example.permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2)), block(example), 1e-6)


@pytest.mark.parametrize("name", [name for name in CASES if "Pipeline" in name])
def test_forward_derivatives_are_those_of_difference_quotients(name):
    block, example = build(name, torch.float64)
    example = example.clamp(0.05, 0.95)
    tangent, step = 1e-3 * torch.randn(example.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64), 1e-6
    _, derivative = torch.func.jvp(lambda images: block(images).depth_mm, (example,), (tangent,))
    quotient = (block(example + step * tangent).depth_mm - block(example - step * tangent).depth_mm) / (2.0 * step)
    assert float((derivative - quotient).abs().max()) < 1e-8 < 1e-4 < float(derivative.abs().max())


@pytest.mark.parametrize("name", [name for name in CASES if "Pipeline" not in name])
def test_a_block_works_in_sequential(name):
    block, example = build(name)
    assert_same(nn.Sequential(nn.Identity(), block)(example), block(example))


def test_blocks_chain_by_hand_in_sequential():
    whole, example = build("DepthPipeline fast")
    slopes = nn.Sequential(whole.compensate, whole.normals, whole.gradient)(example)
    weight = whole.mask(whole.compensate(example), slopes)
    depth = whole.solve.zero(whole.integrate(slopes * weight), weight)
    assert_same(depth, whole(example).depth_mm, 1e-6)


@pytest.mark.parametrize("name", SIZED)
def test_another_size_than_the_calibration_is_refused(name):
    block, example = build(name)
    with pytest.raises(ValueError, match=r"expected 48 x 64 like the calibration, got 48 x 63"):
        block(example[..., :63])


@pytest.mark.parametrize("mode", ["fast", "precise"])
def test_another_size_is_refused_without_a_background(mode):
    lights = calibration(torch.float32).lights
    pipeline = vts.DepthPipeline.from_calibration(vts.Calibration.from_lights(lights, SENSOR), mode)
    with pytest.raises(ValueError, match=r"expected 48 x 64 like the calibration, got 47 x 64"):
        pipeline(images(torch.float32)[..., :47, :])


def test_a_scripted_error_keeps_its_text():
    with pytest.raises(torch.jit.Error, match=r"gradient: expected \(B, 2, H, W\), got \[2, 8, 8\]"):
        torch.jit.script(vts.PoissonDST())(torch.zeros(2, 8, 8))


@pytest.mark.parametrize("name", [name for name in CASES if "Pipeline" in name])
def test_an_empty_batch_gives_an_empty_batch(name):
    """No frames are no error: they may be what a filter left of a stream."""
    block, example = build(name)
    assert block(example[:0]).depth_mm.shape == (0, 1, HEIGHT, WIDTH)
