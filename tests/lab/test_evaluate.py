"""Scores against balls: zero for exact presses, of known size for wrong ones; both scripts at small scale."""

import csv
import dataclasses
import json
import math
import shutil
import sys
from functools import partial

import pytest
import torch

import torchvts as vts
from lab import evaluate as ev
from lab import methods, sets
from lab.score import score_press
from lab.training import Training
from torchvts.core.geometry import normal_from_gradient
from torchvts.model.gs_sdk import CATALOG_COLUMNS, LABEL_COLUMNS
from torchvts.training import presses as presses_room
from torchvts.training.balls import ball_truth
from torchvts.training.presses import train_network, training_pixels

HEIGHT, WIDTH, PITCH = 96, 128, 0.15
CENTERS = ((-3.0, -2.0), (3.5, -2.5), (0.0, 0.5), (-4.0, 2.5), (3.0, 2.5), (0.5, -3.0))
BALL_MM, PRESS_MM = 10.0, 0.6


def ball(center_mm):
    return vts.scenes.sphere_press(0.5 * BALL_MM, PRESS_MM, center_mm, HEIGHT, WIDTH, PITCH)


def contact_radius_px():
    return math.sqrt((0.5 * BALL_MM) ** 2 - (0.5 * BALL_MM - PRESS_MM) ** 2) / PITCH


def center_px(center_mm):
    return center_mm[0] / PITCH + (WIDTH - 1) / 2, center_mm[1] / PITCH + (HEIGHT - 1) / 2


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Six presses under point lights, the last without a contact radius, and the sensor's file."""
    folder = tmp_path_factory.mktemp("presses")
    lights = vts.PointLights([[25.0, 9.0, 22.0], [-20.0, 15.0, 22.0], [-3.0, -25.0, 22.0]], [500.0, 500.0, 500.0])
    catalog, labels = [CATALOG_COLUMNS], [LABEL_COLUMNS]
    for k, center_mm in enumerate(CENTERS):
        scene = ball(center_mm)
        if k == 0:
            background = vts.scenes.render(vts.scenes.undeformed(scene), lights, noise_std=0.002)
            vts.write_image(folder / "background.png", background[0].detach())
        (folder / f"ball/{k}").mkdir(parents=True)
        image = vts.scenes.render(scene, lights, noise_std=0.002, seed=1 + k)[0].detach()
        vts.write_image(folder / f"ball/{k}" / "gelsight.png", image)
        catalog.append((f"ball/{k}", BALL_MM))
        labels.append((f"ball/{k}", BALL_MM, *center_px(center_mm), "" if k == 5 else contact_radius_px()))
    for name, lines in (("catalog.csv", catalog), ("labels.csv", labels)):
        with (folder / name).open("w", newline="") as stream:
            csv.writer(stream).writerows(lines)
    vts.Sensor("rig", HEIGHT, WIDTH, PITCH, gamma=1.0).save(folder / "rig.yaml")
    return folder


@pytest.fixture(scope="module")
def press():
    center_mm = (1.3, -0.7)
    image = torch.zeros(3, HEIGHT, WIDTH)
    return vts.Press(image, BALL_MM, "exact", center_px(center_mm), contact_radius_px()), ball(center_mm)


def test_an_exact_press_has_no_error(press):
    given, scene = press
    score = score_press(given, scene.depth_mm, scene.normal, PITCH, "exact")
    assert score.normal_deg < 1e-3 and score.relief_um < 1e-2
    assert score.radius_percent < 1e-2 and score.center_px < 1e-2
    assert (score.press, score.method) == ("exact", "exact")
    assert bool(scene.contact[ball_truth(given, HEIGHT, WIDTH, PITCH).region].all())
    assert score.depth_normal_deg < 0.05 and score.lowest_mm == 0.0 and score.iou is None
    assert score_press(given, scene.depth_mm, scene.normal, PITCH, contact=scene.contact).iou > 0.97
    wide = scene.contact.clone()
    wide[..., :2, :3] = True  # a corner, far from the ball
    found = [score_press(given, scene.depth_mm, scene.normal, PITCH, contact=mask) for mask in (scene.contact, wide)]
    exact, more = found
    assert (exact.stray_px, more.stray_px) == (0, 6) and abs(exact.area_percent) < 3.0
    grown = 100.0 * 6 / int(ball_truth(given, HEIGHT, WIDTH, PITCH).contact.sum())
    assert more.area_percent - exact.area_percent == pytest.approx(grown)


