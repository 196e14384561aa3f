"""Defects found by an attack on the library: wrong answers without a word, and what PyTorch's own tools could not do."""

import copy
import pickle
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_model, save_model
from torch import Tensor
from torch._subclasses import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode

import torchvts as vts
from torchvts.core import checks
from torchvts.model.response_field import ResponseField, ResponseModel

HEIGHT, WIDTH, PITCH = 48, 64, 0.5


LIGHTS = vts.PointLights([[20, 9, 30], [-18, 13, 30], [-2, -22, 30]], [900, 900, 900])


def rig(**kinds: object) -> vts.Calibration:
    """A unit by lights."""
    kinds = {"mm_per_pixel": PITCH, **kinds}
    return vts.Calibration.from_lights(LIGHTS, vts.Sensor("rig", HEIGHT, WIDTH, **kinds))


def press(center_mm: tuple[float, float] = (0.0, 0.0), press_mm: float = 1.0) -> Tensor:
    """An image of a ball on that unit."""
    scene = vts.scenes.sphere_press(8.0, press_mm, center_mm, HEIGHT, WIDTH, PITCH)
    return vts.scenes.render(scene, LIGHTS).detach()


@pytest.mark.parametrize("mode, without_gradients", [("fast", torch.no_grad), ("precise", torch.inference_mode)])
def test_trained_lights_count_without_gradients(mode: str, without_gradients: type) -> None:
    pipe, image = vts.DepthPipeline.from_calibration(rig(), mode), press()
    before = pipe(image).depth_mm
    pipe.requires_grad_(True)
    optimiser = torch.optim.SGD(pipe.parameters(), lr=50.0)
    pipe(image).depth_mm.square().mean().backward()
    optimiser.step()
    with without_gradients():
        found = pipe(image).depth_mm.clone()
    recorded = pipe(image).depth_mm.detach()
    assert float((recorded - before).abs().max()) > 1e-3  # the step moved the lights
    assert float((found - recorded).abs().max()) < 1e-5
    assert float((pipe.requires_grad_(False)(image).depth_mm - recorded).abs().max()) < 1e-5
    with torch.jit.optimized_execution(False):  # which takes up to 10 s
        assert float((torch.jit.script(pipe)(image).depth_mm - recorded).abs().max()) < 1e-5


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:Torchinductor does not support code generation for complex")  # FFTs stay operators
@pytest.mark.parametrize("mode", ["fast", "precise"])
def test_compiles_with_inductor(mode: str) -> None:
    pipe, image = vts.DepthPipeline.from_calibration(rig(), mode), press()
    with torch.no_grad():
        compiled = torch.compile(pipe, fullgraph=mode == "fast")(image)
        for found, expected in zip(compiled, pipe(image), strict=True):
            assert float((found.double() - expected.double()).abs().max()) < 1e-5


def _derivatives(module: torch.nn.Module, image: Tensor) -> list[Callable[[], object]]:
    def loss(given: Tensor) -> Tensor:
        out = module(given)
        return (out.depth_mm if isinstance(out, vts.DepthOutput) else out).square().mean()

    return [
        lambda: torch.func.grad(loss)(image),
        lambda: torch.func.vjp(loss, image)[1](torch.ones(())),
        lambda: torch.func.jvp(loss, (image,), (torch.ones_like(image),)),
        lambda: torch.func.jacrev(loss)(image),
    ]


@pytest.mark.parametrize("mode", ["precise", pytest.param("fast", marks=pytest.mark.long)])
def test_transforms_leave_a_pipeline_as_it_was(mode: str) -> None:
    image = press()
    pipe = vts.DepthPipeline.from_calibration(rig(), mode)
    expected = torch.func.grad(lambda x: pipe(x).depth_mm.square().mean())(image)
    recorded = image.clone().requires_grad_(True)
    vts.DepthPipeline.from_calibration(rig(), mode)(recorded).depth_mm.square().mean().backward()
    assert recorded.grad is not None
    assert float((recorded.grad - expected).abs().max()) < 1e-6 * float(expected.abs().max())
    for transform in range(4):
        pipe = vts.DepthPipeline.from_calibration(rig(), mode)
        _derivatives(pipe, image)[transform]()
        assert torch.equal(copy.deepcopy(pipe)(image).depth_mm, pipe(image).depth_mm)
        pickle.dumps(pipe)


