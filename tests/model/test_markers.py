"""Printed markers: found in every frame, moved ones too, nothing else taken for one, and no dots left in the depth."""

import cv2
import pytest
import torch
from conftest import ring_lights
from torch import nn

import torchvts as vts
from torchvts.model.markers import FillMarkers, fill_markers, find_markers, is_printed
from torchvts.model.response_field import ResponseField, ResponseModel

HEIGHT, WIDTH, PITCH, NOISE = 200, 264, 0.1, 0.004
PRESSES = ("sample_8", "sample_13", "sample_34", "sample_43")
FRAMES = ("ref", *PRESSES)


def dots(spacing=20.0, long=4.5, short=3.0, push=0.0, dtype=torch.float32):
    """How much of a marker lies on each pixel, 0 to 1, (1, 1, H, W): ellipses with soft edges, moved away from the middle."""
    y, x = torch.meshgrid(torch.arange(HEIGHT, dtype=dtype), torch.arange(WIDTH, dtype=dtype), indexing="ij")
    cover = torch.zeros(HEIGHT, WIDTH, dtype=dtype)
    for row in range(int(HEIGHT / spacing)):
        for column in range(int(WIDTH / spacing)):
            cy, cx = (row + 0.5) * spacing, (column + 0.5) * spacing
            dy, dx = cy - HEIGHT / 2, cx - WIDTH / 2
            far = push / (1.0 + (dx * dx + dy * dy) / 1600.0)
            radius = (((x - cx - far * dx / 40) / long) ** 2 + ((y - cy - far * dy / 40) / short) ** 2).sqrt()
            cover = torch.maximum(cover, torch.sigmoid((1.0 - radius) * 8.0))
    return cover[None, None]


def frame(press_mm=0.0, depth=0.45, noise=NOISE, seed=0, dtype=torch.float32, **how):
    """A frame with markers, the same without them and without noise, and the markers' pixels."""
    scene = vts.scenes.sphere_press(8.0, press_mm or 1.0, (1.0, -0.5), HEIGHT, WIDTH, PITCH, dtype)
    scene = scene if press_mm else vts.scenes.undeformed(scene)
    clean = vts.scenes.render(scene, ring_lights(dtype=dtype))
    cover = dots(push=4.0 * press_mm, dtype=dtype, **how)
    generator = torch.Generator().manual_seed(seed)
    grain = noise * torch.randn(clean.shape, generator=generator, dtype=torch.float64).to(dtype)
    image = (clean * (1.0 - depth * cover) + grain).clamp(0, 1)
    return torch.round(image * 255) / 255, clean, cover > 0.5


def grow(mask, reach):
    return nn.functional.max_pool2d(mask.float(), 2 * reach + 1, 1, reach) > 0.5


def centers(mask):
    """Centres of the blobs of a (1, 1, H, W) mask that the border does not cut, (N, 2), x and y."""
    count, _, boxes, middle = cv2.connectedComponentsWithStats(mask[0, 0].to(torch.uint8).numpy())
    left, top, wide, high, _ = boxes.T
    inside = (left > 0) & (top > 0) & (left + wide < mask.shape[3]) & (top + high < mask.shape[2])
    inside[0] = False  # the ground
    return torch.from_numpy(middle[inside]), count - 1


def marker_pattern(values, places, spacing_px):
    """What all markers have in common in a (1, C, H, W) map: the RMS of the mean of the patches around ``places`` (N, 2).

    Patches are one spacing wide, less their own quadratic each, so that shading cancels and noise falls with the root of N.
    """
    half = round(0.5 * spacing_px)
    ramp = torch.linspace(-1, 1, 2 * half + 1, dtype=torch.float64)
    y, x = torch.meshgrid(ramp, ramp, indexing="ij")
    bowl = torch.stack((torch.ones_like(x), x, y, x * x, x * y, y * y)).flatten(1)
    bowl = torch.linalg.qr(bowl.T).Q.T  # (6, N)
    patches = []
    for x, y in places.round().long().tolist():
        if half <= x < values.shape[3] - half and half <= y < values.shape[2] - half:
            patch = values[0, :, y - half : y + half + 1, x - half : x + half + 1].double().flatten(1)
            patches.append(patch - patch @ bowl.T @ bowl)
    return float(torch.stack(patches).mean(0).square().mean().sqrt())


def pseudo_depth(image, rest):
    """Depth from the change of log light, weighted by rough light directions of the lab sensor: red lower right, green left,
    blue top. No calibration, so of no unit; enough to see dots."""
    toward = torch.tensor([[0.7, 0.7], [-1.0, 0.1], [0.0, -1.0]])
    change = torch.log((image + 0.03) / (rest + 0.03))
    return vts.poisson_dct(torch.einsum("bchw,cd->bdhw", change, toward), 1.0)