def test_a_turned_normal_is_off_by_its_angle(press):
    given, scene = press
    angle = math.radians(7.0)
    turn = torch.tensor(
        [[math.cos(angle), 0.0, math.sin(angle)], [0.0, 1.0, 0.0], [-math.sin(angle), 0.0, math.cos(angle)]], dtype=torch.float64
    )
    # n_y keeps its length: a normal turns about y by less than the angle where it tilts along y
    truth = ball_truth(given, HEIGHT, WIDTH, PITCH)
    normal = normal_from_gradient(truth.gradient)
    n_y = normal[:, 1][truth.region[:, 0]]
    cosine = n_y**2 + (1 - n_y**2) * math.cos(angle)
    score = score_press(given, scene.depth_mm, torch.einsum("ij,bjhw->bihw", turn, normal), PITCH)
    assert score.normal_deg == pytest.approx(float(torch.rad2deg(torch.acos(cosine)).mean()), abs=1e-6)
    assert 6.0 < score.normal_deg < 7.0 and score.relief_um < 1e-2


def test_a_scaled_depth_is_off_by_its_scale(press):
    given, scene = press
    score = score_press(given, 1.1 * scene.depth_mm.double(), scene.normal, PITCH)
    truth = ball_truth(given, HEIGHT, WIDTH, PITCH)
    cap = truth.depth_mm[truth.region]
    assert score.relief_um == pytest.approx(100.0 * float(cap.std(correction=0)), rel=1e-3)
    assert score.tilt_um < 1e-2 * score.relief_um  # a ball in the middle scaled is no plane
    # a flat cap of height h over a circle a has radius a^2 / 2h: 10 % higher, a tenth smaller
    assert score.radius_percent == pytest.approx(9.0, abs=1.5) and score.center_px < 1e-2


def test_a_tilted_depth_moves_the_fitted_ball(press):
    given, scene = press
    slope = 0.05
    tilt = slope * PITCH * torch.arange(WIDTH, dtype=torch.float64).expand(1, 1, HEIGHT, WIDTH)
    score = score_press(given, scene.depth_mm.double() + tilt, scene.normal, PITCH)
    truth = ball_truth(given, HEIGHT, WIDTH, PITCH)
    assert score.relief_um == pytest.approx(1000.0 * float(tilt[truth.region].std(correction=0)), rel=1e-3)
    assert score.tilt_um == pytest.approx(score.relief_um, rel=1e-3) and score.level_um < 0.05 * score.relief_um
    assert score.center_px == pytest.approx(slope * 0.5 * BALL_MM / PITCH, rel=0.15)


OWN = """
import torch
from torchvts import NormalFromResponse, DepthPipeline

def normals(training):
    return NormalFromResponse.from_calibration(training.calibration)

def depth(training):
    pipe = DepthPipeline.from_calibration(training.calibration)
    return lambda images: pipe(images).depth_mm
"""


