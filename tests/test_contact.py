"""The contact mask."""

from contextlib import nullcontext

import numpy as np
import pytest
import references
import torch
from kornia.morphology import dilation

import torchvts as vts
from torchvts import accelerated
from torchvts.accelerated import reference_only
from torchvts.accelerated.blocks import Drift
from torchvts.core.cells import cell_means, mean_around
from torchvts.core.morphology import dilate, erode, reconstruct
from torchvts.core.robust import half_sample_mode
from torchvts.evaluation import metrics

scenes = vts.scenes


def found(scene, lights, sensor, noise_std=0.0, bits=None, seed=3):
    """Contact of one frame, judged with a background as noisy as the frame."""
    background = scenes.render(scenes.undeformed(scene), lights, noise_std=noise_std, bits=bits, seed=seed + 1)[0]
    pipeline = vts.DepthPipeline.from_calibration(vts.Calibration.from_lights(lights, sensor, background))
    return pipeline(scenes.render(scene, lights, noise_std=noise_std, bits=bits, seed=seed)).deformed


def rim_distance_px(mask, truth):
    """Mean distance between the rims of two masks of one frame, in both directions."""
    rims = []
    for frame in (mask.float(), truth.float()):
        rims.append(torch.nonzero((frame + torch.nn.functional.max_pool2d(-frame, 3, 1, 1))[0, 0] > 0).double())
    distance = torch.cdist(*rims)
    return 0.5 * float(distance.min(0).values.mean() + distance.min(1).values.mean())


@pytest.mark.parametrize("noise_std, bits, least, rim_px", [(0.0, None, 0.999, 0.01), (0.01, 8, 0.99, 0.1)])
@pytest.mark.parametrize("press_mm", [1.0, 2.0])
def test_a_ball_full_size(ring, noise_std, bits, least, rim_px, press_mm):
    scene = scenes.sphere_press(10.0, press_mm)
    contact = found(scene, ring(), vts.Sensor("rig", 480, 640, 0.0625), noise_std, bits)
    assert metrics.mask_iou(contact, scene.contact) > least
    assert rim_distance_px(contact, scene.contact) < rim_px


@pytest.mark.parametrize(
    "press_mm, radius_mm, center_mm", [(1.0, 10.0, (0, 0)), (0.3, 4.0, (-9, 5)), (1.5, 5.0, (12, -8)), (1.0, 10.0, (18, 0))]
)
@pytest.mark.parametrize("noise_std, bits", [(0.0, None), (0.01, 8)])
def test_balls_of_any_size_and_place(ring, small_sensor, small_press, press_mm, radius_mm, center_mm, noise_std, bits):
    scene = small_press(press_mm, center_mm, radius_mm)
    assert metrics.mask_iou(found(scene, ring(), small_sensor, noise_std, bits), scene.contact) > 0.97


def test_letters(ring):
    scene = scenes.letters_press("VTS", height=240, width=320, mm_per_pixel=0.125)
    contact = found(scene, ring(), vts.Sensor("rig", 240, 320, 0.125), 0.005, 8)
    assert metrics.mask_iou(contact, scene.contact) > 0.93
    assert rim_distance_px(contact, scene.contact) < 1.0


def mask_of(changed, height=480, width=640, noise=0.01, seed=None, **options):
    flat = torch.full((3, height, width), 0.5)
    image = flat[None].clone()
    for rows, columns, change in changed:
        image[:, :, rows, columns] += change
    if seed is not None:
        image += noise * torch.randn(image.shape, generator=torch.Generator().manual_seed(seed))
    return vts.ContactMask(flat, torch.full((3,), noise), **options)(image)


def test_a_hole_where_the_slope_vanishes_is_filled():
    ring_shape = [(slice(100, 300), slice(100, 300), 0.2), (slice(180, 220), slice(180, 220), -0.2)]
    expected = torch.zeros(1, 1, 480, 640, dtype=torch.bool)
    expected[..., 100:300, 100:300] = True
    for seed in (None, 0):
        assert metrics.mask_iou(mask_of(ring_shape, seed=seed), expected) > (0.9999 if seed is None else 0.995)


@pytest.mark.parametrize("side, kept", [(1, False), (3, False), (20, True)])
def test_specks_go_and_contacts_stay(side, kept):
    mask = mask_of([(slice(200, 200 + side), slice(300, 300 + side), 0.3)])
    assert int(mask.sum()) == (side**2 if kept else 0)


def test_the_smallest_contact_can_be_set():
    change = [(slice(200, 220), slice(300, 320), 0.3)]
    assert int(mask_of(change, min_size_px=40.0).sum()) == 0


