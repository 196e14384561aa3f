"""Diagnoses: every finding has a frame that triggers it, and ordinary frames raise no alarm.

All that triggers stands in :data:`TRIGGERS`, all that must not in :data:`ORDINARY` and in the real sets.
"""

import dataclasses
import functools
import json
import re
import warnings

import pytest
import torch
from conftest import LONG, ROOT, half_drawn, ring_lights

import torchvts as vts
from lab import sets
from lab.gallery import CORRUPTIONS, undisturbed
from lab.training import Training
from torchvts import scenes
from torchvts.cli.reconstruct import diagnose_some
from torchvts.core.blur import blur, gaussian_weights
from torchvts.dataset import RunReport
from torchvts.diagnose import Diagnosis, Finding
from torchvts.diagnose.checks import CHECKS
from torchvts.model.response_field import ResponseModel

SIZE = {"height": 120, "width": 160, "mm_per_pixel": 0.25}
undisturbed = functools.cache(undisturbed)

# ---- frames that trigger a finding: functions of a seed that give (background or None, image, calibration) --------------------


def gallery(name, severity):
    """A corruption of the gallery."""

    def make(seed):
        case = CORRUPTIONS[name].make(severity, seed)
        return case.background, case.image[0], case.calibration

    return make


def changed(change, of_background=False):
    """An undisturbed case whose image, and where asked a background of now, is changed."""

    def make(seed):
        case = undisturbed(seed)
        background, image = case.background, case.image[0]
        return change(background) if of_background else None, change(image), case.calibration

    return make


def pressed_background(seed):
    case = undisturbed(seed)
    return CORRUPTIONS["cut by the border"].make(8.0, seed).image[0], case.image[0], case.calibration


def pressed_calibration(seed):
    case = undisturbed(seed)
    pressed = CORRUPTIONS["cut by the border"].make(8.0, seed).image[0]
    return None, case.image[0], vts.Calibration.from_lights(case.calibration.lights, case.calibration.sensor, pressed)


def uneven(image):
    """Each channel brighter on another side."""
    y, x = torch.meshgrid(torch.linspace(-1, 1, image.shape[1]), torch.linspace(-1, 1, image.shape[2]), indexing="ij")
    return (image * (1.0 + 0.08 * torch.stack((x * y, x * x - y, y * y + x)))).clamp(0, 1)


def blotched(image, size, channels):
    """Light that differs from place to place, equally in all channels or in each by itself."""
    noise = torch.randn(1, channels, *image.shape[1:], generator=torch.Generator().manual_seed(5))
    pattern = blur(blur(noise, gaussian_weights(4.0)), gaussian_weights(4.0))[0]
    return (image * (1.0 + size * pattern / pattern.std())).clamp(0, 1)


def mirrored(seed):
    y, x = torch.meshgrid(torch.linspace(-1, 1, 96), torch.linspace(-1, 1, 128), indexing="ij")
    background = torch.stack((0.5 + 0.3 * x, 0.5 + 0.3 * y, 0.5 - 0.2 * x + 0.1 * y))
    background = background + 0.002 * torch.randn(background.shape, generator=torch.Generator().manual_seed(seed))
    unit = vts.Calibration.from_response(ResponseModel.zero(), vts.Sensor("rig", 96, 128, 0.1), background)
    return None, background.flip(2), unit


def grain(seed):
    """A fine pattern of the skin's coating."""
    noise = torch.randn(1, 3, 120, 160, generator=torch.Generator().manual_seed(seed))
    return 1.0 + 0.04 * blur(noise, gaussian_weights(0.8))[0] / 0.35


def grained(change):
    """A unit whose skin has a fine pattern, and a change of an image of it: ``change(image, seed)``."""

    def make(seed):
        case = undisturbed(seed)
        background, image = (frame * grain(seed) for frame in (case.background, case.image[0]))
        unit = vts.Calibration.from_lights(case.calibration.lights, case.calibration.sensor, background.clamp(0, 1))
        return None, change(image, seed).clamp(0, 1), unit

    return make


