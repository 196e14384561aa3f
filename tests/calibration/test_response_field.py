"""Response fields by themselves, as normals, in files and in a sensor's YAML; the blur they are used under."""

import dataclasses
import itertools
import json

import cv2
import kornia
import numpy as np
import pytest
import torch
import yaml
from conftest import refused_when_rewritten, rewritten

import torchvts as vts
from lab.prior import fit_log_background
from torchvts.calibration.response_fit import STEEPER
from torchvts.core.blur import gaussian_weights
from torchvts.core.geometry import gradient_from_normal, gradient_of_depth
from torchvts.model.response_field import (
    MAX_SLOPE,
    DepthBrightness,
    ResponseField,
    ResponseModel,
    SensorPrior,
    sine_from_slope,
    slope_from_sine,
)
from torchvts.normals import NormalFromResponse

FAMILIES = [(0, -1), (1, -1), (2, 1), (1, 2), (3, 3), (2, 1, 0), (1, 0, 1), (1, -1, 2)]
CHANGE_SCALE = 0.3  # stated in the definition
PAIRS = [(i, k) for i in range(3) for k in range(i, 3)]
TRIPLES = [(i, k, m) for i, k in PAIRS for m in range(k, 3)]


def count_by_hand(degree, product_degree, cubic_degree=-1):
    monomials = [(d + 1) * (d + 2) // 2 for d in (degree, product_degree, cubic_degree)]  # of degree -1: none
    return 3 * monomials[0] + 6 * monomials[1] + 10 * monomials[2]


def random_rows(rows, count, size, seed):
    """Numbers of six digits, which plain text keeps."""
    numbers = torch.randn(rows, count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * size
    return tuple(tuple(float(f"{v:.6g}") for v in row) for row in numbers.tolist())


def random_field(degree, product_degree, cubic_degree=-1, half_mm=9.0, size=0.1, seed=0):
    rows = random_rows(2, count_by_hand(degree, product_degree, cubic_degree), size, seed)
    return ResponseField(degree, product_degree, half_mm, rows, cubic_degree)


def random_by_depth(degree=2, half_mm=9.0, size=0.1, seed=1):
    return DepthBrightness(degree, half_mm, random_rows(3, (degree + 1) * (degree + 2) // 2, size, seed))


def polynomial_by_hand(numbers, degree, row, column, height, width, pitch, half_mm):
    u, v = ((place - (size - 1) / 2) * pitch / half_mm for place, size in ((column, width), (row, height)))
    return sum(next(numbers) * u**i * v**j for i in range(degree + 1) for j in range(degree + 1 - i))


def maps_by_hand(field, height, width, pitch):
    """W_t(x, y) from the definition, pixel by pixel: (terms, 2, H, W)."""
    groups = ((field.degree, 3), (field.product_degree, len(PAIRS)), (field.cubic_degree, len(TRIPLES)))
    degrees = [degree for degree, count in groups if degree >= 0 for _ in range(count)]
    out = np.zeros((len(degrees), 2, height, width))
    for row in range(height):
        for column in range(width):
            for axis in range(2):
                numbers = iter(field.coefficient[axis])
                for term, degree in enumerate(degrees):
                    place = (row, column, height, width, pitch, field.half_mm)
                    out[term, axis, row, column] = polynomial_by_hand(numbers, degree, *place)
    return out


def sine_by_hand(field, change, pitch):
    """Sine from the definition: change (3, H, W) to (2, H, W)."""
    terms = [channel / CHANGE_SCALE for channel in change]
    if field.product_degree >= 0:
        terms += [terms[i] * terms[k] for i, k in PAIRS]
    if field.cubic_degree >= 0:
        terms += [terms[i] * terms[k] * terms[m] for i, k, m in TRIPLES]
    maps = maps_by_hand(field, *change.shape[1:], pitch)
    assert len(terms) == len(maps)
    return sum(map_of_term * term for map_of_term, term in zip(maps, terms))


def per_mm_by_hand(by_depth, height, width, pitch):
    out = np.zeros((3, height, width))
    for channel, row, column in np.ndindex(*out.shape):
        place = (row, column, height, width, pitch, by_depth.half_mm)
        out[channel, row, column] = polynomial_by_hand(iter(by_depth.coefficient[channel]), by_depth.degree, *place)
    return out


def model(gamma=1.0, blur_px=1.0, **kwargs):
    return ResponseModel(random_field(2, 1, **kwargs), random_by_depth(), gamma, blur_px)


# the field


@pytest.mark.parametrize("family", FAMILIES)
def test_maps_are_those_of_the_definition(family):
    field = random_field(*family, half_mm=0.9)
    assert field.maps(5, 7, 0.3).numpy() == pytest.approx(maps_by_hand(field, 5, 7, 0.3), abs=1e-12)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_maps_of_depth_are_those_of_the_definition(degree):
    by_depth = random_by_depth(degree, half_mm=0.9)
    assert by_depth.maps(5, 7, 0.3).numpy() == pytest.approx(per_mm_by_hand(by_depth, 5, 7, 0.3), abs=1e-12)


@pytest.mark.parametrize("family", FAMILIES)
def test_a_larger_family_holds_the_same_field(family):
    field = random_field(*family, half_mm=2.0)
    for larger in ((3, 3, 2), (4, 5, 3)):
        larger_field = field.embedded(*larger)
        degrees = (larger_field.degree, larger_field.product_degree, larger_field.cubic_degree)
        assert (*degrees, larger_field.half_mm) == (*larger, 2.0)
        maps, old = dict(zip(larger_field.terms(), larger_field.maps(6, 8, 0.5))), dict(zip(field.terms(), field.maps(6, 8, 0.5)))
        for term, values in maps.items():
            expected = old.get(term, torch.zeros(2, 6, 8, dtype=torch.float64))
            assert torch.allclose(values, expected, rtol=0, atol=1e-12), term


@pytest.mark.parametrize("scale", [0.0, 0.1, 1.0, 3.0])
def test_slope_and_sine_are_those_of_one_angle(scale):
    slope = scale * torch.randn(2, 50, generator=torch.Generator().manual_seed(1), dtype=torch.float64).clamp(-0.6, 0.6)
    sine, length = sine_from_slope(slope), slope.norm(dim=0)
    assert torch.allclose(sine.norm(dim=0), torch.sin(torch.atan(length)), atol=1e-12)
    assert torch.allclose(slope_from_sine(sine), slope, atol=1e-9)


def test_a_sine_beyond_the_steepest_counts_as_the_steepest():
    slope = slope_from_sine(torch.tensor([[0.0, 3.0], [2.0, -4.0]], dtype=torch.float64))
    assert slope.norm(dim=0).tolist() == pytest.approx([MAX_SLOPE, MAX_SLOPE])
    assert slope[:, 1].tolist() == pytest.approx([0.6 * MAX_SLOPE, -0.8 * MAX_SLOPE])


@pytest.mark.parametrize("family", FAMILIES)
def test_a_field_survives_plain_text(family):
    field = random_field(*family)
    assert ResponseField.from_dict(json.loads(json.dumps(field.to_dict())), "file") == field
    assert ResponseField.from_dict(yaml.safe_load(yaml.safe_dump(field.to_dict())), "file") == field
    by_depth = random_by_depth(seed=3)
    assert DepthBrightness.from_dict(json.loads(json.dumps(by_depth.to_dict())), "file") == by_depth


def test_a_field_of_any_numbers_survives_to_seven_digits():
    fine = ResponseField(0, -1, 1 / 3, ((1 / 3, 2 / 3, -1e-9 / 7), (1e9 / 7, 0, 1)))
    again = ResponseField.from_dict(fine.to_dict(), "file")
    assert torch.allclose(again.tensor(), fine.tensor(), rtol=1e-6, atol=0)
    assert again.to_dict() == fine.to_dict()


REST = {"degree": 0, "product_degree": -1, "half_mm": 1.0, "coefficient": [[0, 0, 0], [0, 0, 0]]}
BAD_FIELDS = {
    "degree too high": ({"degree": 7}, "degree: expected at most 6, got 7"),
    "degree below zero": ({"degree": -1}, "degree: expected at least 0, got -1"),
    "no scale": ({"half_mm": 0}, "half_mm: expected a number above 0"),
    "one row": ({"coefficient": [[0, 0, 0]]}, "coefficient: expected 2 x 3 numbers"),
    "ragged rows": ({"coefficient": [[0] * 3, [0] * 4]}, "coefficient: expected 2 x 3 numbers"),
    "NaN": ({"coefficient": [[0, 0, float("nan")], [0, 0, 0]]}, "coefficient: expected finite numbers"),
}


@pytest.mark.parametrize("kind", BAD_FIELDS)
def test_a_bad_field_is_refused_by_name(kind):
    change, message = BAD_FIELDS[kind]
    with pytest.raises((ValueError, TypeError), match=f"^{message}"):
        ResponseField(**(REST | change))
    with pytest.raises(ValueError, match=f"^unit.yaml: key {message}"):
        ResponseField.from_dict(REST | change, "unit.yaml")


def test_unknown_and_missing_keys_are_named():
    with pytest.raises(ValueError, match=r"^unit.yaml: key 'colour': unknown; expected degree, product_degree"):
        ResponseField.from_dict(REST | {"colour": 1}, "unit.yaml")
    for key in REST:
        with pytest.raises(ValueError, match=f"^unit.yaml: key '{key}': missing"):
            ResponseField.from_dict({k: v for k, v in REST.items() if k != key}, "unit.yaml")
    for kind, values in itertools.product((ResponseField, ResponseModel, SensorPrior), ([1], None, "field")):
        with pytest.raises(ValueError, match=r"^unit\.yaml: expected keys and values, got"):
            kind.from_dict(values, "unit.yaml")


def test_a_model_wants_its_parts_in_their_places():
    shallow, deep = random_field(1, -1), random_by_depth(1)
    with pytest.raises(TypeError, match="field: expected a ResponseField"):
        ResponseModel(deep, None)
    with pytest.raises(TypeError, match="by_depth: expected a DepthBrightness or None"):
        ResponseModel(shallow, shallow)
    for name in ("steeper", "reference_mm"):
        for value in (-0.1, float("nan"), float("inf")):
            with pytest.raises(ValueError, match=f"{name}: expected a number of at least 0"):
                DepthBrightness(0, 1.0, ((0.0,),) * 3, **{name: value})
    with pytest.raises(ValueError, match="degree: expected at most 2, got 3"):
        DepthBrightness(3, 1.0, ((0.0,) * 10,) * 3)
    with pytest.raises(ValueError, match="coefficient: expected 3 x 3 numbers"):
        DepthBrightness(1, 1.0, ((0.0,) * 6,) * 3)
    with pytest.raises(ValueError, match="gamma: expected a number in"):
        ResponseModel(shallow, deep, gamma=11)
    with pytest.raises(ValueError, match="blur_px: expected a number above 0 and finite"):
        ResponseModel(shallow, deep, blur_px=-1)
    assert ResponseModel.from_dict(json.loads(json.dumps(model(2.2, 0).to_dict())), "file") == model(2.2, 0)
    assert ResponseModel.from_dict(ResponseModel(shallow, None).to_dict(), "file") == ResponseModel(shallow, None)


# normals


def normals(uses_depth=True, dtype=torch.float64, height=6, width=7, pitch=0.4, size=0.1, family=(2, 1)):
    field = random_field(*family, half_mm=1.4, size=size)
    by_depth = random_by_depth(2, 1.4, 0.03) if uses_depth else None
    return field, by_depth, vts.NormalFromResponse(field, by_depth, height, width, pitch, dtype)


def random_image(batch=2, height=6, width=7, spread=0.2):
    numbers = torch.rand(batch, 4, height, width, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    return 1.0 + spread * (2.0 * numbers[:, :3] - 1.0), numbers[:, 3:] - 0.2  # some depths below the undeformed skin too


def test_an_unchanged_image_has_slope_zero_exactly():
    _, _, block = normals()
    for depth in (None, torch.zeros(1, 1, 6, 7, dtype=torch.float64)):
        normal = block(torch.ones(1, 3, 6, 7, dtype=torch.float64), depth)
        assert torch.equal(normal[:, :2], torch.zeros_like(normal[:, :2]))
        assert torch.equal(normal[:, 2], torch.ones_like(normal[:, 2]))


@pytest.mark.parametrize("with_depth", [False, True])
@pytest.mark.parametrize("family", [(2, 1), (2, 1, 0), (1, -1, 1)])
def test_normals_have_the_sines_of_the_definition(family, with_depth):
    field, by_depth, block = normals(family=family)
    image, depth = random_image()
    normal = block(image, depth if with_depth else None)
    assert torch.allclose(normal.norm(dim=1), torch.ones(2, 6, 7, dtype=torch.float64), atol=1e-12)
    for b in range(2):
        change = image[b].numpy() - 1.0
        if with_depth:
            change = change - per_mm_by_hand(by_depth, 6, 7, 0.4) * depth[b].numpy()
        expected = sine_by_hand(field, change, 0.4)
        assert np.hypot(*expected).max() < 0.9  # nothing is cut
        assert -normal[b, :2].numpy() == pytest.approx(expected, abs=1e-9)


def test_a_flat_skin_at_a_depth_is_flat_in_the_second_pass():
    _, by_depth, block = normals()
    image = 1.0 + 0.7 * by_depth.maps(6, 7, 0.4)[None]
    assert float(block(image)[:, :2].abs().max()) > 1e-3
    assert float(block(image, torch.full((1, 1, 6, 7), 0.7, dtype=torch.float64))[:, :2].abs().max()) < 1e-12


def test_steepness_is_bounded_and_its_direction_kept():
    field, _, block = normals(size=1.0)
    image, _ = random_image(spread=0.9)
    normal = block(image)
    expected = np.stack([sine_by_hand(field, one.numpy() - 1.0, 0.4) for one in image])
    length, found = np.hypot(expected[:, 0], expected[:, 1]), gradient_from_normal(normal, 1e9).norm(dim=1).numpy()
    assert length.max() > 2.0 and found.max() == pytest.approx(MAX_SLOPE)
    direction = -normal[:, :2].numpy() / np.hypot(*normal[:, :2].numpy().swapaxes(0, 1))[:, None]
    assert direction == pytest.approx(expected / length[:, None], abs=1e-9)


def brightness_under_lights(slope, depth_mm, lights_mm):
    """Relative change of brightness (1, 3, 1, N) of matt skin of slopes (2, N) at the image's middle, by eq. 1 of the paper."""
    towards = lights_mm[:, :, None] - torch.tensor([0.0, 0.0, depth_mm])[:, None]  # (3, 3, 1)
    facing = towards[:, 2] - (towards[:, :2] * slope).sum(1)  # (3, N)
    normal = (1.0 + slope.square().sum(0)).sqrt()
    light = facing / normal / towards.norm(dim=1) ** 3
    return (light / (lights_mm[:, 2] / lights_mm.norm(dim=1) ** 3)[:, None])[None, :, None]


@pytest.mark.parametrize(("out", "high"), [(1.2, 0.6), (1.3, 1.0), (1.6, 1.4)])
def test_slopes_deeper_than_the_presses_are_not_too_steep(out, high):
    # lights that stand `out` half images out and `high` half images high; a linear field fitted to slopes at 0.3 mm
    half, shallow, deep = 10.0, 0.3, 1.5
    angle = torch.tensor([0.0, 120.0, 240.0]).deg2rad()
    lights = half * torch.stack((out * angle.cos(), out * angle.sin(), torch.full((3,), high)), 1)
    slope = 0.3 * torch.randn(2, 400, generator=torch.Generator().manual_seed(1))
    sine, flat = sine_from_slope(slope), torch.zeros(2, 1)
    change = lambda depth: (brightness_under_lights(slope, depth, lights) - 1.0)[0, :, 0]  # noqa: E731
    per_mm = (brightness_under_lights(flat, shallow, lights) - 1.0).flatten() / shallow
    inputs = (change(shallow) - per_mm[:, None] * shallow) / CHANGE_SCALE
    field = ResponseField(0, -1, half, tuple(map(tuple, torch.linalg.lstsq(inputs.t(), sine.t()).solution.t().tolist())))

    def gain(steeper):
        by_depth = DepthBrightness(0, half, tuple((float(c),) for c in per_mm), steeper, shallow)
        block = NormalFromResponse(field, by_depth, 1, 400, 0.01)
        found = -block(brightness_under_lights(slope, deep, lights), torch.full((1, 1, 1, 400), deep))[0, :2, 0]
        return float((found * sine).sum() / sine.square().sum())

    assert gain(0.0) > 1.08
    assert abs(gain(STEEPER / half) - 1.0) < 0.5 * abs(gain(0.0) - 1.0)


def test_depth_is_refused_where_nothing_is_known_about_it():
    _, _, block = normals(uses_depth=False)
    image, depth = random_image()
    assert block.uses_depth is False
    with pytest.raises(
        ValueError, match="depth_mm: expected None, because this response does not say what depth does to brightness"
    ):
        block(image, depth)


@pytest.mark.parametrize("mode", ["fast", "precise"])
@pytest.mark.parametrize("by_depth", [None, random_by_depth(2, 1.4)])
def test_normals_of_the_output_are_those_of_the_depth(mode, by_depth):
    """Also of a unit of whose depth nothing is known: its second pass is integration alone."""
    sensor = vts.Sensor("small", 48, 64, 0.1)
    background = torch.full((3, 48, 64), 0.4)
    unit = vts.Calibration.from_response(
        ResponseModel(ResponseField(0, -1, 1.4, ((0.6, 0, 0), (0, 0.6, 0))), by_depth), sensor, background
    )
    image = background.clone()
    coloured = torch.tensor((1.0, -1.0, 0.5)).view(3, 1, 1)  # a change that all channels share would be a shadow
    image[:, 15:35, 20:45] += 0.1 * coloured * torch.rand(3, 20, 25, generator=torch.Generator().manual_seed(0))
    fast, again = (vts.DepthPipeline.from_calibration(unit, m)(image[None]) for m in ("fast", mode))
    inside = fast.contact.expand(-1, 2, -1, -1)
    slope = gradient_of_depth(again.depth_mm, 0.1)
    assert bool(fast.contact.any()) and torch.allclose(again.gradient[inside], slope[inside], atol=1e-6)
    if by_depth is None:
        assert torch.allclose(again.depth_mm, fast.depth_mm, atol=1e-6)


def test_derivatives_are_those_of_the_slopes():
    _, _, block = normals(height=3, width=4)
    image, depth = (t.requires_grad_() for t in random_image(1, 3, 4))
    assert torch.autograd.gradcheck(block, (image, depth))
    assert torch.autograd.gradcheck(block, (image,))
    rest = torch.ones(1, 3, 3, 4, dtype=torch.float64, requires_grad=True)
    block(rest).sum().backward()
    assert bool(torch.isfinite(rest.grad).all()) and float(rest.grad.abs().max()) > 0


# files


def smooth_background(height=240, width=320, seed=0, noise=0.004):
    y, x = torch.meshgrid(torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij")
    light = torch.stack((0.5 + 0.2 * x, 0.4 + 0.15 * y, 0.45 - 0.2 * x * y))
    return (light + noise * torch.randn(light.shape, generator=torch.Generator().manual_seed(seed))).clamp(0, 1)


def eight_bits(image):
    return torch.round(image * 255) / 255


def small_calibration(gamma=1.0, dtype=torch.float32):
    background = eight_bits(smooth_background(24, 32)).to(dtype)
    sensor, report = vts.Sensor("rig", 24, 32, 0.5), {"model": "response", "note": "ü"}
    return vts.Calibration.from_response(model(gamma), sensor, background, report)


@pytest.fixture
def saved(tmp_path):
    small_calibration().save(tmp_path / "unit.safetensors")
    return tmp_path / "unit.safetensors"


@pytest.mark.parametrize("gamma", [1.0, 2.2, 0.5])
def test_an_eight_bit_background_survives_bit_for_bit_in_a_small_file(tmp_path, gamma):
    sensor = vts.Sensor("rig", 240, 320, 0.0625)
    calibration = vts.Calibration.from_response(model(gamma), sensor, eight_bits(smooth_background()))
    path = tmp_path / "unit.safetensors"
    calibration.save(path)
    loaded = vts.Calibration.load(path)
    assert path.stat().st_size < 200_000
    for name in ("background", "noise_std", "gain", "flat", "defects", "compensated_noise_std"):
        assert torch.equal(getattr(loaded, name), getattr(calibration, name)), name
    assert loaded.response == calibration.response and loaded.sensor == calibration.sensor
    assert loaded.report == calibration.report and loaded.measured is True and loaded.lights is None
    loaded.save(tmp_path / "again.safetensors")
    assert path.read_bytes() == (tmp_path / "again.safetensors").read_bytes()


@pytest.mark.parametrize("gamma", [1.0, 2.2])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_float_background_survives_within_sixteen_bits(tmp_path, gamma, dtype):
    sensor = vts.Sensor("rig", 60, 80, 0.25)
    calibration = vts.Calibration.from_response(model(gamma), sensor, smooth_background(60, 80).to(dtype))
    calibration.save(tmp_path / "unit.safetensors")
    loaded = vts.Calibration.load(tmp_path / "unit.safetensors").background
    values, kept = (b ** (1.0 / gamma) for b in (calibration.background, loaded))
    assert loaded.dtype == dtype and float((values - kept).abs().max()) < 0.51 / 65535 + 2e-7


def png(shape, dtype=np.uint8, suffix=".png"):
    return torch.from_numpy(cv2.imencode(suffix, np.full(shape, 9, dtype))[1].reshape(-1).copy())


def flipped(raw, place):
    raw = raw.clone()
    raw[place] ^= 255
    return raw


WHOLE, NO_PNG = "expected a whole colour PNG of 24 x 32, got one that says", "expected the bytes of a PNG"
PNGS = {
    "a tenth": (lambda raw: raw[: len(raw) // 10].clone(), WHOLE),
    "a header alone": (lambda raw: raw[:24].clone(), WHOLE),
    "a flipped byte": (lambda raw: flipped(raw, len(raw) // 2), WHOLE),
    "a header of another width": (lambda raw: flipped(raw, 19), WHOLE),
    "a header of two thousand million pixels": (lambda raw: flipped(raw, 16), WHOLE),
    "with opacity": (lambda raw: png((24, 32, 4)), WHOLE),
    "a JPEG": (lambda raw: png((24, 32, 3), suffix=".jpg"), NO_PNG),
    "floats": (lambda raw: raw.float(), NO_PNG),
}


@pytest.mark.parametrize("kind", PNGS)
def test_a_damaged_background_is_refused(saved, kind):
    change, message = PNGS[kind]
    rewritten(saved, lambda tensors: tensors.update(background_png=change(tensors["background_png"])))
    with pytest.raises(ValueError, match=f"tensor 'background_png': {message}") as caught:
        vts.Calibration.load(saved)
    assert str(caught.value).startswith(f"{saved}: ")


def put(value, *path):
    def change(metadata):
        for key in path[:-1]:
            metadata = metadata[key]
        if value is KeyError:
            del metadata[path[-1]]
        else:
            metadata[path[-1]] = value

    return change


NAN = float("nan")
METADATA = {
    "empty": (put({}, "response"), "response: key 'field': missing"),
    "none, and no lights": (put(None, "response"), "tensor 'light_position_mm' is missing"),
    "no field": (put(None, "response", "field"), "response: key field: expected a ResponseField"),
    "an unknown key of a field": (put(1, "response", "field", "colour"), "response: field: key 'colour': unknown"),
    "NaN": (put(NAN, "response", "field", "coefficient", 0, 3), "response: field: key coefficient: expected finite numbers"),
    "a negative blur": (put(-1, "response", "blur_px"), "response: key blur_px: expected a number above 0"),
}


@pytest.mark.parametrize("kind", METADATA)
def test_a_damaged_response_is_refused(saved, kind):
    change, message = METADATA[kind]
    refused_when_rewritten(saved, message, change_metadata=change)


@pytest.mark.parametrize("where, key, value", [("sensor", "gamma", 1.3), ("response", "gamma", 1.3), ("response", "blur_px", 4.0)])
def test_a_file_whose_sensor_and_response_disagree_is_refused(saved, where, key, value):
    rewritten(saved, change_metadata=put(value, where, key))
    with pytest.raises(ValueError, match=key):
        vts.Calibration.load(saved)


def test_a_response_has_no_light_matrix_and_is_one_on_undeformed_skin():
    calibration = small_calibration()
    assert torch.equal(calibration.flat, torch.ones(3, 24, 32)) and calibration.sensor.blur_px == 1.0
    assert float((vts.Compensate.from_calibration(calibration)(calibration.background[None]) - 1).abs().max()) < 1e-5
    with pytest.raises(ValueError, match="inverse: expected a calibration by lights, got one by response fields"):
        _ = calibration.inverse
    with pytest.raises(ValueError, match="calibration: expected one by response fields, got one by lights"):
        lights = vts.PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900, 900, 900])
        vts.NormalFromResponse.from_calibration(vts.Calibration.from_lights(lights, vts.Sensor("rig", 24, 32, 0.5)))


# a sensor's prior


def a_prior(blur_px=1.0):
    numbers = 0.1 * torch.randn(3, 15, generator=torch.Generator().manual_seed(6))
    rows = tuple(tuple(float(f"{v:.5g}") for v in row) for row in numbers.tolist())
    return SensorPrior(model(2.2, blur_px), rows, 10.0, "12 presses, müßig")


def test_a_prior_survives_yaml(tmp_path):
    sensor = vts.Sensor("rig", 24, 32, 0.5, blur_px=0.5, prior=a_prior())
    sensor.save(tmp_path / "rig.yaml")
    loaded = vts.Sensor.load(tmp_path / "rig.yaml")
    assert loaded == sensor and isinstance(loaded.prior, SensorPrior) and loaded.prior.source == "12 presses, müßig"
    without = dataclasses.replace(sensor, prior=None)
    without.save(tmp_path / "plain.yaml")
    assert "prior" not in (tmp_path / "plain.yaml").read_text() and vts.Sensor.load(tmp_path / "plain.yaml") == without


def test_a_prior_says_how_good_it_is_on_each_unit_or_nothing(tmp_path):
    tried = dataclasses.replace(a_prior(), held_out_deg=[2.5, 5])
    assert tried.expected_deg == pytest.approx(3.75)
    vts.Sensor("rig", 24, 32, 0.5, prior=tried).save(tmp_path / "rig.yaml")
    assert vts.Sensor.load(tmp_path / "rig.yaml").prior.held_out_deg == (2.5, 5.0)
    vts.Sensor("rig", 24, 32, 0.5, prior=a_prior()).save(tmp_path / "rig.yaml")
    assert "held_out_deg" not in (tmp_path / "rig.yaml").read_text()
    assert vts.Sensor.load(tmp_path / "rig.yaml").prior.expected_deg is None


BAD_PRIORS = {
    "unknown key": (put(1, "colour"), "key prior: key 'colour': unknown; expected response, log_background, half_mm, source"),
    "no source": (put(KeyError, "source"), "key prior: key 'source': missing"),
    "NaN": (put(NAN, "log_background", 0, 0), "key prior: key log_background: expected finite numbers"),
}


@pytest.mark.parametrize("kind", BAD_PRIORS)
def test_a_bad_prior_is_refused_by_file_and_key(tmp_path, kind):
    change, message = BAD_PRIORS[kind]
    path = tmp_path / "rig.yaml"
    vts.Sensor("rig", 24, 32, 0.5, prior=a_prior()).save(path)
    values = yaml.safe_load(path.read_text(encoding="utf-8"))
    change(values["prior"])
    path.write_text(yaml.safe_dump(values), encoding="utf-8")
    with pytest.raises(ValueError, match=message) as caught:
        vts.Sensor.load(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_another_number_of_pixels_scales_the_blur_and_nothing_else():
    sensor = vts.Sensor("rig", 24, 32, 0.5, blur_px=0.5, prior=a_prior(1.25))
    double = sensor.resized(48, 64)
    assert double.prior.response.blur_px == pytest.approx(2.5) and double.blur_px == pytest.approx(1.0)
    back = double.resized(24, 32)
    assert back == sensor
    assert double.prior.response.field == sensor.prior.response.field and double.prior.log_background == sensor.prior.log_background


def test_the_smooth_background_of_a_prior_is_found_again():
    numbers = 0.2 * torch.randn(3, 15, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    prior = SensorPrior(model(), tuple(map(tuple, numbers.tolist())), 8.0, "")
    background = prior.background(24, 32, 0.5)
    assert tuple(background.shape) == (3, 24, 32) and float(background.min()) > 1e-3
    assert torch.allclose(torch.tensor(fit_log_background(background, 0.5), dtype=torch.float64), numbers, atol=1e-9)
    assert torch.allclose(prior.background(72, 96, 0.5 / 3)[:, 1::3, 1::3], background, rtol=1e-12)


def test_the_gelsight_mini_ships_with_a_prior():
    sensor = vts.Sensor.load("gelsight_mini")
    assert isinstance(sensor.prior, SensorPrior) and sensor.prior.response.by_depth is not None and sensor.prior.source
    background = sensor.prior.background(sensor.height, sensor.width, sensor.mm_per_pixel)
    assert bool(torch.isfinite(background).all()) and 0.005 < float(background.min()) < float(background.max()) < 1.5
    field, by_depth = sensor.prior.response.field, sensor.prior.response.by_depth
    assert field.half_mm == pytest.approx(0.5 * sensor.width * sensor.mm_per_pixel, rel=1e-3) and by_depth.half_mm == field.half_mm


# the blur


@pytest.mark.parametrize("std_px", [0.3, 1.0, 3.0])
def test_the_blur_is_kornia_s(std_px):
    image = torch.rand(2, 3, 30, 41, generator=torch.Generator().manual_seed(1))
    size = len(gaussian_weights(std_px))
    expected = kornia.filters.gaussian_blur2d(image, (size, size), (std_px, std_px), border_type="replicate")
    assert size % 2 == 1 and size >= 6 * std_px
    assert float((vts.Compensate(blur_px=std_px)(image) - expected).abs().max()) < 1e-6
