"""The attack, repeated: odd sizes, damaged files, bad calls, kills, states of other units, odd names, sanitizers.

Each test reports how much it did; the last lines of `pytest -m long tests/test_attack.py -n 2` add that up.
"""

import json
import os
import random
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


@pytest.fixture
def attacked(record_property):
    """Report what was done: ``attacked("what", count)``; conftest adds it up."""
    return lambda what, count: record_property("attacked", json.dumps([what, count]))


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


def disagreements(size, counts=(1, 3)):
    """Frames of which frozen and plain pipelines do not agree, and how many comparisons were made."""
    scene, lights, units = units_of(size)
    wrong, done = [], 0
    for unit, mode, count in ((unit, mode, count) for unit in units for mode in ("fast", "auto") for count in counts):
        pipe = vts.DepthPipeline.from_calibration(unit, mode)
        frozen = pipe.freeze()
        for fill, image in fills(scene, lights, count, size[1]).items():
            with torch.inference_mode():
                expected = pipe(image)
            largest = float(expected.depth_mm.abs().max())
            outputs = [frozen(given) for given in layouts(image).values() if torch.equal(given, image)]
            for out in outputs:
                off = (out.depth_mm - expected.depth_mm).abs().flatten()
                # where two slopes fit alike, and at the limit of faint depth, rounding decides
                typical = float(off.kthvalue(max(1, int(0.98 * len(off)))).values)
                if not bool(torch.isfinite(out.depth_mm).all()) or typical > 1e-4 + 1e-3 * largest:
                    wrong.append((size, count, mode, fill, typical, largest))
                done += 1
            if not all(torch.equal(one, other) for out in outputs for one, other in zip(out, outputs[0], strict=True)):
                wrong.append((size, count, mode, fill, "layouts"))
    return wrong, done


@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
def test_frozen_and_plain_agree_at_odd_sizes(size, attacked):
    if library() is None:
        pytest.skip("no compiled library")
    wrong, done = disagreements(size)
    attacked("comparisons of frozen pipelines with plain ones", done)
    assert wrong == []


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_the_c_files_stay_within_their_memory(tmp_path, attacked):
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
        "    frozen = vts.DepthPipeline.from_calibration(calibration, 'auto').freeze()\n    assert frozen.compiled\n"
        "    frozen(images)\n    done += len(images)\n"
        "from torchvts.scenes import objects\n"
        "track = [objects.press(objects.key(), objects.pose(2.0 * k), 121, 163, 0.12) for k in range(3)]\n"
        "tracker = vts.PoseTracker(track[0], 0.12)\nfor frame in track[1:]: tracker(frame)\n"
        "assert str(place.library()._name) == sys.argv[1]\nprint(done)"
    )
    options = {"LD_PRELOAD": runtime, "ASAN_OPTIONS": "detect_leaks=0:abort_on_error=0:allocator_may_return_null=1"}
    done = run_python(program, watched, **options)
    assert done.returncode == 0, f"{done.stdout[-300:]} {done.stderr[-3000:]}"
    attacked("comparisons under sanitizers", int(done.stdout.split()[-1]))


# ---- files ----


@pytest.mark.parametrize("part", range(4))
def test_damaged_files(part, tmp_path, attacked):
    """Every kind of file that is read, damaged by chance."""
    test_fuzz.write_whole_files(tmp_path)
    count = 25
    program = "import sys, torch, test_fuzz\ntorch.set_num_threads(1)\n"
    done = run_python(f"{program}test_fuzz.read_damaged(test_fuzz.Path(sys.argv[1]), {count}, {part + 100})", tmp_path)
    lines = [line.partition("] ") for line in done.stdout.splitlines() if line.startswith('["')]
    assert done.returncode == 0, f"the child died at {lines[-1:]}: {done.stderr[-800:]}"
    rows = [(*json.loads(head + "]"), *json.loads(tail)) for head, _, tail in lines]
    assert len(rows) == count * len(test_fuzz.READERS)
    assert [row for row in rows if row[2].startswith("UNEXPECTED")] == []
    attacked("damaged files read", len(rows))


