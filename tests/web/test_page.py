"""The page in a real browser: Chromium, headless, by its DevTools protocol; CHROMIUM names another than the system's."""

import base64
import json
import os
import re
import shutil
import subprocess
import threading
import zipfile

import cv2
import numpy as np
import pytest
import torch
from conftest import ROOT
from test_wasm import wasm  # noqa: F401 -- a fixture

import torchvts as vts
from lab import frames
from torchvts.calibration import read_presses
from torchvts.cli.web_page import drawn_unit, make_server, prior_unit, write_page
from torchvts.compiled import library
from torchvts.core.files import read_depth_png, write_image
from torchvts.pose.clouds import read_point_cloud

CHROMIUM = os.environ.get("CHROMIUM") or shutil.which("chromium")
pytestmark = pytest.mark.skipif(
    library() is None or CHROMIUM is None or shutil.which("node") is None, reason="no compiled library, Chromium or Node"
)
PICTURES = ("light", "dark", "phone", "unit", "waiting", "sensor", "sensor_dark", "sensor_phone")


def walked(what, url, folder):
    """What a browser saw; page.mjs says what it does."""
    command = ["node", "--experimental-websocket", str(ROOT / "tests" / "web" / "page.mjs"), what, CHROMIUM, url, str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=400)
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def site(wasm, tmp_path_factory):  # noqa: F811
    """The page in a folder."""
    folder = tmp_path_factory.mktemp("site")
    write_page(folder)
    return folder


@pytest.fixture(scope="module")
def seen(site, data, tmp_path_factory):
    """What a browser saw, with a camera and without a network; and the real GelSight Mini that it saw."""
    folder = tmp_path_factory.mktemp("walk")
    unit = frames.mini(data, (240, 320))
    real = vts.DepthPipeline.from_calibration(unit.calibration, "precise").freeze()
    press = (unit.image[0] * 255.0).round() / 255.0
    real.save(folder / "unit.plan")
    write_image(folder / "image.png", press)
    write_film(folder / "film.webm", press)
    rest = read_presses(data / "gelsight_mini_a")[0]
    write_camera(folder / "camera.y4m", press, rest)
    write_image(folder / "a_rest.png", rest)
    write_image(folder / "b_press.png", press)
    write_image(folder / "swapped.png", press.flip(0))
    shutil.copy(data / "gelsight_mini_a" / "6.310mm" / "0" / "gelsight.png", folder / "corner.png")
    (folder / "bad.plan").write_bytes((folder / "unit.plan").read_bytes()[:100_000])
    for name in ("none.txt", "none.png", "sound.webm", "unit.safetensors"):
        (folder / name).write_text("no image")
    server = make_server(site)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    url = f"http://127.0.0.1:{server.server_port}/"
    try:
        found = walked("walk", url, folder)
        without = {what: walked(what, url, folder)["status"] for what in ("none", "plain")}
    finally:
        server.shutdown(), server.server_close()
    without["file"] = walked("file", (site / "index.html").as_uri(), folder)["status"]
    found["offline"] = walked("offline", url, folder)
    if pictures := os.environ.get("PICTURES"):
        for name in PICTURES:
            shutil.copy(folder / f"{name}.png", pictures)
    return found, without, (real, press, rest), folder


def bgr(image):
    """Bytes (H, W, 3) of an image (3, H, W), as OpenCV has them."""
    return (image.flip(0).permute(1, 2, 0) * 255.0).round().to(torch.uint8).contiguous().numpy()


def write_film(path, image):
    """A second of an image (3, H, W), which Chromium plays."""
    film = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"VP80"), 30.0, (image.shape[2], image.shape[1]))
    for _ in range(30):
        film.write(bgr(image))
    film.release()


def write_camera(path, press, rest):
    """What a Mini's camera gives, 640 x 480 with the frame of the gel around it: six seconds of a press, six at rest."""
    content = b"YUV4MPEG2 W640 H480 F5:1 Ip A1:1 C420\n"
    for image in (press, rest):
        raw = np.full((480, 640, 3), 40, np.uint8)
        raw[68:412, 91:549] = cv2.resize(bgr(image), (458, 344), interpolation=cv2.INTER_CUBIC)
        content += 30 * (b"FRAME\n" + cv2.cvtColor(raw, cv2.COLOR_BGR2YUV_I420).tobytes())
    path.write_bytes(content)


def planes(found):
    """Floats (C, 240, 320) that the page gave as base64."""
    return torch.frombuffer(bytearray(base64.b64decode(found)), dtype=torch.float32).reshape(-1, 240, 320)


def difference(found, frozen, image):
    depth = frozen(image[None]).depth_mm
    return float((torch.frombuffer(bytearray(base64.b64decode(found)), dtype=torch.float32) - depth.flatten()).abs().max())


def test_the_page_measures_a_drawn_press_at_once(seen):
    found, (pipe, image) = seen[0], drawn_unit()
    assert found["errors"] == [] and difference(found["demo"], pipe.freeze(), image) < 1e-6
    assert re.match(r"deepest 0\.9\d\d mm, contact [\d.]+ mm²", found["drawn"])
    x, y = map(int, re.search(r"mm at x (\d+), y (\d+)", found["under"]).groups())
    assert found["right"].endswith(f"mm at x {x + 1}, y {y}")
    assert found["ball"] == pytest.approx(8.0, rel=0.02)


def test_the_drawn_sensor_measures_nothing_else(seen):
    start, image, depth = seen[0]["first"]
    assert start == image and start.startswith("Which sensor is it? Choose it first") and depth == seen[0]["demo"]


