"""Bad input: what the message says."""

import pytest
import torch

import torchvts as vts

SENSOR = vts.Sensor("rig", 24, 32, 1.25)


@pytest.fixture(scope="module")
def background(ring):
    lights = ring()
    return vts.scenes.render(vts.scenes.undeformed(vts.scenes.sphere_press(10, 1, (0, 0), 24, 32, 1.25)), lights)[0]


def with_value(image, value, share=1.0, channel=1):
    changed = image.clone()
    changed[channel].view(-1)[: int(share * changed[channel].numel())] = value
    return changed


BAD = {
    "a batch": (
        lambda i: i[None],
        ValueError,
        r"expected \(3, 24, 32\) for sensor 'rig', got \(1, 3, 24, 32\): take one image of the batch",
    ),
    "channels last": (lambda i: i.permute(1, 2, 0), ValueError, r"got \(24, 32, 3\): channels stand last: permute\(2, 0, 1\)"),
    "one channel": (lambda i: i[:1], ValueError, r"got \(1, 24, 32\): one RGB image is needed"),
    "four channels": (lambda i: torch.cat((i, i[:1])), ValueError, r"got \(4, 24, 32\): one RGB image is needed"),
    "grey": (lambda i: i[0], ValueError, r"got \(24, 32\): one RGB image is needed"),
    "another size": (
        lambda i: i[:, :20, :30],
        ValueError,
        r"expected \(3, 24, 32\) for sensor 'rig', got \(3, 20, 30\): resize it, or load the sensor with height=20, width=30",
    ),
    "empty": (lambda i: i[:, :0], ValueError, r"got \(3, 0, 32\)"),
    "bytes": (lambda i: (255 * i).to(torch.uint8), TypeError, "expected a floating-point image, got torch.uint8: divide by 255"),
    "0-255": (lambda i: 255 * i, ValueError, r"expected values in \[0, 1\], got \[.*\]: 0-255 given for 0-1: divide by 255"),
    "negative": (lambda i: i - 0.9, ValueError, r"expected values in \[0, 1\], got \[-0\..*\]: clamp it"),
    "slightly bright": (lambda i: i + 0.6, ValueError, r"expected values in \[0, 1\], got \[.*, 1\..*\]: clamp it"),
    "one NaN": (lambda i: with_value(i, float("nan"), 0.002), ValueError, "expected finite values, got 1 NaN or infinite"),
    "infinite": (lambda i: with_value(i, float("inf"), 0.01), ValueError, "expected finite values, got 7 NaN or infinite"),
    "numpy": (lambda i: i.numpy(), TypeError, "expected a torch.Tensor, got ndarray: torch.from_numpy"),
    "a path": (lambda i: "background.png", TypeError, "expected a torch.Tensor, got str: read files with torchvts.read_image"),
    "none": (lambda i: None, TypeError, "expected a torch.Tensor, got NoneType"),
}
UNUSABLE = {
    "black": (lambda i: 0 * i, r"expected light in channel R, got a mean of 0.0000: black image, .* off"),
    "one LED off": (lambda i: with_value(i, 0.001), r"expected light in channel G, got a mean of 0.0010"),
    "saturated": (
        lambda i: with_value(i, 1.0, 0.75, 2),
        r"expected light below .*, got a channel B that is saturated in 75% of the image: lower the exposure",
    ),
    "constant": (
        lambda i: with_value(i, 0.5, 1.0, 0),
        r"expected light that varies, got a channel R that is constant at 0.5000: not a camera image",
    ),
}


@pytest.mark.parametrize("kind", BAD)
@pytest.mark.parametrize("use", ["calibrate", "fit_lights", "from_lights"])
def test_a_bad_background_is_refused(ring, background, use, kind):
    change, error, message = BAD[kind]
    if use == "from_lights" and kind == "none":
        pytest.skip("no background is allowed there")
    call = {
        "calibrate": vts.calibrate,
        "fit_lights": vts.fit_lights,
        "from_lights": lambda image, sensor: vts.Calibration.from_lights(ring(), sensor, image),
    }
    with pytest.raises(error, match=f"^background: .*{message}"):
        call[use](change(background), SENSOR)


@pytest.mark.parametrize("kind", UNUSABLE)
@pytest.mark.parametrize("call", [vts.calibrate, vts.fit_lights])
def test_an_unusable_background_is_refused(background, call, kind):
    change, message = UNUSABLE[kind]
    with pytest.raises(ValueError, match=f"^background: .*{message}"):
        call(change(background), SENSOR)


