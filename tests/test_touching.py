"""Where an object touches, apart from where the skin has moved: on drawn skin that hangs free, and on labelled presses."""

import dataclasses
import math

import pytest
import torch

import torchvts as vts
from torchvts.accelerated import ContactMask, reference_only
from torchvts.calibration import fit_prior
from torchvts.contact import above_tail
from torchvts.core.geometry import gradient_of_depth
from torchvts.evaluation import pose_accuracy
from torchvts.evaluation.gallery import CORRUPTIONS
from torchvts.integration.background import ZeroBackground, with_faces
from torchvts.model import ResponseModel
from torchvts.scenes import hanging_skin, render
from torchvts.scenes import objects as targets
from torchvts.scenes.surfaces import smooth_step, surface

PITCH, HEIGHT, WIDTH = 0.0634, 240, 320


def membrane(object_mm, decay_mm=0.6, steps=250):
    """Depth of skin that hangs free around an object, and where it is pressed: the obstacle problem, by accelerated projection."""
    height, width = object_mm.shape
    ky, kx = (2.0 * math.pi * f for f in (torch.fft.fftfreq(2 * height, PITCH), torch.fft.rfftfreq(2 * width, PITCH)))
    kernel = 1.0 / (1.0 + decay_mm**2 * (ky[:, None] ** 2 + kx**2))

    def depth_under(pressure):
        spectrum = torch.fft.rfft2(pressure, s=(2 * height, 2 * width)) * kernel
        return torch.fft.irfft2(spectrum, s=(2 * height, 2 * width))[:height, :width]

    pressure = momentum = torch.zeros_like(object_mm)
    for k in range(steps):
        after = (momentum - (depth_under(momentum) - object_mm)).clamp_min(0.0)
        momentum, pressure = after + k / (k + 3.0) * (after - pressure), after
    return depth_under(pressure)[None, None], (pressure > 0.02 * float(object_mm.max()))[None, None]


def objects():
    y, x = torch.meshgrid((torch.arange(HEIGHT) - 119.5) * PITCH, (torch.arange(WIDTH) - 159.5) * PITCH, indexing="ij")
    away = torch.hypot(x, y)
    ball = torch.sqrt((3.15**2 - away**2).clamp_min(0.01)) - 3.15 + 0.8
    flat = 0.5 - ((away - 3.0) / 0.15 + 0.5).clamp(0.0, 1.0) * 4.0
    rod = torch.sqrt((9.0 - (0.6 * x - 0.8 * y) ** 2).clamp_min(0.01)) - 2.5
    return {"ball": ball, "flat punch": flat, "cone": 0.8 - 0.45 * away, "rod": rod}


def found(depth):
    deformed = depth > 0.02
    gradient = gradient_of_depth(depth, PITCH) * deformed
    return vts.ContactFromDepth(PITCH)(depth, gradient, deformed), deformed


def iou(one, other):
    return float((one & other).sum() / (one | other).sum())


@pytest.mark.parametrize("name, least", [("ball", 0.85), ("flat punch", 0.7), ("cone", 0.75), ("rod", 0.85)])
def test_contact_of_skin_that_hangs_free(name, least):
    depth, truth = membrane(objects()[name])
    contact, deformed = found(depth)
    assert iou(contact, truth) > least > iou(deformed, truth) + 0.15


@pytest.mark.parametrize("pitch, height, width", [(0.128, 60, 80), (0.064, 120, 160), (0.032, 240, 320)])
def test_skin_that_hangs_over_a_groove_is_no_contact(pitch, height, width):
    """Two bars 1 mm apart: the skin between them is deeper than the rim around them, and was contact."""
    y, x = ((torch.arange(n) - (n - 1) / 2) * pitch for n in (height, width))
    bars = ((x.abs() - 1.2).abs() < 0.7) & (y.abs()[:, None] < 2.4)
    scene = hanging_skin(torch.where(bars, 0.5, -1.0)[None, None], 0.6, pitch)
    deformed = scene.depth_mm > 0.02
    inputs = (scene.depth_mm, scene.gradient * deformed, deformed)
    contact = vts.ContactFromDepth(pitch)(*inputs)
    middle = (x.abs() < 0.25) & (y.abs()[:, None] < 1.5)
    assert not bool(contact[0, 0][middle].any()) and iou(contact, scene.contact) > 0.76  # before: 0.63
    assert float(scene.depth_mm[0, 0][middle].min()) > 0.2
    with reference_only():
        assert torch.equal(vts.ContactFromDepth(pitch)(*inputs), contact)