def test_damaged_results_are_made_again(tmp_path, attacked):
    """A damaged or cut result, record or settings file of a data set: done again, or refused by name."""
    calibration, source, out = data_set(tmp_path, 4)
    program = f"{RUN}\nreport = reconstruct_dataset(*sys.argv[1:4], pictures=False, workers=0)\nprint(report.rows)"
    assert run_python(program, calibration, source, out).returncode == 0
    from torchvts.dataset import reconstruct_dataset

    rng, done = random.Random(5), 0
    whole = {path: path.read_bytes() for path in out.rglob("*") if path.is_file() and path.name != "lock"}
    for path in sorted(whole):
        for _ in range(4):
            for other, content in whole.items():
                other.parent.mkdir(parents=True, exist_ok=True)
                other.write_bytes(content)
            path.write_bytes(test_fuzz.damaged(whole[path], rng) if rng.random() < 0.7 else b"")
            done += 1
            try:
                report = reconstruct_dataset(calibration, source, out, pictures=False, workers=0)
            except ValueError as error:
                assert (path.name == "settings.json" and str(path) in str(error)) or "other settings" in str(error)
            else:
                assert report.rows == 4
    attacked("damaged results of data sets", done)


# ---- calls ----


@pytest.mark.parametrize("part", range(8))
def test_bad_calls(part, tmp_path, attacked):
    """Of every public callable, with values that nobody should give: only TypeError, ValueError and OSError come out, in time."""
    command = [sys.executable, "-W", "ignore", str(HERE / "attack_calls.py"), "1260", str(part)]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, cwd=tmp_path, timeout=900)
    lines = done.stdout.splitlines()
    assert done.returncode == 0, f"died at {lines[-1:]}: {done.stderr[-500:]}"
    assert [line for line in lines if not line.endswith(' ""')] == []
    assert len(lines) == 1260
    attacked("bad calls of public names", len(lines))


# ---- kills ----

RUN = "import os, signal, sys, time\nimport torch\ntorch.set_num_threads(1)\nfrom torchvts.dataset import reconstruct_dataset\n"

KILL = """
import random
rng = random.Random(int(sys.argv[-1]))
for number in range(int(sys.argv[-2])):
    child = os.fork()
    if child == 0:
        try:
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, 2)
            work()
        finally:
            os._exit(0)
    time.sleep(rng.random() * float(sys.argv[-3]))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    check(number)
"""


def data_set(tmp_path, frames):
    """A calibration file, a folder of images, and the folder for results."""
    scene, lights, units = units_of((48, 64))
    units[0].save(tmp_path / "unit.safetensors")
    (tmp_path / "in").mkdir()
    for k in range(frames):
        vts.write_image(tmp_path / "in" / f"{k:03d}.png", vts.scenes.render(scene, lights, noise_std=0.004, seed=k)[0])
    return tmp_path / "unit.safetensors", tmp_path / "in", tmp_path / "out"


def test_kills_of_reconstruct(tmp_path, attacked):
    """Killed at any moment: each file is whole or absent, and the same command completes to what an undisturbed run gives."""
    calibration, source, out = data_set(tmp_path, 60)
    kills = 40
    program = (
        f"{RUN}from pathlib import Path\nout = Path(sys.argv[3])\nsource, calibration = sys.argv[2], sys.argv[1]\n"
        "def work():\n    reconstruct_dataset(calibration, source, out, pictures=False, workers=0)\n"
        "def run(folder):\n    return reconstruct_dataset(calibration, source, folder, pictures=False, workers=0)\n"
        "run(out.parent / 'whole')\n"
        "def files(folder):\n    found = [p for p in folder.rglob('*') if p.is_file() and '.torchvts' not in p.parts]\n"
        "    return {p.name: p.read_bytes() for p in found if not p.name.startswith('.')}\n"
        "whole = files(out.parent / 'whole')\n"
        "def check(number):\n"
        "    for name, content in (files(out) if out.is_dir() else {}).items():\n"
        "        assert content == whole[name] or name.endswith(('.csv', '.json')), name\n"
        "    if number % 5 == 4:\n        assert run(out).rows == 60\n        assert files(out).keys() == whole.keys()\n"
        "        import shutil; shutil.rmtree(out)\n"
        f"{KILL}\nprint('done', number + 1)"
    )
    done = run_python(program, calibration, source, out, 0.5, kills, 1)
    assert done.returncode == 0 and done.stdout.split()[-2:] == ["done", str(kills)], done.stderr[-2000:]
    attacked("kills of reconstruct", kills)


