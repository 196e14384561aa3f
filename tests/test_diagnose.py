"""Diagnoses: seeded faults are found, clean frames raise no alarm, real units are distinguished.

All corruptions of the gallery at middle severity, 20 seeds each, as docs/diagnose.md has them:
python tests/test_diagnose.py --seeds 20
"""

import argparse
import dataclasses
import functools
import itertools
import json
import warnings

import pytest
import torch

import torchvts as vts
from lab.faults import jpeg
from lab.gallery import CORRUPTIONS, undisturbed
from torchvts import scenes
from torchvts.diagnose import Diagnosis, Finding
from torchvts.diagnose.camera import blockiness, levels_of
from torchvts.model.response_field import ResponseModel

NAMED = {
    "deeper press": {"deep_press"},
    "steep walls": {"steep_walls"},
    "cut ends": {"steep_walls"},
    "cut by the border": {"contact_at_border"},
    "covers the image": {"contact_covers_image", "no_free_skin"},
    "two contacts": {"several_contacts"},
    "faint contact": {"faint_contact", "no_contact"},
    "gel sag": {"transition_zone"},
    "attached shadows": {"shadow"},
    "cast shadows": {"cast_shadow"},
    "specular": {"specular"},
    "inter-reflection": {"inter_reflection"},
    "ambient light": {"ambient_light"},
    "a channel dims": {"channel_level"},
    "dead lights": {"led_failed"},
    "a light moves": {"light_moved"},
    "lights close together": {"lights_coplanar"},
    "albedo drift": {"skin_changed"},
    "spots and dead pixels": {"new_spots"},
    "markers": {"markers"},
    "defocus": {"blurred"},
    "motion blur": {"moved"},
    "vignetting": {"vignetting"},
    "lens distortion": {"lens_distortion"},
    "perspective": {"perspective"},
    "wrong pitch": {"wrong_pitch"},
    "saturation": {"saturated"},
    "black crush": {"black_level"},
    "wrong gamma": {"gamma"},
    "channel order": {"channels_mixed", "channels_swapped"},
    "noise": {"noise"},
    "few bits": {"few_bits"},
    "JPEG": {"compressed"},
}
"""Corruption -> findings that name it."""

NEVER_HARMLESS = {"two contacts", "markers", "JPEG"}
"""Corruptions whose first severity is no clean image, such as a JPEG, which halves the resolution of colours."""


