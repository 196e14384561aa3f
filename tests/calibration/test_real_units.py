"""Real GelSight Minis: what one image, a prior and presses are worth."""

import dataclasses

import pytest
import torch
from conftest import calibrated, unlabelled

import torchvts as vts
from lab import metrics
from lab.prior import fit_prior
from lab.score import score_press
from torchvts.calibration.doubts import of_type
from torchvts.core.blur import blur, gaussian_weights


@pytest.fixture(scope="module")
def mini():
    return vts.Sensor.load("gelsight_mini")


def precise(calibration, image):
    with torch.inference_mode():
        return vts.DepthPipeline.from_calibration(calibration, "precise")(image[None])


def test_a_second_unit_from_its_background_alone(data, mini):
    background, bead = (vts.read_image(data / "gelsight_mini_b" / name) for name in ("background.png", "bead.png"))
    calibration = vts.calibrate(background, mini)
    assert calibration.report["source"] == "prior"
    smooth_rest, smooth = (blur(image[None], gaussian_weights(1.0)) for image in (background, bead))
    own = vts.NormalFromMLP.load(data / "gelsight_mini_b" / "model" / "nnmodel.pth", smooth_rest[0])(smooth)
    for mode in ("fast", "precise"):
        out = vts.DepthPipeline.from_calibration(calibration, mode)(bead[None])
        changed = ((smooth - smooth_rest).abs().amax(1, keepdim=True) > 15 / 255) & out.deformed
        assert float(changed.double().mean()) > 0.2
        assert float(metrics.normal_angle_deg(out.normal, own, changed).mean()) < 3.25
    # its light drifts: the contact is not the whole frame
    assert 0.05 < float(out.contact.double().mean()) < 0.2 and float(out.deformed.double().mean()) < 0.4


@pytest.mark.long
def test_presses_of_one_ball_calibrate_for_another(data, mini):
    background, presses = vts.read_presses(data / "gelsight_mini_a")
    small, large = ([p for p in presses if (p.ball_diameter_mm > 8) is big and p.contact_radius_px] for big in (False, True))
    prior = fit_prior(background, mini, small)
    sensor = dataclasses.replace(mini, prior=prior)
    calibration, _ = calibrated(background, sensor, unlabelled(large[::2]))
    scores = []
    for press in large[1::2]:
        out = precise(calibration, press.image)
        scores.append(score_press(press, out.depth_mm, out.normal, mini.mm_per_pixel).normal_deg)
    assert sum(scores) / len(scores) < 3.0
    assert calibration.report["source"] == "presses" and "from the sensor's prior and " in calibration.report["reason"]


def mini_backgrounds(data):
    """Of three units, the third from the median of its presses, cut to the gel."""
    frames = torch.stack([vts.read_image(data / "gelsight_mini_c" / f"frame_{k}.jpg") for k in range(1, 50, 3)])
    gel = frames.median(dim=0).values[None, :, 34:206, 46:274]
    third = torch.nn.functional.interpolate(gel, (240, 320), mode="bilinear", antialias=True)[0].clamp(0, 1)
    return [vts.read_image(data / f"gelsight_mini_{unit}" / "background.png") for unit in "ab"] + [third]


def test_backgrounds_of_the_type_are_not_named_and_turned_ones_are(data, mini):
    for image in mini_backgrounds(data):
        assert of_type(image, mini) == []
        assert "it is turned by 180 degrees (" in of_type(image.flip(1, 2), mini)[0].text
        assert "it is mirrored left to right (" in of_type(image.flip(2), mini)[0].text
        assert "it is mirrored top to bottom (" in of_type(image.flip(1), mini)[0].text
        assert "it has its channels swapped to the order B, G, R (" in of_type(image.flip(0), mini)[0].text


@pytest.mark.parametrize("place", [0, pytest.param(12, marks=pytest.mark.long)])
def test_images_that_are_all_swapped_are_doubted_for_that_alone(data, mini, place):
    background, presses = vts.read_presses(data / "gelsight_mini_a")
    press = unlabelled([presses[place]], image=presses[place].image.flip(0))
    calibration, warned = calibrated(background.flip(0), mini, press)
    (doubt,) = calibration.report["doubts"]
    assert "it has its channels swapped to the order B, G, R (" in doubt and warned == [doubt]
    assert not calibration.metric


