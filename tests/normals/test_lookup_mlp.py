"""Normals learned from pixels of known slope: the look-up table and the network."""

import math
import sys

import kornia
import pytest
import torch

import torchvts as vts
from lab.metrics import normal_angle_deg
from lab.score import ball_truth
from torchvts.core.files import save_tensors
from torchvts.core.geometry import MAX_SLOPE, gradient_from_normal, normal_from_gradient
from torchvts.model.gs_sdk import read_calibration_folder, read_labels
from torchvts.model.response_field import ResponseField, ResponseModel
from torchvts.normals.lookup import NormalFromLookup
from torchvts.normals.mlp import NormalFromMLP
from torchvts.training import fit_mlp

HEIGHT, WIDTH = 24, 32
# what a rig of three lights 120 degrees apart shows of a slope, and its inverse on the plane that the colours fill
COLOUR_OF_SLOPE = torch.tensor([[0.30, 0.02], [-0.14, 0.25], [-0.15, -0.27]], dtype=torch.float64)


def flat_skin(dtype=torch.float32):
    x = torch.linspace(-0.08, 0.08, WIDTH, dtype=torch.float64).expand(HEIGHT, WIDTH)
    y = torch.linspace(-0.05, 0.05, HEIGHT, dtype=torch.float64)[:, None].expand(HEIGHT, WIDTH)
    return (0.5 + torch.stack((x, y, -x))).to(dtype)


