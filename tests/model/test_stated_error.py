"""The error of normals that a calibration states from its covariance alone."""

import dataclasses

import pytest
import torch
from conftest import refused_when_rewritten

import torchvts as vts
from torchvts.model import stated_deg, stated_error_deg
from torchvts.model.response_field import ResponseField, ResponseModel, term_values

SENSOR = vts.Sensor("rig", 24, 32, 0.5)
REPORT = {"model": "response", "source": "presses", "own_deg": 2.0}


def unit(covariance="drawn", report=REPORT):
    field = ResponseField(1, 0, 8.0, ((0.1,) * 15, (0.2,) * 15))
    generator = torch.Generator().manual_seed(0)
    root = torch.randn(15, 15, generator=generator)
    covariance = root @ root.t() if covariance == "drawn" else covariance
    y, x = torch.meshgrid(torch.linspace(0.3, 0.6, 24), torch.linspace(0.3, 0.6, 32), indexing="ij")
    return vts.Calibration.from_response(ResponseModel(field, None), SENSOR, torch.stack((x, y, 0.9 - x)), report, covariance)


def test_each_pixel_is_stated_by_its_own_factors():
    calibration = unit()
    image = 1.0 + 0.3 * torch.rand(2, 3, 24, 32, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found = stated_error_deg(calibration, image)
    assert found.shape == (2, 1, 24, 32)
    for b, row, column in ((0, 3, 5), (1, 20, 31)):
        place = [torch.tensor([0.5 * (k - 0.5 * (n - 1))], dtype=torch.float64) for k, n in ((column, 32), (row, 24))]
        phi = term_values(image[b, :, row, column, None] - 1.0, *place, 8.0, calibration.response.field.degrees())[:, 0]
        variance = phi @ calibration.covariance.double() @ phi
        assert float(found[b, 0, row, column]) == pytest.approx(float((4.0 * (1 + 0.15 * variance) + 1.5**2).sqrt()), rel=1e-4)


def test_undeformed_skin_is_stated_as_well_as_the_own_presses():
    found = stated_error_deg(unit(), torch.ones(1, 3, 24, 32))
    assert torch.allclose(found, stated_deg(2.0, torch.zeros(())).expand_as(found))


def test_the_covariance_survives_the_file(tmp_path):
    calibration = unit()
    calibration.save(tmp_path / "unit.safetensors")
    loaded = vts.Calibration.load(tmp_path / "unit.safetensors")
    assert torch.equal(loaded.covariance, calibration.covariance) and loaded.covariance.dtype == torch.float32
    without = dataclasses.replace(calibration, covariance=None)
    without.save(tmp_path / "without.safetensors")
    assert vts.Calibration.load(tmp_path / "without.safetensors").covariance is None


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda c: c[:-1], r"covariance: expected \(120,\)"),
        (lambda c: c.to(torch.int64), "covariance: expected floating point"),
        (lambda c: c.index_fill(0, torch.tensor([3]), float("nan")), "covariance: expected finite values"),
        (lambda c: -c, "covariance: expected .* with a positive diagonal"),
    ],
)
def test_a_damaged_covariance_is_refused(tmp_path, change, message):
    unit().save(tmp_path / "unit.safetensors")

    def damage(tensors):
        tensors["covariance"] = change(tensors["covariance"])

    refused_when_rewritten(tmp_path / "unit.safetensors", message, change_tensors=damage)


@pytest.mark.parametrize(
    "covariance, message",
    [
        (torch.eye(14), r"covariance: expected \(15, 15\)"),
        (float("nan") * torch.eye(15), "covariance: expected finite values"),
        (-torch.eye(15), "with a positive diagonal"),
    ],
)
def test_a_covariance_that_cannot_be_is_refused(covariance, message):
    with pytest.raises(ValueError, match=message):
        unit(covariance)


def test_without_a_covariance_nothing_is_stated():
    for calibration in (unit(None), unit(report={"model": "response", "source": "given"})):
        with pytest.raises(ValueError, match="calibration: expected one whose field has a covariance"):
            stated_error_deg(calibration, torch.ones(1, 3, 24, 32))


def test_a_prior_without_presses_states_an_error():
    sensor = vts.Sensor.load("gelsight_mini")
    image = sensor.prior.background(240, 320, 0.0634).clamp(0, 1).float()
    calibration = vts.calibrate(image, sensor)
    size = calibration.response.field.size()
    assert calibration.report["source"] == "prior" and calibration.covariance.shape == (size, size)
    steep = stated_error_deg(calibration, torch.full((1, 3, 240, 320), 1.3))
    assert float(steep.min()) > calibration.report["own_deg"]
