"""The command torchvts: its help, its errors and exit statuses, and what it says of a calibration."""

import dataclasses
import importlib
import warnings

import pytest
import torch
from conftest import tiny_image

import torchvts as vts
from torchvts.cli import COMMANDS, main
from torchvts.cli.calibrate import warn_of_a_small_place
from torchvts.model.summary import SHOWN, expected, left_out


@pytest.mark.parametrize("name", COMMANDS)
def test_help_fits_a_screen_and_shows_an_example(name, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit) as stop:
        main([name, "--help"])
    text = capsys.readouterr().out
    assert stop.value.code == 0 and len(text.splitlines()) <= 45
    assert text.startswith(f"usage: torchvts {name} ") and f"  torchvts {name}" in text.partition("example")[2]


def test_the_overview_names_every_command(capsys):
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    assert len(text.splitlines()) <= 40
    assert all(f"  {name} " in text and what in text for name, what in COMMANDS.items())
    assert main([]) == 2


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["calibrat", "a.png"], "got 'calibrat': did you mean 'calibrate'?"),
        (["pose", "a", "b", "c", "--out", "d", "--netwrk", "e"], "unknown option '--netwrk': did you mean '--network'?"),
        (
            ["pose", "a.png", "b.png", "--out", "c"],
            "expected a calibration file, an image, folder or video, and an image as reference",
        ),
        (["pose", "a.png", "b.ply", "--out", "c"], "expected two clouds and nothing beside them, got a.png, b.ply"),
        (["reconstruct", "a", "b", "--out", "c", "--mode", "presise"], "got 'presise': did you mean 'precise'?"),
        (["reconstruct", "a", "b", "--out", "c", "--format", "png"], "got 'png': did you mean 'png16'?"),
        (["reconstruct", "a", "b"], "the following arguments are required: --out"),
        (["reconstruct", "gelsight_mini", "b", "--out", "c"], "torchvts calibrate background.png --sensor gelsight_mini"),
        (["reconstruct", "nnmodel.pth", "b", "--out", "c"], "a network: give it by --network"),
        (["reconstruct", "a.png", "b.safetensors", "--out", "c"], "calibration first, then what it reads, got a.png before b.safe"),
        (["reconstruct", "a.png", "--out", "c"], "name both, or --sensor to calibrate"),
        (["calibrate", "a.png", "--sensor", "gelsight-mini", "--out", "a.safetensors"], "did you mean 'gelsight_mini'?"),
        (["calibrate", "a.png"], "expected either --sensor or --mm-per-pixel"),
        (["calibrate", "a.png", "--sensor", "digit", "--gamma", "2.2"], "--gamma: expected it beside --mm-per-pixel"),
        (["calibrate", "a.png", "--sensor", "digit", "--out", "unit.npz"], "expected a name ending in .safetensors"),
        (["calibrate", "nofolder", "--mm-per-pixel", "0.1"], "nofolder: no such file or folder"),
        (["stream", "0"], "expected a calibration file and an input, got 0: name both, or --sensor to calibrate"),
        (["stream", "0", "1", "--sensor", "digit"], "expected one source, got 0, 1"),
        (["samples", "gelsight_maxi"], "did you mean 'gelsight_mini'?"),
    ],
)
def test_a_wrong_request_is_one_line_that_says_what_was_meant(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err.startswith("torchvts: error: ") and message in printed.err
    assert len(printed.err.splitlines()) == 1


def raising(error):
    raise error


@pytest.mark.parametrize(
    "failing, status, message",
    [
        (lambda: vts.Sensor.from_dict({"a": 1}, "unit:\n "), 2, "torchvts: error: unit: : key 'a': unknown; expected name, "),
        (lambda: vts.Sensor("rig", 48, 64, "0.1"), 2, "torchvts: error: mm_per_pixel: expected a number, got str"),
        (lambda: raising(FileNotFoundError(2, "No such file", "x.png")), 2, "torchvts: error: [Errno 2] No such file: 'x.png'\n"),
        (lambda: torch.empty(2**60, dtype=torch.uint8), 2, "torchvts: error: [enforce fail at "),
        (lambda: raising(KeyError("passes")), 70, "KeyError: 'passes': a bug in torchvts: please report it with the lines above\n"),
        (lambda: None + 1, 70, "error: TypeError: unsupported operand type(s)"),
        (lambda: vts.PointLights([[9, 2, 10]] * 3, [45] * 3).to("moon"), 70, "error: RuntimeError: Expected one of cpu, "),
        (lambda: torch.ones(2).numpy().reshape(3), 70, "error: ValueError: cannot reshape"),
        (lambda: raising(KeyboardInterrupt()), 130, "torchvts: stopped\n"),
    ],
)
def test_a_refusal_is_one_line_and_a_bug_has_a_traceback_and_a_status_of_its_own(failing, status, message, capsys, monkeypatch):
    monkeypatch.setattr(importlib.import_module("torchvts.cli.samples"), "run", lambda arguments: failing())
    assert main(["samples"]) == status
    printed = capsys.readouterr().err
    assert message in printed and ("Traceback" in printed) == (status == 70) and (status == 70 or printed.count("\n") == 1)
    assert main(["samples", "--debug"]) == status and "Traceback" in capsys.readouterr().err


def test_of_many_left_out_a_few_are_printed():
    lines = list(left_out("press", [(str(k), "too wide") for k in range(SHOWN + 7)]))
    assert lines[0] == "left out: press 0: too wide" and lines[-1] == "left out: 7 more" and len(lines) == SHOWN + 1


def test_presses_that_count_little_are_named_with_their_weights(mini_by_prior):
    weights = {"a": 1.0, "b": 0.31, "c": 0.04, "d": 0.0}
    rows = [{"name": name, "used": weight > 0.0, "weight": weight, "reason": ""} for name, weight in weights.items()]
    unit = dataclasses.replace(mini_by_prior, report={"model": "response", "source": "presses", "presses": rows})
    named = [line for line in str(unit).splitlines() if line.startswith("counts little")]
    assert len(named) == 1 and named[0].endswith(": c 0.04, b 0.31")
    rows[1]["reason"] = rows[2]["reason"] = "counts 0.31 of a press: by the others the ball seems wider"  # said as a doubt
    assert "counts little" not in str(unit)


@pytest.fixture(scope="module")
def rig(ring):
    """Sensor, lights, background and an image of a press."""
    lights, press = ring(), vts.scenes.sphere_press(10.0, 1.0, (0.0, 0.0), 48, 64, 0.6)
    background = vts.scenes.render(vts.scenes.undeformed(press), lights, noise_std=0.002)[0].detach()
    image = vts.scenes.render(press, lights, noise_std=0.002, seed=1)[0].detach()
    return vts.Sensor("rig", 48, 64, 0.6, gamma=1.0), lights, background, image


def test_calibrate_says_in_few_lines_what_to_expect(rig, run_script, tmp_path):
    sensor, _, background, press = rig
    for name, image in (("background", background), ("ball", press)):
        vts.write_image(tmp_path / f"{name}.png", image)
    sensor.save(tmp_path / "rig.yaml")
    given = (tmp_path / "background.png", "--sensor", tmp_path / "rig.yaml", "--out", tmp_path / "unit.safetensors")
    done = run_script("calibrate", *given)
    lines = done.stdout.splitlines()
    assert done.returncode == 0 and done.stderr == "" and len(lines) == 5, done.stderr
    assert [line.partition(" ")[0] for line in lines] == ["sensor:", "chosen:", "expected:", "wrote", "next:"]
    assert "directions of the lights to 0." in lines[2]
    wrong = run_script("calibrate", *given, "--press", tmp_path / "ball.png", "20", "--press", tmp_path / "background.png", "20")
    left = [line for line in wrong.stdout.splitlines() if line.startswith("left out: press background.png: ")]
    assert wrong.returncode == 0 and len(left) == 1 and "background.png: left out" not in wrong.stderr
    touched = run_script("calibrate", tmp_path / "ball.png", *given[1:])  # a press as the background
    assert touched.returncode == 1 and "NOT METRIC" in touched.stdout and "press next" not in touched.stdout
    table = run_script("calibrate", *given, "--candidates")
    assert "| point lights | 0." in table.stdout and "| R | " in table.stdout


def test_a_calibrated_place_refuses_frames_of_another_mode_of_the_camera(rig, run_script, tmp_path):
    sensor, _, background, press = rig
    for name, image in (("background", background), ("ball", press)):
        vts.write_image(tmp_path / f"{name}.png", torch.nn.functional.pad(image, (10, 6, 8, 4), value=0.1))
    dataclasses.replace(sensor, roi_px=(10, 8, 64, 48)).save(tmp_path / "rig.yaml")
    given = (tmp_path / "background.png", "--sensor", tmp_path / "rig.yaml", "--out", tmp_path / "unit.safetensors")
    assert run_script("calibrate", *given, "--press", tmp_path / "ball.png", "20").returncode == 0
    vts.write_image(tmp_path / "other_mode.png", torch.zeros(3, 120, 160))
    call = ("reconstruct", tmp_path / "unit.safetensors", "--no-pictures")
    written = run_script(*call, tmp_path / "ball.png", "--out", tmp_path / "out")
    assert written.returncode == 0, written.stderr
    other = run_script(*call, tmp_path / "other_mode.png", "--out", tmp_path / "other")
    assert other.returncode == 1 and "raw frames of 60 x 80" in other.stderr and "another mode of the camera" in other.stderr


def test_reconstruct_begins_with_a_sheet_keeps_the_order_and_says_what_to_do_next(unit, run_script, tmp_path):
    for k in (1, 2):
        vts.write_image(tmp_path / f"{k}.png", tiny_image(k))
    given = [tmp_path / f"{k}.png" for k in (2, 1)]
    done = run_script("reconstruct", unit, *given, "--out", tmp_path / "out")
    said = done.stdout.splitlines()
    assert (
        said[0] == f"wrote {tmp_path / 'out' / 'sheet.png'}: the first 2 of 2 images in one scale"
        and (tmp_path / "out/sheet.png").is_file()
    )
    assert [line.partition(":")[0] for line in said[1:3]] == ["2.png", "1.png"]
    assert said[-1].startswith("next: ")
    again = run_script("reconstruct", unit, *given, "--out", tmp_path / "out")
    assert "in one scale" not in again.stdout and again.returncode == done.returncode


def test_a_source_that_is_not_there_is_named(unit, run_script, tmp_path):
    done = run_script("reconstruct", unit, tmp_path / "none.png", "--out", tmp_path / "out")
    assert done.returncode == 2 and done.stderr == f"torchvts: error: {tmp_path / 'none.png'}: no such file or folder\n"


@pytest.mark.parametrize("command", ["stream", "reconstruct", "pose", "track"])
def test_what_is_refused_leaves_no_folder(command, unit, run_script, tmp_path):
    vts.write_image(tmp_path / "odd.png", torch.zeros(3, 20, 30))
    given = (tmp_path / "odd.png", tmp_path / "odd.png") if command == "pose" else (tmp_path / "none.avi",)
    done = run_script(command, unit, *given, "--out", tmp_path / "out")
    assert done.returncode == 2 and not (tmp_path / "out").exists(), done.stderr


def test_what_to_expect_follows_the_source(rig, mini_by_prior):
    sensor, lights, background, _ = rig
    given = vts.Calibration.from_lights(lights, sensor, background)
    assert "presses of a ball would measure it" in expected(given)
    assert expected(mini_by_prior).startswith("normals within a contact to about 4.5 degrees, the mean over units that its prior")
    few = {"model": "response", "source": "presses", "held_out_deg": None, "presses": []}
    used = [{"name": "a", "used": True}]
    for report, said in (
        (few, "5.0 degrees, a guess; presses"),
        (
            few | {"own_deg": 2.0, "stated_deg": 4.5, "presses": used},
            "4.5 degrees, by what so few presses leave open; more presses",
        ),
        (
            few | {"held_out_deg": 1.5, "stated_deg": 2.4, "presses": 12 * used},
            "to about 2.4 degrees anywhere on the skin: 1.5 on each of 12 presses by the others",
        ),
        ({"model": "response", "source": "stand_in", "not_metric": ["lights"]}, "NOT METRIC"),
    ):
        unit = vts.Calibration.from_response(mini_by_prior.response, mini_by_prior.sensor, mini_by_prior.background, report)
        assert said in expected(unit)


def test_a_video_or_a_folder_in_the_wrong_place_names_the_way_that_works(rig, tmp_path):
    with pytest.raises(ValueError, match=r"expected an image, got a video: torchvts\.stream\.read_background"):
        (tmp_path / "film.avi").write_bytes(b"film")
        vts.read_image(tmp_path / "film.avi")
    vts.write_image(tmp_path / "background.png", rig[2])
    with pytest.raises(FileNotFoundError, match=r"name the images: torchvts calibrate .*background\.png --press"):
        vts.read_presses(tmp_path)


@pytest.mark.parametrize("roi_px, warned", [((0, 0, 160, 120), 1), ((40, 30, 240, 180), 0)])
def test_a_place_of_a_smaller_picture_is_warned_of(roi_px, warned):
    sensor = vts.Sensor("rig", 120, 160, 0.1, roi_px=roi_px, raw_size_px=((240, 320),))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warn_of_a_small_place(sensor)
    assert sum("was its place measured in a smaller picture?" in str(one.message) for one in caught) == warned