def random_slopes(count, seed=0, steepest=0.6):
    return (2.0 * torch.rand(count, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 1.0) * steepest


def image_of(slope, dtype=torch.float32):
    """(3, H, W) image of the linear rig and (2, H, W) slopes, from (H * W, 2) slopes."""
    change = (slope @ COLOUR_OF_SLOPE.T).T.reshape(3, HEIGHT, WIDTH)
    return (flat_skin(torch.float64) + change).to(dtype), slope.T.reshape(2, HEIGHT, WIDTH)


def random_images(dtype=torch.float32, count=3):
    return torch.stack([image_of(random_slopes(HEIGHT * WIDTH, seed), dtype)[0] for seed in range(count)])


def lookup(dtype=torch.float32, bins=16, **options):
    slope = random_slopes(20000)
    return NormalFromLookup.fit(flat_skin(dtype), slope @ COLOUR_OF_SLOPE.T, slope, bins=bins, **options)


def network(dtype=torch.float32, **options):
    # the same weights in both precisions
    block = NormalFromMLP(HEIGHT, WIDTH, flat_skin(), (16, 16), seed=3, **options).requires_grad_(False)
    block = block.to(dtype)
    block.set_flat(flat_skin(dtype))
    return block


def angle_deg(one, two):
    cross = torch.linalg.cross(one.double(), two.double(), dim=-3).norm(dim=-3)
    return torch.rad2deg(torch.atan2(cross, (one.double() * two.double()).sum(-3)))


BLOCKS = {"lookup": lookup, "network": network}
both = pytest.mark.parametrize("build", BLOCKS.values(), ids=BLOCKS)


# What both blocks promise


@both
def test_normals_are_of_unit_length_and_face_the_camera(build):
    normal = build()(random_images())
    assert torch.allclose(normal.norm(dim=1), torch.ones(()), atol=1e-5) and bool((normal[:, 2] > 0).all())


@both
def test_the_flat_skin_is_flat(build):
    for dtype, tolerance in ((torch.float32, 1e-6), (torch.float64, 1e-14)):
        normal = build(dtype)(flat_skin(dtype)[None])
        assert float(normal[:, 0:2].abs().max()) <= tolerance and float((normal[:, 2] - 1).abs().max()) <= tolerance


@both
def test_the_image_gets_its_gradient(build):
    block = build(torch.float64)
    rows, columns = slice(4, 7), slice(5, 9)
    images = random_images(torch.float64, 2)

    def part(patch):
        whole = images.clone()
        whole[:, :, rows, columns] = patch
        return block(whole)[:, :, rows, columns]

    patch = images[:, :, rows, columns].clone()
    if build is lookup:  # the middle of a cell of the table, where the interpolation has no corner
        flat = flat_skin(torch.float64)[:, rows, columns]
        step = block.step.reshape(3, 1, 1)
        patch = flat + (torch.floor((patch - flat) / step) + 0.5) * step
    assert torch.autograd.gradcheck(part, (patch.requires_grad_(True),))


@both
def test_one_bad_pixel_stays_alone(build):
    block, images = build(), random_images()
    spoilt = images.clone()
    spoilt[1, 2, 5, 6], spoilt[0, 0, 9, 9], spoilt[0, 1, 3, 3] = torch.nan, torch.inf, -torch.inf
    spoilt_too = torch.zeros(3, 1, HEIGHT, WIDTH, dtype=torch.bool)
    spoilt_too[1, 0, 5, 6] = spoilt_too[0, 0, 9, 9] = spoilt_too[0, 0, 3, 3] = True
    same = (block(spoilt) - block(images)).abs() <= 1e-6
    assert bool((same | spoilt_too).all())


@both
def test_a_file_gives_the_block_back(build, tmp_path):
    block, images = build(torch.float64), random_images(torch.float64)
    block.save(tmp_path / "block.safetensors")
    loaded = type(block).load(tmp_path / "block.safetensors")
    assert torch.equal(loaded(images), block(images)) and not any(p.requires_grad for p in loaded.parameters())
    save_tensors(tmp_path / "other.safetensors", {"flat": torch.zeros(3, 4, 4)}, {"kind": "other"})
    with pytest.raises(ValueError, match=r"other\.safetensors: expected a .*, got 'other'"):
        type(block).load(tmp_path / "other.safetensors")


# The look-up table


@pytest.mark.parametrize("bins, most_deg", [(16, 1.0), (32, 0.4)])
def test_the_table_learns_a_linear_rig(bins, most_deg):
    image, slope = image_of(random_slopes(HEIGHT * WIDTH, 9, steepest=0.5), torch.float64)
    error = angle_deg(lookup(torch.float64, bins)(image[None])[0], normal_from_gradient(slope[None])[0])
    assert float(error.mean()) < most_deg


def test_between_the_nodes_the_table_is_trilinear():
    interpolate = pytest.importorskip("scipy.interpolate")
    block = lookup(torch.float64, bins=9)
    change = 1.6 * (torch.rand(1, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(2), dtype=torch.float64) - 0.5)
    nodes = [((torch.arange(9) - zero) * step).numpy() for zero, step in zip(block.zero_index, block.step, strict=True)]
    reference = interpolate.RegularGridInterpolator(nodes, block.table.numpy())
    edge = torch.tensor([[axis[0], axis[-1]] for axis in nodes]).reshape(3, 2, 1, 1)
    inside = torch.minimum(torch.maximum(change[0], edge[:, 0]), edge[:, 1])  # beyond the table its border holds
    assert not torch.equal(inside, change[0])
    expected = torch.from_numpy(reference(inside.permute(1, 2, 0).numpy())).permute(2, 0, 1)
    assert torch.allclose(gradient_from_normal(block(block.flat + change))[0], expected, atol=1e-12)


def test_no_change_is_no_slope_to_the_last_bit():
    slope = random_slopes(500) + 0.2  # no sample is the background
    for flat in (flat_skin(), flat_skin(torch.float64)):
        block = NormalFromLookup.fit(flat, slope @ COLOUR_OF_SLOPE.T, slope)
        assert float(gradient_from_normal(block(flat[None])).abs().max()) == 0.0


def test_holes_take_the_slope_of_their_nearest_bins():
    # two clouds of colour, far apart, and nothing between or beyond
    generator = torch.Generator().manual_seed(1)
    left = torch.rand(400, 3, generator=generator) * 0.05 - 0.3
    right = torch.rand(400, 3, generator=generator) * 0.05 + 0.3
    slope = torch.cat((torch.full((400, 2), -0.5), torch.full((400, 2), 0.5)))
    block = NormalFromLookup.fit(flat_skin(), torch.cat((left, right)), slope)
    assert bool(torch.isfinite(block.table).all())
    assert float(block.table.min()) >= -0.5 - 1e-6 and float(block.table.max()) <= 0.5 + 1e-6
    far = gradient_from_normal(block((flat_skin() + 0.9)[None]))
    assert float((far - 0.5).abs().max()) < 0.02
    beside = gradient_from_normal(block((flat_skin() + torch.tensor([-0.3, -0.3, -0.2]).reshape(3, 1, 1))[None]))
    assert float((beside + 0.5).abs().max()) < 0.05


def test_without_smoothing_each_bin_is_the_mean_of_its_pixels():
    change = torch.tensor([[-0.3, -0.3, -0.3]] * 1000 + [[0.3, 0.3, 0.3]] * 1000, dtype=torch.float64)
    slope = torch.tensor([[0.1, 0.0], [0.3, 0.2]] * 500 + [[-0.2, 0.4]] * 1000, dtype=torch.float64)
    block = NormalFromLookup.fit(flat_skin(torch.float64), change, slope, bins=8, smoothing=0.0)
    image = (flat_skin(torch.float64) - 0.3)[None]
    assert torch.allclose(gradient_from_normal(block(image))[0, :, 0, 0], torch.tensor([0.2, 0.1], dtype=torch.float64), atol=2e-3)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"table": torch.zeros(4, 4, 5, 2)}, r"table: expected \(n, n, n, 2\)"),
        ({"zero_index": torch.tensor([0, 1, 4])}, "zero_index: expected three nodes of the table, 0 to 3"),
    ],
)
def test_a_bad_table_is_refused(change, message, tmp_path):
    good = {"flat": torch.zeros(3, 4, 4), "table": torch.zeros(4, 4, 4, 2), "step": torch.ones(3)}
    good["zero_index"] = torch.tensor([1, 1, 1])
    save_tensors(tmp_path / "bad.safetensors", good | change, {"kind": "lookup_table"})
    with pytest.raises(ValueError, match=rf"bad\.safetensors: damaged: {message}"):
        NormalFromLookup.load(tmp_path / "bad.safetensors")