@pytest.mark.filterwarnings("ignore:There is a performance drop")  # of vmap, whose rule for one operator PyTorch lacks
@pytest.mark.parametrize("kind", [vts.PoissonDST, vts.PoissonDCT, vts.PoissonBackground])
def test_transforms_leave_a_solver_as_it_was(kind: type[vts.PoissonDCT]) -> None:
    gradient = torch.randn(3, 2, 24, 32, generator=torch.Generator().manual_seed(0))
    for transform in range(5):
        solver = kind(0.1)
        calls = [*_derivatives(solver, gradient), lambda solver=solver: torch.func.vmap(lambda x: solver(x[None])[0])(gradient)]
        calls[transform]()
        with FakeTensorMode() as mode:
            assert solver(mode.from_tensor(gradient)).shape == (3, 1, 24, 32)
        pickle.dumps(solver)
        assert torch.equal(copy.deepcopy(solver)(gradient), kind(0.1)(gradient))


@pytest.mark.parametrize("mode", ["fast", "precise"])
@pytest.mark.parametrize(
    ("other", "named"), [({"gamma": 2.2}, "gamma"), ({"mm_per_pixel": 0.25}, "mm_per_pixel"), ({"blur_px": 2.0}, "std_px")]
)
def test_a_state_of_another_unit_is_refused(mode: str, other: dict[str, float], named: str) -> None:
    state = vts.DepthPipeline.from_calibration(rig(**other), mode).state_dict()
    with pytest.raises((ValueError, RuntimeError), match=named):
        vts.DepthPipeline.from_calibration(rig(), mode).load_state_dict(state)


def test_a_pipeline_goes_through_safetensors(tmp_path: Path) -> None:
    pipe, other = (vts.DepthPipeline.from_calibration(rig(), "precise") for _ in range(2))
    with torch.no_grad():
        next(p for name, p in pipe.named_parameters() if name.endswith("albedo")).mul_(1.1)
    save_model(pipe, str(tmp_path / "pipe.safetensors"))
    load_model(other, str(tmp_path / "pipe.safetensors"))
    image = press()
    with torch.no_grad():
        assert torch.equal(other(image).depth_mm, pipe(image).depth_mm)


def test_a_state_of_another_zero_is_refused() -> None:
    pipe, other = (vts.DepthPipeline.from_calibration(rig()) for _ in range(2))
    other.solve.zero.face *= 2.0
    with pytest.raises((ValueError, RuntimeError), match=r"zero\.face"):
        pipe.load_state_dict(other.state_dict())


def test_a_frame_without_contact_has_a_graph_and_tensors_of_its_own() -> None:
    pipe = vts.DepthPipeline.from_calibration(rig(), "precise")
    flat = vts.scenes.render(vts.scenes.undeformed(vts.scenes.sphere_press(8.0, 1.0, (0.0, 0.0), HEIGHT, WIDTH, PITCH)), LIGHTS)
    image = flat.detach().clone().requires_grad_(True)
    out = pipe(image)
    assert not bool(out.deformed.any())
    out.depth_mm.sum().backward()
    pipe.requires_grad_(True)(flat.detach()).depth_mm.sum().backward()
    out = pipe.requires_grad_(False)(flat.detach())
    out.depth_mm.add_(1.0)
    assert not bool(out.gradient.any())


def unit_of(kind: str) -> vts.Calibration:
    """A unit with low lights, which cast shadows, or one by a response field."""
    lights = vts.PointLights([[22, 4, 16], [-14, 17, 15], [-8, -20, 17]], [300, 300, 300])
    sensor = vts.Sensor("rig", HEIGHT, WIDTH, PITCH)
    unit = vts.Calibration.from_lights(lights, sensor)
    if kind == "lights":
        return unit
    field = ResponseField(0, -1, 16.0, ((0.3, 0.0, 0.1), (0.1, 0.3, 0.0)))
    return vts.Calibration.from_response(ResponseModel(field, None), sensor, unit.model_image.clamp(max=1.0))


