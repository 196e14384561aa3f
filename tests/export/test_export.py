"""Exported files give what the pipeline gives, in a process that cannot import torchvts."""

import itertools
import json
import subprocess
import sys

import pytest
import torch
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode

import torchvts as vts
from torchvts import export
from torchvts.export import onnx_operators
from torchvts.export.trace import PoissonBackgroundByMatrix

HEIGHT, WIDTH, PITCH = 48, 64, 0.6
SENSOR = vts.Sensor("rig", HEIGHT, WIDTH, PITCH)


@pytest.fixture(scope="module")
def low(ring):
    """Lights so low that a press blocks some: their calibration, and frames well, hardly and not pressed."""
    lights = ring(20.0, 15.0)
    presses = [vts.scenes.sphere_press(10.0, mm, (x, 0), HEIGHT, WIDTH, PITCH) for mm, x in ((3.0, 0), (0.5, -6), (1.5, 5))]
    frames = [vts.scenes.render(scene, lights, noise_std=0.003, bits=8, seed=k) for k, scene in enumerate(presses)]
    background = vts.scenes.render(vts.scenes.undeformed(presses[0]), lights, noise_std=0.003, bits=8, seed=9)
    return vts.Calibration.from_lights(lights, SENSOR, background[0]), torch.cat([*frames, background])


@pytest.fixture(scope="module")
def mini():
    """A GelSight Mini by the prior of its type, on a background of its own making."""
    sensor = vts.Sensor.load("gelsight_mini", height=48, width=64)
    prior = sensor.prior
    background = (prior.background(48, 64, sensor.mm_per_pixel) ** (1.0 / prior.response.gamma)).float().clamp(0.0, 1.0)
    calibration = vts.Calibration.from_response(prior.response, sensor, background)
    return calibration, export.sample_frames(calibration)


def pipeline(calibration, mode, **options):
    return vts.DepthPipeline.from_calibration(calibration, mode, **options)


def learned():
    block = nn.Conv2d(3, 3, 1)
    with torch.no_grad():
        block.weight.copy_(torch.eye(3)[:, :, None, None])
        block.bias.copy_(torch.tensor([-0.4, -0.4, 1.0]))
    return block.requires_grad_(False)


def of_kind(calibration, kind):
    """A pipeline by its name in the tables: lights or response and the mode, or own normals."""
    return pipeline(calibration, "fast", normals=learned()) if kind == "own normals" else pipeline(calibration, kind.split()[1])


def test_the_scenes_are_hard_enough(low, mini):
    calibration, frames = low
    pipe = pipeline(calibration, "precise")
    compensated = pipe.compensate(frames)
    shadowed = pipe.normals.shadowed
    blocked = shadowed.dark(compensated) | (compensated >= shadowed.saturated_above)
    assert int(blocked[0].sum()) > 10
    assert pipe(frames).contact.flatten(1).any(1).tolist() == [True, True, True, False]
    assert (pipe(frames).depth_mm - pipeline(calibration, "fast")(frames).depth_mm).abs().max() > 0.05
    for mode in ("fast", "precise"):
        assert pipeline(mini[0], mode)(mini[1]).deformed[:3].flatten(1).any(1).tolist() == [True, False, True]


@pytest.fixture(scope="module")
def cells_of_two(ring):
    """A fast pipeline of an image whose mask cells are two pixels wide, the last ones overlapping others, and three frames."""
    height, width, lights = 166, 222, ring(20.0, 15.0)
    scene = vts.scenes.sphere_press(10.0, 1.5, (3.0, 1.0), height, width, 0.17)
    frames = vts.scenes.render(scene, lights, noise_std=0.003, bits=8, seed=1).detach().repeat(3, 1, 1, 1)
    pipe = pipeline(vts.Calibration.from_lights(lights, vts.Sensor("rig", height, width, 0.17)), "fast")
    return pipe, frames


def test_a_program_of_a_mask_whose_cells_are_larger_than_pixels(cells_of_two):
    pipe, frames = cells_of_two
    compensated = pipe.compensate(frames)
    with torch.no_grad():
        program = torch.export.export(pipe.mask, (compensated,), dynamic_shapes=({0: torch.export.Dim.AUTO},)).module()
        for batch in (compensated, compensated[:2]):
            found, expected = program(batch), pipe.mask(batch)
            assert torch.allclose(found, expected, atol=1e-6) and bool(expected.any()) and not bool(expected.all())