@pytest.mark.parametrize("folder", ["gelsight_pale", "digit_a"])
def test_another_sensor_under_the_prior_of_a_mini_is_named(data, mini, folder):
    image = vts.read_image(data / folder / "background.png")
    small = torch.nn.functional.interpolate(image[None], (240, 320), mode="bilinear", antialias=True)[0].clamp(0, 1)
    own = vts.Sensor(folder, 320, 240, 1 / 19.58, prior=mini.prior)
    for background, sensor in ((small, mini), (image, own)):
        with pytest.warns(vts.CalibrationWarning, match="background: (its light is .* off that of|held against images of) sensor"):
            vts.calibrate(background, sensor)


@pytest.mark.long
def test_presses_of_a_pale_unit_calibrate_although_the_prior_is_a_minis(data, mini):
    folder = data / "gelsight_pale"
    sensor = vts.Sensor("pale", 320, 240, 1 / 19.58, prior=mini.prior)
    presses = [vts.Press(vts.read_image(folder / f"ball_{k:04}.png"), 4.7, str(k)) for k in range(1, 42, 8)]
    calibration, _ = calibrated(vts.read_image(folder / "background.png"), sensor, presses)
    assert "without the sensor's prior: the background does not have its pattern of light" in calibration.report["reason"]
    assert sum(row["used"] for row in calibration.report["presses"]) >= 5 and calibration.report["held_out_deg"] < 6.0


def test_a_sensor_with_white_light_is_refused_for_it(data):
    whole = (vts.read_image(data / "ninedtact_white" / name) for name in ("background.png", "ball_8mm.png"))
    background, ball = (torch.nn.functional.avg_pool2d(image, 2) for image in whole)
    sensor = vts.Sensor("white", *background.shape[1:], 0.06)
    for presses in ([vts.Press(ball, 8.0)], []):
        with pytest.raises(ValueError, match="this sensor has no coloured lights: photometric depth is not possible"):
            vts.calibrate(background, sensor, presses)


def test_frames_with_the_gels_frame_in_the_picture_are_named(data):
    folder = data / "gelsight_mini_c"
    presses = [vts.Press(vts.read_image(folder / f"frame_{k}.jpg"), 4.0) for k in range(1, 50, 8)]
    background = vts.read_image(folder / "frame_0.png")
    with pytest.raises(ValueError, match="is cropped otherwise and shows more than the background, by 14% of each side"):
        vts.calibrate(background, vts.Sensor("mini", *background.shape[1:], 0.0634), presses)


@pytest.mark.long
def test_a_marked_skin_is_calibrated_and_its_dots_stay_out_of_the_depth(data):
    folder = data / "gelslim_markers"
    background = vts.read_image(folder / "ref.jpg")
    sensor = vts.Sensor("marked", *background.shape[1:], 0.05, gamma=1.0, markers=True)
    names = ["sample_8", "sample_13", "sample_34", "sample_43"]
    presses = [vts.Press(vts.read_image(folder / f"{name}.jpg"), 5.0, name) for name in names]
    calibration, _ = calibrated(background, sensor, presses)
    assert calibration.markers is not None and all(row["used"] for row in calibration.report["presses"])
    assert calibration.report["held_out_deg"] < 4.0


@pytest.mark.parametrize("sensor, folders", [("gelsight_mini", ["gelsight_mini_a", "gelsight_mini_b"]), ("digit", ["digit_b"])])
def test_a_press_given_as_the_only_image_is_read_as_one(data, sensor, folders):
    unit = vts.Sensor.load(sensor)
    for folder in folders:
        background = vts.read_image(data / folder / "background.png")
        own = dataclasses.replace(unit, height=background.shape[1], width=background.shape[2])
        assert vts.calibrate(background, own).metric
    folder = data / folders[-1]
    pressed = vts.read_image(folder / ("bead.png" if folder.name == "gelsight_mini_b" else "ball_0010.png"))
    with pytest.warns(vts.CalibrationWarning, match=r"read as a frame it shows skin that is \d\.\d mm deep"):
        assert not vts.calibrate(pressed, own).metric