@pytest.mark.parametrize("height", [targets.tool_handle(), targets.textured_patch(seed=7)], ids=["grooves", "waves"])
def test_grooves_and_waves_are_no_skin_that_hangs_free(height):
    """They bend as free skin does; their contacts had an IoU of 0.7 and 0.5."""
    lights, pipe = pose_accuracy.rig()
    for k, tilt_deg in enumerate([(0.5, -0.2), (1.5, 1.9), (-1.8, 1.0)]):
        scene = targets.press(height, targets.pose(10.0 * k, (0.3 * k, -0.2), 0.45, tilt_deg), 240, 320, pipe.mm_per_pixel)
        with torch.inference_mode():
            out = pipe(render(scene, lights, noise_std=0.005, bits=8, seed=k))
        assert iou(out.contact, scene.contact) > 0.94


def test_contact_does_not_depend_on_units_of_length():
    depth, _ = membrane(objects()["ball"])
    contact, deformed = found(depth)
    turned = [t.transpose(2, 3) for t in (depth, gradient_of_depth(depth, PITCH).flip(1) * deformed, deformed)]
    assert torch.equal(vts.ContactFromDepth(PITCH)(*turned).transpose(2, 3), contact)


def test_pressure_is_looked_for_above_the_edge_of_the_tail():
    """Frames each by themselves; without a tail nothing changes; a flat face within the tail stays."""
    y, x = torch.meshgrid(torch.arange(40.0) - 20.0, torch.arange(50.0) - 25.0, indexing="ij")
    away = torch.hypot(x, y)[None, None]
    depth = torch.cat((0.05 * (16.0 - away).clamp(0.0, 10.0), 0.05 * (16.0 - away).clamp(0.0, 10.0)))
    deformed = depth > 0.0
    tail = torch.cat((deformed[:1] & (away > 12.0), torch.zeros_like(deformed[:1])))
    tail[0, 0, 20, 25] = True  # as deep as it gets
    above, core = above_tail(depth, deformed, tail)
    assert 0.2 <= float((depth - above)[0][core[0]].max()) < 0.25  # depth at 12 pixels from the middle, and at 11
    assert torch.equal(core[0], (away <= 12.0)[0]) and float(above.min()) == 0.0
    assert torch.equal(above[1], depth[1]) and torch.equal(core[1], deformed[1])


def test_script_export_windows_and_batches_agree():
    depth, _ = membrane(objects()["ball"], steps=60)
    depth = torch.cat((depth, 0.5 * depth.roll(16, 3)))
    deformed = depth > 0.02
    inputs = (depth, gradient_of_depth(depth, PITCH) * deformed, deformed)
    block = vts.ContactFromDepth(PITCH)
    contact = block(*inputs)
    assert torch.equal(torch.jit.script(block)(*inputs), contact) and not bool((contact & ~deformed).any())
    assert torch.equal(torch.export.export(block, inputs, strict=False).module()(*inputs), contact)
    assert torch.equal(torch.cat([block(*(t[k : k + 1] for t in inputs)) for k in range(2)]), contact)
    rows, columns = deformed.any(0)[0].nonzero().unbind(1)
    top, left = int(rows.min() - 1) // 8 * 8, int(columns.min() - 1) // 8 * 8
    window = (slice(None), slice(None), slice(top, int(rows.max()) + 10), slice(left, int(columns.max()) + 10))
    assert torch.equal(block(*(t[window] for t in inputs)), contact[window])


def test_a_constant_error_of_slope_leaves_no_pit():
    depth, truth = membrane(objects()["ball"], steps=60)
    deformed = depth > 0.02
    gradient = (gradient_of_depth(depth, PITCH) + torch.tensor([0.05, 0.03])[:, None, None]) * deformed
    before = vts.poisson_background(gradient, PITCH)
    after = ZeroBackground()(before, deformed)
    assert float(before.min()) < -0.05 and float(after.min()) > -0.02
    assert float((after - depth)[truth].abs().mean()) < float((before - depth)[truth].abs().mean()) + 0.01
    assert torch.equal(torch.jit.script(ZeroBackground())(before, deformed), after)