def test_faint_wide_contact_below_the_noise_of_a_pixel_is_found():
    mask = mask_of([(slice(100, 300), slice(100, 300), 0.02)], seed=0)  # two sigmas
    truth = mask_of([(slice(100, 300), slice(100, 300), 0.2)])
    assert metrics.mask_iou(mask, truth) > 0.88


@pytest.mark.parametrize("noise_std", [0.005, 0.02])
def test_pure_noise_is_no_contact(ring, small_sensor, small_press, noise_std):
    rest, lights = scenes.undeformed(small_press()), ring()
    background = scenes.render(rest, lights, noise_std=noise_std, bits=8, seed=99)[0]
    pipeline = vts.DepthPipeline.from_calibration(vts.Calibration.from_lights(lights, small_sensor, background))
    frames = torch.cat([scenes.render(rest, lights, noise_std=noise_std, bits=8, seed=seed) for seed in range(20)])
    assert int(pipeline(frames).deformed.sum()) == 0


@pytest.mark.parametrize("times", [2, 4])
def test_a_frame_noisier_than_the_calibration_does_not_flood(ring, small_sensor, small_press, times):
    scene, lights = small_press(1.0), ring()
    background = scenes.render(scenes.undeformed(scene), lights, noise_std=0.005, bits=8)[0]
    pipeline = vts.DepthPipeline.from_calibration(vts.Calibration.from_lights(lights, small_sensor, background))
    rest = scenes.render(scenes.undeformed(scene), lights, noise_std=0.005 * times, bits=8, seed=1)
    press = scenes.render(scene, lights, noise_std=0.005 * times, bits=8, seed=2)
    assert int(pipeline(rest).deformed.sum()) == 0
    assert metrics.mask_iou(pipeline(press).deformed, scene.contact) > 0.97


def test_undeformed_skin_in_a_shadow_is_shaded_and_a_press_is_not():
    flat = torch.full((3, 64, 64), 0.5)
    mask, image = vts.ContactMask(flat, torch.full((3,), 0.01)), flat.clone()
    image[0, 8:24, 8:24] = 0.0  # one light kept off
    image[:2, 8:24, 40:56] = 0.0  # two, which leaves too little to tell by
    image[0, 40:56, 8:24], image[1, 40:56, 8:24] = 0.0, 0.6  # slopes
    image[0, 40:56, 40:56] = 0.2  # half a shadow
    found = mask.shadowed(image[None])[0, 0]
    expected = torch.zeros(64, 64, dtype=torch.bool)
    expected[8:24, 8:24] = True
    assert torch.equal(found, expected) and bool(mask(image[None])[0, 0][found].all())
    image[2] = 0.0  # a failed LED
    assert not bool(mask.shadowed(image[None]).any())
    dim = torch.full((3, 64, 64), 0.05)  # a channel that is never bright cannot go dark
    assert not bool(vts.ContactMask(dim, torch.full((3,), 0.01)).shadowed(torch.zeros(1, 3, 64, 64)).any())


@pytest.mark.parametrize("compiled", [True, False])
def test_a_strong_shade_is_no_contact_and_does_not_hide_one(compiled):
    """A shade changes more of the light than the press beside it, which alone has colour."""
    y, x = torch.arange(120.0)[:, None] - 60.0, torch.arange(160.0) - 40.0
    disc = x * x + y * y < 20.0**2
    skin = 1.0 + 0.002 * torch.randn(2, 3, 120, 160, generator=torch.Generator().manual_seed(0))
    skin[..., 90:] *= 0.8
    skin[0] += disc * torch.tensor([0.1, -0.1, 0.05])[:, None, None]
    mask = vts.ContactMask(torch.ones(3, 120, 160), torch.full((3,), 0.002), far_field=0.01, least_colour=0.7)
    with nullcontext() if compiled else reference_only():
        pressed, rest = mask(skin)[:, 0]
    assert metrics.mask_iou(pressed[None, None], disc[None, None]) > 0.9 and not bool(rest.any())


