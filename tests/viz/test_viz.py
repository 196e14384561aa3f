"""Pictures of frames: one extent in all panels, a stated exaggeration, a zero that keeps its colour."""

import numpy as np
import pytest
import torch

import torchvts as vts
from lab import figures
from torchvts import viz

PITCH = 0.1


def frame(height=60, width=80, low=0.0):
    y, x = torch.meshgrid(torch.arange(height) - height / 2, torch.arange(width) - width / 2, indexing="ij")
    return 0.5 * torch.exp(-(x**2 + y**2) / 200.0) + low


@pytest.mark.parametrize(("height", "width"), [(60, 80), (80, 60)])
def test_a_frame_has_one_extent_in_all_panels_and_states_its_exaggeration(height, width):
    depth = frame(height, width)
    figure = viz.depth_figure(depth, PITCH, torch.rand(3, height, width), depth > 0.1, "a frame")
    image, contours, surface = figure.axes
    expected = (-width * PITCH / 2, width * PITCH / 2), (height * PITCH / 2, -height * PITCH / 2)
    for axes in (image, contours, surface):
        assert axes.get_xlim() == pytest.approx(expected[0]) and axes.get_ylim() == pytest.approx(expected[1])
    assert image.get_position().width == pytest.approx(contours.get_position().width)
    assert "mm" in image.get_xlabel() and surface.get_zticklabels()[-1].get_text().strip() == "0.5 mm"
    stated = float(surface.get_title().split(" x ")[1])
    box = np.asarray(surface._box_aspect)
    assert box[2] / box[0] == pytest.approx(stated * float(depth.max() - depth.min()) / (width * PITCH), rel=1e-3)
    figure.draw_without_rendering()
    boxes = [axes.get_window_extent() for axes in (image, contours)]
    assert boxes[0].height == pytest.approx(boxes[1].height) and not boxes[0].overlaps(boxes[1])


def test_zero_keeps_its_colour_and_equal_depths_are_equally_far_from_it():
    for low, high in ((0.0, 1.0), (-0.1, 2.0), (-3.0, 0.5)):
        colors, norm = viz.depth_colors(low, high)
        assert np.allclose(colors(norm(0.0))[:3], 0.97, atol=0.02)
        if low < 0:
            red, _, blue, _ = colors(norm(low))
            assert red > blue  # brown below zero, blue above
    colors, norm = viz.depth_colors(-1.0, 1.0)
    shades = np.array([np.dot(colors(norm(v))[:3], (0.3, 0.59, 0.11)) for v in np.linspace(0.0, 1.0, 21)])
    assert (np.diff(shades) < 0).all()  # ever darker, so that it can be read in grey


def test_panels_that_are_compared_share_their_range():
    truth, measured, error, *_ = figures.comparison_figure(frame() - 0.05, frame(), PITCH).axes
    assert truth.get_images()[0].get_clim() == measured.get_images()[0].get_clim() == pytest.approx((-0.05, 0.5), abs=1e-3)
    low, high = error.get_images()[0].get_clim()
    assert low == pytest.approx(-high)


@pytest.mark.parametrize("count", [1, 2, 4])
def test_a_sheet_of_few_frames_has_no_empty_panel(count):
    frames = [(0.1 * k, frame().numpy() * (k + 1), "") for k in range(count)]
    figure = viz.sheet_figure(frames, PITCH)
    figure.draw_without_rendering()
    assert len(figure.axes) == count + 1 and all(axes.get_images() for axes in figure.axes[:count])


def test_a_sheet_says_what_is_in_doubt_and_of_how_many_frames_it_is():
    frames = [("a", frame().numpy(), ""), ("b", frame().numpy(), "too dark"), ("c", frame().numpy(), "too bright")]
    figure = viz.sheet_figure(frames, PITCH, "3 of 40 images", metric=False, doubts=["one ball only"])
    titles = [(axes.get_title(), axes.title.get_color() == viz.DOUBT) for axes in figure.axes[:3]]
    assert titles == [("a", False), ("b, IN DOUBT", True), ("c, IN DOUBT", True)]
    assert figure.get_suptitle() == "3 of 40 images, NOT METRIC"
    assert figure.get_supxlabel() == "one ball only\nb IN DOUBT: too dark"


def test_a_pose_is_shown_before_and_after_at_one_scale():
    source = torch.rand(500, 3, dtype=torch.float64) * torch.tensor([8.0, 3.0, 0.4])
    T = torch.eye(4, dtype=torch.float64)
    T[:2, :2] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
    T[:3, 3] = torch.tensor([5.0, -6.0, 0.1])
    figure = viz.pose_figure(source, source @ T[:3, :3].T + T[:3, 3], T, "turned")
    above, space, above_after, space_after = figure.axes
    assert above.get_xlim() == above_after.get_xlim() and above.get_ylim() == above_after.get_ylim()
    assert space.get_zlim() == space_after.get_zlim() and space.get_title().split(", ")[1] == space_after.get_title().split(", ")[1]
    points = [np.asarray(c.get_offsets()) for c in above_after.collections]
    assert np.abs(np.sort(points[0], 0) - np.sort(points[1], 0)).max() < 1e-6
    for axes in (above, above_after):
        shown = np.concatenate([np.asarray(c.get_offsets()) for c in axes.collections])
        assert (shown[:, 0] > axes.get_xlim()[0]).all() and (shown[:, 1] < axes.get_ylim()[1]).all()


def test_a_comparison_names_what_it_compares_and_takes_one_frame():
    one, other, difference, *_ = figures.comparison_figure(frame() - 0.05, frame(), PITCH, names=("response", "look-up table")).axes
    assert one.get_title().startswith("look-up table") and other.get_title().startswith("response")
    assert difference.get_title().startswith("difference, px")
    with pytest.raises(ValueError, match="depth: expected one frame, got"):
        viz.depth_figure(torch.stack((frame(), frame())), PITCH, torch.rand(3, 60, 80))
    with pytest.raises(ValueError, match="truth_mm: expected"):
        figures.comparison_figure(frame(), frame()[..., :-1], PITCH)


def test_arrows_of_dots_have_their_true_length():
    skin = vts.scenes.DottedSkin(120, 160, 0.125)
    drag = vts.scenes.Drag(radius_mm=30.0, shift_mm=(0.3, -0.15))
    calibration = vts.Calibration.from_lights(skin.lights, vts.Sensor("rig", 120, 160, 0.125), skin.image())
    moved = vts.SkinMotion.from_calibration(calibration)(skin.image(drag)[None], skin.depth_mm(drag).float())
    axes = viz.new_figure(3.0, 3.0).subplots()
    viz.draw_motion(axes, moved)
    arrows = axes.collections[0]
    assert len(arrows.U) == int(moved.seen.sum()) > 40
    assert abs(float(arrows.U.mean()) - 0.3) < 0.02 and abs(float(arrows.V.mean()) + 0.15) < 0.02
    assert [text.get_text() for text in axes.texts] == ["0.1 mm"]
