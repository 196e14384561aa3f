"""Motion of printed dots: exact where it must be, never a dot that is not there, and as sure as it says."""

import dataclasses
import functools
import math

import pytest
import torch

import torchvts as vts
from torchvts.model.markers import FillMarkers, find_dots
from torchvts.scenes import DottedSkin, Drag
from torchvts.skin import DotMotion, SkinMotion

PITCH = 0.1
SIZE = {"height": 144, "width": 192, "mm_per_pixel": PITCH, "spacing_mm": 1.8, "diameter_mm": 0.7}
PRESS = Drag((0.6, -0.4), 3.0, 0.7, (0.25, -0.12), 8.0, 0.2, 1.0, 2.5)
CLEAN = DottedSkin(**SIZE, noise_std=0.0, worn=0.05)


@functools.cache
def motion_of(skin, dtype=torch.float32, camera_mm=None):
    background = torch.stack([skin.image(seed=seed) for seed in range(100, 108 if skin.noise_std else 101)]).mean(0).to(dtype)
    markers = FillMarkers.from_background(background)
    camera_mm = (0.0, 0.0, skin.camera_height_mm) if camera_mm is None else camera_mm
    return SkinMotion(background, find_dots(background, markers), markers.diameter_px, PITCH, camera_mm)


@functools.cache
def frame(skin, drag, seed=0, left=None, dtype=torch.float32):
    return skin.image(drag, seed, left)[None].to(dtype), skin.depth_mm(drag).to(dtype)


def errors(moved, drag):
    """Errors (N, 3), mm."""
    return moved.displacement_mm[0].double() - drag.displacement_mm(moved.rest_mm.double())


def test_the_background_itself_has_not_moved():
    motion = motion_of(CLEAN)
    moved = motion(*frame(CLEAN, None))
    assert int(moved.seen.sum()) >= 70 and float(moved.displacement_mm.abs().max()) < 1e-4 * PITCH


def test_images_and_depth_of_another_precision_give_the_same():
    motion = motion_of(CLEAN)
    images, depth = frame(CLEAN, PRESS)
    wanted = motion(images, depth).displacement_mm
    for found in (motion(images.double(), depth), motion(images, depth.double())):
        assert torch.equal(found.displacement_mm, wanted)


@pytest.mark.parametrize("across, down", [(1, 0), (0, -2), (3, 2), (-4, 3)])
def test_a_shift_by_whole_pixels_is_found_exactly(across, down):
    motion = motion_of(CLEAN)
    wide = torch.nn.functional.pad(CLEAN.image()[None], [8, 8, 8, 8], mode="reflect")
    image = wide[..., 8 - down : 152 - down, 8 - across : 200 - across]
    moved = motion(image, torch.zeros(1, 1, 144, 192))
    error = moved.displacement_mm[0, :, :2] / PITCH - torch.tensor([across, down])
    inner = (moved.rest_mm.abs() < torch.tensor([7.0, 5.0])).all(1)
    assert bool(moved.seen[0, inner].all()) and float(error[inner].abs().max()) < 4e-3  # reflected dots bend the border


@pytest.mark.parametrize("size_px", [0.1, 1.0, 4.0])
def test_a_drawn_shear_is_found_to_a_hundredth_of_a_pixel(size_px):
    drag = Drag(radius_mm=30.0, shift_mm=(0.8 * size_px * PITCH, -0.6 * size_px * PITCH))
    moved = motion_of(CLEAN)(*frame(CLEAN, drag))
    error = errors(moved, drag)[moved.seen[0]]
    assert float(error.square().mean().sqrt()) < 0.01 * PITCH and float(error.abs().max()) < 0.04 * PITCH
    assert float(moved.seen.double().mean()) > 0.8