def test_kills_of_calibrate(tmp_path, attacked):
    """Killed at any moment: the file is the old one or the new one."""
    kills = 60
    program = (
        f"{RUN}import torchvts as vts, test_attack\nfrom pathlib import Path\npath = Path(sys.argv[1])\n"
        "scene, lights, units = test_attack.units_of((48, 64))\nsensor, background = units[0].sensor, units[0].background\n"
        "def work():\n    for level in (1.0, 0.9, 0.8, 0.7):\n        vts.calibrate(background * level, sensor).save(path)\n"
        "seen = []\n"
        "def check(number):\n    left = [p for p in path.parent.iterdir() if p != path]\n"
        "    assert all(p.name.startswith('.unit-') for p in left) and len(left) <= 1, left\n"
        "    for p in left: p.unlink()\n"
        "    if path.is_file(): seen.append(vts.Calibration.load(path).sensor.name)\n"
        f"{KILL}\nprint('done', number + 1, len(seen))"
    )
    (tmp_path / "unit").mkdir()
    done = run_python(program, tmp_path / "unit" / "unit.safetensors", 1.5, kills, 2)
    assert done.returncode == 0 and done.stdout.split()[-3:-1] == ["done", str(kills)], done.stderr[-2000:]
    attacked("kills of calibrate", kills)


# ---- states ----


def test_a_state_goes_into_a_pipeline_of_the_same_unit_only(attacked):
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
    attacked("states loaded into pipelines", pairs)


# ---- names ----

NAMES = [b"\xff", b"a\xfe b", b"\xc3(", b"\xed\xa0\x80", b"new\nline", b"=1+1", b"-x", b"caf\xc3\xa9", b" ", b"%s{}"]


def test_odd_names(tmp_path, attacked):
    """Names that are not UTF-8, or look like something else: read, written, or refused in words; no process dies."""
    program = (
        "import json, os, shutil, sys\nimport test_attack, test_fuzz, torch\ntorch.set_num_threads(1)\n"
        "root, done = os.fsencode(sys.argv[1]), 0\n"
        "for name in test_attack.NAMES:\n"
        "    folder = test_fuzz.Path(os.fsdecode(root + b'/f' + name)); folder.mkdir()\n"
        "    for kind, (write, read) in test_fuzz.READERS.items():\n"
        "        if kind in ('catalog.csv', 'labels.csv', 'label.npz', 'gelsight.png'): continue\n"
        "        plain, path = test_fuzz.Path(sys.argv[1]) / kind, folder / (os.fsdecode(name) + kind)\n"
        "        if not plain.exists(): write(plain)\n"
        "        shutil.copyfile(plain, path)\n"
        "        print(json.dumps([kind, ascii(name), *test_fuzz.outcome(read, path)]), flush=True)\n"
        "        if kind not in ('film.avi', 'nnmodel.pth', 'gs_sdk.yaml'):\n"
        "            print(json.dumps([kind, ascii(name), *test_fuzz.outcome(write, folder / ('w' + os.fsdecode(name) + kind))]), "
        "flush=True)\n"
    )
    done = run_python(program, tmp_path)
    rows = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("[")]
    assert done.returncode == 0, f"died at {rows[-1:]}: {done.stderr[-800:]}"
    bad = [row for row in rows if row[2] != "read" and not (row[2] == "ValueError" and "expected a name in UTF-8" in row[3])]
    assert bad == []
    attacked("odd names read and written", len(rows))
