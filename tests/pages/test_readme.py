"""README's code and commands run as they stand, on images of a real sensor where these are, else on drawn ones."""

import os
import shutil
from pathlib import Path

import pytest
import torch
from conftest import ROOT
from documents import blocks, run

import torchvts as vts
from torchvts.model.response_field import CHANGE_SCALE

README = ROOT / "README.md"


def mini_image(scene, seed):
    """The image of a GelSight Mini by its prior: the light in which its response sees the slopes of a scene, by Newton steps."""
    sensor = vts.Sensor.load("gelsight_mini")
    size, response = (sensor.height, sensor.width, sensor.mm_per_pixel), sensor.prior.response
    normals = vts.NormalFromResponse(response.field, None, *size)
    inverse = CHANGE_SCALE * torch.linalg.pinv(response.field.maps(*size)[:3].float().permute(2, 3, 1, 0))  # (H, W, 3, 2)
    light = torch.ones(1, 3, *size[:2])
    for _ in range(20):
        off = normals(light)[:, :2] - scene.normal[:, :2]
        light = light + 0.5 * torch.einsum("hwck,bkhw->bchw", inverse, off)
    assert float(off.abs().max()) < 1e-3
    image = sensor.prior.background(*size).float().clamp(0, 1) * light[0] ** (1.0 / response.gamma)
    return image + 0.003 * torch.randn(image.shape, generator=torch.Generator().manual_seed(seed))


def photograph(folder):
    """Draw what README asks for: a Mini without contact, with a ball of 6.31 mm, and a press by another ball."""
    ball, other = (
        vts.scenes.sphere_press(r, d, c, 240, 320, 0.0634) for r, d, c in ((3.155, 0.4, (-2.0, 1.0)), (4.75, 0.5, (2.0, 1.0)))
    )
    scenes = {"background": vts.scenes.undeformed(ball), "ball": ball, "press": other}
    for seed, (name, scene) in enumerate(scenes.items()):
        vts.write_image(folder / f"{name}.png", mini_image(scene, seed).clamp(0, 1))
    return other


def real_images(folder):
    """Copy what README asks for from a GelSight Mini's presses, if they are at hand."""
    data = Path(os.environ.get("TORCHVTS_DATA", ROOT.parent / "shared" / "data")) / "gelsight_mini_a"
    files = {"background.png": "background.png", "ball.png": "6.310mm/10/gelsight.png", "press.png": "9.500mm/16/gelsight.png"}
    if not data.is_dir():
        return False
    for name, source in files.items():
        shutil.copy(data / source, folder / name)
    return True


def code(path):
    """Lines of a document's Python, without comments."""
    return {line.partition("  #")[0] for _, text in blocks(path, ["python"]) for line in text.splitlines()}


@pytest.mark.filterwarnings("ignore::torchvts.CalibrationWarning")
@pytest.mark.parametrize("rendered", [False, pytest.param(True, marks=pytest.mark.long)])
def test_code_and_commands_run_in_order(rendered, tmp_path, monkeypatch):
    real = not rendered and real_images(tmp_path)
    truth = None if real else photograph(tmp_path)
    monkeypatch.chdir(tmp_path)
    names = run(README)
    deepest_mm = float(vts.read_result("out/press/press.npz").depth_mm.max())
    area_mm2 = len(names["points"]) * 0.0634**2
    if truth is None:  # a ball of 9.5 mm
        assert 0.5 < deepest_mm < 1.2 and 10.0 < area_mm2 < 25.0
    else:
        assert deepest_mm == pytest.approx(0.5, rel=0.1)
        assert area_mm2 == pytest.approx(float(truth.contact.sum()) * 0.0634**2, rel=0.2)
    assert names["learned"].weight.grad is not None
    (last,) = code(ROOT / "docs" / "index.md") - code(README)  # the documentation's first page has the same lines, and one more
    exec(last, names)
