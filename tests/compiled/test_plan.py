"""A plan file: what is written is read again, by Python, C, and a reader made from its page alone; what is damaged is refused."""

import pickle
import re
import shutil
import struct
import subprocess
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import ROOT, without_library
from test_frozen import UNITS, lights_unit, marked_unit

import torchvts as vts
from torchvts.compiled import library, plan
from torchvts.compiled.binding import LIBRARY

CSRC = LIBRARY.parent
MODES = ("fast", "precise")
KINDS = UNITS | {"marked": marked_unit}
pytestmark = pytest.mark.skipif(library() is None, reason="no compiled library")


@pytest.fixture(scope="module", params=[(kind, mode) for kind in KINDS for mode in MODES], ids="-".join)
def saved(request, tmp_path_factory):
    """A plan file, the frozen pipeline that wrote it, and images."""
    kind, mode = request.param
    calibration, images = KINDS[kind]((24, 32), 0.5)
    frozen = vts.DepthPipeline.from_calibration(calibration, mode).freeze()
    path = tmp_path_factory.mktemp("plan") / "unit.plan"
    frozen.save(path)
    return path, frozen, images


def test_a_plan_gives_the_depth_of_what_wrote_it(saved):
    path, frozen, images = saved
    loaded = vts.FrozenPipeline.load(path)
    for found, conditions in (loaded.with_conditions(images), pickle.loads(pickle.dumps(loaded)).with_conditions(images)):
        expected, seen = frozen.with_conditions(images)
        assert all(torch.equal(one, other) for one, other in zip(found, expected, strict=True))
        assert torch.equal(conditions.light, seen.light) and torch.equal(conditions.unseen_deg, seen.unseen_deg)
    assert (loaded.mode, loaded.mm_per_pixel, loaded.compiled) == (frozen.mode, 0.5, True)
    again = path.with_name("again.plan")
    loaded.save(again)
    assert again.read_bytes() == path.read_bytes()


def test_a_plan_says_what_it_is_of_and_whether_it_is_metric(tmp_path):
    calibration, _ = lights_unit((24, 32), 0.5)
    told = vts.DepthPipeline.from_calibration(calibration).freeze()
    told.save(tmp_path / "unit.plan")
    read = plan.Plan((tmp_path / "unit.plan").read_bytes())
    assert read.metric and read.size == (24, 32) and read.about["unit"] == "rig" and read.about["metric"] is True
    assert str(read.about["made_by"]).startswith(f"torchvts {vts.__version__}")
    blocks = vts.DepthPipeline.from_calibration(calibration)
    by_hand = vts.DepthPipeline(
        blocks.compensate, blocks.mask, blocks.normals, blocks.gradient, blocks.integrate, mm_per_pixel=0.5, contact=blocks.contact
    ).eval()
    by_hand.freeze().save(tmp_path / "own.plan")
    assert not plan.Plan((tmp_path / "own.plan").read_bytes()).metric  # nobody knows


def test_what_no_plan_can_hold_is_said(tmp_path):
    calibration, _ = lights_unit((24, 32), 0.5)
    slow = vts.DepthPipeline.from_calibration(calibration, integrate=vts.PoissonDST(0.5)).freeze()
    with pytest.raises(ValueError, match=r"pipe: expected one that is compiled, got one .*, because integrate is PoissonDST"):
        slow.save(tmp_path / "unit.plan")
    assert not (tmp_path / "unit.plan").exists()


# ---- damaged files ----


def signed(content):
    """The file with the size and checksum that fit its bytes."""
    rest = struct.pack("<Q", len(content)) + content[24:]
    return content[:12] + struct.pack("<I", zlib.crc32(rest)) + rest


def with_number(content, name, value):
    """The file with another number in a field, and a checksum that fits."""
    at = content.index(name.encode().ljust(32, b"\0")) + plan.LINE
    return signed(content[:at] + struct.pack("<q" if isinstance(value, int) else "<d", value) + content[at + 8 :])