def of_another_unit(image, seed):
    """Another pattern, and lights that stand a little otherwise."""
    return uneven(image / grain(seed) * grain(seed + 1000))


def softened(image, seed):
    noise = 0.002 * torch.randn(image.shape, generator=torch.Generator().manual_seed(seed))
    return blur(image[None], gaussian_weights(1.5))[0] + noise


def little_known(seed):
    unit = half_drawn(31)
    balls = [unit.ball(5.0, 0.3 + 0.2 * k, (0.5 * k - 1.0, 0.3 * k - 0.5), f"{k}", k) for k in range(4)]
    calibration = vts.calibrate(unit.background, unit.sensor, balls)
    unsure = dataclasses.replace(calibration, covariance=100.0 * calibration.covariance)
    return None, unit.ball(5.0, 0.7, (0.5, 0.5), "other", seed).image, unsure


def dotted(change):
    """A skin with printed dots: ``change`` gives what an object does, and what is left of each dot."""

    def make(seed):
        skin = scenes.DottedSkin(120, 160, 0.125)
        unit = vts.Calibration.from_lights(skin.lights, vts.Sensor("rig", 120, 160, 0.125), skin.image(seed=seed))
        drag, left = change(skin)
        return None, skin.image(drag, seed + 1, left), unit

    return make


TRIGGERS = {
    # the calibration
    "calibration_saturated": gallery("saturation", 2.0),
    "contact_in_calibration": pressed_calibration,
    "lights_coplanar": gallery("lights close together", 100.0),
    "lights_misfit": gallery("specular", 1.0),
    # the background of now
    "contact_in_background": pressed_background,
    "light_changed": changed(uneven, of_background=True),
    "channels_swapped, of now": changed(lambda image: image[[2, 1, 0]], of_background=True),
    "no_picture, of now": changed(lambda image: 0.1 * image, of_background=True),
    # the camera
    "few_bits": gallery("few bits", 5.0),
    "compressed": gallery("JPEG", 70.0),
    "noise": gallery("noise", 0.02),
    "led_failed": gallery("dead lights", 1.0),
    "no_picture": changed(lambda image: torch.full_like(image, 0.5)),
    "no_picture, all black": changed(lambda image: torch.zeros_like(image)),
    "no_picture, dark": changed(lambda image: (0.05 * image * 255.0).round() / 255.0),
    "no_picture, grey": changed(lambda image: image.mean(0, keepdim=True).expand(3, -1, -1).clone()),
    "other_view": mirrored,
    "channels_swapped": changed(lambda image: image[[2, 1, 0]]),
    "channels_swapped, at calibration too": gallery("channel order", 1.0),
    "saturated": gallery("saturation", 1.6),
    "wrong_size": changed(lambda image: image[:, :, :100]),
    # the light and the skin
    "no_free_skin": changed(lambda image: blotched(image, 0.15, 3)),
    "other_unit": grained(of_another_unit),
    "light_changed, exposure": changed(lambda image: 0.85 * image),
    "light_changed, a channel": gallery("a channel dims", 0.1),
    "blurred, or ambient light": gallery("ambient light", 0.1),
    "lights_misfit, black level": gallery("black crush", 0.1),
    "lights_misfit, gamma": gallery("wrong gamma", 1.2),
    "blurred, or a light moves": gallery("a light moves", 5.0),
    "light_changed, albedo": gallery("albedo drift", 0.1),
    "unseen_slopes": grained(of_another_unit),
    "skin_changed": changed(lambda image: blotched(image, 0.03, 1)),
    "new_spots": gallery("spots and dead pixels", 100.0),
    "specular": gallery("specular", 0.2),
    "blurred, rims": gallery("defocus", 3.0),
    "blurred, by motion": gallery("motion blur", 10.0),
    "blurred, by other skin": gallery("inter-reflection", 0.2),
    "blurred, texture": grained(softened),
    "dots_lost": dotted(lambda skin: (None, (torch.arange(len(skin.dots_mm)) % 3 == 0).double())),
    "dots_shifted": dotted(lambda skin: (scenes.Drag(radius_mm=60.0, shift_mm=(0.2, -0.1)), None)),
    # the scene
    "no_contact": gallery("faint contact", 0.0),
    "contact_at_border": gallery("cut by the border", 8.0),
    "steep_walls": gallery("steep walls", 4.0),
    "steep_walls, cut ends": gallery("cut ends", 3.0),
    "beyond_presses": little_known,
    "shadow": gallery("attached shadows", 30.0),
    "cast_shadow": gallery("cast shadows", 30.0),
}
"""Name of a finding, and after a comma what makes it -> the frame that triggers it."""

