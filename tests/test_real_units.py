"""Real GelSight Minis: what one image, a prior and presses are worth."""

import dataclasses
import warnings

import pytest
import torch

import torchvts as vts
from torchvts.calibration import fit_prior
from torchvts.core.blur import blur, gaussian_weights
from torchvts.evaluation import metrics
from torchvts.evaluation.score import score_press


@pytest.fixture(scope="module")
def mini():
    return vts.Sensor.load("gelsight_mini")


def precise(calibration, image):
    with torch.inference_mode():
        return vts.DepthPipeline.from_calibration(calibration, "precise")(image[None])


@pytest.mark.parametrize("mode, limit_deg", [("fast", 2.7), ("precise", 3.0)])
def test_a_second_unit_from_its_background_alone(data, mini, mode, limit_deg):
    background, bead = (vts.read_image(data / "gelsight_mini_b" / name) for name in ("background.png", "bead.png"))
    calibration = vts.calibrate(background, mini)
    assert calibration.report["source"] == "prior" and "point lights rejected" in calibration.report["reason"]
    smooth_rest, smooth = (blur(image[None], gaussian_weights(1.0)) for image in (background, bead))
    own = vts.NormalFromMLP.load(data / "gelsight_mini_b" / "model" / "nnmodel.pth", smooth_rest[0])(smooth)
    out = vts.DepthPipeline.from_calibration(calibration, mode)(bead[None])
    changed = ((smooth - smooth_rest).abs().amax(1, keepdim=True) > 15 / 255) & out.contact
    assert float(changed.double().mean()) > 0.2
    assert float(metrics.normal_angle_deg(out.normal, own, changed).mean()) < limit_deg


def test_the_contact_of_a_unit_whose_light_drifts_is_not_the_whole_frame(data, mini):
    background, bead = (vts.read_image(data / "gelsight_mini_b" / name) for name in ("background.png", "bead.png"))
    assert float(precise(vts.calibrate(background, mini), bead).contact.double().mean()) < 0.6


def test_presses_of_one_ball_calibrate_for_another(data, mini):
    background, presses = vts.read_presses(data / "gelsight_mini_a")
    small, large = ([p for p in presses if (p.ball_diameter_mm > 8) is big and p.contact_radius_px] for big in (False, True))
    prior = fit_prior(background, mini, small)
    sensor = dataclasses.replace(mini, prior=prior)
    blind = [dataclasses.replace(p, center_px=None, contact_radius_px=None) for p in large[::2]]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", vts.CalibrationWarning)
        calibration = vts.calibrate(background, sensor, blind)
    scores = []
    for press in large[1::2]:
        out = precise(calibration, press.image)
        scores.append(score_press(press, out.depth_mm, out.normal, mini.mm_per_pixel).normal_deg)
    assert sum(scores) / len(scores) < 3.0
    assert calibration.report["candidates"][0]["model"] == "point lights"
    assert calibration.report["candidates"][0]["note"].startswith("not fitted: the closed-form lights leave a misfit of ")


def test_a_marked_skin_is_calibrated_and_its_dots_stay_out_of_the_depth(data):
    folder = data / "gelslim_markers"
    background = vts.read_image(folder / "ref.jpg")
    sensor = vts.Sensor("marked", *background.shape[1:], 0.05, gamma=1.0, markers=True)
    names = ["sample_8", "sample_13", "sample_34", "sample_43"]
    presses = [vts.Press(vts.read_image(folder / f"{name}.jpg"), 5.0, name) for name in names]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", vts.CalibrationWarning)
        calibration = vts.calibrate(background, sensor, presses)
    assert calibration.markers is not None and all(row["used"] for row in calibration.report["presses"])
    assert calibration.report["held_out_deg"] < 4.0
