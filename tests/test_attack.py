"""The attack, repeated: kernels at odd sizes and under sanitizers, states of other units. Files, calls and kills: test_fuzz."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import test_fuzz
import torch
from conftest import ring_lights

import torchvts as vts
from torchvts.accelerated import kernels, reference_only
from torchvts.model.response_field import DepthBrightness, ResponseField, ResponseModel

pytestmark = pytest.mark.long

HERE = Path(__file__).parent
ENVIRONMENT = test_fuzz.ENVIRONMENT | {"PYTHONPATH": os.pathsep.join([str(HERE), *sys.path])}

SIZES = [
    (8, 8), (8, 40), (40, 8), (9, 11), (13, 17), (16, 16), (17, 33), (24, 32), (31, 29), (37, 53),
    (45, 63), (59, 79), (61, 97), (64, 64), (71, 128), (99, 101), (127, 129), (120, 161), (181, 200), (241, 319),
]  # fmt: skip


def run_python(program, *arguments, timeout=900, **environment):
    command = [sys.executable, "-W", "ignore", "-c", program, *map(str, arguments)]
    return subprocess.run(command, env=ENVIRONMENT | environment, capture_output=True, text=True, errors="replace", timeout=timeout)


# ---- kernels against the PyTorch reference ----


def layouts(tensor):
    """The same values in other places of memory."""
    count, channels, height, width = tensor.shape
    wide = torch.zeros(count, channels, height + 3, width + 5)
    wide[:, :, 1:-2, 2:-3] = tensor
    double = torch.zeros(count, channels, height, 2 * width)
    double[..., ::2] = tensor
    shifted = torch.zeros(tensor.numel() + 1)
    shifted[1:] = tensor.flatten()
    return {
        "contiguous": tensor,
        "channels last": tensor.contiguous(memory_format=torch.channels_last),
        "part of a larger one": wide[:, :, 1:-2, 2:-3],
        "every second column": double[..., ::2],
        "columns first": tensor.transpose(2, 3).contiguous().transpose(2, 3),
        "not aligned": shifted[1:].reshape(tensor.shape),
        "expanded": tensor[:1].expand(count, -1, -1, -1),
    }


def fills(scene, lights, count, seed):
    """Images: pressed, flat, noise, black, white, one dead channel, one bright pixel."""
    generator = torch.Generator().manual_seed(seed)
    flat = vts.scenes.render(vts.scenes.undeformed(scene), lights).expand(count, -1, -1, -1)
    pressed = vts.scenes.render(scene, lights, noise_std=0.005, seed=seed).repeat(count, 1, 1, 1)
    dead, spot = pressed.clone(), flat.clone()
    dead[:, seed % 3] = 0.0
    spot[..., 3, 4] = 1.0
    noise = torch.rand(pressed.shape, generator=generator)
    plain = {"noise": noise, "black": 0.0 * noise, "white": 0.0 * noise + 1.0}
    return {"pressed": pressed, "flat": flat.clone(), **plain, "dead": dead, "spot": spot}


def units_of(size):
    """A unit by lights and one by a response, of this size."""
    lights, sensor = ring_lights(), vts.Sensor("rig", *size, 30.0 / max(size))
    scene = vts.scenes.sphere_press(8.0, 1.0, (0.5, -0.3), *size, sensor.mm_per_pixel)
    background = vts.scenes.render(vts.scenes.undeformed(scene), lights)[0]
    field = ResponseField(0, -1, 20.0, ((0.3, 0.1, -0.2), (-0.1, 0.3, -0.1)))
    model = ResponseModel(field, DepthBrightness(0, 20.0, ((0.05,), (-0.02,), (0.1,))))
    by_response = vts.Calibration.from_response(model, sensor, background)
    return scene, lights, (vts.Calibration.from_lights(lights, sensor, background), by_response)


def both(call, *arguments):
    with reference_only():
        expected = call(*arguments)
    return call(*arguments), expected


def close(found, expected, tolerance):
    """Equal up to a tolerance, and NaN or infinite in the same places."""
    if found.shape != expected.shape:
        return False
    scale = 1.0 + float(expected[torch.isfinite(expected)].abs().max()) if bool(torch.isfinite(expected).any()) else 1.0
    return torch.allclose(found.double(), expected.double(), rtol=0.0, atol=tolerance * scale, equal_nan=True)


def disagreements(size, counts=(1, 3)):
    """What kernels and PyTorch reference do not agree on, and how many comparisons were made."""
    scene, lights, units = units_of(size)
    wrong, done = [], 0
    for unit, count in ((unit, count) for unit in units for count in counts):
        pipe = vts.DepthPipeline.from_calibration(unit, "fast")
        for fill, image in fills(scene, lights, count, size[1]).items():
            for layout, given in layouts(image).items():
                compensated, expected = both(pipe.compensate, given)
                case = (size, count, fill, layout)
                if not close(compensated, expected, 2e-5):
                    wrong.append((*case, "compensate", float((compensated - expected).abs().max())))
                normal, expected_normal = both(pipe.normals, expected)
                apart = (normal - expected_normal).abs().flatten()
                if not bool(torch.isfinite(normal).all()) or float(apart.kthvalue(max(1, int(0.99 * len(apart)))).values) > 1e-3:
                    wrong.append((*case, "normals", float(apart.max())))
                gradient, expected_gradient = both(pipe.gradient, expected_normal)
                if not close(gradient, expected_gradient, 1e-5):
                    wrong.append((*case, "gradient", float((gradient - expected_gradient).abs().max())))
                depth, expected_depth = both(pipe.integrate, expected_gradient)
                if not close(depth, expected_depth, 1e-5):
                    wrong.append((*case, "integrate", float((depth - expected_depth).abs().max())))
                done += 4
    return wrong, done


@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
def test_loops_agree_with_tensors_at_odd_sizes(size):
    if kernels.library() is None:
        pytest.skip("no compiled kernels")
    wrong, _ = disagreements(size)
    assert wrong == []


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_the_c_files_stay_within_their_memory(tmp_path):
    """Built with the address and undefined-behaviour sanitizers, which end the process at the first error."""
    sources = sorted(kernels.LIBRARY.parent.glob("*.c"))
    library = tmp_path / "libtorchvts.so"
    flags = [
        "-std=c11",
        "-O1",
        "-g",
        "-fPIC",
        "-shared",
        "-fvisibility=hidden",
        "-fsanitize=address,undefined",
        "-fno-sanitize-recover=all",
    ]
    built = subprocess.run(["cc", *flags, f"-DSOURCES={crc()}u", "-o", library, *sources, "-lm"], capture_output=True, text=True)
    runtime = subprocess.run(["cc", "-print-file-name=libasan.so"], capture_output=True, text=True).stdout.strip()
    if built.returncode != 0 or not Path(runtime).is_file():
        pytest.skip(f"the compiler has no sanitizers: {built.stderr[-200:]}")
    program = (
        "import ctypes, sys\nfrom torchvts.accelerated import kernels\nloaded, real = [], ctypes.CDLL\n"
        "def watched(path, *a, **k):\n"
        "    if str(path) == str(kernels.LIBRARY):\n        path = sys.argv[1]; loaded.append(path)\n"
        "    return real(path, *a, **k)\n"
        "ctypes.CDLL = watched\nimport torch, test_attack\ntorch.set_num_threads(1)\n"
        "done = 0\nfor size in ((8, 8), (9, 11), (8, 40), (17, 33), (45, 63), (59, 79)):\n"
        "    wrong, some = test_attack.disagreements(size, (1, 2))\n    done += some\n    assert not wrong, wrong[:3]\n"
        "assert loaded\nprint(done)"
    )
    options = {"LD_PRELOAD": runtime, "ASAN_OPTIONS": "detect_leaks=0:abort_on_error=0:allocator_may_return_null=1"}
    done = run_python(program, library, **options)
    assert done.returncode == 0, f"{done.stdout[-300:]} {done.stderr[-3000:]}"


def crc():
    import zlib

    return zlib.crc32(b"".join(path.read_bytes() for path in sorted(kernels.LIBRARY.parent.glob("*.[ch]"))))


# ---- states ----


def test_a_state_goes_into_a_pipeline_of_the_same_unit_only():
    """Loaded, it gives what the pipeline gave that it is of; else it is refused."""
    lights = ring_lights()
    kinds = [
        {}, {"gamma": 1.8}, {"mm_per_pixel": 0.5}, {"blur_px": 1.5}, {"height": 40}, {"width": 72}, {"markers": True},
    ]  # fmt: skip
    pipes = []
    for kind in kinds:
        sensor = vts.Sensor(**{"name": "rig", "height": 48, "width": 64, "mm_per_pixel": 0.6, **kind})
        scene = vts.scenes.sphere_press(8.0, 1.0, (0, 0), sensor.height, sensor.width, sensor.mm_per_pixel)
        background = vts.scenes.render(vts.scenes.undeformed(scene), lights, noise_std=0.004, seed=len(pipes))[0]
        for mode in ("fast", "precise", "auto"):
            for unit in (vts.Calibration.from_lights(lights, sensor), vts.Calibration.from_lights(lights, sensor, background)):
                pipes.append((vts.DepthPipeline.from_calibration(unit, mode), vts.scenes.render(scene, lights)))
        response = ResponseModel(ResponseField(0, -1, 20.0, ((0.3, 0.1, -0.2), (-0.1, 0.3, -0.1))), None, sensor.exponent, 1.0)
        unit = vts.Calibration.from_response(response, sensor, background)
        pipes.append((vts.DepthPipeline.from_calibration(unit), vts.scenes.render(scene, lights)))
    pairs, loaded = 0, 0
    for k, (of, image) in enumerate(pipes):
        state, expected = of.state_dict(), of(image).depth_mm
        for j, (into, _) in enumerate(pipes):
            pairs += 1
            before = {name: value.clone() for name, value in into.state_dict().items()}
            try:
                into.load_state_dict(state)
            except (RuntimeError, ValueError, TypeError):
                assert j != k
                continue
            loaded += 1
            assert torch.equal(into(image).depth_mm, expected), (k, j)
            into.load_state_dict(before)
    assert loaded >= len(pipes)