def test_a_program_of_normals_whose_lights_are_blocked(low):
    calibration, frames = low
    pipe = pipeline(calibration, "fast")
    compensated = pipe.compensate(frames)
    with torch.no_grad():
        program = torch.export.export(pipe.normals, (compensated,)).module()
        assert (program(compensated) - pipe.normals(compensated)).abs().max() < 1e-6


@pytest.mark.long
def test_a_program_of_an_image_whose_cells_are_larger_than_pixels(cells_of_two, tmp_path):
    """The program that was written, and its file without torchvts."""
    pipe, frames = cells_of_two
    with torch.no_grad():
        found, expected = export.export_program(pipe, tmp_path / "pipe.pt2").module()(frames), pipe(frames)
    assert export.compare(tmp_path / "pipe.pt2", pipe, frames, "pt2") <= 1e-5
    assert torch.equal(found[3], expected.contact) and torch.equal(found[4], expected.deformed)
    assert (found[0] - expected.depth_mm).abs().max() < 1e-5


@pytest.mark.long
def test_onnx_of_an_image_whose_zero_has_cells_of_two(ring, tmp_path):
    if export.missing("onnx"):
        pytest.skip(export.missing("onnx"))
    lights, (height, width) = ring(20.0, 15.0), (64, 96)
    frames = vts.scenes.render(vts.scenes.sphere_press(4.0, 0.5, (0, 0), height, width, 0.2), lights).detach().repeat(3, 1, 1, 1)
    pipe = pipeline(vts.Calibration.from_lights(lights, vts.Sensor("rig", height, width, 0.2)), "fast")
    assert export.compare(export.export_onnx(pipe, tmp_path / "pipe.onnx"), pipe, frames, "onnx") <= 1e-3


class AnyKeywords(nn.Module):
    """A network that does not script."""

    def __init__(self):
        super().__init__()
        self.slope = learned()

    def forward(self, image, **unused):
        return nn.functional.normalize(self.slope(image), dim=1)


def test_a_network_that_does_not_script_is_exported_traced(low, tmp_path):
    calibration, frames = low
    network = AnyKeywords().eval()
    pipe = pipeline(calibration, "fast", normals=network)
    with pytest.raises(RuntimeError, match=r"(?s)pipe: expected modules that torch\.jit\.script takes.*torch\.jit\.trace.*unused"):
        export.export_torchscript(pipe, tmp_path / "pipe.pt")
    assert not (tmp_path / "pipe.pt").exists()
    traced = pipeline(calibration, "fast", normals=torch.jit.trace(network, frames[:1]))
    path = export.export_torchscript(traced, tmp_path / "pipe.pt")
    with torch.jit.optimized_execution(False):
        assert (torch.jit.load(path)(frames).depth_mm - pipe(frames).depth_mm).abs().max() <= 1e-5


@pytest.mark.parametrize(
    "mode, optimised", [("fast", False), *(pytest.param("precise", some, marks=pytest.mark.long) for some in (False, True))]
)
def test_gradients_through_torchscript_without_torchvts(low, tmp_path, mode, optimised):
    calibration, frames = low
    pipe = pipeline(calibration, mode).requires_grad_(True)
    image = frames[:1].clone().requires_grad_(True)
    pipe(image).depth_mm.square().sum().backward()
    export.export_torchscript(pipe, tmp_path / "pipe.pt")
    torch.save(frames[:1], tmp_path / "image")
    code = (
        "import sys, json, torch; sys.modules['torchvts'] = None; metadata = {'torchvts.json': ''}\n"
        "pipe = torch.jit.load('pipe.pt', _extra_files=metadata)\n"
        "image = torch.load('image', weights_only=True).requires_grad_(True)\n"
        f"with torch.jit.optimized_execution({optimised}): depth = pipe(image).depth_mm\n"
        "depth.square().sum().backward()\n"
        "found = {name: p.grad for name, p in pipe.named_parameters() if p.grad is not None}\n"
        "torch.save(found | {'image': image.grad}, 'grad'); print(metadata['torchvts.json'].decode())\n"
    )
    command = [sys.executable, "-I", "-W", "ignore", "-c", code]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = torch.load(tmp_path / "grad", weights_only=True)
    expected = {name: p.grad for name, p in pipe.named_parameters()} | {"image": image.grad}
    assert {"image", "solve.normals.lights.position_mm", "solve.normals.lights.albedo"} <= set(found)
    for name, gradient in found.items():
        assert float(gradient.abs().max()) > 0
        assert torch.allclose(gradient, expected[name], rtol=1e-3, atol=1e-4 * float(expected[name].abs().max())), name
    found = json.loads(done.stdout)
    assert (found["mode"], found["mm_per_pixel"], found["height"], found["width"]) == (mode, PITCH, HEIGHT, WIDTH)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["response precise", "own normals", "lights precise"])
