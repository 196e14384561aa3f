"""Drawn skins with dots: what an image shows lies where the truth says."""

import pytest
import torch

from torchvts.scenes import DottedSkin, Drag

SIZE = {"height": 96, "width": 128, "mm_per_pixel": 0.1, "spacing_mm": 1.6, "diameter_mm": 0.6, "noise_std": 0.0}
DRAG = Drag((0.5, -0.3), 2.0, 0.6, (0.4, 0.2), 8.0, 0.1, 0.7, 1.5)


@pytest.mark.parametrize("camera_height_mm", [float("inf"), 15.0])
@pytest.mark.parametrize("pattern", ["square", "hexagonal"])
def test_dots_are_where_the_truth_says(pattern, camera_height_mm):
    skin = DottedSkin(**SIZE, pattern=pattern, camera_height_mm=camera_height_mm)
    image = skin.image(DRAG)
    moved = DRAG.displacement_mm(skin.dots_mm)
    places = skin.seen_px(torch.cat((skin.dots_mm + moved[:, :2], moved[:, 2:]), 1)).round().long()
    inside = ((places >= 3) & (places < torch.tensor([125, 93]))).all(1)
    x, y = places[inside].T
    dark = torch.nn.functional.avg_pool2d(image.mean(0)[None, None], 15, 1, 7)[0, 0] - image.mean(0)
    assert int(inside.sum()) > 30
    assert float(dark[y, x].min()) > 0.15 and float(dark.quantile(0.5)) < 0.02


@pytest.mark.parametrize("camera_height_mm", [float("inf"), 15.0])
def test_pixels_see_the_points_that_the_truth_puts_there(camera_height_mm):
    skin = DottedSkin(**SIZE, camera_height_mm=camera_height_mm)
    rest = skin.rest_mm(DRAG)
    moved = DRAG.displacement_mm(rest)
    seen = skin.seen_px(torch.cat((rest + moved[..., :2], moved[..., 2:]), -1))
    x, y = torch.meshgrid(torch.arange(128.0), torch.arange(96.0), indexing="xy")
    assert float((seen - torch.stack((x, y), -1)).abs().max()) < 1e-3
    assert torch.equal(skin.depth_mm(DRAG)[0, 0], moved[..., 2])


def test_stuck_skin_moves_with_its_object_and_skin_far_away_does_not():
    stuck, far = torch.tensor([[0.5, -0.3], [1.0, 0.5]]).double(), torch.tensor([[60.0, 0.0]]).double()
    drag = Drag((0.5, -0.3), 2.0, 0.0, (0.4, 0.2), 8.0, 0.0, 0.7, 1.5)
    assert float((drag.displacement_mm(stuck)[:, :2] - drag.object_mm(stuck)).abs().max()) < 1e-12
    assert float(drag.displacement_mm(far).abs().max()) < 0.01


def test_a_dot_without_darkness_is_gone():
    skin = DottedSkin(**SIZE)
    left = torch.zeros(len(skin.dots_mm))
    assert float(skin.image(left=left).mean()) > float(skin.image().mean()) + 0.02


def test_a_drag_that_folds_the_skin_is_refused():
    with pytest.raises(ValueError, match="drag: expected skin that does not fold"):
        DottedSkin(**SIZE | {"height": 24, "width": 32}).image(Drag(radius_mm=1.0, shift_mm=(3.0, 0.0), reach_mm=0.5))