def slopes_of_noise(smooth_px, size=(HEIGHT, WIDTH)):
    """Slopes that are no surface: independent noise of both slopes, smoothed, of 0.1 RMS."""
    noise = torch.randn(2, 1, *size, generator=torch.Generator().manual_seed(smooth_px))
    noise = torch.nn.functional.avg_pool2d(noise, 2 * smooth_px + 1, 1, smooth_px)
    return (0.1 * noise / noise.std()).transpose(0, 1)


@pytest.mark.parametrize("smooth_px", [2, 5])
def test_slopes_of_noise_are_no_contact_and_light_presses_beside_them_are(smooth_px):
    patch = torch.zeros(1, 1, HEIGHT, WIDTH, dtype=torch.bool)
    patch[..., 20:90, 20:110] = True
    gradient = slopes_of_noise(smooth_px) * patch
    depth = ZeroBackground()(vts.poisson_background(gradient, PITCH), patch)
    touching = vts.ContactFromDepth(PITCH)
    assert float(depth.max()) > 0.005 and not bool(touching(depth, gradient, patch).any())
    y, x = torch.meshgrid((torch.arange(HEIGHT) - 170.0) * PITCH, (torch.arange(WIDTH) - 230.0) * PITCH, indexing="ij")
    pressed, truth = membrane(torch.sqrt((9.0 - x.square() - y.square()).clamp_min(0.01)) - 3.0 + 0.1, decay_mm=0.3, steps=60)
    deformed = pressed > 0.005
    slopes = gradient + (gradient_of_depth(pressed, PITCH) + 0.2 * slopes_of_noise(2)) * deformed
    contact = touching(depth + pressed * deformed, slopes, patch | deformed)
    assert not bool((contact & patch).any()) and bool(contact[truth].float().mean() > 0.9)


def test_no_pixel_decides_all_at_once_how_deep_the_skin_around_it_is():
    y, x = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
    depth = (1.0 - ((x - 80.0) ** 2 + (y - 60.0) ** 2) / 900.0).clamp_min(0.0)[None, None]
    deformed = ((x - 80.0).square() + (y - 60.0).square() < 45.0**2)[None, None]
    beside, low = [], torch.linspace(0.0, 0.04, 81)
    for by in low:
        one = depth.clone()
        one[..., 60, 118] = -float(by)
        beside.append(float(ZeroBackground()(one, deformed)[..., 60, 116]))
    steps = torch.tensor(beside).diff().abs()
    assert beside[20] == beside[0]  # 1 % of the depth is left as it is
    assert float(steps.max()) < 0.1 * abs(beside[-1] - beside[0]) and abs(beside[-1] - beside[0]) > 1e-3


def test_a_pocket_of_errors_makes_no_face_of_the_skin_around_it_and_a_cut_face_stays():
    deformed = torch.zeros(1, 1, 96, 128, dtype=torch.bool)
    deformed[..., 30:60, 40:90] = True
    pocket = deformed.clone()
    pocket[..., 40:50, 60:70] = False  # unchanged skin that deformed skin surrounds
    depth = 0.01 * torch.ones(1, 1, 96, 128)
    depth[..., 36:54, 56:74] = -0.05
    assert not bool(ZeroBackground()(depth, pocket)[..., :25, :].any())
    face = torch.zeros(1, 1, 96, 128)
    face[..., :50] = 0.5  # its other end lies beyond the image
    rim = torch.zeros_like(deformed)
    rim[..., 46:54] = True
    zeroed = ZeroBackground()(face - 0.2, rim)
    assert float((zeroed - face)[..., :40].abs().max()) < 1e-6 and not bool(zeroed[..., 60:].any())