ORDINARY = {
    "ball": lambda k: scenes.sphere_press(10.0, 1.0, **k),
    "ball aside": lambda k: scenes.sphere_press(5.0, 0.5, (8.0, -6.0), **k),
    "cylinder": lambda k: scenes.surface(scenes.cylinder_depth(), **k),
    "cone": lambda k: scenes.surface(scenes.cone_depth(), **k),
    "sine": lambda k: scenes.surface(scenes.sine_depth(), **k),
    "punch": lambda k: scenes.surface(scenes.punch_depth(), **k),
    "letters": lambda k: scenes.surface(scenes.letters_depth(), **k),
}
"""Drawn presses that raise no alarm."""


def triggered(name, seed):
    found = vts.diagnose(*TRIGGERS[name](seed))
    return name.split(",")[0] in found.names, found


FIRST = {name.split(",")[0]: name for name in reversed(TRIGGERS)}.values()
"""One frame for each finding; make test-long has the others."""


@pytest.mark.parametrize("name", [pytest.param(name, marks=[] if name in FIRST else [pytest.mark.long]) for name in TRIGGERS])
def test_every_finding_has_a_frame_that_triggers_it(name):
    hit, found = triggered(name, seed=7)
    assert hit, str(found)


def test_every_finding_of_the_table_is_triggered_and_has_a_row_in_the_page():
    names = {name.split(",")[0] for name in TRIGGERS}
    assert {check.name for check in CHECKS} <= names
    page = (ROOT / "docs" / "diagnose.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| ([a-z_, ]+?)(?: \(.*?\))? \|", page, re.MULTILINE)
    assert names == {name for row in rows[1:] for name in row.split(", ")}


@pytest.mark.parametrize("fitted", [False, pytest.param(True, marks=pytest.mark.long)])
def test_ordinary_drawn_frames_raise_no_alarm(fitted, small_sensor):
    lights = ring_lights(rotation_deg=40.0, level=0.4)
    sensor = small_sensor if fitted else vts.Sensor("rig", 120, 160, 0.25, gamma=1.0)
    undeformed = scenes.undeformed(ORDINARY["ball"](SIZE))
    background = scenes.render(undeformed, lights, noise_std=0.003, bits=8, seed=1)[0]
    unit = vts.calibrate(background, sensor) if fitted else vts.Calibration.from_lights(lights, sensor, background)
    for k, (name, press) in enumerate(list(ORDINARY.items())[:: 3 if fitted else 1 if LONG else 2]):
        image = scenes.render(press(SIZE), lights, noise_std=0.003, bits=8, seed=2 + k)
        found = vts.diagnose(background if k % 2 else None, image, unit)
        assert found.ok, f"{name}: {found}"
    again = scenes.render(undeformed, lights, noise_std=0.003, bits=8, seed=20)
    assert vts.diagnose(None, again, unit).names == ("no_contact",)


@pytest.mark.parametrize("seed", [0, pytest.param(2, marks=pytest.mark.long)])
def test_undisturbed_frames_of_the_gallery_have_no_finding(seed):
    case = undisturbed(seed)
    assert vts.diagnose(case.background, case.image, case.calibration).findings == ()
    without = vts.Calibration.from_lights(case.calibration.lights, case.calibration.sensor)
    assert vts.diagnose(None, case.image, without).ok


QUICK = ("gelsight_mini_b",)
CLIPPED = "gelsight_pale"
"""A set whose camera clips: a fifth of each contact is at 255, and the finding "saturated" is right."""


