"""A calibration on disk."""

import copy
import dataclasses
import json
import pickle

import pytest
import safetensors.torch
import torch
from conftest import refused_when_rewritten

import torchvts as vts

SENSOR = vts.Sensor("rig", 24, 32, 1.25, gamma=1.8)


@pytest.fixture(scope="module")
def calibration(ring):
    lights = ring(gloss=[0.0, 0.1, 0.2])
    rest = vts.scenes.undeformed(vts.scenes.sphere_press(10, 1, (0, 0), 24, 32, 1.25))
    background = vts.scenes.render(rest, lights, noise_std=0.01, bits=8, gamma=1.8)[0]
    return vts.Calibration.from_lights(lights, SENSOR, background, {"model": "point_lights", "note": "Grüße", "figures": [1, 2.5]})


@pytest.fixture
def saved(calibration, tmp_path):
    calibration.save(tmp_path / "unit.safetensors")
    return tmp_path / "unit.safetensors"


def test_a_saved_calibration_loads_bit_for_bit(calibration, saved):
    loaded = vts.Calibration.load(saved)
    assert loaded.sensor == calibration.sensor and loaded.report == calibration.report and loaded.measured is True
    for name in ("background", "noise_std", "inverse", "model_image", "defects"):
        assert torch.equal(getattr(loaded, name), getattr(calibration, name)), name
    for name in ("position_mm", "albedo", "gloss"):
        assert torch.equal(getattr(loaded.lights, name), getattr(calibration.lights, name)), name
    loaded.save(saved.with_name("again.safetensors"))
    assert saved.read_bytes() == saved.with_name("again.safetensors").read_bytes()


def test_double_precision_survives(ring, tmp_path):
    cal = vts.Calibration.from_lights(ring(dtype=torch.float64), SENSOR)
    cal.save(tmp_path / "unit.safetensors")
    loaded = vts.Calibration.load(str(tmp_path / "unit.safetensors"))
    assert loaded.inverse.dtype == torch.float64 and torch.equal(loaded.inverse, cal.inverse) and loaded.measured is False


def no_tensor(name):
    return lambda tensors: tensors.pop(name)


def put(name, value):
    def change(tensors):
        tensors[name] = value(tensors[name].clone())

    return change


def with_nan(tensor):
    tensor.view(-1)[0] = float("nan")
    return tensor


TENSORS = {
    **{f"without {name}": (no_tensor(name), f"tensor '{name}' is missing")
       for name in ("light_position_mm", "light_albedo", "light_gloss", "background", "noise_std")},
    **{f"NaN in {name}": (put(name, with_nan), f"{name}: expected finite values") for name in ("background", "noise_std")},
    "NaN in a position": (put("light_position_mm", with_nan), "position_mm: expected "),
    "no noise": (put("noise_std", lambda t: 0 * t), "noise_std: expected finite values above 0"),
    "another size": (put("background", lambda t: t[:, 1:].contiguous()), r"background: expected .*, got \(3, 23, 32\)"),
    "integers": (put("background", lambda t: t.to(torch.int32)), "background: expected a floating-point image, got torch.int32"),
}  # fmt: skip
METADATA = {
    "a later version": (lambda m: m.update(format_version=99), "expected format version 9, got 99: .*update torchvts"),
    "another kind": (lambda m: m.update(kind="mesh"), "expected a calibration, got a file of kind 'mesh'"),
    "no sensor": (lambda m: m.pop("sensor"), "expected keys and values, got NoneType"),
    "another sensor": (lambda m: m["sensor"].update(height=48), r"background: expected \(3, 48, 32\) .*, got \(3, 24, 32\)"),
    "unknown key of the sensor": (lambda m: m["sensor"].update(colour=1), "key 'colour': unknown"),
    "a share above 1": (lambda m: m.update(contact_share=1.5), "contact_share: expected .*1.5"),
    "a length in um": (lambda m: m.update(contact_decay_mm=450.0), "contact_decay_mm: expected .*450.0"),
    "no word on its background": (lambda m: m.pop("measured"), "measured: expected True or False, got NoneType"),
    "unknown key of the markers": (lambda m: m.update(markers={"colour": 1}), "unexpected keyword argument 'colour'"),
    "no report": (lambda m: m.pop("report"), "report: expected keys and values, got NoneType"),
    "a report without a source": (lambda m: m["report"].pop("source"), "report: source: expected one of given, .*, got None"),
}


@pytest.mark.parametrize("kind", TENSORS)
def test_damaged_tensors_are_refused(saved, kind):
    change, message = TENSORS[kind]
    refused_when_rewritten(saved, message, change_tensors=change)