def test_accuracy_writes_tables_rows_and_pictures(run_script, monkeypatch, folder, tmp_path):
    """Beside the methods, the calibrated model itself, given as networks of one's own, which has its scores."""
    monkeypatch.setattr(methods, "train_network", partial(train_network, max_epochs=15))
    (tmp_path / "own_networks.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    own = ("own_networks:normals", "own_networks:depth")
    options = ("--normals", own[0], "--depth", own[1], "--folds", 2, "--out", tmp_path)
    done = run_script("accuracy", folder, "--sensor", folder / "rig.yaml", *options)
    assert done.returncode == 0, done.stderr
    document = json.loads((tmp_path / "scores.json").read_text())
    summary = {row["method"]: row for row in document["rows"]}
    assert list(summary) == [*(name for name in ev.COMPARED if "no prior" not in name), *own]  # the file has none
    for name in ("depth_normal_deg", "relief_um"):
        same = [summary[method]["errors"][name] for method in ("fast", *own)]
        assert same == pytest.approx([same[0]] * 3, rel=0.05), (name, [row["note"] for row in summary.values()])
    assert len(document["scores"]) == 5 * len(summary) and document["command"].startswith("python scripts/accuracy.py ")
    # exact lights, little noise: the model is right, and learning from three presses beats zero depth
    assert summary["point lights"]["errors"]["normal_deg"] < 1.5
    assert summary["precise"]["errors"]["normal_deg"] < 3.0 and summary["precise"]["errors"]["level_um"] < 20.0
    for name in ("look-up table", "MLP"):
        assert summary[name]["errors"]["normal_deg"] < 0.8 * summary["flat"]["errors"]["normal_deg"]
    for name in ("fast", "precise", "look-up table", "MLP", own[0]):
        errors, note = summary[name]["errors"], summary[name]["note"]
        assert (errors["used"], errors["given"]) == (6, 6) and "Error" not in note
    assert summary["flat"]["errors"]["radius_percent"] is None and summary["flat"]["errors"]["iou"] == 0.0
    assert "not scored, no contact radius: ball/5" in done.stdout
    assert done.stdout.splitlines()[2].startswith("|") and "| flat |" in done.stdout.splitlines()[2]
    assert (tmp_path / "table.md").read_text().startswith("| data | method |")
    assert [path.name for path in tmp_path.glob("*.png")] == [f"{folder.name}.png"]


def test_evaluate_with_a_trained_network(run_script, folder, tmp_path):
    network = tmp_path / "mlp.safetensors"
    done = run_script("train", folder, "--sensor", folder / "rig.yaml", "--out", network, "--max-epochs", 3)
    assert done.returncode == 0, done.stderr
    assert "held out" in done.stdout and "2370 weights" in done.stdout
    sensor = vts.Sensor.load(folder / "rig.yaml")
    result = ev.evaluate(sets.from_folder(folder, sensor, folds=1, network=network, limit=4), ["fast"])
    assert [row.method for row in result.rows] == ["fast", methods.GIVEN_NETWORK]
    assert "learned from and scored: 4 presses" in result.data.how and [row.seen for row in result.rows] == [False, True]
    assert result.rows[0].errors["normal_deg"] < 3.0 and result.rows[1].frames == 4


def test_networks_of_ones_own_are_found_in_the_working_folder_or_named(run_script, folder, monkeypatch, tmp_path):
    (tmp_path / "networks_here.py").write_text(OWN)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.chdir(tmp_path)
    assert [method.name for method in methods.own_methods("networks_here:normals", None)] == ["networks_here:normals"]
    for text, message in (("networks_here", "expected module:factory"), ("networks_here:other", "expected a function other in")):
        assert message in run_script("accuracy", folder, "--normals", text).stderr
    with pytest.raises(ImportError, match=r"no_networks:normals: expected no_networks\.py in .+ or on PYTHONPATH, found none"):
        methods.own_methods("no_networks:normals", None)


class FailingUnit:
    """A calibration that cannot be made."""

    def __init__(self, *arguments):
        raise ValueError("presses: no contact|\nin any of them")


def test_a_method_or_a_set_that_fails_is_a_row_with_its_reason(folder, monkeypatch, tmp_path):
    sensor = vts.Sensor.load(folder / "rig.yaml")
    data = sets.from_folder(folder, sensor, folds=2)
    calls = []
    monkeypatch.setattr(presses_room, "calibrate", lambda *arguments: FailingUnit(calls.append(1)))
    result = ev.evaluate(data, ["flat", "fast", "precise"])
    assert len(calls) == 2  # once for each fold, not for each method
    assert [row.note for row in result.rows[1:]] == ["presses: no contact/ in any of them"] * 2
    assert result.rows[1].frames == 0 and result.rows[1].errors["used"] == 0.0 and result.rows[0].frames == 5
    refused = ev.evaluate(dataclasses.replace(data, refused=True), ["fast"])
    assert refused.rows[0].note == "refused, as is right: presses: no contact/ in any of them"
    missing = ev.evaluate_all(["digit_a"], tmp_path)
    assert "no such folder: set TORCHVTS_DATA" in missing[0].rows[0].note
    text = ev.write_tables([result, *missing], tmp_path, "a command")
    assert (
        "| digit_a |" in text
        and "| no contact/ in any" not in text
        and len({line.count("|") for line in text.splitlines()[:6]}) == 1
    )


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in ("gelsight_mini_a", "digit_b") else [pytest.mark.long]) for name in sets.REAL]
)
def test_real_sets_are_read(data, monkeypatch, name):
    monkeypatch.setattr(presses_room, "calibrate", FailingUnit)  # balls without a label are not located here
    monkeypatch.setattr(sets, "fit_prior", lambda *arguments: None)
    read = sets.load(name, data, 4)
    sensor = read.folds[0].sensor
    assert read.background.shape == (3, sensor.height, sensor.width) and read.how
    names = [{press.name for press in fold.learned} & {target.name for target in fold.scored} for fold in read.folds]
    assert read.refused or not any(names)
    assert all(target.image.shape == read.background.shape for fold in read.folds for target in fold.scored)