# The network


def test_the_inputs_stand_in_the_order_of_gs_sdk(tmp_path):
    # one hidden unit per input, so that each weight is tested by itself: B, G, R, x / W, y / H
    image = random_images(torch.float64, 1)
    x = (torch.arange(WIDTH, dtype=torch.float64) / WIDTH).expand(HEIGHT, WIDTH)
    y = (torch.arange(HEIGHT, dtype=torch.float64) / HEIGHT)[:, None].expand(HEIGHT, WIDTH)
    flat = flat_skin(torch.float64)
    for k, (value, zero) in enumerate(zip((*image[0].flip(0), x, y), (*flat.flip(0), x, y), strict=True)):
        first = torch.zeros(1, 5)
        first[0, k] = 1.0
        state = {"fc1.weight": first, "fc1.bias": torch.zeros(1), "fc2.weight": torch.ones(2, 1), "fc2.bias": torch.zeros(2)}
        state["fc2.weight"][1] = -0.5
        torch.save(state, tmp_path / "one.pth")
        angles = NormalFromMLP.load(tmp_path / "one.pth", flat)
        expected = torch.stack((zero.tan() - value.tan(), (-0.5 * zero).tan() - (-0.5 * value).tan()))  # dz/dx = -dH/dx
        assert torch.allclose(gradient_from_normal(angles(image))[0], expected, atol=1e-12)
        slopes = NormalFromMLP.load(tmp_path / "one.pth", flat, output="gradient")
        expected = torch.stack((zero - value, 0.5 * (value - zero)))
        assert torch.allclose(gradient_from_normal(slopes(image))[0], expected, atol=1e-12)


@pytest.mark.parametrize("output", ["angle", "gradient"])
@pytest.mark.parametrize("level", [1.5, math.pi / 2, 2.0, 1e6])
def test_no_output_is_steeper_than_the_bound(output, level, tmp_path):
    state = {
        "fc1.weight": torch.zeros(4, 5),
        "fc1.bias": torch.ones(4),
        "fc2.weight": torch.zeros(2, 4),
        "fc2.bias": torch.zeros(2),
    }
    state["fc1.weight"][0, 2] = 1.0
    state["fc2.weight"][0, 0], state["fc2.bias"][0] = level, -level
    torch.save(state, tmp_path / "steep.pth")
    block = NormalFromMLP.load(tmp_path / "steep.pth", torch.zeros(3, HEIGHT, WIDTH), output=output)
    gradient = block.gradient_px(torch.full((1, 3, HEIGHT, WIDTH), 1.0))
    expected = min(MAX_SLOPE, math.tan(level) if output == "angle" and level < math.atan(MAX_SLOPE) else MAX_SLOPE)
    if output == "gradient":
        expected = min(level, MAX_SLOPE)
    assert float(gradient[:, 0].max()) == pytest.approx(expected, rel=1e-4)


