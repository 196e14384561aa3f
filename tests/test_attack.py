"""The attack, repeated: kernels at odd sizes and under sanitizers, states of other units. Files, calls and kills: test_fuzz."""

import copy
import os
import shutil
import subprocess
import sys
import zlib
from pathlib import Path

import pytest
import test_fuzz
import torch
from conftest import ring_lights

import torchvts as vts
from torchvts.compiled import library
from torchvts.compiled.binding import LIBRARY
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


# ---- frozen against plain ----


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


def most(off):
    """98 % of the values are at most this."""
    return float(off.flatten().kthvalue(max(1, int(0.98 * off.numel()))).values)


def nearer(out, expected, pipe, image):
    """Whether the frozen depth is nearer to that in double precision than the plain one is."""
    with torch.inference_mode():
        exact = copy.deepcopy(pipe).double()(image.double()).depth_mm
    return most((out.depth_mm - exact).abs()) <= most((expected.depth_mm - exact).abs())


def disagreements(size, counts=(1, 3)):
    """Frames of which frozen and plain pipelines do not agree, and how many comparisons were made."""
    scene, lights, units = units_of(size)
    wrong, done = [], 0
    for unit, mode, count in ((unit, mode, count) for unit in units for mode in ("fast", "precise") for count in counts):
        pipe = vts.DepthPipeline.from_calibration(unit, mode)
        frozen = pipe.freeze()
        for fill, image in fills(scene, lights, count, size[1]).items():
            with torch.inference_mode():
                expected = pipe(image)
            largest = float(expected.depth_mm.abs().max())
            outputs = [frozen(given) for given in layouts(image).values() if torch.equal(given, image)]
            for out in outputs:
                off = (out.depth_mm - expected.depth_mm).abs().flatten()
                # where two slopes fit alike, rounding decides
                typical = most(off)
                agree = typical <= 1e-4 + 1e-3 * largest or nearer(out, expected, pipe, image)
                if not bool(torch.isfinite(out.depth_mm).all()) or not agree:
                    wrong.append((size, count, mode, fill, typical, largest))
                done += 1
            if not all(torch.equal(one, other) for out in outputs for one, other in zip(out, outputs[0], strict=True)):
                wrong.append((size, count, mode, fill, "layouts"))
    return wrong, done


@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
def test_frozen_and_plain_agree_at_odd_sizes(size):
    if library() is None:
        pytest.skip("no compiled library")
    wrong, _ = disagreements(size)
    assert wrong == []


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_the_c_files_stay_within_their_memory(tmp_path):
    """Built with the address and undefined-behaviour sanitizers, which end the process at the first error."""
    for path in LIBRARY.parent.glob("*.[ch]"):
        shutil.copy(path, tmp_path)
    crc = zlib.crc32(b"".join(path.read_bytes() for path in sorted(tmp_path.glob("*.[ch]"))))
    flags = ["-std=c11", "-O1", "-g", "-fPIC", "-shared", "-fvisibility=hidden", "-fsanitize=address,undefined"]
    flags += ["-fno-sanitize-recover=all", f"-DSOURCES={crc}u"]
    sources, watched = sorted(tmp_path.glob("*.c")), tmp_path / LIBRARY.name
    built = subprocess.run(["cc", *flags, "-o", watched, *sources, "-lm"], capture_output=True, text=True)
    runtime = subprocess.run(["cc", "-print-file-name=libasan.so"], capture_output=True, text=True).stdout.strip()
    if built.returncode != 0 or not Path(runtime).is_file():
        pytest.skip(f"the compiler has no sanitizers: {built.stderr[-200:]}")
    program = (
        "import sys, pathlib\nimport torchvts.compiled.binding as place\nplace.LIBRARY = pathlib.Path(sys.argv[1])\n"
        "import torch, test_attack, test_frozen, torchvts as vts\ntorch.set_num_threads(1)\n"
        "done = 0\nfor size in ((8, 8), (9, 11), (8, 40), (17, 33), (45, 63), (59, 79)):\n"
        "    wrong, some = test_attack.disagreements(size, (1, 2))\n    done += some\n    assert not wrong, wrong[:3]\n"
        "for kind, make in test_frozen.UNITS.items():\n"
        "    calibration, images = make((240, 320), 0.08)\n"
        "    frozen = vts.DepthPipeline.from_calibration(calibration, 'precise').freeze()\n    assert frozen.compiled\n"
        "    frozen(images)\n    done += len(images)\n"
        "from torchvts.scenes import objects\n"
        "track = [objects.press(objects.key(), objects.pose(2.0 * k), 121, 163, 0.12) for k in range(3)]\n"
        "tracker = vts.PoseTracker(track[0], 0.12)\nfor frame in track[1:]: tracker(frame)\n"
        "assert str(place.library()._name) == sys.argv[1]\nprint(done)"
    )
    options = {"LD_PRELOAD": runtime, "ASAN_OPTIONS": "detect_leaks=0:abort_on_error=0:allocator_may_return_null=1"}
    done = run_python(program, watched, **options)
    assert done.returncode == 0, f"{done.stdout[-300:]} {done.stderr[-3000:]}"


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
        for mode in ("fast", "precise"):
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