def middle(corruption):
    return corruption.severities[len(corruption.severities) // 2]


def named(name, seed):
    case = CORRUPTIONS[name].make(middle(CORRUPTIONS[name]), seed)
    found = vts.diagnose(case.background, case.image, case.calibration)
    return bool(NAMED[name] & set(found.names)), found


def test_a_mirrored_image_is_named_and_nothing_else():
    y, x = torch.meshgrid(torch.linspace(-1, 1, 96), torch.linspace(-1, 1, 128), indexing="ij")
    background = torch.stack((0.5 + 0.3 * x, 0.5 + 0.3 * y, 0.5 - 0.2 * x + 0.1 * y))
    background = background + 0.002 * torch.randn(background.shape, generator=torch.Generator().manual_seed(1))
    unit = vts.Calibration.from_response(ResponseModel.zero(), vts.Sensor("rig", 96, 128, 0.1), background)
    found = vts.diagnose(None, background.flip(2), unit)
    assert found.names == ("other_view",) and not found.ok and "is mirrored left to right: " in str(found)
    assert "other_view" not in vts.diagnose(None, background.flip(0), unit).names  # channels_swapped names it


@pytest.mark.parametrize("name", NAMED)
def test_every_fault_of_the_gallery_is_named(name):
    hit, found = named(name, seed=7)
    assert hit, str(found)


@functools.cache
def diagnosis_of(key):
    """The diagnosis of a case of :data:`CASES`; most corruptions of no severity are one and the same image."""
    case = CASES[key]
    return vts.diagnose(case.background, case.image, case.calibration)


CASES = {}


@pytest.mark.parametrize("name", [name for name in NAMED if name not in NEVER_HARMLESS])
def test_findings_come_from_the_fault_and_from_nothing_else(name):
    """A corruption of no severity is not found."""
    case = CORRUPTIONS[name].make(CORRUPTIONS[name].severities[0], 7)
    unit = case.calibration
    tensors = (case.background, case.image, unit.background, unit.lights.position_mm.detach(), unit.lights.albedo.detach())
    key = (*(hash(tensor.numpy().tobytes()) for tensor in tensors), repr(unit.sensor), repr(unit.report), repr(unit.markers))
    CASES[key] = case
    found = diagnosis_of(key)
    assert found.ok and not NAMED[name] & set(found.names), str(found)


def test_perspective_is_known_from_the_calibration_only():
    case = CORRUPTIONS["perspective"].make(20.0, 0)
    without = dataclasses.replace(case.calibration, report={"model": "point_lights", "source": "given"})
    assert vts.diagnose(case.background, case.image, without).findings == ()
    assert vts.diagnose(case.background, case.image, case.calibration).names == ("perspective",)


CLEAN = {
    "ball": lambda k: scenes.sphere_press(10.0, 1.0, **k),
    "ball aside": lambda k: scenes.sphere_press(5.0, 0.5, (8.0, -6.0), **k),
    "cylinder": lambda k: scenes.cylinder_press(**k),
    "cone": lambda k: scenes.cone_press(**k),
    "sine": lambda k: scenes.sine_press(**k),
    "punch": lambda k: scenes.punch_press(**k),
    "letters": lambda k: scenes.letters_press(**k),
}


@pytest.mark.parametrize("fitted", [False, True])
def test_clean_frames_of_any_object_raise_no_alarm(ring, small_sensor, fitted):
    size = {"height": 120, "width": 160, "mm_per_pixel": 0.25}
    lights = ring(rotation_deg=40.0, level=0.4)
    sensor = small_sensor if fitted else vts.Sensor("rig", 120, 160, 0.25, gamma=1.0)
    undeformed = scenes.undeformed(CLEAN["ball"](size))
    background = scenes.render(undeformed, lights, noise_std=0.003, bits=8, seed=1)[0]
    unit = vts.calibrate(background, sensor) if fitted else vts.Calibration.from_lights(lights, sensor, background)
    for k, (name, press) in enumerate(list(CLEAN.items())[:: 3 if fitted else 1]):
        image = scenes.render(press(size), lights, noise_std=0.003, bits=8, seed=2 + k)
        found = vts.diagnose(background if k % 2 else None, image, unit)
        assert found.ok, f"{name}: {found}"
    found = vts.diagnose(None, scenes.render(undeformed, lights, noise_std=0.003, bits=8, seed=20), unit)
    assert found.names == ("no_contact",)


@pytest.mark.parametrize("spots", [10, *(pytest.param(n, marks=pytest.mark.long) for n in (2, 40))])
def test_dust_is_no_contact(ring, small_sensor, small_press, spots):
    """Spots of up to a twelfth of the height, at calibration already or since then; a contact is still found."""
    lights, dust = ring(), vts.scenes.skin_spots(120, 160, spots, 0, seed=1)
    undeformed, press = vts.scenes.undeformed(small_press()), small_press(0.5, (3.0, 2.0))
    images = {
        (scene, worn): vts.scenes.render(scene, lights, noise_std=0.004, bits=8, seed=k, spots=dust if worn else None)
        for k, (scene, worn) in enumerate(itertools.product((undeformed, press), (False, True)))
    }
    for worn in (False, True):
        calibration = vts.Calibration.from_lights(lights, small_sensor, images[undeformed, worn][0])
        for background, contact in ((None, False), (images[undeformed, True][0], False), (images[press, True][0], True)):
            names = vts.diagnose(background, images[press, True], calibration).names
            assert "contact_in_calibration" not in names and ("contact_in_background" in names) == contact
    begun = vts.Calibration.from_lights(lights, small_sensor, images[press, False][0])
    assert "contact_in_calibration" in vts.diagnose(None, images[press, False], begun).names


@pytest.mark.parametrize("share", [0.05, 0.12, 0.3])
def test_a_dimmer_channel_is_measured(share):
    case = undisturbed(3)
    factor = torch.tensor([1.0, 1.0, 1.0 - share]).reshape(3, 1, 1)
    first = vts.diagnose(None, torch.round(case.image * factor * 255) / 255, case.calibration).findings[0]
    assert first.name == "channel_level" and first.severity != "note"
    assert first.value == pytest.approx(-share, abs=0.005)
    assert "blue channel" in first.message and "degrees" in first.message


def test_the_cost_in_degrees_is_that_of_the_pipeline():
    case = undisturbed(3)
    dim = case.image * torch.tensor([1.0, 1.0, 0.88]).reshape(3, 1, 1)
    message = vts.diagnose(None, dim, case.calibration).findings[0].message
    claimed = float(message.split("accept ")[1].split(" degrees")[0])
    normals, compensate = (
        vts.NormalFromIntensity.from_calibration(case.calibration),
        vts.Compensate.from_calibration(case.calibration),
    )
    cosine = (normals(compensate(case.image)) * normals(compensate(dim))).sum(1).clamp(-1, 1)
    angle = torch.rad2deg(torch.arccos(cosine))
    assert float(angle.mean()) - 0.1 < claimed < float(angle.max())


@pytest.mark.parametrize("order", [(2, 1, 0), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1)])
def test_every_wrong_order_of_channels_is_seen(order):
    case = undisturbed(1)
    assert vts.diagnose(None, case.image[:, list(order)], case.calibration).findings[0].name == "channels_swapped"