def test_a_program_takes_the_decisions_of_the_pipeline(low, mini, tmp_path, kind):
    """Passes and dark pixels in the graph, against the Python of the pipeline; then from its file, without torchvts."""
    calibration, frames = mini if kind == "response precise" else low
    pipe = of_kind(calibration, kind)
    program = export.export_program(pipe, tmp_path / "pipe.pt2").module()
    for batch in (frames[:1], frames[1:3], frames[:3], frames[3:], frames):
        wanted = pipe(batch)
        for found, expected in zip(program(batch), wanted, strict=True):
            assert (found.double() - expected.double()).abs().max() <= 1e-5
    if kind != "response precise":
        assert export.compare(tmp_path / "pipe.pt2", pipe, frames, "pt2") <= 1e-5


class Changed(nn.Module):
    """Where the light has changed: next to nothing of the graph of a ContactMask."""

    def __init__(self, flat):
        super().__init__()
        self.register_buffer("flat", flat)

    def forward(self, compensated):
        return (compensated - self.flat).abs().amax(1, keepdim=True) > 0.05


class Deep(nn.Module):
    def forward(self, depth_mm, deformed):
        return deformed & (depth_mm > 0.1)


def own_chain(calibration, frames):
    """Own normals, own masks before and after them, and what the library does around them."""
    blocks = pipeline(calibration, "fast")
    chain = (blocks.compensate, Changed(blocks.compensate(frames[3:])), learned(), blocks.gradient, vts.PoissonDST(PITCH))
    pipe = vts.DepthPipeline(*chain, mm_per_pixel=PITCH, contact=Deep()).eval()
    assert pipe(frames).contact.flatten(1).any(1).tolist() == [True, True, True, False]
    return pipe


WRITERS = {
    "torchscript": (export.export_torchscript, 1e-5),
    "onnx": (export.export_onnx, 1e-3),
    "pt2": (export.export_program, 1e-4),
}
"""Of each format: what writes it, and by how much its depth may differ, mm."""
CALIBRATED = ("response fast", "response precise", "lights fast", "lights precise")


@pytest.mark.long  # some graphs take minutes to write
@pytest.mark.parametrize(
    "name, kind",
    [
        *itertools.product(("torchscript", "onnx"), CALIBRATED),
        ("torchscript", "own normals"), ("onnx", "own chain"), ("pt2", "own chain"),
    ],
)  # fmt: skip
def test_files_run_without_torchvts(low, mini, tmp_path, name, kind):
    if export.missing(name):
        pytest.skip(export.missing(name))
    calibration, frames = mini if kind.startswith("response") else low
    pipe = own_chain(calibration, frames) if kind == "own chain" else of_kind(calibration, kind)
    write, most_mm = WRITERS[name]
    path = tmp_path / f"pipe.{name}"
    write(pipe, path)
    assert export.compare(path, pipe, frames, name) <= most_mm


