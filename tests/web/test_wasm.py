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
from torchvts.cli.web_page import prior_unit
from torchvts.compiled import library

MEASURE = """
import { readFileSync, writeFileSync } from "node:fs";
import { Plan, library } from "./torchvts.js";
const [wasm, folder] = process.argv.slice(2);
const plan = new Plan(await library(readFileSync(wasm)), readFileSync(folder + "/unit.plan"));
const { depth, contact, conditions } = plan.measure(readFileSync(folder + "/image.rgba"));
writeFileSync(folder + "/conditions.f32", conditions);
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
    made = ROOT / "web" / "torchvts.wasm"
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


RECTIFY = """
import { readFileSync, writeFileSync } from "node:fs";
import { Rectify } from "./frames.js";
const [folder, plan, width, height] = [process.argv[2], ...process.argv.slice(3).map(JSON.parse)];
const data = readFileSync(folder + "/raw.rgba"), rectify = new Rectify(plan);
writeFileSync(folder + "/image.f32", rectify.image({ data, width, height }));
let why = "";
try { rectify.image({ data, width: 10, height }, "raw"); } catch (error) { why = error.message; }
console.log(why);
"""
TOUCH = """
import { readFileSync } from "node:fs";
import { touchOf } from "./background.js";
import { Plan, library } from "./torchvts.js";
const [wasm, folder, count] = process.argv.slice(2);
const plan = new Plan(await library(readFileSync(wasm)), readFileSync(folder + "/unit.plan"));
const image = (k) => new Float32Array(new Uint8Array(readFileSync(`${folder}/${k}.f32`)).buffer);
console.log(JSON.stringify(Array.from({ length: Number(count) }, (_, k) => touchOf(image(k), plan))));
"""
VIEWS = {
    "cropped": vts.Sensor.load("gelsight_mini"),
    "turned": vts.Sensor.load("digit"),
    "enlarged": vts.Sensor("enlarged", 60, 80, 0.2, turn_deg=270, mirror=True, raw_size_px=[[64, 48]]),
    "a region": vts.Sensor("region", 60, 80, 0.2, turn_deg=180, roi_px=(10, 20, 160, 120)),
}


@pytest.mark.parametrize("kind", VIEWS)
def test_frames_are_rectified_as_in_python(tmp_path, kind):
    sensor = VIEWS[kind]
    height, width = sensor.raw_size_px[-1] if sensor.raw_size_px else (240, 200)
    raw = torch.randint(0, 256, (height, width, 4), dtype=torch.uint8, generator=torch.Generator().manual_seed(4))
    (tmp_path / "raw.rgba").write_bytes(raw.numpy().tobytes())
    (tmp_path / "package.json").write_text('{"type": "module"}')
    shutil.copy(ROOT / "web" / "frames.js", tmp_path)
    (tmp_path / "rectify.mjs").write_text(RECTIFY)
    plan = {"height": sensor.height, "width": sensor.width, "about": {"view": sensor.view._asdict()}}
    words = [json.dumps(value) for value in (plan, width, height)]
    command = ["node", str(tmp_path / "rectify.mjs"), str(tmp_path), *words]
    why = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    found = torch.from_numpy(np.fromfile(tmp_path / "image.f32", np.float32)).reshape(3, sensor.height, sensor.width)
    expected = sensor.rectify(raw[..., :3].permute(2, 0, 1)[None] / 255.0)[0]
    assert float((found - expected).abs().max()) < 1e-6
    assert why.startswith("raw: ")


@pytest.mark.parametrize("mode", ["fast", "precise"])
def test_a_real_press_in_node(wasm, data, tmp_path, mode):
    unit = frames.mini(data, (240, 320))
    frozen = vts.DepthPipeline.from_calibration(unit.calibration, mode).freeze()
    image = (unit.image[0] * 255.0).round() / 255.0
    depth, contact, said = measured(wasm, tmp_path, frozen, image)
    expected = frozen(image[None])
    assert float(expected.depth_mm.max()) > 0.2
    assert float((depth - expected.depth_mm[0, 0]).abs().max()) < 1e-6
    conditions = torch.from_numpy(np.fromfile(tmp_path / "conditions.f32", np.float32))
    light, lost, unseen_deg = frozen.with_conditions(image[None])[1]
    assert torch.allclose(conditions, torch.cat((light.flatten(), lost[0], unseen_deg.deg2rad().tan())), atol=1e-5)
    assert int((contact ^ expected.contact[0, 0]).sum()) <= 2
    assert said["metric"] is True and said["about"]["mode"] == mode and said["pitch"] == pytest.approx(frozen.mm_per_pixel)
    assert said["refused"].startswith("not a plan") and said["size"].startswith("Expected an image of 320 x 240 pixels")


@pytest.mark.parametrize("kind, folder", [("gelsight_mini", "gelsight_mini_a"), ("digit", "digit_b")])
def test_a_press_is_no_background(wasm, data, tmp_path, kind, folder):
    sensor = vts.Sensor.load(kind)
    paths = [
        data / folder / "background.png",
        *sorted((data / folder).glob("*mm/*/gelsight.png" if kind == "gelsight_mini" else "ball*.png")),
    ]
    for k, path in enumerate(paths):
        (tmp_path / f"{k}.f32").write_bytes(sensor.read_image(path).numpy().tobytes())
    prior_unit(sensor).freeze().save(tmp_path / "unit.plan")
    for name in ("torchvts.js", "background.js", "fit.js"):
        shutil.copy(ROOT / "web" / name, tmp_path)
    (tmp_path / "package.json").write_text('{"type": "module"}')
    (tmp_path / "touch.mjs").write_text(TOUCH)
    command = ["node", str(tmp_path / "touch.mjs"), str(wasm), str(tmp_path), str(len(paths))]
    rest, *presses = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    assert rest == "" and all(text.startswith("Something touches the skin, which reads as ") for text in presses)
