"""The page in a folder, with a plan of each shipped prior and a drawn press, and a server of it for this machine alone."""

import json
import os
import shutil
import tempfile
import webbrowser
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from torch import Tensor

from ..calibration import calibrate
from ..core.files import make_folder, write_image
from ..model import Calibration, PointLights, Sensor, shipped_sensors
from ..pipeline import DepthPipeline
from ..scenes import render, sphere_press, undeformed
from ..skin import ContactMask

PACKAGE = Path(__file__).parents[1]
HEIGHT, WIDTH, PITCH_MM = 120, 160, 0.12
PORT = 8470
"""Of the page, where it is free: a browser keeps the permission for a camera, and the page without a network, by it."""


def drawn_unit() -> tuple[DepthPipeline, Tensor]:
    """A drawn rig of three lights, and its image (3, H, W) of a ball pressed in."""
    lights = PointLights([[13, 6, 16], [-12, 8, 16], [-1, -14, 16]], [210, 210, 210]).requires_grad_(False)
    press = sphere_press(4.0, 0.9, (0.6, -0.4), HEIGHT, WIDTH, PITCH_MM)
    scenes = (undeformed(press), press)
    rest, image = (render(scene, lights, noise_std=0.003, bits=8, seed=k).detach()[0] for k, scene in enumerate(scenes, 1))
    unit = Calibration.from_lights(lights, Sensor("drawn rig", HEIGHT, WIDTH, PITCH_MM), rest)
    return DepthPipeline.from_calibration(unit, "precise"), image


def prior_unit(sensor: Sensor) -> DepthPipeline:
    """The pipeline of a sensor type whose unit is not known: by the prior, and the usual background of the type."""
    prior = sensor.prior
    if prior is None:
        raise ValueError(f"sensor: expected one with a prior, '{sensor.name}' has none")
    light = prior.background(sensor.height, sensor.width, sensor.mm_per_pixel).float().clamp(0.0, 1.0)
    pipe = DepthPipeline.from_calibration(calibrate(light ** (1.0 / prior.response.gamma), sensor), "precise")
    assert isinstance(pipe.mask, ContactMask)
    pipe.mask.most_spread = 1e6  # none: the light of units of a type differs smoothly, as that of skin that hangs
    return pipe


def write_plans(folder: Path, calibration: Calibration | None = None) -> None:
    """Write the plans that the page offers, and their list: the drawn rig, a unit if there is one, shipped sensors with a prior."""
    pipe, image = drawn_unit()
    pipe.freeze().save(folder / "demo.plan")
    write_image(folder / "demo.png", image)
    rows: list[dict[str, object]] = []
    if calibration is not None:
        DepthPipeline.from_calibration(calibration, "precise").freeze().save(folder / "unit.plan")
        rows.append({"name": f"{calibration.sensor.name}, calibrated", "file": "unit.plan", "prior_deg": None})
    for sensor in map(Sensor.load, shipped_sensors()):
        if sensor.prior is not None:
            prior_unit(sensor).freeze().save(folder / f"{sensor.name}.plan")
            prior_deg = sensor.prior.expected_deg
            rows.append({"name": f"{sensor.name}, by its prior", "file": f"{sensor.name}.plan", "prior_deg": prior_deg})
    (folder / "plans.json").write_text(json.dumps(rows))


def write_page(folder: Path, calibration: Calibration | None = None) -> None:
    """Write all files of the page, which offers the unit of a calibration if there is one."""
    here = PACKAGE / "web" if (PACKAGE / "web").is_dir() else PACKAGE.parent / "web"
    if not (library := here / "torchvts.wasm").is_file():
        raise FileNotFoundError(f"{library}: no such file: this torchvts was built without it; make wasm builds it in a checkout")
    make_folder(folder)
    for path in here.iterdir():
        shutil.copyfile(path, folder / path.name)
    write_plans(folder, calibration)


class Quiet(SimpleHTTPRequestHandler):
    """Serves a folder without a line for each file; a browser asks each time whether one has changed."""

    def log_message(self, format: str, *args: object) -> None:
        pass

    def guess_type(self, path: str | os.PathLike[str]) -> str:
        return "text/javascript" if str(path).endswith(".js") else super().guess_type(path)  # some systems say text/plain

    def end_headers(self) -> None:
        self.send_header("Cache-Control", "no-cache")
        super().end_headers()


def make_server(folder: Path, port: int = 0) -> ThreadingHTTPServer:
    """A server of a folder that this machine alone reaches, at a port that is free where this one is taken."""
    serving = partial(Quiet, directory=str(folder))
    try:
        return ThreadingHTTPServer(("127.0.0.1", port), serving)
    except OSError:
        return ThreadingHTTPServer(("127.0.0.1", 0), serving)


def serve(calibration: Calibration | None) -> None:
    """Serve the page until Ctrl-C, and open it in the browser; as of :func:`write_page`."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_page(folder, calibration)
        with make_server(folder, PORT) as server:
            address = f"http://localhost:{server.server_port}"
            print(f"{address} shows the page, on this machine alone; Ctrl-C ends it", flush=True)
            webbrowser.open(address)
            server.serve_forever()