def test_a_turned_image_gives_turned_motion():
    skin = DottedSkin(**SIZE | {"width": 144}, noise_std=0.0, worn=0.05)
    images, depth = frame(skin, PRESS, dtype=torch.float64)
    straight = motion_of(skin, torch.float64)(images, depth)
    background = skin.image().double().rot90(1, (1, 2))
    dots = find_dots(background, FillMarkers.from_background(background))
    turned = SkinMotion(background, dots, motion_of(skin).diameter_px, PITCH, (0.0, 0.0, math.inf))
    moved = turned(images.rot90(1, (2, 3)), depth.rot90(1, (2, 3)))
    back = torch.tensor([[0.0, 1.0], [-1.0, 0.0]], dtype=torch.float64)  # x, y of the image, anticlockwise on the screen
    near, same = torch.cdist(straight.rest_mm @ back.T, moved.rest_mm).min(1)
    expected = torch.cat((straight.displacement_mm[0, :, :2] @ back.T, straight.displacement_mm[0, :, 2:]), 1)
    both = straight.seen[0] & moved.seen[0, same]
    assert float(near.max()) < 1e-6 and int(both.sum()) > 40
    assert float((moved.displacement_mm[0, same] - expected)[both].abs().max()) < 1e-3 * PITCH


def test_no_dot_is_seen_that_is_not_there():
    skin = DottedSkin(**SIZE)
    gone = (torch.rand(len(skin.dots_mm), generator=torch.Generator().manual_seed(1)) < 0.3).double()
    motion = motion_of(skin)
    images, depth = frame(skin, PRESS, left=1.0 - gone)
    last = motion(*frame(skin, PRESS, 3))
    near = torch.cdist(motion(images, depth).rest_mm.double(), skin.dots_mm).argmin(1)
    for moved in (motion(images, depth), motion(images, depth, last)):
        assert not bool((moved.seen[0] & (gone[near] > 0.5)).any())
        assert float(errors(moved, PRESS)[moved.seen[0], :2].norm(dim=1).max()) < 0.2 * PITCH
        assert float(moved.seen[0, gone[near] < 0.5].double().mean()) > 0.8


def test_a_jump_without_a_frame_before_is_missing_and_never_wrong():
    skin, far = DottedSkin(**SIZE), Drag(radius_mm=2.5, shift_mm=(2.6, -0.6), press_mm=0.6, reach_mm=2.4)
    motion = motion_of(skin)
    moved = motion(*frame(skin, far))
    assert float(errors(moved, far)[moved.seen[0], :2].norm(dim=1).max()) < PITCH
    last = None
    for share in (0.2, 0.4, 0.6, 0.8, 1.0):
        drag = Drag(radius_mm=2.5, shift_mm=(2.6 * share, -0.6 * share), press_mm=0.6, reach_mm=2.4)
        last = motion(*frame(skin, drag), last)
        assert float(errors(last, drag)[last.seen[0], :2].norm(dim=1).max()) < PITCH
    assert float(last.seen.double().mean()) > 0.85


def test_frames_do_not_influence_one_another_and_nothing_is_remembered():
    skin = DottedSkin(**SIZE)
    motion = motion_of(skin, torch.float64)
    frames = [frame(skin, drag, dtype=torch.float64) for drag in (PRESS, None)]
    images, depth = (torch.cat(part) for part in zip(*frames))
    both = motion(images, depth)
    again = motion(images, depth, both)
    for k, (one, below) in enumerate(frames):
        alone = motion(one, below)
        last = alone._replace(displacement_mm=both.displacement_mm[k : k + 1])
        for left, right in ((alone, both), (motion(one, below, last), again)):
            assert torch.equal(left.seen[0], right.seen[k])
            assert float((left.displacement_mm[0] - right.displacement_mm[k]).abs().max()) < 1e-9


def test_a_script_takes_the_frame_before():
    skin = DottedSkin(**SIZE)
    motion = motion_of(skin)
    script, (images, depth) = torch.jit.script(motion), frame(skin, PRESS)
    first, plain = script(images, depth), motion(images, depth)
    assert torch.equal(first.seen, plain.seen)
    second = script(images, depth, first)
    assert float((second.displacement_mm - motion(images, depth, plain).displacement_mm).abs().max()) < 1e-4 * PITCH
    assert DotMotion(*first).field()[0].shape == (1, 3, 144, 192)