def test_wider_networks_are_read_and_those_of_gsrobotics_are_refused(tmp_path):
    wide = NormalFromMLP(HEIGHT, WIDTH, flat_skin(), (64, 64, 64), output="gradient", seed=5).requires_grad_(False)
    torch.save(wide.gs_sdk_state(), tmp_path / "wide.pth")
    loaded = NormalFromMLP.load(tmp_path / "wide.pth", flat_skin(), output="gradient")
    assert torch.equal(loaded(random_images()), wide(random_images()))
    assert {name: tuple(tensor.shape) for name, tensor in loaded.gs_sdk_state().items()}["fc1.weight"] == (64, 5)
    torch.save({"state_dict": wide.gs_sdk_state(), "epoch": 3}, tmp_path / "nnmini.pt")
    for output in (None, "gradient"):
        with pytest.raises(ValueError, match=r"nnmini\.pt: .* gives n_x and n_y of the normal, from constant places"):
            NormalFromMLP.load(tmp_path / "nnmini.pt", flat_skin(), output=output)


def test_a_network_declares_what_it_was_trained_on(tmp_path):
    unit = response_unit()
    block = NormalFromMLP(HEIGHT, WIDTH, flat_skin(), (4,), input_domain="ratio", blur_px=1.5)
    block.save(tmp_path / "ratio.safetensors")
    loaded = NormalFromMLP.load(tmp_path / "ratio.safetensors")
    assert (loaded.input_domain, loaded.blur_px) == ("ratio", 1.5)
    assert vts.DepthPipeline.from_calibration(unit, normals=loaded).normals is loaded


def test_a_network_on_images_that_it_was_not_trained_on_is_refused(tmp_path):
    unit, block = response_unit(), network()
    torch.save(block.gs_sdk_state(), tmp_path / "nnmodel.pth")
    loaded = NormalFromMLP.load(tmp_path / "nnmodel.pth", flat_skin())
    with pytest.raises(
        ValueError, match=r"(?s)NormalFromMLP works on images as the camera .*; its input here is image / background"
    ) as caught:
        vts.DepthPipeline.from_calibration(unit, normals=loaded)
    assert str(caught.value).count("\n") == 5 and "DepthPipeline.from_gs_sdk(" in str(caught.value)
    by_light = vts.Calibration.from_lights(vts.PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900] * 3), unit.sensor)
    with pytest.raises(ValueError, match="its input here is linear light"):
        vts.DepthPipeline.from_calibration(by_light, normals=loaded)
    with pytest.raises(
        ValueError, match=r"NormalFromResponse works on image / background.*; its input here is images as the camera"
    ):
        own = vts.DepthPipeline.from_calibration(unit)
        vts.DepthPipeline(vts.Compensate(), own.contact, own.normals, own.gradient, own.integrate, mm_per_pixel=0.5)


def response_unit():
    field = ResponseField(0, -1, 10.0, ((0.3, 0, 0), (0, 0.3, 0)))
    return vts.Calibration.from_response(ResponseModel(field, None), vts.Sensor("rig", HEIGHT, WIDTH, 0.5), flat_skin())


def test_from_gs_sdk_gives_the_network_its_own_images(tmp_path):
    block, sensor = network(), vts.Sensor("rig", HEIGHT, WIDTH, 0.5)
    torch.save(block.gs_sdk_state(), tmp_path / "nnmodel.pth")
    pipe = vts.DepthPipeline.from_gs_sdk(tmp_path / "nnmodel.pth", flat_skin(), sensor)
    image = flat_skin().clone()[None]
    image[:, :, 8:20, 8:20] *= torch.tensor([1.4, 0.7, 1.2])[:, None, None]
    out = pipe(image)
    moved = pipe.frame_of(image)[0].weight[0, 0] == 1.0
    assert int(moved[10:18, 10:18].sum()) > 30
    alone = NormalFromMLP.load(tmp_path / "nnmodel.pth", flat_skin())(image)
    assert torch.allclose(out.normal[0, :, moved], alone[0, :, moved], atol=1e-5)
    assert float(pipe(flat_skin()[None]).depth_mm.abs().max()) == 0.0
    block.blur_px = 2.0
    block.save(tmp_path / "blurred.safetensors")
    assert vts.DepthPipeline.from_gs_sdk(str(tmp_path / "blurred.safetensors"), flat_skin(), sensor).normals.blur_px == 2.0


def test_from_gs_sdk_on_a_real_unit_equals_the_network(data, mini_presses):
    background, presses = mini_presses
    weights = data / "gelsight_mini_a" / "model" / "nnmodel.pth"
    pipe, alone = vts.DepthPipeline.from_gs_sdk(weights, background, "gelsight_mini"), NormalFromMLP.load(weights, background)
    for press in [p for p in presses if p.contact_radius_px][::6]:
        inside = ball_truth(press, 240, 320, 0.0634).region
        with torch.inference_mode():
            angle = normal_angle_deg(pipe(press.image[None]).normal, alone(press.image[None]), inside)
        assert float(angle.mean()) < 0.3