def dissimilar() -> Tensor:
    """Noisy frames of that rig: none, small and wide contacts, dirt, a failed LED."""
    lights = unit_of("lights").lights
    balls = (8.0, 1.0, (0, 0)), (4.0, 0.5, (-10, 5)), (10.0, 3.0, (6, -3)), (2.0, 1.0, (13, 9)), (6.0, 1.0, (3, 3))
    scenes = [vts.scenes.sphere_press(*ball, HEIGHT, WIDTH, PITCH) for ball in balls]
    scenes.insert(0, vts.scenes.undeformed(scenes[0]))
    images = torch.cat([vts.scenes.render(scene, lights).detach() for scene in scenes])
    images = images + 0.004 * torch.randn(images.shape, generator=torch.Generator().manual_seed(0))
    images[2, :, 20:22, 15:20] = 0.0
    images[5, 1] = 0.0
    return images.clamp(0.0, 1.0)


@pytest.mark.parametrize("mode", ["fast", "precise"])
def test_recording_gradients_changes_no_frame_of_a_batch(mode: str) -> None:
    pipe, images = vts.DepthPipeline.from_calibration(unit_of("response"), mode), dissimilar()[:3]
    recorded = images.clone().requires_grad_(True)
    out = pipe(recorded).depth_mm
    assert float((out.detach() - pipe(images).depth_mm).abs().max()) < 1e-5
    out[1].sum().backward()
    assert recorded.grad is not None
    assert bool(recorded.grad[1].any())
    assert not bool(recorded.grad[[0, 2]].any())


@pytest.mark.parametrize("size", [(8, 640), (640, 8), (8, 5000)])
def test_thin_sensors(size: tuple[int, int]) -> None:
    unit = vts.Calibration.from_lights(LIGHTS, vts.Sensor("thin", *size, 0.05))
    image = vts.scenes.render(vts.scenes.sphere_press(2.0, 0.1, (0.0, 0.0), *size, 0.05), LIGHTS).detach()
    pipe = vts.DepthPipeline.from_calibration(unit)
    out, by_operators = pipe.freeze()(image), pipe(image)
    assert float((out.depth_mm - by_operators.depth_mm).abs().max()) < 1e-5
    assert torch.equal(out.deformed, by_operators.deformed)
    assert not bool(out.deformed[..., 0, 0])


class LargestTensor(TorchDispatchMode):
    """Keeps the number of elements of the largest tensor that an operator makes."""

    elements = 0

    def __torch_dispatch__(self, operator, types, args=(), kwargs=None):  # type: ignore[no-untyped-def]
        made = operator(*args, **(kwargs or {}))
        for one in made if isinstance(made, tuple | list) else (made,):
            if isinstance(one, Tensor):
                self.elements = max(self.elements, one.numel())
        return made


