"""torchvts view --web: the page with its plans, for this machine alone."""

import json
import signal
import socket
import threading
import urllib.request

import pytest

import torchvts as vts
from torchvts.cli import main, web_page
from torchvts.compiled import library

pytestmark = pytest.mark.skipif(library() is None, reason="no compiled library")
BUILT = [folder / "web" / "torchvts.wasm" for folder in (web_page.PACKAGE, web_page.PACKAGE.parent)]


def own_address():
    """An address of this machine that others reach; None where it has none."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        try:
            one.connect(("192.0.2.1", 9))  # sends nothing
        except OSError:
            return None
        return one.getsockname()[0]


@pytest.mark.skipif(not any(path.is_file() for path in BUILT), reason="no torchvts.wasm: make wasm builds it")
def test_the_page_is_served_to_this_machine_alone(tmp_path, monkeypatch, run_script):
    lights = vts.PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900, 900, 900])
    vts.Calibration.from_lights(lights, vts.Sensor("mine", 48, 64, 0.5)).save(tmp_path / "unit.safetensors")
    answers, failed = {}, []

    def visit(port):
        """What a browser and another machine do; then Ctrl-C."""
        try:
            names = ["plans.json", "", "app.js", "torchvts.wasm", "demo.png"]
            for name in names:
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/{name}") as answer:
                    answers[name] = answer.read()
                    assert answers[name] and answer.headers["Cache-Control"] == "no-cache"
                if name == "plans.json":
                    names += [plan["file"] for plan in json.loads(answers[name])]
            outside = own_address()
            if outside not in (None, "127.0.0.1"):
                with pytest.raises(OSError):
                    socket.create_connection((outside, port), timeout=5)
        except BaseException as error:
            failed.append(error)
        finally:
            signal.raise_signal(signal.SIGINT)

    def opened(address):
        threading.Thread(target=visit, args=(int(address.rpartition(":")[2]),)).start()

    monkeypatch.setattr("webbrowser.open", opened)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # shells let commands in the background ignore Ctrl-C
    try:
        done = run_script("view", "--web", tmp_path / "unit.safetensors")
    finally:
        signal.signal(signal.SIGINT, before)
    assert failed == [] and done.returncode == 130 and " shows the page, on this machine alone" in done.stdout, done.stderr
    plans = json.loads(answers["plans.json"])
    assert [plan["name"] for plan in plans] == ["mine, calibrated", "digit, by its prior", "gelsight_mini, by its prior"]
    assert plans[0]["prior_deg"] is None and 4.0 < plans[2]["prior_deg"] < 5.0


def test_what_is_missing_is_said(capsys, monkeypatch, tmp_path):
    assert main(["view"]) == 2 and "expected CALIBRATION SOURCE, or --web" in capsys.readouterr().err
    monkeypatch.setattr(web_page, "PACKAGE", tmp_path / "torchvts")
    assert main(["view", "--web"]) == 2
    assert "torchvts.wasm: no such file: this torchvts was built without it" in capsys.readouterr().err
    with pytest.raises(ValueError, match="sensor: expected one with a prior, 'tacto' has none"):
        web_page.prior_unit(vts.Sensor.load("tacto"))