def test_another_flat_image_is_taken():
    block = network()
    other = (flat_skin() + 0.1).contiguous()
    block.set_flat(other)
    assert float(block(other[None])[:, 0:2].abs().max()) < 1e-6
    assert float(block(flat_skin()[None])[:, 0:2].abs().max()) > 1e-3


@pytest.mark.parametrize(
    "change, message",
    [
        ({"fc2.bias": None}, r"expected the tensors fc1\.weight, fc1\.bias, fc2\.weight, \.\.\., got"),
        ({"conv.weight": torch.zeros(2, 2)}, "another network"),
        ({"fc1.weight": torch.zeros(32, 6)}, r"fc1: expected weight \(32, 5\) .*, got \(32, 6\)"),
        ({"fc3.bias": torch.zeros(31)}, r"fc3: expected weight \(32, 32\) and a bias to match, got \(32, 32\) and \(31,\)"),
        ({"fc4.weight": torch.zeros(3, 32), "fc4.bias": torch.zeros(3)}, r"fc4: expected weight \(2, 32\)"),
        ({"fc1.weight": torch.full((32, 5), torch.nan)}, "fc1: expected finite weights, got NaN"),
        ({"fc4.bias": torch.zeros(2, dtype=torch.int8)}, "fc4: expected floating point, got .*int8"),
        ({"fc4.bias": "text"}, "expected a state dict of tensors"),
    ],
)
def test_a_bad_state_dict_is_refused(change, message, tmp_path):
    state = NormalFromMLP(HEIGHT, WIDTH, flat_skin()).gs_sdk_state() | change
    torch.save({name: tensor for name, tensor in state.items() if tensor is not None}, tmp_path / "bad.pth")
    with pytest.raises(ValueError, match=rf"bad\.pth: .*{message}"):
        NormalFromMLP.load(tmp_path / "bad.pth", flat_skin())


def test_a_file_without_the_flat_skin_or_of_something_else_is_refused(tmp_path):
    path = tmp_path / "bad.pth"
    torch.save(NormalFromMLP(HEIGHT, WIDTH, flat_skin()).gs_sdk_state(), path)
    with pytest.raises(ValueError, match=r"flat: expected the image of the flat skin, .* a bare state dict holds none"):
        NormalFromMLP.load(path)
    torch.save([1, 2], path)
    with pytest.raises(ValueError, match=r"bad\.pth: expected a state dict of tensors .* got list"):
        NormalFromMLP.load(path, flat_skin())


# Training


def rig_samples(count=6000, presses=8):
    generator = torch.Generator().manual_seed(4)
    x = torch.randint(WIDTH, (count,), generator=generator)
    y = torch.randint(HEIGHT, (count,), generator=generator)
    slope = random_slopes(count, 5)
    intensity = flat_skin(torch.float64)[:, y, x].T + slope @ COLOUR_OF_SLOPE.T
    return intensity.float(), torch.stack((x, y), dim=1), slope.float(), torch.arange(count) % presses


def train(samples=None, **options):
    intensity, xy, slope, groups = samples or rig_samples()
    return fit_mlp(intensity, xy, slope, flat_skin(), groups=groups, **options)


def test_the_network_learns_a_linear_rig():
    fit = train(batch_size=256, max_epochs=30)
    image, slope = image_of(random_slopes(HEIGHT * WIDTH, 9, steepest=0.5))
    error = angle_deg(fit.module(image[None])[0], normal_from_gradient(slope[None])[0])
    assert float(error.mean()) < 1.5
    assert fit.history[fit.best_epoch][1] == min(held for _, held in fit.history) < 0.2 * fit.history[0][1] + 1.0
    assert not fit.module.training and not any(parameter.requires_grad for parameter in fit.module.parameters())


def test_training_is_decided_by_its_seed_alone():
    before = torch.random.get_rng_state()
    one = train(max_epochs=2, seed=1)
    torch.manual_seed(99)
    two, other = train(max_epochs=2, seed=1), train(max_epochs=2, seed=2)
    state = torch.random.get_rng_state()
    train(max_epochs=1)
    assert torch.equal(torch.random.get_rng_state(), state)
    torch.random.set_rng_state(before)
    assert one.history == two.history != other.history
    assert torch.equal(one.module(random_images()), two.module(random_images()))