@pytest.mark.parametrize(("count", "height", "width"), [(3, 59, 79), (1, 8, 3000)])
def test_memory_for_shadows_grows_with_the_image(count: int, height: int, width: int) -> None:
    lights = unit_of("lights").lights
    unit = vts.Calibration.from_lights(lights, vts.Sensor("rig", height, width, PITCH))
    image = unit.model_image[None].repeat(count, 1, 1, 1).clamp(0.0, 1.0)
    middle = width // 2
    image[:, 1, : height // 2, middle - 10 : middle] = 0.0  # one light is blocked
    image[:, 0, :, middle : middle + 10] *= 0.7
    pipe = vts.DepthPipeline.from_calibration(unit, "precise")
    with LargestTensor() as largest:
        out = pipe(image)
    assert bool(out.deformed.any())
    assert largest.elements < (2e6 if count > 1 else 1e7)  # 4e6 of a batch in one tensor, 6e8 of the thin one in cells of a pixel


class SmallNetwork(torch.nn.Module):
    """A learned model of normals."""

    def __init__(self) -> None:
        super().__init__()
        self.slope = torch.nn.Sequential(torch.nn.Conv2d(3, 4, 1), torch.nn.BatchNorm2d(4), torch.nn.Conv2d(4, 2, 1))

    def forward(self, compensated: Tensor) -> Tensor:
        slope = self.slope(compensated)
        return torch.nn.functional.normalize(torch.cat((slope, torch.ones_like(slope[:, :1])), dim=1), dim=1)


@pytest.mark.parametrize("training", [True, False])
def test_given_modules_keep_their_mode(training: bool) -> None:
    network, solver = SmallNetwork().train(training), vts.PoissonDCT(PITCH).train(training)
    network.slope[1].train(not training)  # a mode of its own, as of a frozen layer
    pipe = vts.DepthPipeline.from_calibration(rig(), normals=network, integrate=solver)
    assert not pipe.training
    assert not pipe.compensate.training
    assert network.training == solver.training == network.slope[2].training == training
    assert network.slope[1].training != training
    assert all(weight.requires_grad for weight in network.parameters())
    confident = vts.ConfidentPipeline.from_calibration(rig(), integrate=solver)
    assert not confident.training
    assert solver.training == training


def test_gradients_stop_outside_the_deformed_area() -> None:
    class Slopes(torch.nn.Module):
        """Normals that are a parameter."""

        def __init__(self) -> None:
            super().__init__()
            self.normal = torch.nn.Parameter(torch.tensor([0.1, 0.1, 1.0])[None, :, None, None].repeat(1, 1, HEIGHT, WIDTH))

        def forward(self, compensated: Tensor) -> Tensor:
            return self.normal * torch.ones_like(compensated)

    model = Slopes()
    out = vts.DepthPipeline.from_calibration(rig(), normals=model)(press())
    out.depth_mm.square().sum().backward()
    assert model.normal.grad is not None
    reached = (model.normal.grad != 0.0).any(dim=1, keepdim=True)
    assert bool(reached.any())
    weight = vts.DepthPipeline.from_calibration(rig(), normals=model).frame_of(press())[0].weight
    assert not bool((reached & (weight == 0.0)).any())


def tensors_beside_buffers(module: torch.nn.Module) -> list[Tensor]:
    """Tensors that ``module.to(device)`` does not move."""
    found: list[Tensor] = []
    for part in module.modules():
        for name, value in vars(part).items():
            if not name.startswith(("_parameters", "_buffers", "_modules")):
                found += [one for one in (value if isinstance(value, list | tuple) else [value]) if isinstance(one, Tensor)]
    return found


@pytest.mark.parametrize("kind", ["lights", "response"])
def test_fast_asks_a_device_for_nothing_but_the_parts_of_a_mask(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the meta device, which has no values: reading one raises, and so does an operator that gets a tensor left on the CPU."""
    pipe = vts.DepthPipeline.from_calibration(unit_of(kind)).to("meta")
    monkeypatch.setattr(checks, "check_tensor", lambda name, value: None)  # which refuses tensors of this device
    images = torch.zeros(2, 3, HEIGHT, WIDTH, device="meta")
    with pytest.raises(RuntimeError, match=r"item\(\)|aten::equal"):
        pipe(images)  # connected parts: a loop until nothing is gained
    monkeypatch.setattr("torchvts.skin.weight.reconstruct", lambda seed, mask: seed & mask)
    out = pipe(images)
    assert all(tensor.device.type == "meta" for tensor in (*out, *tensors_beside_buffers(pipe)))
    assert len(tensors_beside_buffers(pipe)) > 0  # the tables of the Poisson solver


@pytest.mark.parametrize("kind, mode", [("lights", "precise"), ("response", "fast")])
def test_the_way_that_asks_for_nothing_gives_the_same_depth(kind: str, mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pipe, images = vts.DepthPipeline.from_calibration(unit_of(kind), mode).double(), dissimilar().double()
    images = images if mode == "fast" else images[1:4:2]
    expected = pipe(images)
    monkeypatch.setattr("torchvts.normals.shadowed.may_read", lambda tensor: False)
    found = pipe(images)
    assert torch.equal(found.deformed, expected.deformed)
    assert float((found.depth_mm - expected.depth_mm).abs().max()) < 1e-5