@pytest.mark.parametrize("name", [pytest.param(s, marks=() if s in QUICK else pytest.mark.long) for s in sets.REAL])
def test_ordinary_frames_of_real_sensors_raise_no_alarm(name, data):
    """Calibrated as ``scripts/accuracy.py`` does: by some presses, and others as frames; and the background itself."""
    found_set = sets.load(name, data, 6 if name in QUICK else None)
    if found_set.refused:
        pytest.skip(f"{name}: no calibration, and that is right")
    right = {"saturated"} if name.startswith(CLIPPED) else set()
    for fold in found_set.folds[:1] if name in QUICK else found_set.folds:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", vts.CalibrationWarning)
            unit = Training(found_set.background, fold.learned, fold.sensor).calibration
        assert vts.diagnose(None, found_set.background, unit).ok
        for target in fold.scored:
            found = vts.diagnose(found_set.background, target.image, unit)
            alarms = {finding.name for finding in found if finding.severity != "note"}
            assert alarms <= right, f"{name}, {target.name}: {found}"


@pytest.fixture(scope="module")
def other_mini(data):
    """Background, an image of a bead, and the calibration of a second GelSight Mini."""
    background, bead = (vts.read_image(data / "gelsight_mini_b" / f"{name}.png") for name in ("background", "bead"))
    return background, bead, vts.calibrate(background, vts.Sensor.load("gelsight_mini"))


def test_real_faults_are_found(mini_presses, mini_by_prior, other_mini):
    image = mini_presses[1][7].image
    assert vts.diagnose(None, other_mini[1], mini_by_prior).names[0] == "other_unit"
    assert not vts.diagnose(None, image, other_mini[2]).ok
    assert vts.diagnose(None, image[[2, 1, 0]], mini_by_prior).names[0] == "channels_swapped"
    found = vts.diagnose(None, image * torch.tensor([1.0, 1.0, 0.88]).reshape(3, 1, 1), mini_by_prior)
    dim = next(finding for finding in found if finding.name == "light_changed")
    assert found.ok and dim.value == pytest.approx(0.12, abs=0.02) and "blue 88%" in dim.message
    assert "light_changed" in vts.diagnose(None, 0.9 * image + 0.05, mini_by_prior).names
    assert not vts.diagnose(None, image**1.5, mini_by_prior).ok
    assert "contact_in_background" in vts.diagnose(image, mini_presses[1][20].image, mini_by_prior).names
    with pytest.warns(vts.CalibrationWarning, match="contact in the calibration image"):
        unit = vts.calibrate(mini_presses[1][20].image, vts.Sensor.load("gelsight_mini"))
    assert "contact_in_calibration" in vts.diagnose(None, image, unit).names


def test_a_failed_led_of_the_background_is_named_and_no_contact(mini_presses, mini_by_prior):
    """It was a contact, whose remedy, nothing touching the skin, helps nobody; the light of the others may reach the channel."""
    background, presses = mini_presses
    for left, name, says in (
        (0.0, "led_failed", "the red LED has failed"),
        (0.1, "light_changed", "red 12%, green 100%, blue 100%"),
    ):
        dead = torch.cat((left * background.mean(0, keepdim=True), background[1:]))
        for image in (dead, presses[3].image):
            found = vts.diagnose(dead, image, mini_by_prior)
            assert "contact_in_background" not in found.names
            assert says in next(finding.message for finding in found if finding.name == name)


@pytest.mark.parametrize("share", [0.12, pytest.param(0.5, marks=pytest.mark.long)])
def test_a_dimmer_channel_and_a_darker_image_are_measured_and_cost_nothing(share):
    case = undisturbed(3)
    for factor in ((1.0, 1.0, 1.0 - share), (1.0 - share,) * 3):
        found = vts.diagnose(None, torch.round(case.image * torch.tensor(factor)[:, None, None] * 255) / 255, case.calibration)
        first = next(finding for finding in found if finding.name == "light_changed")
        assert first.severity == "note" and first.value == pytest.approx(share, abs=0.01)
        assert f"blue {1.0 - share:.0%}" in first.message


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_an_empty_image_is_a_fault_and_no_crash(value):
    case = undisturbed(1)
    assert vts.diagnose(None, torch.full_like(case.image, value), case.calibration).findings[0].severity == "fault"