@pytest.mark.parametrize("height, width", [(24, 32), (23, 35)])
@pytest.mark.parametrize("zero_in_background", [True, False])
def test_matrix_products_integrate_as_the_pipeline_does(height, width, zero_in_background):
    gradient = torch.randn(3, 2, height, width, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    gradient[1:, :, :8] = 0.0
    by_matrix = PoissonBackgroundByMatrix(height, width, 0.3, torch.float64, zero_in_background)(gradient)
    expected = (vts.PoissonBackground if zero_in_background else vts.PoissonDCT)(0.3)(gradient)
    assert (by_matrix - expected).abs().max() < 1e-12


@pytest.mark.parametrize("length", [1, 2, 7, 8])
def test_what_stands_in_for_operators_that_onnx_lacks(length):
    values = torch.randn(3, length, 2, generator=torch.Generator().manual_seed(length))
    some = torch.where(values > 0.3, torch.nan, values)
    for keep in (True, False):
        calls = [
            lambda keep=keep: values.median(1, keepdim=keep),
            lambda keep=keep: torch.median(values, dim=1, keepdim=keep),
            lambda keep=keep: some.nanmedian(1, keep),
            lambda keep=keep: torch.nanmedian(some, 1, keep),
        ]
        for call in calls:
            expected = call()
            with onnx_operators.InOnnxOperators(), Names() as called:
                found = call()
            assert torch.equal(found.values.nan_to_num(9.0), expected.values.nan_to_num(9.0))
            assert not any("median" in name for name in called.names)
    with onnx_operators.InOnnxOperators():
        whole = values.median(), torch.nanmedian(some)
    assert torch.equal(whole[0], values.median()) and torch.equal(whole[1].nan_to_num(9.0), some.nanmedian().nan_to_num(9.0))


class Names(TorchDispatchMode):
    """The operators that are called within it."""

    def __init__(self):
        super().__init__()
        self.names = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.names.append(str(func))
        return func(*args, **(kwargs or {}))


def test_a_file_that_does_not_agree_or_does_not_run_is_reported(low, tmp_path):
    """It is of a network in training, which is written in eval mode."""
    calibration, frames = low
    pipe = pipeline(calibration, "fast")
    training = pipeline(calibration, "fast", normals=nn.Sequential(learned(), nn.Dropout(0.5)).train())
    path = export.export_torchscript(training, tmp_path / "pipe.pt")
    with torch.jit.optimized_execution(False):
        assert torch.allclose(torch.jit.load(path)(frames[:1]).depth_mm, training.eval()(frames[:1]).depth_mm, atol=1e-5)
    assert export.compare(path, pipe, frames[:1], "torchscript") > 0.05
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(RuntimeError, match=r"pipe.pt: could not be run without torchvts: .+"):
        export.compare(path, pipe, frames[:1], "torchscript")


class Unscriptable(nn.Module):
    def forward(self, compensated):
        return compensated * float(next(iter({compensated.mean().item()})))


def test_one_format_that_fails_leaves_the_others(low, tmp_path, monkeypatch):
    calibration, frames = low
    monkeypatch.setattr(export.formats, "find_spec", lambda name: None)
    rows = export.export_checked(own_chain(calibration, frames), tmp_path / "new", ["onnx", "torchscript"], frames)
    assert [row.ok for row in rows] == [False, True]
    assert rows[0].reason == "onnx: onnx, onnxscript, onnxruntime not found: pip install 'torchvts[onnx]'"
    assert rows[1].size_kb > 10 and rows[1].difference_mm <= 1e-5
    rows = export.export_checked(pipeline(calibration, "fast", normals=Unscriptable()), tmp_path, ["torchscript"], frames)
    assert not rows[0].ok and rows[0].reason and not (tmp_path / "pipeline.pt").exists()


def test_a_plan_is_written_and_compared(low, tmp_path):
    calibration, frames = low
    (row,) = export.export_checked(pipeline(calibration, "precise"), tmp_path, ["plan"], frames)
    assert row.ok and row.path.name == "pipeline.plan" and row.difference_mm <= 1e-5, row
    (row,) = export.export_checked(pipeline(calibration, "fast", normals=learned()), tmp_path / "own", ["plan"], frames)
    assert row.reason.startswith("pipe: expected one that is compiled")


def test_the_script(run_script, low, tmp_path):
    low[0].save(tmp_path / "unit.safetensors")
    vts.write_image(tmp_path / "press.png", low[1][0])
    network = vts.NormalFromMLP(HEIGHT, WIDTH, low[0].background.float().clamp(0.0, 1.0), (4,))  # a short graph
    network.save(tmp_path / "network.safetensors")
    arguments = (
        tmp_path / "unit.safetensors",
        "--network",
        tmp_path / "network.safetensors",
        "--out",
        tmp_path / "out",
        "--format",
    )
    done = run_script("export", *arguments, "torchscript", "--frames", tmp_path / "press.png")
    assert done.returncode == 0, done.stderr
    assert "| torchscript |" in done.stdout and "| ok |\nnext: " in done.stdout
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["pipeline.pt"]
    done = run_script("export", *arguments, "tflite")
    assert done.returncode != 0 and "error: format: expected one of torchscript" in done.stderr


def test_an_integrator_that_loops_over_what_it_finds_is_refused(low, tmp_path):
    """It failed with an error of the compiler's."""
    own = pipeline(low[0], "fast", integrate=vts.AdaptiveIntegration(PITCH))
    with pytest.raises(TypeError, match="got AdaptiveIntegration: no file can hold it; export with PoissonDCT"):
        export.export_torchscript(own, tmp_path / "a.pt")
