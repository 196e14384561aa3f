"""The page in a real browser: Chromium, headless, by its DevTools protocol; CHROMIUM names another than the system's."""

import functools
import json
import os
import re
import shutil
import subprocess
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import cv2
import pytest
import torch
from conftest import ROOT
from test_wasm import wasm  # noqa: F401 -- a fixture

import torchvts as vts
import web_demo
from lab import frames
from torchvts.compiled import library
from torchvts.core.files import write_image

CHROMIUM = os.environ.get("CHROMIUM") or shutil.which("chromium")
pytestmark = pytest.mark.skipif(
    library() is None or CHROMIUM is None or shutil.which("node") is None, reason="no compiled library, Chromium or Node"
)


class Quiet(SimpleHTTPRequestHandler):
    """Serves a folder without a line for each file."""

    def log_message(self, *_):
        pass


@pytest.fixture(scope="module")
def seen(wasm, data, tmp_path_factory):  # noqa: F811
    """What a browser saw, and what Python measures: of the drawn press, and of a press of a real GelSight Mini."""
    site, folder = tmp_path_factory.mktemp("site"), tmp_path_factory.mktemp("walk")
    for path in [*(ROOT / "web").iterdir(), wasm]:
        shutil.copy(path, site)
    pipe, image = web_demo.demo_unit()
    drawn = pipe.freeze()
    drawn.save(site / "demo.plan")
    write_image(site / "demo.png", image)
    unit = frames.mini(data, (240, 320))
    real = vts.DepthPipeline.from_calibration(unit.calibration, "precise").freeze()
    press = (unit.image[0] * 255.0).round() / 255.0
    real.save(folder / "unit.plan")
    write_image(folder / "image.png", press)
    write_film(folder / "film.webm", press)
    (folder / "bad.plan").write_bytes((folder / "unit.plan").read_bytes()[:100_000])
    (folder / "none.txt").write_text("no image")
    (folder / "none.png").write_text("no image")
    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(site)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    script = ROOT / "tests" / "web" / "page.mjs"
    command = ["node", "--experimental-websocket", str(script), CHROMIUM, f"http://127.0.0.1:{server.server_port}/", str(folder)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    finally:
        server.shutdown(), server.server_close()
    assert done.returncode == 0, done.stderr[-3000:]
    pictures = os.environ.get("PICTURES")
    if pictures:
        for name in ("light", "dark", "phone", "unit"):
            shutil.copy(folder / f"{name}.png", pictures)
    return json.loads(done.stdout), (drawn, image), (real, press)


def write_film(path, image):
    """A second of an image (3, H, W), which Chromium plays."""
    pixels = (image.flip(0).permute(1, 2, 0) * 255.0).round().to(torch.uint8).contiguous().numpy()
    film = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"VP80"), 30.0, (image.shape[2], image.shape[1]))
    for _ in range(30):
        film.write(pixels)
    film.release()


def difference(found, frozen, image):
    return float((torch.tensor(found) - frozen(image[None]).depth_mm.flatten()).abs().max())


def test_the_page_measures_a_drawn_press_at_once(seen):
    found, drawn, _ = seen
    assert found["errors"] == [] and difference(found["demo"], *drawn) < 1e-6
    assert re.match(r"deepest 0\.9\d\d mm, contact [\d.]+ mm²", found["drawn"])
    x, y = map(int, re.search(r"mm at x (\d+), y (\d+)", found["under"]).groups())
    assert found["right"].endswith(f"mm at x {x + 1}, y {y}")


def test_the_page_measures_as_python_does(seen):
    found, _, real = seen
    assert "unit.plan is in use" in found["plan"] and found["empty"] is None
    assert difference(found["unit"], *real) < 1e-6
    assert found["about"].startswith("gelsight_mini, precise, 63 µm a pixel, lengths in mm")


def test_the_page_says_what_it_cannot_use(seen):
    size, cut, other, broken = seen[0]["refused"]
    assert "light.png: expected 320 x 240 pixels, as the plan, got 1280 x 680" in size
    assert "damaged: the plan should have" in cut and "Expected a plan (.plan), images or a video" in other
    assert "none.png: no image that this browser reads" in broken


def test_the_page_plays_a_video(seen):
    found, _, (real, press) = seen
    assert found["name"] == "film.webm" and found["said"] == ""
    assert re.match(r"320 x 240, measured in [\d.]+ ms, \d+ frames a second", found["film"])
    deepest = float(re.match(r"deepest ([\d.]+) mm", found["what"]).group(1))
    assert abs(deepest - float(real(press[None]).depth_mm.max())) < 0.1  # the video has lost some of the image


def test_the_page_fits_a_phone(seen):
    assert seen[0]["wide"] <= 390