@pytest.mark.parametrize("compiled", [True, False])
def test_a_shade_over_half_of_the_skin_gives_no_colour(compiled):
    """Modes of channels that are of different halves would be a change of colour of both."""
    generator = torch.Generator().manual_seed(1)
    skin = 1.0 + 0.002 * torch.randn(1, 3, 120, 160, generator=generator)
    skin[..., 80:] *= 0.88
    skin[:, 0, :60, :80] += 0.02 * torch.rand(60, 80, generator=generator)  # red's mode is in the shade, the others' is not
    skin[:, 1:, :60, 80:] += 0.02 * torch.rand(60, 80, generator=generator)
    with nullcontext() if compiled else reference_only():
        level = Drift().by_mode(skin).flatten()
    assert float(level.max() - level.min()) < 1e-6
    alone = half_sample_mode(skin.flatten(2).sort(dim=2).values)
    assert float(alone.max() - alone.min()) > 0.1


def test_items_of_a_batch_do_not_influence_one_another(ring, small_sensor, small_press):
    lights = ring()
    cal = vts.Calibration.from_lights(lights, small_sensor)
    block = vts.ContactMask(cal.model_image, cal.light_noise_std)
    presses = [small_press(1.0), scenes.undeformed(small_press()), small_press(0.2, (8, 8))]
    frames = torch.cat([scenes.render(scene, lights, noise_std=0.01 * k, seed=k) for k, scene in enumerate(presses)])
    assert torch.equal(block(frames), torch.cat([block(frame[None]) for frame in frames]))


def any_frame(generator, flat, noise, count=3):
    """Frames of noise with up to six contacts: discs, rings and boxes, faint or strong, some cut by the border, one everywhere."""
    height, width = flat.shape[1:]
    y, x = np.mgrid[:height, :width]
    frames = np.repeat(flat.numpy()[None], count, axis=0)
    for frame in frames:
        for _ in range(generator.integers(0, 7)):
            from_center = np.hypot(y - generator.uniform(0, height), x - generator.uniform(0, width))
            if generator.random() < 0.3:
                from_center = np.maximum(abs(y - generator.uniform(0, height)), abs(x - generator.uniform(0, width)))
            radius = generator.uniform(1.0, 0.5 * min(height, width))
            inside = (from_center < radius) & (from_center >= generator.choice([0.0, 0.5, 0.9]) * radius)
            frame += inside * (noise * generator.choice([0.5, 2.0, 5.0, 20.0]) * generator.normal(size=(3, 1, 1)))
        frame += 0.3 * (generator.random() < 0.05)
        frame += noise * generator.choice([0.0, 0.5, 1.0, 3.0]) * generator.normal(size=frame.shape)
    return torch.from_numpy(frames).to(flat.dtype)


@pytest.mark.parametrize("size", [(240, 320), (243, 322), (480, 641), (161, 204), (160, 160), (120, 157), (81, 400), (12, 9)])
def test_loops_find_the_masks_that_operators_find(size):
    generator = np.random.default_rng(size[1])
    flat = torch.full((3, *size), 0.5)
    touched = 0
    for min_size_px, count in ((8.0, 6), (3.0, 1), (25.0, 1)):
        block = vts.ContactMask(flat, torch.full((3,), 0.01), min_size_px=min_size_px)
        frames = any_frame(generator, flat, 0.01, count)
        mask, soft = block(frames), block.soft(frames)
        with reference_only():
            assert torch.equal(mask, block(frames)) and torch.equal(soft, block.soft(frames))
        touched += int(mask.flatten(1).any(dim=1).sum())
    assert touched > 0 or min(size) < 20


def spiral(n):
    """A path one pixel wide that winds inwards: the longest way a flood can be sent."""
    mask = np.zeros((n, n), dtype=bool)
    row, column, step = 0, -1, (0, 1)
    for length in [n, *(k for j in range(n - 1, 0, -2) for k in (j, j))]:
        for _ in range(length):
            row, column = row + step[0], column + step[1]
            mask[row, column] = True
        step = (step[1], -step[0])
    return mask


@pytest.mark.parametrize("share", [0.3, 0.5, 0.6, 0.8])
@pytest.mark.parametrize("size", [(17, 23), (40, 31)])
@pytest.mark.parametrize("way", [vts.ContactMask(torch.full((3, 8, 8), 0.5), torch.full((3,), 0.01)).reconstruct, reconstruct])
def test_reconstruct_equals_a_flood_fill_on_random_masks(share, size, way):
    generator = np.random.default_rng(int(100 * share))
    mask = generator.random((3, 1, *size)) < share
    seed = generator.random(mask.shape) < 0.02
    result = way(torch.from_numpy(seed), torch.from_numpy(mask)).numpy()
    for item in range(3):
        assert np.array_equal(result[item, 0], references.flood(seed[item, 0], mask[item, 0]))