def test_dust_is_no_contact(small_sensor, small_press):
    """Spots of up to a twelfth of the height, at calibration already or since then; a contact is still found."""
    lights, dust = ring_lights(), scenes.skin_spots(120, 160, 10, 0, seed=1)
    undeformed, press = scenes.undeformed(small_press()), small_press(0.5, (3.0, 2.0))

    def seen(scene, worn, seed):
        return scenes.render(scene, lights, noise_std=0.004, bits=8, seed=seed, spots=dust if worn else None)[0]

    for worn in (False, True):
        unit = vts.Calibration.from_lights(lights, small_sensor, seen(undeformed, worn, 1))
        for background, contact in ((None, False), (seen(undeformed, True, 2), False), (seen(press, True, 3), True)):
            names = vts.diagnose(background, seen(press, True, 4), unit).names
            assert "contact_in_calibration" not in names and ("contact_in_background" in names) == contact


def test_the_worst_comes_first_and_each_name_once():
    note, warning, fault = (Finding(name, name, severity, 0.0) for name, severity in zip("abc", ("note", "warning", "fault")))
    again = Finding("c", "milder", "note", 0.0)
    found = Diagnosis.of([note, again, warning, fault])
    assert found.findings == (fault, warning, note) and found.names == ("c", "b", "a") and not found.ok
    assert str(found).splitlines()[0] == "fault: c [c]" and Diagnosis.of([note]).ok
    with pytest.raises(ValueError, match="severity"):
        Finding("x", "x", "grave", 0.0)


def test_the_command_prints_words_and_json(tmp_path, run_script):
    case = undisturbed(2)
    unit, swapped, now = (tmp_path / name for name in ("unit.safetensors", "swapped.png", "now.png"))
    case.calibration.save(unit)
    vts.write_image(swapped, case.image[0, [2, 1, 0]])
    vts.write_image(now, case.background)
    done = run_script("diagnose", unit, swapped)
    assert done.returncode == 1 and "has its channels swapped to the order B, G, R" in done.stdout, done.stderr
    done = run_script("diagnose", unit, swapped, "--background", now, "--json")
    assert json.loads(done.stdout)["findings"][0]["name"] == "channels_swapped"
    done = run_script("diagnose", unit, tmp_path / "none.png")
    assert done.returncode == 2 and done.stderr.startswith("torchvts: error: ")


def test_the_command_sums_up_a_folder(tmp_path, run_script):
    case = undisturbed(2)
    unit, folder = tmp_path / "unit.safetensors", tmp_path / "frames"
    case.calibration.save(unit)
    (folder / "day").mkdir(parents=True)
    (folder / "damaged.png").write_bytes(b"no image")
    for name in ("day/1.png", "day/2.png"):
        vts.write_image(folder / name, case.image[0, [2, 1, 0]])
    vts.write_image(folder / "good.png", case.image[0])
    done = run_script("diagnose", unit, folder)
    first, *rows, last = done.stdout.splitlines()
    assert done.returncode == 1 and first == "4 frames: 1 without a warning or a fault", done.stderr
    assert rows[0].startswith("fault in 2 of 4, such as day/1.png: ") and rows[0].endswith("[channels_swapped]")
    assert any(row.startswith("fault in 1 of 4, such as damaged.png: ") and row.endswith("[unreadable]") for row in rows)
    assert last.startswith("next: ")
    found = json.loads(run_script("diagnose", unit, folder, "--json").stdout)
    assert (found["ok"], found["frames"]) == (False, 4) and found["findings"][0]["frames"] == ["day/1.png", "day/2.png"]
    assert found["findings"][0]["severities"] == {"fault": 2}
    (tmp_path / "empty").mkdir()
    assert "expected images or videos, got none" in run_script("diagnose", unit, tmp_path / "empty").stderr