def cut_face(width=128, level=0.5, shift=0.0):
    """A face that reaches beyond the left border, its rim, and undeformed skin; depth errs by a constant."""
    depth, rim = torch.zeros(1, 1, 96, width), torch.zeros(1, 1, 96, width, dtype=torch.bool)
    depth[..., 20:70, :50] = level
    rim[..., 18:72, :52], rim[..., 24:66, :46] = True, False
    return depth + shift, rim


def test_a_face_whose_rim_is_open_is_deformed_and_no_other_skin_is():
    depth, rim = cut_face(shift=-0.1)
    grown = with_faces(depth, rim)
    assert bool(grown[..., 18:72, :46].all()) and not bool((grown & (depth < 0.0) & ~rim).any())
    assert torch.equal(torch.jit.script(with_faces)(depth, rim), grown)
    inside, opened = (torch.nn.functional.pad(t, [6, 0], value=v)[..., :128] for t, v in ((depth, -0.1), (rim, 0.0)))
    assert bool(with_faces(inside, opened)[..., 20:70, 6:56].all())  # the image border cuts nothing, but the rim has no left side
    level = torch.where(rim, depth, torch.full_like(depth, -0.1))  # depth is that of undeformed skin on both sides of the rim
    assert torch.equal(with_faces(level, rim), rim)
    rise = depth - 0.6 * (
        torch.arange(128.0) > 50
    )  # slopes that do not sum to zero: all skin on the left lies above that on the right
    middle = torch.nn.functional.pad(rim[..., 20:70, 20:90], [20, 38, 20, 26])
    assert torch.equal(with_faces(rise, middle), middle)  # and no rim reaches the image border
    leak = torch.where(rim, depth + 0.6, depth)  # unchanged skin lies above undeformed skin, by less than half of the depth
    assert torch.equal(with_faces(leak, rim), rim)
    both = with_faces(torch.cat((depth, level)), torch.cat((rim, rim)))
    assert torch.equal(both, torch.cat((grown, rim)))


@pytest.mark.parametrize("mode", ["fast", "precise"])
def test_contact_holds_a_face_along_whose_rim_the_light_hardly_changes(ring, mode):
    """A part of the rim is so gentle that its change is below the threshold; before, the face was neither deformed nor contact."""
    cal = vts.Calibration.from_lights(ring(), vts.Sensor("open", 120, 160, 0.1))
    pipe = vts.DepthPipeline.from_calibration(cal, mode)
    pipe.deformed = ContactMask(cal.flat, torch.full((3,), 0.05))
    wall = lambda x, y: 0.4 + 3.0 * torch.exp(-((torch.atan2(y, x) / 0.5) ** 2))  # noqa: E731
    scene = surface(lambda x, y: 0.5 * (1.0 - smooth_step((torch.hypot(x, y) - 2.5) / wall(x, y))), 120, 160, 0.1)
    image = vts.scenes.render(scene, ring(), noise_std=0.004, bits=8)
    found, out = pipe.deformed(pipe.compensate(image)), pipe(image)
    face = scene.depth_mm > 0.49
    assert float(found[face].float().mean()) < 0.2 and float(out.contact[face].float().mean()) > 0.99
    assert not bool(out.deformed[scene.depth_mm < 1e-3].any())
    with reference_only():
        same = pipe(image)
    assert torch.equal(same.contact, out.contact) and float((same.depth_mm - out.depth_mm).abs().max()) < 1e-6


@pytest.mark.parametrize("mode", ["fast", "precise"])
def test_contact_holds_a_face_that_the_border_cuts(ring, mode):
    """Before, a face too flat to change the light was neither deformed nor contact, and depth was zero between it and the skin."""
    pipe = vts.DepthPipeline.from_calibration(vts.Calibration.from_lights(ring(), vts.Sensor("cut", 120, 160, 0.1)), mode)
    scene = surface(lambda x, y: 0.5 * (1.0 - smooth_step((torch.hypot(x + 6.0, y) - 4.0) / 0.8)), 120, 160, 0.1)
    image = vts.scenes.render(scene, ring(), noise_std=0.004, bits=8)
    out = pipe(image)
    assert float(out.contact[scene.depth_mm > 0.49].float().mean()) > 0.99
    assert float(out.deformed[scene.depth_mm < 1e-3].float().mean()) < 0.01
    assert float((out.depth_mm - scene.depth_mm).abs().mean()) < 0.02
    with reference_only():
        same = pipe(image)
    assert torch.equal(same.contact, out.contact) and float((same.depth_mm - out.depth_mm).abs().max()) < 1e-5


