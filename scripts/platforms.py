#!/usr/bin/env python3
"""A plan's depth on other platforms: WebAssembly in Node and in Chromium, aarch64 under qemu, against the native library.

make wasm
python scripts/platforms.py --out out/platforms

With --calls, columns of time too: the least of so many calls over the native library's, in turn, on the same bytes.

Real units, each calibrated by its first presses, measure later ones. Needed: node, chromium, qemu-aarch64,
and the zig of `make wasm`.
"""

import ctypes
import functools
import http.server
import json
import math
import shutil
import subprocess
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

import torchvts as vts
from lab import doubts
from lab.commands import main_of, parser_of
from lab.rows import write_files
from torchvts.compiled.binding import loaded
from torchvts.core.tables import markdown

UNITS = ("gelsight_mini_a", "gelsight_mini_c", "digit_a", "digit_b", "gelsight_pale", "gelslim_b")
LEARNED, MEASURED = 5, 3
"""Presses of a unit that it is calibrated by, and others that it measures."""

BROWSER_S = 300.0
ROOT = Path(__file__).resolve().parents[1]
CSRC = ROOT / "torchvts" / "compiled" / "csrc"

RUN = """
const c = await library(await read("torchvts.wasm"));
for (const name of NAMES) {
  const plan = new Plan(c, await read(name + ".plan"));
  for (let k = 0; k < COUNT; k++) {
    const { depth, contact } = plan.measure(await read(`${name}_${k}.rgba`));
    await write(`${name}_${k}.HOW`, depth, contact);
  }
  const image = await read(name + "_0.rgba");
  let least = Infinity;
  for (let k = 0; k < CALLS; k++) {
    const start = performance.now();
    plan.measure(image);
    least = Math.min(least, performance.now() - start);
  }
  await write(name + ".HOW_ms", new Float64Array([least]), new Uint8Array());
  plan.free();
}
"""

IN_NODE = """
import { readFileSync, writeFileSync } from "node:fs";
import { Plan, library } from "./torchvts.js";
const read = (name) => readFileSync(name), bytes = (a) => Buffer.from(a.buffer, a.byteOffset, a.byteLength);
const write = (name, depth, contact) => writeFileSync(name, Buffer.concat([bytes(depth), bytes(contact)]));
"""

IN_CHROMIUM = """<script type="module">
import { Plan, library } from "./torchvts.js";
const read = async (name) => new Uint8Array(await (await fetch(name)).arrayBuffer());
const write = (name, depth, contact) => fetch(name, { method: "POST", body: new Blob([depth, contact]) });
RUN
await write("done", new Uint8Array(), new Uint8Array());
</script>"""

IN_C = """
#include "torchvts.h"
#include <stdio.h>
#include <stdlib.h>

static unsigned char *read_file(const char *name, size_t *size) {
    FILE *file = fopen(name, "rb");
    if (!file || fseek(file, 0, SEEK_END)) exit(2);
    *size = (size_t)ftell(file), rewind(file);
    unsigned char *bytes = malloc(*size);
    if (fread(bytes, 1, *size, file) != *size) exit(3);
    fclose(file);
    return bytes;
}

int main(int count, char **names) { /* a plan, then images, each with a name for its depth and contact */
    char reason[VTS_REASON];
    vts_facts facts;
    size_t size;
    const unsigned char *bytes = read_file(names[1], &size);
    vts_plan *plan = vts_load(bytes, size, reason);
    if (!plan) return fprintf(stderr, "%s\\n", reason), 1;
    vts_info(plan, &facts);
    const size_t pixels = (size_t)facts.height * (size_t)facts.width;
    float *depth = malloc(4 * pixels);
    uint8_t *contact = malloc(pixels);
    for (int k = 2; k + 1 < count; k += 2) {
        const vts_output output = {.depth_mm = depth, .contact = contact};
        if (vts_depth(plan, read_file(names[k], &size), VTS_RGB8, &output)) return 4;
        FILE *file = fopen(names[k + 1], "wb");
        fwrite(depth, 4, pixels, file), fwrite(contact, 1, pixels, file), fclose(file);
    }
    return 0;
}
"""