def test_contact_in_the_background_and_at_calibration():
    case, other = undisturbed(1), CORRUPTIONS["cut by the border"].make(8.0, 2)
    assert "contact_in_background" in vts.diagnose(other.image[0], case.image, case.calibration).names
    unit = vts.Calibration.from_lights(case.calibration.lights, case.calibration.sensor, other.image[0])
    assert "contact_in_calibration" in vts.diagnose(None, case.image, unit).names


def test_a_background_of_now_shows_the_same_as_the_image():
    case = undisturbed(1)
    factor = torch.tensor([0.9, 1.0, 1.0]).reshape(3, 1, 1)
    found = vts.diagnose(case.background * factor, case.image * factor, case.calibration)
    assert found.findings[0].name == "channel_level" and found.names.count("channel_level") == 1


def test_another_size_is_a_finding_and_another_shape_an_error():
    case = undisturbed(1)
    found = vts.diagnose(None, case.image[..., :100], case.calibration)
    assert found.names == ("wrong_size",) and not found.ok
    with pytest.raises(ValueError, match="image: expected"):
        vts.diagnose(None, case.image[:, :2], case.calibration)
    with pytest.raises(ValueError, match="divide by 255"):
        vts.diagnose(None, case.image * 255, case.calibration)
    with pytest.raises(TypeError, match="background: expected a torch"):
        vts.diagnose([1], case.image, case.calibration)
    with pytest.raises(TypeError, match="divide by 255"):
        vts.diagnose(None, (case.image * 255).to(torch.uint8), case.calibration)
    with pytest.raises(TypeError, match="calibration: expected"):
        vts.diagnose(None, case.image, "unit.safetensors")


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_an_empty_image_is_a_fault_and_no_crash(value):
    case = undisturbed(1)
    found = vts.diagnose(None, torch.full_like(case.image, value), case.calibration)
    assert found.findings[0].severity == "fault", str(found)


def test_without_a_background_there_is_no_alarm(ring, small_sensor, small_press):
    unit = vts.Calibration.from_lights(ring(), small_sensor)
    assert vts.diagnose(None, scenes.render(small_press(), ring(), noise_std=0.002, bits=8), unit).ok


def test_levels_and_blocks():
    smooth = torch.linspace(0.2, 0.8, 128).expand(3, 96, 128) + 0.002 * torch.randn(
        3, 96, 128, generator=torch.Generator().manual_seed(0)
    )
    for bits in (3, 5, 8):
        assert levels_of(torch.round(smooth * (2**bits - 1)) / (2**bits - 1)) == 2**bits - 1
    assert levels_of(smooth) == float("inf")
    assert blockiness(smooth) < 1.1 < 1.3 < blockiness(jpeg(smooth[None], 60)[0])


def test_the_worst_comes_first_and_each_name_once():
    note, warning, fault = (Finding(name, name, severity, 0.0) for name, severity in zip("abc", ("note", "warning", "fault")))
    again = Finding("c", "milder", "note", 0.0)
    found = Diagnosis.of([note, again, warning, fault])
    assert found.findings == (fault, warning, note) and found.names == ("c", "b", "a") and not found.ok
    assert str(found).splitlines()[0] == "fault: c [c]" and Diagnosis.of([note]).ok
    with pytest.raises(ValueError, match="severity"):
        Finding("x", "x", "grave", 0.0)