FRAMES = {
    "no batch": (lambda i: i[0], ValueError, r"expected \(B, 3, H, W\), got \[3, 24, 32\]: add the batch dimension with \[None\]"),
    "channels last": (
        lambda i: i.permute(0, 2, 3, 1),
        ValueError,
        r"got \[1, 24, 32, 3\]: channels stand last: permute\(0, 3, 1, 2\)",
    ),
    "one channel": (lambda i: i[:, :1], ValueError, r"got \[1, 1, 24, 32\]"),
    "bytes": (lambda i: (255 * i).to(torch.uint8), TypeError, r"got torch.uint8: images are value / 255 in \[0, 1\]"),
    "0-255": (lambda i: 255 * i, ValueError, r"expected values in \[0, 1\], got .*: 0-255 given for 0-1: divide by 255"),
    "NaN": (lambda i: with_value(i[0], float("nan"), 0.01)[None], ValueError, "expected finite values, got 7 NaN or infinite"),
}


@pytest.mark.parametrize("kind", FRAMES)
@pytest.mark.parametrize("mode", ["fast", "precise", "auto"])
def test_a_bad_frame_is_refused(ring, background, mode, kind):
    pipe = vts.DepthPipeline.from_calibration(vts.Calibration.from_lights(ring(), SENSOR), mode)
    change, error, message = FRAMES[kind]
    with pytest.raises(error, match=f"^images: .*{message}"):
        pipe(change(background[None]))


def test_a_frame_of_another_size_is_refused(ring, background):
    pipe = vts.DepthPipeline.from_calibration(vts.Calibration.from_lights(ring(), SENSOR, background))
    with pytest.raises(ValueError, match="expected 24 x 32 like the calibration, got 20 x 30"):
        pipe(background[None, :, :20, :30])


def test_wrong_types_are_refused(ring):
    calibration = vts.Calibration.from_lights(ring(), SENSOR)
    with pytest.raises(ValueError, match="mode: expected one of fast, precise, auto, got 'slow'"):
        vts.DepthPipeline.from_calibration(calibration, "slow")
    with pytest.raises(TypeError, match=r"calibration: expected a Calibration, got str: Calibration.load reads a file"):
        vts.DepthPipeline.from_calibration("unit.safetensors")
    with pytest.raises(TypeError, match="lights: expected PointLights, got list"):
        vts.Calibration.from_lights([[0, 0, 1]], SENSOR)


def test_an_empty_batch_gives_an_empty_batch(ring, background):
    """No frames are no error: they may be what a filter left of a stream."""
    out = vts.DepthPipeline.from_calibration(vts.Calibration.from_lights(ring(), SENSOR), "fast").compensate(background[None][:0])
    assert out.shape == (0, 3, 24, 32)
    calibration = vts.Calibration.from_lights(ring(), SENSOR)
    for mode in ("fast", "precise", "auto"):
        assert vts.DepthPipeline.from_calibration(calibration, mode)(background[None][:0]).depth_mm.shape == (0, 1, 24, 32)


@pytest.mark.parametrize("kwargs", [{"gain": torch.ones(3, 4)}, {"offset": torch.ones(1, 4, 4)}])
def test_compensation_of_a_wrong_shape_is_refused(kwargs):
    with pytest.raises(ValueError, match=rf"{next(iter(kwargs))}: expected \(3, H, W\), got "):
        vts.Compensate(**kwargs)


@pytest.mark.parametrize("gamma, error", [(0, ValueError), (float("inf"), ValueError), ("2.2", TypeError), (True, TypeError)])
def test_an_impossible_response_is_refused(gamma, error):
    with pytest.raises(error, match="gamma: expected a number"):
        vts.Compensate(gamma=gamma)


@pytest.mark.parametrize("shape", [(2, 1, 4, 4), (4,)])
def test_points_need_one_frame(shape):
    with pytest.raises(ValueError, match=r"depth_mm: expected one frame, .*: loop over the batch"):
        vts.depth_to_points(torch.zeros(shape), 1.0)


def test_points_need_contact_of_the_same_size():
    with pytest.raises(ValueError, match="contact: expected 4 x 4 like depth_mm, got 4 x 5"):
        vts.depth_to_points(torch.zeros(4, 4), 1.0, torch.ones(4, 5, dtype=torch.bool))
    assert vts.depth_to_points(torch.zeros(2, 2), 1.0, torch.zeros(2, 2, dtype=torch.bool)).shape == (0, 3)