def test_the_status_says_what_happened(capsys, monkeypatch):
    short = train(max_epochs=1, progress=True)
    assert capsys.readouterr().err == ""  # no terminal, no bar
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    train(max_epochs=1, progress=True)
    assert not short.converged and short.message.startswith("stopped at 1 epochs") and "raise max_epochs" in short.message
    assert "network" in capsys.readouterr().err
    intensity, xy, slope, groups = rig_samples(400, 2)
    noise = torch.rand(slope.shape, generator=torch.Generator().manual_seed(0)) - 0.5  # nothing to be learned
    stopped = train((intensity, xy, noise, groups), max_epochs=200, patience=2)
    assert stopped.converged and len(stopped.history) == stopped.best_epoch + 3 and "stopped falling" in stopped.message
    assert "1 of 2 presses" in stopped.message


# A real unit

TABLE_DEG, NETWORK_DEG = 7.0, 5.5  # of presses that were not seen; more epochs bring the network to 3


def real_presses(folder, blur_px):
    """Flat image, and per labelled press of a ball: image, pixels inside the contact (H, W), true slope (2, H, W)."""

    def smooth(image):
        return kornia.filters.gaussian_blur2d(image[None], (7, 7), (blur_px, blur_px))[0] if blur_px else image

    (background, pressed), labels, presses = read_calibration_folder(folder), read_labels(folder), []
    for press in pressed:
        cx, cy, contact_px = labels[press.name]
        if contact_px is None:
            continue
        ball_px = 0.5 * press.ball_diameter_mm / 0.0634
        y, x = torch.meshgrid(torch.arange(press.image.shape[1]) - cy, torch.arange(press.image.shape[2]) - cx, indexing="ij")
        squared = x * x + y * y
        inside = squared < (contact_px - 3.0) ** 2
        slope = -torch.stack((x, y)) / (ball_px**2 - squared).clamp_min(1.0).sqrt()
        presses.append((smooth(press.image), inside, slope))
    return smooth(background), presses


RAW, BLURRED = (0.0, 3.6), (1.0, 2.9)  # blur in pixels, and largest error of gs_sdk's network in degrees


@pytest.fixture(scope="module", params=[RAW, BLURRED], ids=["raw", "blurred by 1 px"])
def real(data, request):
    return *real_presses(data / "gelsight_mini_a", request.param[0]), request.param[1]


def mean_error_deg(block, presses):
    errors = [angle_deg(block(image[None])[0], normal_from_gradient(slope[None])[0])[inside] for image, inside, slope in presses]
    return float(torch.cat(errors).mean())


def samples_of(presses):
    """Colours, places, slopes and press numbers of the pixels inside the contacts."""
    parts = []
    for number, (image, inside, slope) in enumerate(presses):
        y, x = torch.where(inside)
        parts.append((image[:, y, x].T, torch.stack((x, y), dim=1), slope[:, y, x].T, torch.full_like(x, number)))
    return tuple(torch.cat(column) for column in zip(*parts, strict=True))


@pytest.mark.parametrize("learn", [False, pytest.param(True, marks=pytest.mark.long)], ids=["table", "network"])
@pytest.mark.parametrize("real", [BLURRED, pytest.param(RAW, marks=pytest.mark.long)], indirect=True)
def test_presses_that_were_not_seen(real, learn):
    flat, presses, _ = real
    seen, unseen = [press for k, press in enumerate(presses) if k % 5], presses[::5]
    intensity, xy, slope, groups = samples_of(seen)
    if learn:
        fit = fit_mlp(intensity, xy, slope, flat, groups=groups, max_epochs=12)
        assert mean_error_deg(fit.module, unseen) < NETWORK_DEG
        return
    table = NormalFromLookup.fit(flat, intensity - flat[:, xy[:, 1], xy[:, 0]].T, slope)
    assert mean_error_deg(table, unseen) < TABLE_DEG


@pytest.mark.parametrize("real", [BLURRED, pytest.param(RAW, marks=pytest.mark.long)], indirect=True)
def test_the_network_of_gs_sdk_measures_a_ball(data, real):
    flat, presses, most_deg = real
    assert len(presses) == 30
    assert mean_error_deg(NormalFromMLP.load(data / "gelsight_mini_a" / "model" / "nnmodel.pth", flat), presses) < most_deg