def test_the_script_prints_words_and_json(tmp_path, run_script):
    case = undisturbed(2)
    unit, swapped, now = (tmp_path / name for name in ("unit.safetensors", "swapped.png", "now.png"))
    case.calibration.save(unit)
    vts.write_image(swapped, case.image[0, [2, 1, 0]])
    vts.write_image(now, case.background)
    done = run_script("diagnose", unit, swapped)
    assert done.returncode == 1 and "channels look swapped (red and blue)" in done.stdout, done.stderr
    done = run_script("diagnose", unit, swapped, "--background", now, "--json")
    assert json.loads(done.stdout)["findings"][0]["name"] == "channels_swapped"
    done = run_script("diagnose", unit, tmp_path / "none.png")
    assert done.returncode == 2 and done.stderr.startswith("torchvts: error: ")


@pytest.fixture(scope="module")
def other_mini(data):
    """Background, an image of a bead, and the calibration of a second GelSight Mini."""
    background, bead = (vts.read_image(data / "gelsight_mini_b" / f"{name}.png") for name in ("background", "bead"))
    return background, bead, vts.calibrate(background, vts.Sensor.load("gelsight_mini"))


def test_real_presses_raise_no_alarm(mini_presses, mini_by_prior, other_mini):
    background, presses = mini_presses
    for press in presses[1::12]:
        found = vts.diagnose(background, press.image, mini_by_prior)
        assert found.ok, f"{press.name}: {found}"
    assert vts.diagnose(*other_mini).ok


def test_real_faults_are_found(mini_presses, mini_by_prior, other_mini):
    image = mini_presses[1][7].image
    assert vts.diagnose(None, other_mini[1], mini_by_prior).names[0] == "other_unit"
    assert not vts.diagnose(None, image, other_mini[2]).ok
    assert vts.diagnose(None, image[[2, 1, 0]], mini_by_prior).names[0] == "channels_swapped"
    found = vts.diagnose(None, image * torch.tensor([1.0, 1.0, 0.88]).reshape(3, 1, 1), mini_by_prior)
    assert found.names[0] == "channel_level" and found.findings[0].value == pytest.approx(-0.12, abs=0.02)
    assert "contact_in_background" in vts.diagnose(image, mini_presses[1][20].image, mini_by_prior).names


@pytest.mark.long
def test_a_real_unit_calibrated_by_presses_raises_no_alarm(mini_presses):
    background, presses = mini_presses
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", vts.CalibrationWarning)
        unit = vts.calibrate(background, vts.Sensor.load("gelsight_mini"), presses[::8])
    found = vts.diagnose(background, presses[5].image, unit)
    assert found.ok, str(found)


@pytest.mark.long
def test_a_real_contact_in_the_calibration_image_is_found(mini_presses):
    presses = mini_presses[1]
    with pytest.warns(vts.CalibrationWarning, match="contact in the calibration image"):
        unit = vts.calibrate(presses[20].image, vts.Sensor.load("gelsight_mini"))
    assert "contact_in_calibration" in vts.diagnose(None, presses[7].image, unit).names


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--corruptions", nargs="+", default=list(CORRUPTIONS))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    hits = total = 0
    for name in arguments.corruptions:
        beside: dict[str, int] = {}
        right = 0
        for seed in range(arguments.seeds):
            hit, found = named(name, seed)
            right += hit
            for finding in found:
                if finding.name not in NAMED[name] and finding.severity != "note":
                    beside[finding.name] = beside.get(finding.name, 0) + 1
        severity = f"{middle(CORRUPTIONS[name]):g} {CORRUPTIONS[name].unit}"
        print(f"| {name} | {severity} | {right}/{arguments.seeds} | {beside or ''} |", flush=True)
        hits, total = hits + right, total + arguments.seeds
    clean = [vts.diagnose(c.background, c.image, c.calibration) for c in map(undisturbed, range(100, 100 + arguments.seeds))]
    print(
        f"named {hits} of {total} ({hits / total:.1%}); false alarms on clean frames {sum(not d.ok for d in clean)} of {len(clean)}"
    )


if __name__ == "__main__":
    main()


def test_a_contact_over_the_whole_skin_is_not_taken_for_other_light():
    smooth = CORRUPTIONS["covers the image"].make(2.2, 3)
    assert "no_free_skin" in vts.diagnose(smooth.background, smooth.image, smooth.calibration).names
    size = {"height": 120, "width": 160, "mm_per_pixel": 0.125}
    waves = scenes.surface(lambda x, y: 1.0 + 0.15 * torch.sin(2.1 * x) * torch.sin(1.7 * y), **size)
    image = scenes.render(waves, smooth.calibration.lights, noise_std=0.002, bits=8, seed=1)
    found = vts.diagnose(smooth.background, image, smooth.calibration)
    assert found.names[0] == "no_free_skin" and "channel_level" not in found.names, str(found)