def test_without_labels_balls_are_found(folder, monkeypatch, tmp_path):
    sensor = vts.Sensor.load(folder / "rig.yaml")
    _, presses = vts.read_presses(folder)
    assert presses[0].center_px is not None and presses[5].contact_radius_px is None
    bare = shutil.copytree(folder, tmp_path / "bare", ignore=shutil.ignore_patterns("labels.csv"))
    training = Training(*vts.read_presses(bare), sensor)
    for found, given in zip(training.located, presses, strict=True):
        assert math.dist(found.center_px, given.center_px) < 1.5
    for room in ("torchvts.training.presses", "lab.training"):  # the same presses again
        monkeypatch.setattr(f"{room}.quiet_calibrate", lambda *arguments: training.calibration)
    result = ev.evaluate(sets.from_folder(bare, sensor, folds=1), ["flat"])
    assert "centers from calibrate on the scored presses (6)" in result.data.how and result.rows[0].frames == 6
    fit = train_network(*vts.read_presses(bare), sensor, max_epochs=2)
    assert len(fit.history) == 2 and "raise max_epochs" in fit.message


def test_training_knows_presses_by_their_place_not_by_their_name(folder, monkeypatch):
    sensor = vts.Sensor.load(folder / "rig.yaml")
    background, presses = vts.read_presses(folder)
    alike = [dataclasses.replace(press, name="gelsight.png") for press in presses]
    for found, given in zip(Training(background, alike, sensor).located, presses, strict=True):
        assert torch.equal(found.image, given.image) and math.dist(found.center_px, given.center_px) < 1.5
    learned = []
    kept = lambda _, presses, pitch: learned.extend(presses) or training_pixels(_, presses, pitch)  # noqa: E731
    monkeypatch.setattr(presses_room, "training_pixels", kept)
    train_network(background, [dataclasses.replace(press, name="") for press in presses], sensor, max_epochs=1)
    assert len(learned) == len(presses)  # the last has a centre and no contact radius: it is found
    assert learned[0].center_px == presses[0].center_px and learned[-1].contact_radius_px is not None


def test_camera_frames_are_cut_as_calibrate_cuts_them(folder, tmp_path):
    """Frames of which the sensor file's region is a part; their labels are of cut frames, so the balls are found."""
    raw = shutil.copytree(folder, tmp_path / "raw")
    for path in raw.rglob("*.png"):
        vts.write_image(path, torch.nn.functional.pad(vts.read_image(path), (9, 5, 4, 6)))
    sensor = vts.Sensor("rig", HEIGHT, WIDTH, PITCH, gamma=1.0, roi_px=(9, 4, WIDTH, HEIGHT))
    read = sets.from_folder(raw, sensor, folds=2)
    assert read.background.shape == (3, HEIGHT, WIDTH) and "centers from calibrate" in read.how