def test_a_frame_of_another_light_is_doubted(seen):
    text, what = seen[0]["doubt"]
    assert text.startswith("In doubt: ") and text.endswith("Take the background again.") and what.startswith("deepest at least ")
    assert seen[0]["sure"] == ""


def test_the_page_measures_as_python_does(seen):
    found, (real, press, _) = seen[0], seen[2]
    assert "unit.plan is in use" in found["plan"] and found["empty"] is None
    assert difference(found["unit"], real, press) < 1e-6
    assert found["about"].startswith("gelsight_mini, precise, 63 µm a pixel, lengths in mm")


def test_a_camera_by_the_prior_of_its_type(seen):
    found, _, (_, press, rest), _ = seen
    assert found["prior"].endswith("mm by the prior of its type, normals 4.5° off in the mean")
    assert found["cameras"].endswith(".y4m") and found["still"].startswith("Still and untouched")
    assert re.search("touches the skin|Something moves", found["touched"]) and found["frozen"] == "Go on"
    assert found["taken"].startswith("The background is taken. Press something into the skin. Browsers may change")
    assert re.match(r"320 x 240 of 640 x 480, measured and shown in [\d.]+ ms, \d+ frames a second", found["rate"])
    background, image = planes(found["background"]), planes(found["planes"])  # Chromium turns YUV into RGB otherwise than OpenCV
    assert float((background - rest).abs().mean()) < 0.02 and float((image - press).abs().mean()) < 0.02
    unit = vts.calibrate(background, vts.Sensor.load("gelsight_mini"))
    expected = vts.DepthPipeline.from_calibration(unit, "precise").freeze()
    assert difference(found["depth"], expected, image) < 1e-6 and float(planes(found["depth"]).max()) > 0.2


def test_images_in_place_of_a_camera(seen):
    found, _, (_, press, rest), _ = seen
    why, again = found["contact"]
    assert why.startswith("Something touches the skin, which reads as 0.5 mm deep around x 26") and again == "Take it all the same"
    assert found["before"] is None
    plan = prior_unit(vts.Sensor.load("gelsight_mini")).freeze().with_background((rest * 255.0).round() / 255.0)
    assert difference(found["next"], plan, press) < 1e-6


def test_what_is_saved(seen):
    found, _, _, folder = seen
    depth, saved = planes(found["depth"])[0], folder / "saved"
    assert np.array_equal(np.load(saved / "depth_mm.npy"), depth.numpy())
    assert float((read_depth_png(saved / "depth_mm.png")[0, 0] - depth).abs().max()) <= 5.1e-5
    points = torch.as_tensor(read_point_cloud(saved / "depth_mm.ply")[0]).float()
    assert torch.allclose(points, vts.depth_to_points(depth, 0.0634).float(), atol=1e-5)
    image = planes(found["planes"])
    assert difference(found["depth"], vts.FrozenPipeline.load(saved / "unit.plan"), image) < 1e-6


def test_presses_for_a_calibration(seen):
    found, _, _, folder = seen
    assert found["unsized"].startswith("How large is the ball?")
    kept = r"Kept: its depth is that of a ball of \d\.\d mm: \d+ % too (small|large)\. (Then .*\. )?Press elsewhere"
    assert re.match(kept, found["kept"])  # by the prior alone slopes are a fifth too small
    assert "torchvts calibrate presses --sensor gelsight_mini" in found["zip"]
    with zipfile.ZipFile(folder / "saved" / "presses.zip") as packed:
        assert packed.testzip() is None
        packed.extractall(folder / "saved")
    background, (press,) = read_presses(folder / "saved" / "presses")
    assert press.ball_diameter_mm == 6.31
    for image, name in ((background, "background"), (press.image, "planes")):
        assert float((image - planes(found[name])).abs().max()) < 1e-5


def test_the_page_says_what_it_cannot_use(seen):
    size, cut, other, broken, sound, calibration = seen[0]["refused"]
    assert "torchvts view --web unit.safetensors" in calibration
    assert "light.png: expected 320 x 240 pixels, as the plan, or raw frames of 3280 x 2464 or 640 x 480, got 1280 x 680" in size
    assert "damaged: the plan should have" in cut and "Expected a plan (.plan), images or a video" in other
    assert "none.png: no image that this browser reads" in broken and "sound.webm: no video that this browser plays" in sound


def test_cameras_and_browsers_that_do_not_serve(seen):
    assert seen[0]["denied"].startswith("The camera was refused. Allow it") and seen[0]["gone"].startswith("That camera is gone.")
    assert seen[0]["stopped"] == "Start"
    for what, reason in {
        "none": "No camera is connected. Plug the sensor in, then press Start again",
        "plain": "This browser has no WebAssembly with SIMD: use a Chrome, Firefox or Safari of 2023 or later.",
        "file": "If this text stays, the page was opened as a file",
    }.items():
        assert reason in seen[1][what]


def test_the_page_opens_without_a_network(seen):
    assert seen[0]["offline"]["demo"] == seen[0]["demo"] and seen[0]["offline"]["errors"] == []


def test_the_page_plays_a_video(seen):
    found, (real, press, _) = seen[0], seen[2]
    assert found["name"] == "film.webm" or found["said"] == ""
    assert re.match(r"320 x 240, measured and shown in [\d.]+ ms, \d+ frames a second", found["film"])
    deepest = float(re.match(r"deepest ([\d.]+) mm", found["what"]).group(1))
    assert abs(deepest - float(real(press[None]).depth_mm.max())) < 0.1  # the video has lost some of the image


def test_the_page_fits_a_phone(seen):
    assert seen[0]["wide"] <= 390 and seen[0]["wider"] <= 390
