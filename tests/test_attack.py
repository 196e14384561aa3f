"""The attack, repeated: kernels at odd sizes and under sanitizers. Files, calls and kills: test_fuzz."""

import os
import shutil
import subprocess
import sys
import zlib
from pathlib import Path

import pytest
import test_frozen
import test_fuzz
import torch

import torchvts as vts
from torchvts.compiled import library
from torchvts.compiled.binding import LIBRARY

pytestmark = pytest.mark.long

HERE = Path(__file__).parent
ENVIRONMENT = test_fuzz.ENVIRONMENT | {"PYTHONPATH": os.pathsep.join([str(HERE), *sys.path])}

SIZES = ((8, 8), (9, 11), (8, 40), (17, 33), (45, 63), (59, 79))


def run_python(program, *arguments, timeout=900, **environment):
    command = [sys.executable, "-W", "ignore", "-c", program, *map(str, arguments)]
    return subprocess.run(command, env=ENVIRONMENT | environment, capture_output=True, text=True, errors="replace", timeout=timeout)


# ---- frozen against plain ----


def odd_frames(images):
    """Frames that no press makes: black, white, of one dead channel, with one bright pixel."""
    dead, spot = images[:1].clone(), images[:1].clone()
    dead[:, 1] = 0.0
    spot[..., 3, 4] = 1.0
    return torch.cat((0.0 * images[:1], 0.0 * images[:1] + 1.0, dead, spot))


@pytest.mark.parametrize("mode", test_frozen.MODES)
@pytest.mark.parametrize("kind", test_frozen.UNITS)
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_frozen_and_plain_agree_on_frames_that_no_press_makes(kind, mode, size):
    if library() is None:
        pytest.skip("no compiled library")
    calibration, images = test_frozen.UNITS[kind](size, 12.0 / max(size))
    pipe = vts.DepthPipeline.from_calibration(calibration, mode)
    with torch.inference_mode():
        found, expected = pipe.freeze()(odd_frames(images)).depth_mm, pipe(odd_frames(images)).depth_mm
    assert bool(torch.isfinite(found).all())
    # where two slopes fit alike, rounding decides
    assert float((found - expected).abs().quantile(0.98)) <= 1e-4 + 1e-3 * float(expected.abs().max())


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
        "import itertools, torch, test_attack, test_frozen, torchvts as vts\ntorch.set_num_threads(1)\n"
        "for size, kind, mode in itertools.product((*test_attack.SIZES, (240, 320)), test_frozen.UNITS, test_frozen.MODES):\n"
        "    calibration, images = test_frozen.UNITS[kind](size, 12.0 / max(size))\n"
        "    frozen = vts.DepthPipeline.from_calibration(calibration, mode).freeze()\n    assert frozen.compiled\n"
        "    frozen(torch.cat((images, test_attack.odd_frames(images))))\n"
        "test_frozen.test_images_may_lie_anywhere_in_memory(test_frozen.lights_unit((96, 128), 0.25))\n"
        "from torchvts.scenes import objects\n"
        "track = [objects.press(objects.key(), objects.pose(2.0 * k), 121, 163, 0.12) for k in range(3)]\n"
        "tracker = vts.PoseTracker(track[0], 0.12)\nfor frame in track[1:]: tracker(frame)\n"
        "assert str(place.library()._name) == sys.argv[1]\n"
    )
    options = {"LD_PRELOAD": runtime, "ASAN_OPTIONS": "detect_leaks=0:abort_on_error=0:allocator_may_return_null=1"}
    done = run_python(program, watched, **options)
    assert done.returncode == 0, f"{done.stdout[-300:]} {done.stderr[-3000:]}"