@pytest.mark.parametrize("way", [vts.ContactMask(torch.full((3, 8, 8), 0.5), torch.full((3,), 0.01)).reconstruct, reconstruct])
def test_reconstruct_follows_a_spiral_to_its_end(way):
    mask = spiral(21)
    seed = np.zeros_like(mask)
    seed[0, 0] = True
    result = way(torch.from_numpy(seed)[None, None], torch.from_numpy(mask)[None, None])[0, 0].numpy()
    assert np.array_equal(result, references.flood(seed, mask)) and np.array_equal(result, mask)


def test_filling_from_the_border_equals_the_twin():
    mask = np.random.default_rng(0).random((30, 41)) < 0.6
    border = np.ones_like(mask)
    border[1:-1, 1:-1] = False
    filled = ~reconstruct(torch.from_numpy(border)[None, None], torch.from_numpy(~mask)[None, None])[0, 0].numpy()
    assert np.array_equal(filled, references.fill_holes(mask)) and (filled & ~mask).any()


@pytest.mark.parametrize("share", [0.02, 0.3, 0.9])
def test_dilation_equals_kornia_and_the_twin(share):
    mask = torch.rand(2, 1, 33, 47, generator=torch.Generator().manual_seed(0)) < share
    grown = dilate(mask)
    assert torch.equal(grown, dilation(mask.float(), torch.ones(3, 3)) > 0.5)
    assert np.array_equal(grown[0, 0].numpy(), references.dilate(mask[0, 0].numpy()))
    assert torch.equal(erode(mask), ~dilate(~mask))


@pytest.mark.parametrize("reach", [2, 3, 4, 7, 40])  # 40: beyond the image
def test_dilation_by_a_reach_repeats_the_dilation(reach):
    mask = torch.rand(2, 1, 23, 31, generator=torch.Generator().manual_seed(1)) < 0.01
    repeated = mask
    for _ in range(reach):
        repeated = dilate(repeated)
    assert torch.equal(dilate(mask, reach), repeated)
    assert torch.equal(erode(mask, reach), ~dilate(~mask, reach))