def test_what_most_frames_have_stands_above_a_worse_finding_of_one(tmp_path, run_script):
    case = undisturbed(2)
    unit, folder = tmp_path / "unit.safetensors", tmp_path / "frames"
    case.calibration.save(unit)
    folder.mkdir()
    (folder / "damaged.png").write_bytes(b"no image")
    rough = (case.image[0] + 0.012 * torch.randn(case.image[0].shape, generator=torch.Generator().manual_seed(0))).clamp(0.0, 1.0)
    for k in range(8):
        vts.write_image(folder / f"{k}.png", rough)
    first, worst, *_ = run_script("diagnose", unit, folder).stdout.splitlines()
    assert first == "9 frames: 0 without a warning or a fault"
    assert worst.startswith("warning in 8 of 9, such as 0.png: ") and worst.endswith("[noise]")


def test_reconstruct_gives_a_finding_as_the_worst_of_its_frames(tmp_path):
    """By a warning of the first frame the fault of the second went unseen, and the exit status was 0."""
    case = undisturbed(2)
    for k, noise_std in enumerate((0.012, 0.1)):
        noise = noise_std * torch.randn(case.image[0].shape, generator=torch.Generator().manual_seed(k))
        vts.write_image(tmp_path / f"{k}.png", (case.image[0] + noise).clamp(0.0, 1.0))
    findings = diagnose_some(case.calibration, [tmp_path], RunReport(0, 2, 0, []), 1)
    assert [(name, finding.severity) for name, finding in findings if finding.name == "noise"] == [("1.png and 1 more", "fault")]


def test_the_command_cuts_raw_frames_as_reconstruct_does(tmp_path, run_script):
    sensor = dataclasses.replace(vts.Sensor.load("gelsight_mini"), prior=None)
    height, width = sensor.raw_size_px[1]
    raw = torch.rand(3, height // 8, width // 8, generator=torch.Generator().manual_seed(0))
    raw = torch.nn.functional.interpolate(0.3 + 0.3 * raw[None], (height, width), mode="bilinear")[0]
    vts.Calibration.from_response(ResponseModel.zero(), sensor, sensor.rectify(raw[None])[0]).save(tmp_path / "unit.safetensors")
    for name, image in (("raw", raw), ("small", raw[:, :50, :60])):
        vts.write_image(tmp_path / f"{name}.png", image)
    assert "wrong_size" not in run_script("diagnose", tmp_path / "unit.safetensors", tmp_path / "raw.png").stdout
    done = run_script("diagnose", tmp_path / "unit.safetensors", tmp_path / "small.png")
    assert done.returncode == 1 and "wrong_size" in done.stdout


@pytest.mark.parametrize("size", [(8, 8), (9, 40), (40, 9)])
def test_the_smallest_sensors_are_diagnosed(ring, size):
    unit = vts.Calibration.from_lights(ring(), vts.Sensor("small", *size, 0.5))
    assert vts.diagnose(None, unit.model_image.detach(), unit).ok


@pytest.mark.filterwarnings("ignore::torchvts.CalibrationWarning")
def test_a_raw_frame_of_the_sensors_size_shows_more_than_the_cropped_background(data):
    """It was called another unit's."""
    images = torch.stack([vts.read_image(file) for file in sorted((data / "gelsight_mini_c").glob("frame_*.jpg"))[::5]])
    assert images.shape[2:] == (240, 320)
    sensor = dataclasses.replace(vts.Sensor.load("gelsight_mini"), roi_px=(46, 34, 228, 172), raw_size_px=())
    background = sensor.rectify(images).median(0).values
    unit = vts.calibrate(background, dataclasses.replace(sensor, roi_px=None))
    assert [finding.name for finding in vts.diagnose(None, sensor.rectify(images)[0], unit) if finding.severity != "note"] == []
    found = list(vts.diagnose(None, images[0], unit))
    assert found[0].name == "other_view" and "shows more than the background, by 14% of each side" in str(found[0])