@pytest.mark.parametrize("corruption,severity", [("albedo drift", 0.02), ("few bits", 6.0)])
def test_skin_without_depth_is_no_contact_where_none_hangs_free(corruption, severity):
    case = CORRUPTIONS[corruption].make(severity, 0)
    out = vts.DepthPipeline.from_calibration(case.calibration, "fast")(case.image)
    truth = case.truth.contact
    assert int((out.deformed & ~truth).sum()) > int(truth.sum())  # stains and banding, far from the ball
    assert float((out.contact & truth).sum() / (out.contact | truth).sum()) > 0.7


def test_a_stand_in_needs_as_much_light_to_change_in_dark_pixels_as_in_bright_ones(small_sensor):
    background = torch.full((3, 120, 160), 0.4)
    background[..., 140:] = 0.02
    cal = vts.Calibration.from_response(ResponseModel.zero(1.0, 1.0), small_sensor, background)
    mask = ContactMask.from_calibration(dataclasses.replace(cal, report={"model": "response", "source": "stand_in"}))
    change = torch.zeros(1, 1, 120, 160)
    change[..., 40:60, 40:60], change[..., 40:60, 145:155] = 0.1, 0.005  # light: a quarter of the background in both
    found = mask((background + change) / background)
    assert bool(found[..., 42:58, 42:58].all()) and not bool(found[..., 140:].any())


def test_thresholds_can_be_set(ring, small_sensor, small_press):
    cal = vts.Calibration.from_lights(ring(), small_sensor)
    image = vts.scenes.render(small_press(1.0), ring())
    usual, strict = (vts.DepthPipeline.from_calibration(cal, contact=s) for s in (None, vts.ContactSettings(9.0, 200.0, 1.0)))
    assert bool(usual(image).deformed.any()) and not bool(strict(image).deformed.any())
    assert (strict.deformed.sigmas, strict.deformed.min_size_px, strict.contact.share) == (9.0, 200.0, 1.0)
    depth, _ = membrane(objects()["ball"], steps=60)
    inputs = (depth, gradient_of_depth(depth, PITCH), depth > 0.02)
    assert int(vts.ContactFromDepth(PITCH, 2.0)(*inputs).sum()) < int(vts.ContactFromDepth(PITCH)(*inputs).sum())
    with pytest.raises(TypeError, match="contact: expected a ContactSettings"):
        vts.DepthPipeline.from_calibration(cal, contact=4.5)


@pytest.mark.long
def test_labelled_contacts_of_a_real_sensor(data):
    """The prior is that of the other ball; before, contact was what deformed is: 0.27 in the median.

    The labels' radii are 7 to 10 % too large and the contact found is 10 % smaller in area (docs/decisions.md, "The rule for the
    contact radius"): to ask for more than 0.87 would ask for their bias.
    """
    background, presses = vts.read_presses(data / "gelsight_mini_a")
    sensor, score, low = vts.Sensor.load("gelsight_mini"), [], []
    y, x = torch.meshgrid(torch.arange(240.0), torch.arange(320.0), indexing="ij")
    for diameter in (6.31, 9.5):
        other = [p for p in presses if abs(p.ball_diameter_mm - diameter) > 0.1]
        own = dataclasses.replace(sensor, prior=fit_prior(background, sensor, other))
        pipe = vts.DepthPipeline.from_calibration(vts.calibrate(background, own)).float()
        for press in presses:
            if press.contact_radius_px is None or press in other:
                continue
            out = pipe(press.image[None].float())
            circle = torch.hypot(x - press.center_px[0], y - press.center_px[1]) <= press.contact_radius_px
            score.append(iou(out.contact[0, 0], circle))
            low.append(float(out.depth_mm.min()))
    score, low = torch.tensor(score), torch.tensor(low)
    assert float(score.median()) > 0.87 and float(score.min()) > 0.7
    assert float(low.median()) > -0.05 and float(low.min()) > -0.15
