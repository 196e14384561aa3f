"""Calibration by hand: a film stands in for the camera, a drawn sensor for the unit."""

import csv
import dataclasses
import signal
import threading
import time

import pytest
import torch
from conftest import bgr, half_drawn, write_film

import torchvts as vts
from torchvts.cli.guide import Session, Watch
from torchvts.scenes import objects
from torchvts.stream.background import is_touched

BALL_MM = 5.0
PLACES_MM = ((0, 0), (-4, -2), (4, 2))
UNTIL_DEG = 3.3
"""Between the 4.1 degrees that one press of these states, and the 3.8 that two do."""

STILL = 13
"""Frames of a film that show the same; twelve of them must be still."""


@pytest.fixture(scope="module")
def unit():
    """A drawn sensor of 120 x 160 pixels."""
    return half_drawn(3)


@pytest.fixture(scope="module")
def shots(unit):
    """A ball at three places, and a capsule."""
    balls = [unit.ball(BALL_MM, 0.5, at, seed=k).image for k, at in enumerate(PLACES_MM)]
    return [*balls, unit.press(objects.capsule(1.5, 4.0), objects.pose(20.0, (1.0, 1.0), 0.5)).image]


def film_of(path, unit, presses):
    """A film: untouched, then each press as it comes, stays and is lifted."""
    rest = bgr(unit.background)
    pictures = [rest] * (STILL + 2)
    for picture in map(bgr, presses):
        coming = (picture // 2) + (rest // 2)
        pictures += [coming] + [picture] * STILL + [coming] + [rest] * 3
    unit.sensor.save(path.with_name("rig.yaml"))
    return write_film(path, pictures, code="FFV1")


def command(film, folder, *more):
    given = ("--camera", film, "--ball", BALL_MM, "--sensor", film.with_name("rig.yaml"), "--out", folder / "unit.safetensors")
    return (*given, *more)


def catalog(folder):
    with (folder / "catalog.csv").open(newline="") as file:
        return list(csv.reader(file))


def test_presses_are_kept_or_refused_until_the_error_that_was_asked_for_is_stated(unit, shots, run_script, tmp_path):
    first, second, never, capsule = shots
    film = film_of(tmp_path / "film.mkv", unit, [first, capsule, second, never])
    done = run_script("calibrate", *command(film, tmp_path, "--until-deg", UNTIL_DEG))
    assert done.returncode == 0, done.stderr
    said = done.stdout.splitlines()
    assert "still and untouched: the background is taken" in said
    assert "press the ball of 5 mm and hold it still: anywhere, 0.3 to 0.8 mm deep" in said
    assert any(line.startswith("press 1: kept: a circle at x 79, y 60 px") for line in said)
    assert any(line.startswith("press 2: kept (counts 0.") and "those of a ball of any size" in line for line in said)
    assert any(line.startswith("by 2 presses: depth is NOT METRIC") for line in said)  # which of two is wrong, the third shows
    assert any(line.startswith("press 2: refused: counts 0.0") for line in said)
    assert any(line.startswith("press 3: kept: a circle at x 45, y 43 px") for line in said)
    assert sum(line.startswith("press the ball of 5 mm and hold it still: around x ") for line in said) == 2
    assert not any(line.startswith(("press 4", "ended before")) for line in said)  # the film goes on
    folder = tmp_path / "unit_presses"
    assert catalog(folder) == [["experiment_reldir", "diameter(mm)"], ["1", "5"], ["3", "5"]]
    assert (folder / "2" / "gelsight.png").is_file() and (tmp_path / "unit_calibration.png").is_file()
    guided = vts.Calibration.load(tmp_path / "unit.safetensors")
    background, presses = vts.read_presses(folder)
    again = vts.calibrate(background, unit.sensor, presses)
    assert guided.report["stated_deg"] == again.report["stated_deg"] <= UNTIL_DEG
    assert torch.allclose(background, unit.background, atol=0.6 / 255)


def test_an_ended_session_keeps_what_there_is_and_goes_on(unit, shots, run_script, tmp_path, monkeypatch):
    for room in ("guide", "calibrate"):  # the test of presses above has its picture
        monkeypatch.setattr(f"torchvts.cli.{room}.draw", lambda *given: None)
    film = film_of(tmp_path / "film.mkv", unit, shots[:1])
    taken, ended = tmp_path / "unit_presses" / "catalog.csv", threading.Event()

    def interrupt_while_it_is_judged():
        while not ended.is_set() and not taken.exists():
            time.sleep(0.01)
        signal.raise_signal(signal.SIGINT)

    watcher = threading.Thread(target=interrupt_while_it_is_judged)
    watcher.start()
    done = run_script("calibrate", *command(film, tmp_path))
    ended.set()
    watcher.join()
    assert done.returncode == 0, done.stderr
    assert "interrupted: " in done.stdout and "ended before 3 degrees were stated; the same command goes on" in done.stdout
    assert "press 1: " not in done.stdout and vts.Calibration.load(tmp_path / "unit.safetensors").report["presses"][0]["used"]
    more = film_of(tmp_path / "more.mkv", unit, shots[1:2])
    done = run_script("calibrate", *command(more, tmp_path, "--until-deg", UNTIL_DEG))
    assert done.returncode == 0, done.stderr
    assert "the background is taken" not in done.stdout
    assert done.stdout.index("press 1: kept") < done.stdout.index("press 2: kept") and "ended before" not in done.stdout


def test_a_place_in_raw_frames_is_kept_in_raw_ones(unit, shots, tmp_path):
    """So that torchvts calibrate FOLDER cuts it as the camera's frames."""
    sensor = dataclasses.replace(unit.sensor, roi_px=(8, 12, 160, 120), raw_size_px=((140, 180),))
    watch, session = Watch(sensor), Session(tmp_path / "presses", sensor)
    for _ in range(STILL):
        watch.add(bgr(torch.nn.functional.pad(unit.background, (8, 12, 12, 8), value=0.1)))
    assert watch.why_not_at_rest() == "" and not watch.touched(unit.background)
    session.set_background(watch.picture())
    assert vts.read_image(session.folder / "background.png").shape == (3, 140, 180)
    assert torch.allclose(session.background, unit.background, atol=0.6 / 255)
    watch.add(bgr(torch.nn.functional.pad(shots[0], (8, 12, 12, 8), value=0.1)))
    assert watch.touched(session.background) and watch.moves()
    session.add(watch.picture(), BALL_MM)
    assert [press.name for press in session.presses] == ["1"] and session.presses[0].image.shape == (3, 120, 160)
    session.leave_out("1")
    assert session.presses == [] and not (session.folder / "catalog.csv").exists()


def test_a_change_of_the_level_is_no_touch_and_a_ball_is(unit, shots):
    assert not is_touched(0.8 * unit.background, unit.background)
    assert all(is_touched(image, unit.background) for image in shots)


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("film.mkv", "--camera", "0"), "expected no images beside it"),
        (("--camera", "0"), "expected --ball MM beside it"),
        ((), "or --camera, which guides"),
        (("--camera", "0", "--ball", "-1"), "--ball: expected"),
    ],
)
def test_a_wrong_request_names_what_is_missing(arguments, message, run_script):
    done = run_script("calibrate", *arguments, "--sensor", "gelsight_mini")
    assert done.returncode == 2 and message in done.stderr


def test_a_film_that_is_never_at_rest_is_refused_and_leaves_no_calibration(unit, shots, run_script, tmp_path):
    film = write_film(tmp_path / "film.mkv", [bgr(shots[k // 4 % 3]) for k in range(20)], code="FFV1")
    unit.sensor.save(tmp_path / "rig.yaml")
    done = run_script("calibrate", *command(film, tmp_path))
    assert done.returncode == 2 and "something moves, or the light changes" in done.stderr
    assert not (tmp_path / "unit.safetensors").exists()
