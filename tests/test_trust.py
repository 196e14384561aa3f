"""Defects found by an attack on the library: wrong answers without a word, and what PyTorch's own tools could not do."""

import copy
import pickle
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch._subclasses import FakeTensorMode

import torchvts as vts

HEIGHT, WIDTH, PITCH = 96, 128, 0.25


def rig(**kinds: object) -> vts.Calibration:
    """A unit by lights."""
    lights = vts.PointLights([[20, 9, 30], [-18, 13, 30], [-2, -22, 30]], [900, 900, 900])
    return vts.Calibration.from_lights(lights, vts.Sensor("rig", HEIGHT, WIDTH, PITCH, **kinds))


def press(center_mm: tuple[float, float] = (0.0, 0.0), press_mm: float = 1.0) -> Tensor:
    """An image of a ball on that unit."""
    scene = vts.scenes.sphere_press(8.0, press_mm, center_mm, HEIGHT, WIDTH, PITCH)
    lights = rig().lights
    assert lights is not None
    return vts.scenes.render(scene, lights).detach()


@pytest.mark.parametrize("mode", ["fast", "precise", "auto"])
@pytest.mark.parametrize("without_gradients", [torch.no_grad, torch.inference_mode])
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
    assert float((torch.jit.script(pipe)(image).depth_mm - recorded).abs().max()) < 1e-5


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:Torchinductor does not support code generation for complex")
@pytest.mark.parametrize("mode", ["fast", "precise", "auto"])
def test_compiles_with_inductor(mode: str) -> None:
    pipe, image = vts.DepthPipeline.from_calibration(rig(), mode), press()
    with torch.no_grad():
        compiled = torch.compile(pipe, fullgraph=mode == "fast")(image)
        for found, expected in zip(compiled, pipe(image), strict=True):
            assert float((found.double() - expected.double()).abs().max()) < 1e-5


@pytest.mark.parametrize("mode", ["fast", "precise", "auto"])
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_refused(mode: str, dtype: torch.dtype) -> None:
    for pipe in (vts.DepthPipeline.from_calibration(rig(), mode), vts.DepthPipeline.from_calibration(rig(), mode).to(dtype)):
        with pytest.raises(TypeError, match=r"images: expected float32 or float64, got torch\..*float16: .*use \.float\(\)"):
            pipe(press().to(dtype))


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


@pytest.mark.parametrize("mode", ["fast", "precise", "auto"])
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


@pytest.mark.parametrize("mode", ["fast", "precise", "auto"])
@pytest.mark.parametrize(
    ("other", "named"),
    [
        ({"gamma": 2.2}, "gamma"),
        ({"mm_per_pixel": 0.5}, "mm_per_pixel"),
        ({"blur_px": 2.0}, "std_px"),
    ],
)
def test_a_state_of_another_unit_is_refused(mode: str, other: dict[str, float], named: str) -> None:
    lights = rig().lights
    assert lights is not None
    kinds = {"mm_per_pixel": PITCH, **other}
    state = vts.DepthPipeline.from_calibration(
        vts.Calibration.from_lights(lights, vts.Sensor("rig", HEIGHT, WIDTH, **kinds)), mode
    ).state_dict()
    with pytest.raises((ValueError, RuntimeError), match=named):
        vts.DepthPipeline.from_calibration(rig(), mode).load_state_dict(state)


def test_a_state_of_the_same_unit_loads(tmp_path: Path) -> None:
    trained = vts.DepthPipeline.from_calibration(rig(), "precise")
    with torch.no_grad():
        trained.normals.lights.position_mm.add_(0.5)
    torch.save(trained.state_dict(), tmp_path / "state.pt")
    pipe = vts.DepthPipeline.from_calibration(rig(), "precise")
    pipe.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    assert torch.equal(pipe(press()).depth_mm, trained(press()).depth_mm)


def test_a_frame_without_contact_has_a_graph_and_tensors_of_its_own() -> None:
    pipe = vts.DepthPipeline.from_calibration(rig(), "auto")
    lights = rig().lights
    assert lights is not None
    flat = vts.scenes.render(vts.scenes.undeformed(vts.scenes.sphere_press(8.0, 1.0, (0.0, 0.0), HEIGHT, WIDTH, PITCH)), lights)
    image = flat.detach().clone().requires_grad_(True)
    out = pipe(image)
    assert not bool(out.deformed.any())
    out.depth_mm.sum().backward()
    pipe.requires_grad_(True)(flat.detach()).depth_mm.sum().backward()
    out = pipe.requires_grad_(False)(flat.detach())
    out.depth_mm.add_(1.0)
    assert not bool(out.gradient.any())


def test_calls_are_typed(tmp_path: Path) -> None:
    api = pytest.importorskip("mypy.api")
    modules = {
        "DepthPipeline": "DepthOutput", "ConfidentPipeline": "ConfidentOutput", "Compensate": "Tensor", "ContactMask": "Tensor",
        "ContactFromDepth": "Tensor", "NormalModel": "Tensor", "Integrator": "Tensor", "NormalFromIntensity": "Tensor",
        "PoissonBackground": "Tensor", "GradientFromNormal": "Tensor",
    }  # fmt: skip
    lines = ["import torch", "import torchvts as vts", "x = torch.zeros(1)"]
    for name, kind in modules.items():
        call = "m(x, x, x)" if name == "ContactFromDepth" else "m(x)"
        lines += [f"def of_{name}(m: vts.{name}) -> None:", f"    reveal_type({call})  # {kind}"]
    (tmp_path / "calls.py").write_text("\n".join(lines))
    found, _, _ = api.run(["--config-file=", "--follow-imports=silent", str(tmp_path / "calls.py")])
    revealed = [line for line in found.splitlines() if "Revealed type" in line]
    assert len(revealed) == len(modules), found
    for line, kind in zip(revealed, modules.values(), strict=True):
        assert kind in line, line