@pytest.mark.parametrize("press_mm, depth", [(0.0, 0.2), (0.3, 0.8), (0.8, 0.2), (0.8, 0.45)])
def test_markers_are_found_and_nothing_else(press_mm, depth):
    image, _, true = frame(press_mm, depth)
    mask = find_markers(image)
    assert int((mask & true).sum()) >= 0.95 * int(true.sum())
    assert float((mask & ~grow(true, 4)).float().mean()) < 0.01


@pytest.mark.parametrize("press_mm", [0.0, 0.8])
def test_the_filled_image_is_the_one_without_markers(press_mm):
    image, clean, true = frame(press_mm)
    error = (FillMarkers()(image) - clean)[true.expand_as(clean)]
    before = (image - clean)[true.expand_as(clean)]
    assert (
        float(error.square().mean().sqrt()) < (1.0 if press_mm == 0 else 3.0) * NOISE
    )  # the membrane cuts off the ball's curvature
    assert float(error.square().mean().sqrt()) < 0.08 * float(before.square().mean().sqrt())


@pytest.mark.parametrize("press_mm", [0.0, 0.3])
def test_depth_has_no_dots(press_mm):
    image, clean, true = frame(press_mm)
    places, _ = centers(true)
    rest = frame(noise=0.0)[1]
    before, after, never = (marker_pattern(pseudo_depth(i, rest), places, 20) for i in (image, FillMarkers()(image), clean))
    assert after < never + 0.05 * before


@pytest.mark.parametrize("press_mm, noise", [(0.0, 0.03), (0.8, 0.0), (0.8, 0.004)])
def test_an_image_without_markers_comes_back_as_it_is(press_mm, noise):
    image, _, _ = frame(press_mm, depth=0.0, noise=noise)
    assert not bool(find_markers(image).any())
    assert torch.equal(FillMarkers()(image), image)


def test_lines_rims_and_large_spots_are_no_markers():
    image, _, _ = frame(depth=0.0, noise=0.0)
    y, x = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    for shape in ((x - 100).abs() < 3, (y - 90).abs() < 3, (x - y).abs() < 4, x > 130, (x - 130) ** 2 + (y - 100) ** 2 < 40**2):
        mask = find_markers(torch.where(shape, 0.6 * image, image))
        assert not bool(mask[..., 12:-12, 12:-12].any())  # a slanting line that ends on the border is a wedge in its mirror


def test_what_is_dark_in_two_channels_only_is_no_marker():
    image, _, true = frame(depth=0.0)
    image = image * (1 - 0.4 * true * torch.tensor([1.0, 1.0, 0.0])[:, None, None])
    assert not bool(find_markers(image).any())


def test_markers_cut_by_the_border():
    image = torch.full((1, 3, 64, 64), 0.5)
    image[..., 0:3, 20:26] = image[..., 30:36, 61:64] = image[..., 61:64, 61:64] = 0.25
    assert float((FillMarkers()(image) - 0.5).abs().max()) < 1e-5


@pytest.mark.parametrize("diameter_px", [6.0, 12.0])
def test_the_diameter_need_not_be_exact(diameter_px):
    image, _, true = frame(0.3)
    mask = find_markers(image, diameter_px)
    assert int((mask & true).sum()) >= 0.95 * int(true.sum())


@pytest.mark.parametrize("scale", [1, 2, 3])
def test_the_diameter_comes_from_the_background(scale):
    background = nn.functional.interpolate(frame(noise=0.0)[0], scale_factor=scale, mode="bilinear")[0]
    block = FillMarkers.from_background(background)
    assert abs(block.diameter_px - 7.5 * scale) <= scale  # an ellipse of 9 x 6 px with soft edges
    assert 0.08 < block.contrast < 0.12  # a fifth of the dots'
    rest = block(background[None])
    assert not bool(find_markers(rest, block.diameter_px, block.contrast).any())


def test_a_background_without_markers_gives_a_block_that_does_nothing():
    background = frame(depth=0.0)[0][0]
    block = FillMarkers.from_background(background)
    image = frame(0.5)[0]
    assert block.diameter_px == 0.0 and block(image) is image


def test_a_constant_and_a_ramp_are_filled_exactly():
    mask = dots() > 0.2
    assert float((fill_markers(torch.full((1, 3, HEIGHT, WIDTH), 0.3), mask) - 0.3).abs().max()) < 1e-6
    ramp = torch.linspace(0.2, 0.8, WIDTH, dtype=torch.float64).expand(1, 1, HEIGHT, WIDTH).contiguous()
    rise = 0.6 / WIDTH * 11.0  # over the longer side
    assert float((fill_markers(ramp, mask) - ramp).square()[mask].mean().sqrt()) < 0.03 * rise
    assert float((fill_markers(ramp, mask, 300) - ramp).abs().max()) < 1e-6  # the membrane through a ramp is the ramp


