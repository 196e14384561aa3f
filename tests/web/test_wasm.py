"""The compiled frame in WebAssembly, in Node: the depth of the native library."""

import json
import os
import shutil
import subprocess

import numpy as np
import pytest
import torch
from conftest import ROOT

import torchvts as vts
from lab import frames
from torchvts.compiled import library

MEASURE = """
import { readFileSync, writeFileSync } from "node:fs";
import { Plan, library } from "./torchvts.js";
const [wasm, folder] = process.argv.slice(2);
const plan = new Plan(await library(readFileSync(wasm)), readFileSync(folder + "/unit.plan"));
const { depth, contact } = plan.measure(readFileSync(folder + "/image.rgba"));
writeFileSync(folder + "/depth.f32", depth);
writeFileSync(folder + "/contact.u8", contact);
let refused = "";
try { new Plan(plan.c, readFileSync(folder + "/image.rgba")); } catch (error) { refused = error.message; }
let size = "";
try { plan.measure(new Uint8Array(8)); } catch (error) { size = error.message; }
plan.free();
console.log(JSON.stringify({ about: plan.about, metric: plan.metric, pitch: plan.pitch, refused, size }));
"""

pytestmark = pytest.mark.skipif(library() is None or shutil.which("node") is None, reason="no compiled library, or no Node")


@pytest.fixture(scope="module")
def wasm(tmp_path_factory):
    """The library: of this checkout's `make wasm`, or built by the zig that ZIG names."""
    made = ROOT / "out" / "web" / "torchvts.wasm"
    command = ["make", "--silent", "-C", str(ROOT), "wasm"]
    zig = os.environ.get("ZIG")
    if zig is None and not (ROOT / "out" / "zig").is_dir():
        pytest.skip("no zig: make wasm fetches it")
    subprocess.run(command if zig is None else [*command, f"ZIG={zig}"], check=True)
    return made


def measured(wasm, folder, frozen, image):
    """Depth and contact (H, W) of an image (3, H, W) of 8 bits in Node, and what it says."""
    frozen.save(folder / "unit.plan")
    rgba = torch.cat((image, torch.ones_like(image[:1]))).permute(1, 2, 0).mul(255.0).round().to(torch.uint8)
    (folder / "image.rgba").write_bytes(rgba.contiguous().numpy().tobytes())
    script = ROOT / "web" / "torchvts.js"
    shutil.copy(script, folder / "torchvts.js")
    (folder / "package.json").write_text('{"type": "module"}')
    (folder / "measure.mjs").write_text(MEASURE)
    command = ["node", str(folder / "measure.mjs"), str(wasm), str(folder)]
    said = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    size = image.shape[1:]
    depth = np.fromfile(folder / "depth.f32", np.float32).reshape(size)
    return torch.from_numpy(depth), torch.from_numpy(np.fromfile(folder / "contact.u8", np.uint8).reshape(size) > 0), said


@pytest.mark.parametrize("mode", ["fast", "precise"])
def test_a_real_press_in_node(wasm, data, tmp_path, mode):
    unit = frames.mini(data, (240, 320))
    frozen = vts.DepthPipeline.from_calibration(unit.calibration, mode).freeze()
    image = (unit.image[0] * 255.0).round() / 255.0
    depth, contact, said = measured(wasm, tmp_path, frozen, image)
    expected = frozen(image[None])
    assert float(expected.depth_mm.max()) > 0.2
    assert float((depth - expected.depth_mm[0, 0]).abs().max()) < 1e-6
    assert int((contact ^ expected.contact[0, 0]).sum()) <= 2
    assert said["metric"] is True and said["about"]["mode"] == mode and said["pitch"] == pytest.approx(frozen.mm_per_pixel)
    assert said["refused"].startswith("not a plan") and said["size"].startswith("Expected an image of 320 x 240 pixels")