REFUSED = {
    "empty": (lambda x: b"", "not a plan: 0 bytes are too few"),
    "another file": (lambda x: b"\x89PNG" + x[4:], "not a plan: it does not begin as one"),
    "an earlier version": (lambda x: x[:8] + b"\1" + x[9:], "a plan of version 1, and this library reads version 3: save it again"),
    "a later version": (lambda x: x[:8] + b"\4" + x[9:], "a plan of version 4, and this library reads version 3: save it again"),
    "cut": (lambda x: x[:-64], "damaged: the plan should have .* bytes"),
    "a byte that flipped": (lambda x: x[:5000] + bytes([x[5000] ^ 8]) + x[5001:], "its bytes are not those that were written"),
    "cut, and signed": (lambda x: signed(x[:-128]), "slopes_of_depth: expected it in the plan, which ends before"),
    "longer": (lambda x: signed(x + bytes(64)), "more follows the last field"),
    "of no height": (lambda x: with_number(x, "height", 0), "height: expected a number from 2 to 16384, got 0"),
    "huge": (lambda x: with_number(x, "width", 2**62), "width: expected a number from 2 to 16384, got 4.6"),
    "of another size": (lambda x: with_number(x, "height", 25), "expected .* values for a plan of 25 x 32 pixels, got"),
    "a prime height": (lambda x: with_number(x, "height", 67), "height: it has a prime factor above 64"),
    "markers as large as the image": (
        lambda x: with_number(x, "marker_diameter", 24.0),
        "marker_diameter: expected markers smaller",
    ),
    "a wide margin": (lambda x: with_number(x, "marker_margin", 1e9), "marker_margin: expected at most 2 diameters"),
    "no pitch": (lambda x: with_number(x, "mm_per_pixel", float("nan")), "mm_per_pixel: expected a number from 1e-09"),
    "cells beyond the image": (lambda x: with_number(x, "zero_cell", 30), "zero_cell, contact_cell: expected cells within"),
    "an even blur": (lambda x: with_number(x, "mask_taps", 2), "mask_taps, contact_taps: expected odd numbers"),
    "a value that is none": (
        lambda x: signed(x.replace(struct.pack("<f", 1.0), struct.pack("<f", float("nan")))),
        "expected finite values, got NaN or infinity",
    ),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_damaged_plans_are_refused_with_the_reason(saved, tmp_path, kind):
    damage, reason = REFUSED[kind]
    path = tmp_path / "bad.plan"
    path.write_bytes(damage(saved[0].read_bytes()))
    with pytest.raises(ValueError, match=reason) as caught:
        vts.FrozenPipeline.load(path)
    assert str(caught.value).startswith(str(path))


def test_no_plan_is_read_without_a_file_or_a_library(saved, tmp_path):
    with pytest.raises(FileNotFoundError, match="no such file"):
        vts.FrozenPipeline.load(tmp_path / "none.plan")
    with without_library(), pytest.raises(RuntimeError, match="a plan needs the compiled library, and there is none"):
        vts.FrozenPipeline.load(saved[0])


SANITIZED = "-std=c11 -O0 -g -w -fsanitize=address,undefined,float-cast-overflow -fno-sanitize-recover=all -DSOURCES=0 -DWIDE="
"""Flags of a program that ends at its first access of another's memory, or where C has no meaning."""


@pytest.fixture(scope="module")
def fuzz(tmp_path_factory):
    """A program of fuzz_plan.c and the library's sources, with sanitizers."""
    if shutil.which("cc") is None:
        pytest.skip("no C compiler")
    program = tmp_path_factory.mktemp("fuzz") / "fuzz_plan"
    sources = [str(path) for path in (Path(__file__).parent / "fuzz_plan.c", *sorted(CSRC.glob("*.c")))]
    flags = [*SANITIZED.split(), "-ffp-contract=off", "-fno-strict-aliasing", "-I", str(CSRC)]
    done = subprocess.run(["cc", *flags, *sources, "-lm", "-o", str(program)], capture_output=True, text=True)
    if done.returncode and ("sanitize" in done.stderr or "lasan" in done.stderr):
        pytest.skip("the compiler has no sanitizers")
    assert done.returncode == 0, done.stderr
    return program


@pytest.mark.parametrize(
    "saved",
    [
        pytest.param((kind, mode), id=f"{kind}-{mode}", marks=[] if (kind == "lights") == (mode == "fast") else [pytest.mark.long])
        for kind in ("lights", "marked")
        for mode in MODES
    ]
    + [pytest.param(("response", mode), id=f"response-{mode}", marks=pytest.mark.long) for mode in MODES],
    indirect=True,
)
@pytest.mark.parametrize("count", [40, pytest.param(10_000, marks=pytest.mark.long)])
def test_damaged_plans(saved, fuzz, count):
    """Under sanitizers: none is accepted as it was not written; those whose checksum was made to fit touch no memory of others."""
    done = subprocess.run([str(fuzz), str(saved[0]), str(count), "1"], capture_output=True, text=True, timeout=3000)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    read, refused, wrong = (int(number) for number in re.findall(r"\d+", done.stdout))
    assert wrong == 0 and read + refused == count and read > count // 20 and refused > count // 2


# ---- the example in C++ ----

EXAMPLE = ROOT / "examples" / "cpp"


@pytest.fixture(scope="module", params=["the library", pytest.param("cmake", marks=pytest.mark.long)])
def program(request, tmp_path_factory):
    """The program of examples/cpp, with the library that was built for Python, or all by CMake."""
    compiler = "c++" if request.param == "the library" else request.param
    if shutil.which("c++") is None or shutil.which(compiler) is None:
        pytest.skip(f"no {compiler}")
    folder = tmp_path_factory.mktemp("build")
    if compiler == "cmake":
        for command in (["cmake", "-S", str(EXAMPLE), "-B", str(folder)], ["cmake", "--build", str(folder)]):
            subprocess.run(command, check=True, capture_output=True)
    else:
        files = [str(EXAMPLE / "depth.cpp"), str(LIBRARY), f"-Wl,-rpath,{LIBRARY.parent}", "-o", str(folder / "depth")]
        subprocess.run(["c++", "-std=c++17", "-I", str(CSRC), *files], check=True)
    return folder / "depth"


def test_the_example_in_cpp_gives_the_depth_of_python(saved, program, tmp_path):
    path, frozen, images = saved
    pixels = (images[0] * 255.0).round().to(torch.uint8).permute(1, 2, 0).contiguous().numpy()
    (tmp_path / "image.ppm").write_bytes(b"P6\n32 24\n255\n" + pixels.tobytes())

    def run(*words):
        return subprocess.run([str(program), *map(str, words)], capture_output=True, text=True)

    deepest = float(frozen(images[:1]).depth_mm.max())
    assert deepest > 0.1
    assert run(path, tmp_path / "image.ppm").stdout == f"deepest {deepest:.3f} mm\n"
    for words, reason in (
        ((path,), "expected a plan and an image"),
        ((tmp_path / "none.plan", tmp_path / "image.ppm"), "none.plan: no such file"),
        ((tmp_path / "image.ppm", tmp_path / "image.ppm"), "image.ppm: not a plan"),
        ((path, path), "unit.plan: "),
    ):
        done = run(*words)
        assert done.returncode == 1 and reason in done.stderr


# ---- the page ----

PAGE = (ROOT / "docs" / "plan.md").read_text()


def test_a_reader_made_from_the_page_alone(saved):
    namespace = {}
    exec(re.search(r"```python\n(import struct.*?)```", PAGE, re.DOTALL).group(1), namespace)
    fields = namespace["read_plan"](saved[0].read_bytes())
    assert list(fields) == list(plan.fields())
    assert fields["height"] == [24] and fields["mm_per_pixel"] == [0.5] and fields["background"].shape == (3 * 24 * 32,)
    assert all(np.isfinite(table).all() for table in fields.values())


def test_the_interface_fits_a_screen():
    assert len((CSRC / "torchvts.h").read_text().splitlines()) <= 60


def test_every_number_of_the_page_is_that_of_the_code():
    assert f"version, uint32: {plan.VERSION}\n" in PAGE.replace(" |", "") and f"a record of {plan.LINE} bytes" in PAGE