def test_gradient_flows_through_unmarked_pixels_alone():
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(1, 2, 7, 9, generator=generator, dtype=torch.float64).requires_grad_()
    mask = torch.rand(1, 1, 7, 9, generator=generator) < 0.3
    assert torch.autograd.gradcheck(lambda i: fill_markers(i, mask), (image,))
    (slope,) = torch.autograd.grad(fill_markers(image, mask).sum(), image)
    assert bool((slope[mask.expand_as(image)] == 0).all()) and float(slope.sum()) == pytest.approx(image.numel())
    picture = frame(0.3)[0].requires_grad_()
    FillMarkers()(picture).square().sum().backward()
    assert bool(torch.isfinite(picture.grad).all()) and float(picture.grad.abs().sum()) > 0


def test_a_real_skin_without_markers_is_left_unmarked(data):
    folder = data / "gelsight_mini_a"
    files = [folder / "background.png", *sorted(folder.glob("*mm/*/gelsight.png"))]
    assert len(files) == 35
    shares = [float(find_markers(vts.read_image(file)[None]).float().mean()) for file in files]
    assert max(shares) < 0.001
    assert FillMarkers.from_background(vts.read_image(files[0])).diameter_px == 0.0


def gelslim(data, name):
    return vts.read_image(data / "gelslim_markers" / f"{name}.jpg")[None]


def test_the_grid_of_a_real_sensor_is_found(data):
    image = gelslim(data, "ref")
    block = FillMarkers.from_background(image[0])
    places, count = centers(find_markers(image, block.diameter_px, block.contrast))
    assert 260 <= count <= 280  # 15 rows of 18, those on the border too
    gaps = torch.cdist(places, places).fill_diagonal_(torch.inf).min(1).values
    assert 20 < float(gaps.median()) < 24 and float(((gaps / gaps.median() - 1).abs() < 0.3).double().mean()) > 0.95


@pytest.mark.parametrize("name", [FRAMES[1], *(pytest.param(name, marks=pytest.mark.long) for name in (FRAMES[0], *FRAMES[2:]))])
@pytest.mark.parametrize("margin, left_in_light, left_in_depth", [(0.2, 0.06, 0.28), (0.4, 0.025, 0.12)])
def test_no_dots_are_left_in_a_real_sensors_image_and_depth(data, name, margin, left_in_light, left_in_depth):
    rest, image = gelslim(data, "ref"), gelslim(data, name)
    block = FillMarkers.from_background(rest[0], margin=margin)
    places, _ = centers(find_markers(image, block.diameter_px, block.contrast))
    filled = block(image)
    flat = nn.functional.interpolate(nn.functional.avg_pool2d(block(rest), 20, ceil_mode=True), rest.shape[2:], mode="bilinear")
    before, after = (marker_pattern(torch.log(i + 0.03), places, 21) for i in (image, filled))
    assert after < left_in_light * before
    before, after = (marker_pattern(pseudo_depth(i, flat), places, 21) for i in (image, filled))
    assert after < left_in_depth * before


@pytest.mark.parametrize("name", [PRESSES[0], *(pytest.param(name, marks=pytest.mark.long) for name in PRESSES[1:])])
def test_all_markers_of_a_press_are_found(data, name):
    rest, image = gelslim(data, "ref"), gelslim(data, name)
    block = FillMarkers.from_background(rest[0])
    undeformed, pressed = (find_markers(i, block.diameter_px, block.contrast) for i in (rest, image))
    x, y = centers(undeformed)[0].round().long().T
    assert int((~grow(pressed, 4)[0, 0, y, x]).sum()) <= 1
    assert float(pressed.float().mean()) < 1.03 * float(undeformed.float().mean())  # shading adds nothing


@pytest.mark.parametrize("given, found", [(None, True), (True, True), (False, False)])
def test_a_regular_pattern_is_found_unless_the_sensor_says_otherwise(given, found):
    field = ResponseField(0, -1, 10.0, ((0.3, 0, 0), (0, 0.3, 0)))
    image = torch.full((3, 120, 160), 0.5)
    for row in range(10, 120, 20):
        for column in range(10, 160, 20):
            image[:, row - 2 : row + 3, column - 2 : column + 3] = 0.1
    unit = vts.Calibration.from_response(ResponseModel(field, None), vts.Sensor("rig", 120, 160, 0.1, markers=given), image)
    assert (unit.markers is not None) == found


def test_dust_is_no_pattern():
    image = torch.full((3, 120, 160), 0.5)
    generator = torch.Generator().manual_seed(0)
    for _ in range(25):
        row, column = int(torch.randint(5, 115, (1,), generator=generator)), int(torch.randint(5, 155, (1,), generator=generator))
        image[:, row - 2 : row + 3, column - 2 : column + 3] = 0.1
    assert not is_printed(image, FillMarkers.from_background(image))