@pytest.mark.parametrize("size", [(7, 9), (40, 50)])
def test_means_of_cells_and_around_pixels_equal_pooling(size):
    image = torch.rand(2, 3, *size, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    pool = torch.nn.functional.avg_pool2d
    assert torch.allclose(mean_around(image), pool(image, 3, 1, 1))
    for cell in (1, 2, 4):
        padded = torch.nn.functional.pad(image, [0, -size[1] % cell, 0, -size[0] % cell])
        assert torch.allclose(cell_means(image, cell), pool(padded, cell))


@pytest.fixture(scope="module")
def soft_case(ring, small_sensor, small_press):
    lights, scene = ring(), small_press(1.0)
    background = scenes.render(scenes.undeformed(scene), lights, noise_std=0.01, seed=1)[0]
    cal = vts.Calibration.from_lights(lights, small_sensor, background)
    return vts.ContactMask(cal.model_image, cal.light_noise_std), scenes.render(scene, lights, noise_std=0.01, seed=2)


def test_soft_contact_thresholds_to_the_hard_mask(soft_case):
    block, frame = soft_case
    soft, hard = block.soft(frame), block(frame)
    assert float(soft.min()) >= 0 and float(soft.max()) <= 1
    assert metrics.mask_iou(soft > 0.5, hard) > 0.99


def test_soft_contact_has_a_slope_at_the_rim_only(soft_case):
    block, frame = soft_case
    frame = frame.clone().requires_grad_(True)
    block.soft(frame).sum().backward()
    moved = frame.grad.abs().sum(1, keepdim=True) > 1e-3
    assert bool(torch.isfinite(frame.grad).all()) and bool(moved.any())
    assert not bool((moved & ~dilate(dilate(block(frame.detach())))).any())


def test_the_slope_of_soft_contact_equals_differences():
    flat = torch.full((3, 16, 18), 0.5, dtype=torch.float64)
    block = vts.ContactMask(flat, torch.full((3,), 0.01, dtype=torch.float64))
    image = flat[None].clone()
    image[..., 3:13, 4:14] += 0.035  # six sigmas over three channels
    assert torch.autograd.gradcheck(block.soft, image.requires_grad_(True), fast_mode=True)


def test_it_scripts_with_both_faces(soft_case):
    block, frame = soft_case
    scripted = torch.jit.script(block)
    assert torch.equal(scripted(frame), block(frame))
    assert (scripted.soft(frame) - block.soft(frame)).abs().max() < 1e-6


@pytest.mark.long
def test_it_compiles(soft_case):
    block, frame = soft_case
    assert torch.equal(torch.compile(block, backend="eager")(frame), block(frame))


@pytest.mark.parametrize("options", [{"sigmas": 0}, {"sigmas": float("nan")}, {"min_size_px": -1.0}])
def test_impossible_options_are_refused(options):
    name = next(iter(options))
    with pytest.raises(ValueError, match=rf"{name}: expected a number above 0 and finite, got {next(iter(options.values()))}"):
        vts.ContactMask(torch.zeros(3, 8, 8), torch.ones(3), **options)


def test_a_flat_image_of_another_shape_is_refused():
    with pytest.raises(ValueError, match=r"flat: expected \(3, H, W\), got \(1, 3, 8, 8\)"):
        vts.ContactMask(torch.zeros(1, 3, 8, 8), torch.ones(3))


@pytest.mark.parametrize("across", [3.5, 0.0])
def test_a_gap_that_has_moved_too_joins_the_lobes_of_one_contact(across):
    """Two lobes, and between them a change of ``across`` noises, below the threshold of 4.5; the light has changed all over."""
    flat, noise = torch.ones(3, 240, 320), 0.004
    ripple = torch.randn(1, 3, 16, 21, generator=torch.Generator().manual_seed(2))
    image = flat + 1.3 * noise * torch.nn.functional.interpolate(ripple, (240, 320), mode="bicubic")[0]
    image[0, 60:180, 80:150] += 40 * noise
    image[2, 60:180, 168:240] += 40 * noise
    image[1, 60:180, 150:168] += across * noise
    for far_field, joined in ((0.06, across > 0.0), (0.0, False)):
        mask = vts.ContactMask(flat, torch.full((3,), noise), far_field=far_field)
        moved = mask(image[None])
        assert bool(moved[..., 70:170, 153:165].all()) is joined
        assert bool(moved[..., 70:170, 85:145].all()) and float(moved[..., :50, :].double().mean()) < 0.02
        with reference_only():
            assert torch.equal(mask(image[None]), moved)
        assert torch.equal(torch.jit.script(accelerated.reference(mask))(image[None]), moved)


@pytest.mark.parametrize("height, width", [(120, 160), (240, 320)])
def test_skin_that_hangs_free_goes_on_below_the_threshold(height, width):
    """A far field of 1.5 % asks for a change of 7 %; free skin of less, which is a fifth of the depth, was left out."""
    y, x = torch.meshgrid(*(torch.arange(n) - (n - 1) / 2 for n in (height, width)), indexing="ij")
    away, decay = torch.hypot(x, y), height / 15
    free = torch.exp((0.2 * height - away).clamp_max(0.0) / decay)
    change = 0.3 * free * torch.stack((x, y, -x - y)) / away
    generator = torch.Generator().manual_seed(1)
    grain = torch.nn.functional.avg_pool2d(torch.randn(1, 3, height + 16, width + 16, generator=generator), 17, 1)
    undeformed = 1.0 + 0.015 * grain / grain.std() + 0.002 * torch.randn(1, 3, height, width, generator=generator)
    mask = vts.ContactMask(torch.ones(3, height, width), torch.full((3,), 0.002), far_field=0.06)
    assert not bool(mask(undeformed).any())
    moved = mask(undeformed + change)[0, 0]
    mask.tail_sigmas = 1e9
    before = mask(undeformed + change)[0, 0]
    mask.tail_sigmas = 3.0
    around = (away > 0.2 * height) & (away < 0.2 * height + 5 * decay)
    left_out = [float(free[around & ~found].sum() / free[around].sum()) for found in (before, moved)]
    assert left_out[1] < 0.25 < 0.28 < left_out[0]
    assert not bool((before & ~moved).any()) and not bool(moved[away > 0.2 * height + 5 * decay].any())
    with reference_only():
        assert torch.equal(mask(undeformed + change)[0, 0], moved)
    assert torch.equal(torch.jit.script(mask)(undeformed + change)[0, 0], moved)


def test_a_tail_that_shares_memory_is_refused():
    """A tail is written to: pixels that share memory would be written together."""
    mask = vts.ContactMask(torch.ones(3, 48, 64), torch.full((3,), 0.002))
    image, one = torch.ones(1, 3, 48, 64), torch.zeros(1, 1, 1, 1, dtype=torch.bool)
    for find in (mask, torch.jit.script(mask)):
        with pytest.raises(Exception, match="tail: expected memory of its own"):
            find(image, tail=one.expand(1, 1, 48, 64))
        assert not bool(find(image, tail=one.expand(1, 1, 48, 64).clone()).any())