def plans(name: str, folder: Path) -> list[tuple[str, list[tuple[Tensor, Tensor]]]]:
    """The plans of a unit in both modes and the images beside them, as files; and the native depth and contact of each image."""
    given = doubts.unit_of(name)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        calibration = vts.calibrate(given.background, given.sensor, presses=given.presses[:LEARNED])
    found = []
    for mode in ("fast", "precise"):
        frozen = vts.DepthPipeline.from_calibration(calibration, mode=mode).freeze()
        frozen.save(folder / f"{name}_{mode}.plan")
        native = []
        for k, press in enumerate(given.presses[-MEASURED:]):
            rgb = (press.image * 255.0).round().to(torch.uint8).permute(1, 2, 0).contiguous()
            rgba = torch.cat((rgb, torch.full_like(rgb[..., :1], 255)), dim=2)
            for end, pixels in (("rgb", rgb), ("rgba", rgba)):
                (folder / f"{name}_{mode}_{k}.{end}").write_bytes(pixels.numpy().tobytes())
            output = frozen((rgb.permute(2, 0, 1).float() / 255.0)[None])
            native.append((output.depth_mm.flatten(), output.contact.flatten()))
        found.append((f"{name}_{mode}", native))
    return found


def native_ms(plan: Path, image: Path, calls: int) -> float:
    """Least time of a call of the native library, ms."""
    content, pixels, reason = plan.read_bytes(), image.read_bytes(), ctypes.create_string_buffer(256)
    handle = loaded().vts_load(content, len(content), reason)
    depth, contact = (ctypes.create_string_buffer(len(pixels) // 3 * size) for size in (4, 1))
    output = (ctypes.c_void_p * 6)(ctypes.addressof(depth), None, ctypes.addressof(contact))
    least = math.inf
    for _ in range(calls):
        start = time.perf_counter()
        loaded().vts_depth(handle, pixels, 0, output)
        least = min(least, time.perf_counter() - start)
    loaded().vts_free(handle)
    return 1000.0 * least


def _script(head: str, how: str, names: Sequence[str], calls: int) -> str:
    run = RUN.replace("NAMES", json.dumps(names)).replace("COUNT", str(MEASURED))
    return head + run.replace("HOW", how).replace("CALLS", str(calls))


def in_node(folder: Path, names: Sequence[str], calls: int) -> None:
    (folder / "package.json").write_text('{"type": "module"}')
    (folder / "measure.mjs").write_text(_script(IN_NODE, "node", names, calls))
    subprocess.run(["node", "measure.mjs"], cwd=folder, check=True)


def in_chromium(folder: Path, names: Sequence[str], calls: int) -> None:
    """The page of a server here, which takes what the page sends it."""
    (folder / "measure.html").write_text(IN_CHROMIUM.replace("RUN", _script("", "chromium", names, calls)))
    done = threading.Event()

    class Handler(http.server.SimpleHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            if self.path == "/done":
                done.set()
            else:
                (folder / Path(self.path).name).write_bytes(body)
            self.send_response(204)
            self.end_headers()

        def log_message(self, *_: Any) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=str(folder))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        command = ["chromium", "--headless=new", "--no-sandbox", f"--user-data-dir={folder}/profile"]
        browser = subprocess.Popen(
            [*command, f"http://127.0.0.1:{server.server_port}/measure.html"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        try:
            if not done.wait(BROWSER_S):
                raise OSError(f"chromium: no answer in {BROWSER_S:g} s")
        finally:
            browser.kill()
            browser.wait()
            server.shutdown()


def on_aarch64(folder: Path, names: Sequence[str], calls: int) -> None:
    """What qemu emulates has no time of its own."""
    (folder / "measure.c").write_text(IN_C)
    sources = [str(path) for path in sorted(CSRC.glob("*.c")) if path.name not in ("sources.c", "track.c", "grids.c")]
    compiler = [str(ROOT / "out/zig/bin/python"), "-m", "ziglang", "cc", "-target", "aarch64-linux-musl", "-std=c11", "-O2"]
    flags = ["-fno-math-errno", "-fno-strict-aliasing", "-ffp-contract=off", "-static", f"-I{CSRC}", "-o", "measure"]
    subprocess.run([*compiler, *flags, "measure.c", *sources], cwd=folder, check=True)
    for name in names:
        images = [f"{name}_{k}.{end}" for k in range(MEASURED) for end in ("rgb", "aarch64")]
        subprocess.run(["qemu-aarch64", "./measure", f"{name}.plan", *images], cwd=folder, check=True)


PLATFORMS: dict[str, Callable[[Path, Sequence[str], int], None]] = {"node": in_node, "chromium": in_chromium, "aarch64": on_aarch64}


def _off(file: Path, native: tuple[Tensor, Tensor]) -> tuple[float, int]:
    """Largest difference of depth, mm, and pixels of contact that differ."""
    depth, contact = native
    read, n = file.read_bytes(), depth.numel()
    other = torch.from_numpy(np.frombuffer(read[: 4 * n], "<f4").copy())
    touching = torch.from_numpy(np.frombuffer(read[4 * n :], np.uint8) > 0)
    return float((other - depth).abs().max()), int((touching != contact).sum())


def main(argv: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--units", nargs="+", default=UNITS, choices=doubts.UNITS)
    parser.add_argument(
        "--on", nargs="+", default=list(PLATFORMS), choices=list(PLATFORMS), metavar="PLATFORM", help="default: all three"
    )
    parser.add_argument("--calls", type=int, default=0, metavar="N", help="for the time of a frame; 0: none")
    parser.add_argument("--out", type=Path, default=Path("out/platforms"), help="for table.md")
    arguments = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        for name in ("torchvts.js", "torchvts.wasm"):
            shutil.copy(ROOT / "web" / name, folder)
        native = dict(one for name in tqdm(arguments.units, desc="native", disable=None) for one in plans(name, folder))
        times: dict[str, list[str]] = {name: [] for name in native}
        for platform in tqdm(arguments.on, desc="platforms", disable=None):
            together = [list(native)] if platform == "aarch64" or not arguments.calls else [[name] for name in native]
            for names in together:
                plan, image = folder / f"{names[0]}.plan", folder / f"{names[0]}_0.rgb"
                before = native_ms(plan, image, arguments.calls)
                PLATFORMS[platform](folder, names, arguments.calls)
                after = native_ms(plan, image, arguments.calls)
                if arguments.calls and platform != "aarch64":
                    own = float(np.frombuffer((folder / f"{names[0]}.{platform}_ms").read_bytes())[0])
                    times[names[0]].append(f"{own / min(before, after):.2f}")
        lines = []
        for name, frames in native.items():
            unit, mode = name.rsplit("_", 1)
            line = [unit, mode, f"{max(float(depth.max()) for depth, _ in frames):.2f}"]
            for platform in arguments.on:
                off = [_off(folder / f"{name}_{k}.{platform}", frame) for k, frame in enumerate(frames)]
                line.append(f"{max(mm for mm, _ in off):.1e} mm, {max(px for _, px in off)} px")
            lines.append([*line, *times[name]])
    timed = [f"{platform}, times native" for platform in arguments.on if platform != "aarch64" and arguments.calls]
    text = markdown(["unit", "mode", "deepest, mm", *arguments.on, *timed], lines)
    write_files(arguments.out, {"table.md": text + "\n"})
    print(text)
    return 0


if __name__ == "__main__":
    main_of(main)