@pytest.mark.parametrize("camera_height_mm", [math.inf, 15.0])
def test_gradients_are_those_of_difference_quotients(camera_height_mm):
    skin = DottedSkin(**SIZE, camera_height_mm=camera_height_mm)
    motion = motion_of(skin, torch.float64)
    images, depth = frame(skin, PRESS, dtype=torch.float64)
    last = motion(images, depth)
    weight = torch.randn(last.displacement_mm.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    weight = weight * last.seen[..., None]

    def value(images, depth):
        return (weight * motion(images, depth, last).displacement_mm).sum()

    given = (images.clone().requires_grad_(), depth.clone().requires_grad_())
    slopes = torch.autograd.grad(value(*given), given)
    for seed in range(3):
        draw = torch.Generator().manual_seed(seed)
        ways = [torch.nn.functional.avg_pool2d(torch.randn(t.shape, generator=draw, dtype=t.dtype), 3, 1, 1) for t in given]
        step = 1e-5
        for k in (0, 1):
            up, down = ([t + sign * step * ways[j] * (j == k) for j, t in enumerate((images, depth))] for sign in (1.0, -1.0))
            quotient = float(value(*up) - value(*down)) / (2.0 * step)
            assert float((slopes[k] * ways[k]).sum()) == pytest.approx(quotient, rel=2e-2, abs=1e-3)


@pytest.mark.parametrize("noise_std", [1.5 / 255.0, pytest.param(6.0 / 255.0, marks=pytest.mark.long)])
def test_errors_are_as_large_as_stated(noise_std):
    skin = DottedSkin(**SIZE, noise_std=noise_std)
    motion = motion_of(skin)
    moved = [motion(*frame(skin, PRESS, seed)) for seed in range(3)]
    ratio = torch.cat(
        [
            (errors(one, PRESS)[:, :2] / one.covariance_mm2[0].diagonal(dim1=1, dim2=2)[:, :2].double().sqrt())[one.seen[0]]
            for one in moved
        ]
    ).abs()
    assert 0.6 < float((ratio < 1.0).double().mean()) < 0.8
    assert 0.9 < float((ratio < 2.0).double().mean()) < 0.99


def test_the_pinhole_is_taken_out_with_the_camera_and_said_without():
    skin = DottedSkin(**SIZE, camera_height_mm=15.0, noise_std=0.0)
    press = Drag((4.0, 2.0), 2.5, 0.9)
    given = frame(skin, press)
    known, unknown = motion_of(skin)(*given), SkinMotion(skin.image(), *_dots(skin), PITCH)(*given)
    assert float(errors(known, press)[known.seen[0], :2].norm(dim=1).max()) < 0.2 * PITCH
    off = errors(unknown, press)[unknown.seen[0], :2].norm(dim=1)
    said = unknown.pinhole_mm[0, unknown.seen[0]].double()
    assert float(off.max()) > 0.15 and bool((off < 1.5 * said + 0.2 * PITCH).all())
    assert float(known.pinhole_mm.abs().max()) == 0.0


def _dots(skin):
    markers = FillMarkers.from_background(skin.image())
    return find_dots(skin.image(), markers), markers.diameter_px


def test_the_field_between_dots_and_its_uncertainty():
    skin = DottedSkin(**SIZE)
    moved = motion_of(skin)(*frame(skin, PRESS))
    field, std = moved.field()
    truth = PRESS.displacement_mm(skin.rest_mm()).permute(2, 0, 1)
    error, std = (field[0].double() - truth)[:2, 12:-12, 12:-12], std[0, :2, 12:-12, 12:-12]
    assert float(error.square().mean().sqrt()) < 0.15 * PITCH < 0.25 * float(truth[:2].abs().max())
    assert float((error.abs() < std).double().mean()) > 0.6 and float((error.abs() < 2.0 * std).double().mean()) > 0.88
    none = moved._replace(seen=torch.zeros_like(moved.seen))
    assert float(none.field()[0].abs().max()) == 0.0


@pytest.mark.parametrize("stuck, share", [(1.0, 1.0), (0.6, 0.5)])
def test_slip_under_an_object(stuck, share):
    skin = DottedSkin(**SIZE)
    drag = Drag((0.5, 0.2), 4.5, 0.7, (0.35, -0.15), 5.0, 0.0, stuck, 2.2)
    moved = motion_of(skin)(*frame(skin, drag))
    contact = ((skin.rest_mm(drag) - torch.tensor(drag.center_mm)).norm(dim=-1) < drag.radius_mm)[None, None]
    slip = moved.slip(contact)
    assert float(slip.stuck_share) == pytest.approx(share, abs=0.15)
    assert float(slip.turn_deg) == pytest.approx(5.0, abs=0.2)
    touched = ~slip.slip_mm[0, :, 0].isnan()
    rest = moved.rest_mm[touched].double()
    truth = drag.object_mm(rest) - drag.displacement_mm(rest)[:, :2]
    assert int(touched.sum()) > 10 and float((slip.slip_mm[0, touched] - truth).norm(dim=1).max()) < 0.6 * PITCH
    none = moved.slip(torch.zeros_like(contact))
    assert bool(none.turn_deg.isnan().all() & none.slip_mm.isnan().all())


def unit(skin, image=None, **sensor):
    sensor = vts.Sensor("rig", skin.height, skin.width, PITCH, **sensor)
    return vts.Calibration.from_lights(skin.lights, sensor, skin.image() if image is None else image)


def test_a_calibration_keeps_the_dots_in_its_file(tmp_path):
    skin = DottedSkin(**SIZE)
    unit(skin).save(tmp_path / "unit.safetensors")
    given = frame(skin, PRESS)
    before, after = (
        SkinMotion.from_calibration(c)(*given) for c in (unit(skin), vts.Calibration.load(tmp_path / "unit.safetensors"))
    )
    assert torch.equal(before.displacement_mm, after.displacement_mm) and bool((before.pinhole_mm >= 0).all())


@pytest.mark.parametrize("background", ["bare", "flat", "faint", "dust"])
def test_a_skin_without_dots_is_refused(background):
    skin = DottedSkin(**SIZE)
    image = {
        "bare": skin.image(left=torch.zeros(len(skin.dots_mm))),
        "flat": torch.full((3, 144, 192), 0.5),
        "faint": DottedSkin(**SIZE, darkness=(0.01, 0.01, 0.01)).image(),
        "dust": skin.image(left=(torch.arange(len(skin.dots_mm)) % 17 == 0).double()),
    }[background]
    with pytest.raises(
        ValueError, match="calibration: expected a skin with printed dots, got none in the background of sensor 'rig'"
    ):
        SkinMotion.from_calibration(unit(skin, image))


def test_a_calibration_whose_dots_are_filled_says_so():
    with pytest.raises(ValueError, match="got one in which they are filled: calibrate the unit again"):
        SkinMotion.from_calibration(dataclasses.replace(unit(DottedSkin(**SIZE)), printed=None))


def test_a_background_of_another_unit_shows_hardly_any_dot_and_none_in_silence():
    skin, other = DottedSkin(**SIZE), DottedSkin(**SIZE | {"spacing_mm": 2.3}, pattern="hexagonal")
    moved = motion_of(skin)(*frame(other, None))
    assert float(moved.seen.double().mean()) < 0.5


def test_motion_counts_from_the_background_where_that_was_pressed_too():
    background = CLEAN.image(PRESS)
    markers = FillMarkers.from_background(background)
    dots = find_dots(background, markers)
    moved = SkinMotion(background, dots, markers.diameter_px, PITCH, (0.0, 0.0, math.inf))(*frame(CLEAN, None))
    rest = moved.rest_mm + moved.displacement_mm[0, :, :2]
    error = (moved.displacement_mm[0, :, :2] + PRESS.displacement_mm(rest.double())[:, :2])[moved.seen[0]]
    assert int(moved.seen.sum()) > 50 and float(error.square().mean().sqrt()) < 0.05 * PITCH


def test_wrong_frames_are_refused():
    skin = DottedSkin(**SIZE)
    motion, (images, depth) = motion_of(skin), frame(skin, PRESS)
    with pytest.raises(ValueError, match="images: expected 144 x 192 like the calibration, got 143 x 192"):
        motion(images[:, :, 1:], depth)
    with pytest.raises(ValueError, match="depth_mm: expected 144 x 192 like images, got 144 x 191"):
        motion(images, depth[..., 1:])
    with pytest.raises(ValueError, match="depth_mm: expected 1 frames like images, or one for all, got 2: of another batch"):
        motion(images, torch.cat((depth, depth)))
    last = motion(images, depth)
    with pytest.raises(ValueError, match="last: expected 1 frames like images, or one for all, got 2: of another batch"):
        motion(images, depth, last._replace(displacement_mm=torch.cat((last.displacement_mm, last.displacement_mm))))
    with pytest.raises(ValueError, match="last: expected the motion of"):
        motion(images, depth, last._replace(displacement_mm=last.displacement_mm[:, 1:]))
    with pytest.raises(ValueError, match="contact: expected 1 frames like the motion, got 2"):
        last.slip(torch.zeros(2, 1, 144, 192, dtype=torch.bool))