@pytest.mark.parametrize("kind", METADATA)
def test_damaged_metadata_is_refused(saved, kind):
    change, message = METADATA[kind]
    refused_when_rewritten(saved, message, change_metadata=change)


def test_a_flipped_bit_is_refused(saved):
    """One in the sensor's gamma, 1.8, cost 43 mm of depth on a file without a checksum."""
    content = saved.read_bytes()
    place = content.index(b"1.8", content.index(b"gamma")) + 2
    for other in b"0123456790":
        saved.write_bytes(content[:place] + bytes([other]) + content[place + 1 :])
        with pytest.raises(ValueError, match=r"unit\.safetensors: damaged: its content is not what the checksum says"):
            vts.Calibration.load(saved)
    tensors, metadata = load_tensors_unchecked(content)
    safetensors.torch.save_file(tensors, str(saved), {"torchvts": json.dumps(metadata)})
    with pytest.raises(ValueError, match=r"unit\.safetensors: it has no checksum: written by another torchvts"):
        vts.Calibration.load(saved)


def load_tensors_unchecked(content):
    length = int.from_bytes(content[:8], "little")
    metadata = json.loads(json.loads(content[8 : 8 + length])["__metadata__"]["torchvts"])
    metadata.pop("checksum")
    return safetensors.torch.load(content), metadata


@pytest.mark.parametrize(
    "metadata, message",
    [
        ("none", "not a safetensors file, or cut short"),
        (None, "a safetensors file, but not one written by torchvts"),
        ({"format": "pt"}, "a safetensors file, but not one written by torchvts"),
        ({"torchvts": "{"}, "its metadata is damaged"),
        ({"torchvts": "[1]"}, "its metadata is damaged"),
    ],
)
def test_a_foreign_file_is_refused(tmp_path, metadata, message):
    path = tmp_path / "unit.safetensors"
    if metadata == "none":
        path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(100))
    else:
        safetensors.torch.save_file({"weight": torch.zeros(3)}, str(path), metadata)
    with pytest.raises(ValueError, match=message) as caught:
        vts.Calibration.load(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_a_report_that_json_cannot_hold_leaves_the_old_file(calibration, saved):
    before = saved.read_bytes()
    broken = vts.Calibration.from_lights(calibration.lights, SENSOR, None, {"figure": float("nan")})
    with pytest.raises(ValueError, match="JSON"):
        broken.save(saved)
    assert saved.read_bytes() == before
    assert [path.name for path in saved.parent.iterdir()] == [saved.name]


def test_a_new_file_replaces_the_old_and_keeps_its_mode(calibration, saved):
    saved.chmod(0o640)
    vts.Calibration.from_lights(calibration.lights, SENSOR).save(saved)
    assert vts.Calibration.load(saved).measured is False
    assert saved.stat().st_mode & 0o777 == 0o640


def test_known_lights_need_no_image(ring):
    cal = vts.Calibration.from_lights(ring(), SENSOR)
    assert cal.measured is False and torch.equal(cal.background, cal.model_image) and not bool(cal.defects.any())
    assert cal.noise_std.tolist() == pytest.approx([0.003] * 3)


def test_the_noise_of_the_background_is_measured(calibration):
    assert calibration.noise_std.tolist() == pytest.approx([0.01] * 3, rel=0.2)
    # in light: the slope of value^1.8
    expected = 1.8 * calibration.background ** (0.8 / 1.8) * calibration.noise_std.reshape(3, 1, 1)
    assert torch.allclose(calibration.light_noise_std, expected, rtol=1e-4)


def test_lights_of_a_calibration_are_a_frozen_copy(ring):
    lights = ring().requires_grad_(True)
    cal = vts.Calibration.from_lights(lights, SENSOR)
    assert not any(parameter.requires_grad for parameter in cal.lights.parameters())
    with torch.no_grad():
        lights.albedo.zero_()
    assert float(cal.lights.albedo.min()) > 0


def test_derived_arrays_are_computed_once_and_anew_for_a_changed_calibration(calibration):
    for name in ("model_image", "gain", "inverse", "defects", "flat", "saturated_above"):
        assert getattr(calibration, name) is getattr(calibration, name), name
    brighter = dataclasses.replace(calibration, background=2.0 * calibration.background)
    assert not torch.equal(brighter.gain, calibration.gain) and "gain" not in pickle.loads(pickle.dumps(calibration)).__dict__
    assert torch.equal(copy.deepcopy(calibration).gain, calibration.gain)


def test_a_report_says_where_the_model_comes_from(calibration):
    assert calibration.report["source"] == "given" and calibration.report["note"] == "Grüße"
    with pytest.raises(ValueError, match=r"report: source: expected one of given, .*, got 'elsewhere'"):
        vts.Calibration.from_lights(calibration.lights, SENSOR, None, {"source": "elsewhere"})
