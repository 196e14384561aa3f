"""Sensor files: strict, found wherever the package is installed, and what rectifies a camera's frame."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from conftest import ring_lights

import torchvts as vts
from torchvts.core.files import rgb_from_bgr

GOOD = {"name": "rig", "height": 24, "width": 32, "mm_per_pixel": 0.5}


def written(folder, text):
    path = folder / "unit.yaml"
    path.write_text(text)
    return path


def as_text(**changes):
    values = {**GOOD, **changes}
    return "".join(f"{key}: {value}\n" for key, value in values.items() if value is not None)


@pytest.mark.parametrize(
    "text, message",
    [
        (as_text(mm_per_pixle=0.1), r"key 'mm_per_pixle': unknown; expected name, height, .*mm_per_pixel"),
        (as_text(height=None), "key 'height': missing"),
        (as_text() + "height: 25\n", "key 'height': given twice"),
        (as_text(height="tall"), "key height: expected an integer, got str 'tall'"),
        (as_text(height=24.5), "key height: expected an integer, got float 24.5"),
        (as_text(width=4), "key width: expected at least 8, got 4"),
        (as_text(mm_per_pixel=-1), "key mm_per_pixel: expected a number in .*, got -1"),
        (as_text(mm_per_pixel=0.0000634), r"mm_per_pixel: expected at least 0.0005 mm, got 6.34e-05: is it in m\?"),
        (as_text(mm_per_pixel=63.4), r"key mm_per_pixel: expected a number in \(0, 10\], got 63.4"),
        (as_text(mm_per_pixel="0.1 mm"), "key mm_per_pixel: expected a number, got str"),
        (as_text(mm_per_pixel="0,1"), "key mm_per_pixel: expected a number, got str '0,1': write a decimal point"),
        (as_text(corners_px=[[9, 0], [9, 30], [0, 30], [0, 0]]), "corners_px: expected a gel about 1.33 times as wide as high"),
        (as_text(gamma=0.01), r"key gamma: expected a number in \[0.1, 10\], got 0.01"),
        (as_text(blur_px=100), r"key blur_px: expected a number in \[0, 6\], got 100"),
        (as_text(name=7), "key name: expected a text, got 7"),
        (as_text(light_position_mm="[[1, 2, 3]]"), r"key light_position_mm: expected 3 x 3 numbers, got shape \(1, 3\)"),
        (
            as_text(light_position_mm="[[1, 2, 3], [1, 2, 3], [1, 2, -3]]"),
            r"key light_position_mm: expected lights above the skin \(z > 0\)",
        ),
        (as_text(roi_px="[0, 0, 10]"), r"key roi_px: expected 4 numbers, got shape \(3,\)"),
        (as_text(roi_px="[-1, 0, 10, 10]"), "key roi_px: expected whole numbers"),
        (as_text(raw_size_px="[48, 64]"), r"key raw_size_px: expected sizes \[\[height, width\], ...\] of raw frames"),
        (as_text(raw_size_px="[[48, 64]]", raw_crop=0.5), r"key raw_crop: expected a number in \[0, 0.49\], got 0.5"),
        (as_text(corners_px="[[0, 0], [0, 9], [9, 9], [9, 0]]"), "key corners_px: expected a convex quadrilateral"),
        (as_text(corners_px="[[0, 0], [9, 0], [9, 9], [0, 9]]", roi_px="[0, 0, 9, 9]"), "expected one of them, got both"),
        (as_text(turn_deg=45), "key turn_deg: expected 0, 90, 180 or 270, anticlockwise, got 45"),
        (as_text(turn_deg=90, raw_size_px="[[48, 64]]"), "key raw_size_px: expected frames of the aspect"),
        (as_text(distortion_coefficients=[0, 0, 0, 0]), "key camera_matrix, distortion_coefficients: expected both or none"),
        (as_text(camera_matrix="[[3, 0], [0, 3]]", distortion_coefficients="[]"), "key camera_matrix: expected 3 x 3 numbers"),
        (as_text(sensor_to_robot="[[0, 0, 1, 50]]"), "key sensor_to_robot: expected 4 x 4 numbers"),
        (
            as_text(sensor_to_robot="[[-1, 0, 0, 5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"),
            "key sensor_to_robot: .* mirror image",
        ),
        ("- 1\n- 2\n", "expected keys and values, got list"),
        ("name: [rig\n", "not a YAML file"),
        ("!!python/object/apply:os.getcwd []\n", "not a YAML file"),
    ],
)
def test_a_bad_file_is_refused_by_file_and_key(tmp_path, text, message):
    path = written(tmp_path, text)
    with pytest.raises(ValueError, match=message) as caught:
        vts.Sensor.load(path)
    assert str(caught.value).startswith(f"{path}: ")


@pytest.mark.parametrize("name", vts.shipped_sensors())
def test_every_shipped_sensor_loads_under_its_own_name(name):
    assert vts.Sensor.load(name).name == name


def test_shipped_figures():
    assert {"gelsight_mini", "gelsight_wedge", "tacto"} <= set(vts.shipped_sensors())
    mini = vts.Sensor.load("gelsight_mini")
    assert (mini.height, mini.width, mini.mm_per_pixel, mini.exponent) == (240, 320, 0.0634, 1.0)
    assert vts.Sensor.load("tacto").gamma == 2.2


@pytest.mark.parametrize("height, width", [(480, 640), (120, 160), (60, 80)])
def test_another_resolution_keeps_the_field_of_view(height, width):
    sensor = vts.Sensor.load("gelsight_mini")
    resized = vts.Sensor.load("gelsight_mini", height, width)
    assert resized == sensor.resized(height, width)
    assert resized.field_mm == pytest.approx(sensor.field_mm, rel=1e-12)
    blurred = vts.Sensor(**GOOD, blur_px=2.0).resized(48, 64)
    assert (blurred.blur_px, blurred.mm_per_pixel) == (4.0, 0.25)


@pytest.mark.parametrize(
    "extra",
    [
        {},
        {"gamma": 2.2, "blur_px": 1.5},
        {"light_position_mm": [[20, 0, 30.5], [-10, 17, 30], [-10, -17, 30]]},
        {"roi_px": [4, 5, 60, 45]},
        {"corners_px": [[1, 2], [30, 3.5], [31, 22], [0, 23]]},
        {"raw_size_px": [[48, 64], [96, 128]], "raw_crop": 0.125},
        {"turn_deg": 270, "mirror": True},
        {"sensor_to_robot": [[0, 0, 1, 50], [0, 1, 0, 0], [-1, 0, 0, 120], [0, 0, 0, 1]]},
        {"camera_matrix": [[30, 0, 15.5], [0, 30, 11.5], [0, 0, 1]], "distortion_coefficients": [-0.2, 0.1, 0, 0, 0]},
    ],
)
def test_a_saved_sensor_loads_as_it_was(tmp_path, extra):
    sensor = vts.Sensor(**GOOD, **extra)
    sensor.save(tmp_path / "unit.yaml")
    assert vts.Sensor.load(tmp_path / "unit.yaml") == sensor
    assert vts.Sensor.load(str(tmp_path / "unit.yaml")) == sensor
    assert [path.name for path in tmp_path.iterdir()] == ["unit.yaml"]


def smooth(x, y):
    """Any smooth picture, as a function of place."""
    return torch.stack([0.5 + 0.4 * torch.sin(0.11 * k * x + 0.07 * y + k) for k in (1, 2, 3)])[None]


def frame(height=120, width=160):
    return smooth(torch.arange(width, dtype=torch.float64)[None, :], torch.arange(height, dtype=torch.float64)[:, None])


def test_rectify_leaves_a_frame_of_the_right_size_alone():
    assert torch.equal(vts.Sensor("rig", 120, 160, 0.1).rectify(frame()), frame())


def test_a_digit_runs_on_frames_as_its_camera_gives_them():
    """digit-interface turns them by cv2.transpose and cv2.flip; its upright frames are taken as they are."""
    sensor = vts.Sensor.load("digit")
    for scale in (1, 2):  # QVGA and VGA
        raw = np.random.default_rng(0).integers(0, 256, (240 * scale, 320 * scale, 3), np.uint8)
        upright = rgb_from_bgr(cv2.flip(cv2.transpose(raw), 0))[None]
        expected = upright if scale == 1 else torch.nn.functional.avg_pool2d(upright, 2)
        image = sensor.rectify(rgb_from_bgr(raw)[None])
        assert (image - expected).abs().max() < (1e-7 if scale == 1 else 0.3)  # antialiasing looks beyond two pixels
        assert torch.equal(sensor.rectify(image), image)
    with pytest.raises(
        ValueError, match=r"got 120 x 160: .* a turned camera: it needs turn_deg: 90, and raw_size_px: \[\[120, 160\]\] alone"
    ):
        sensor.rectify(torch.zeros(1, 3, 120, 160))
    with pytest.raises(
        ValueError, match=r"got 32 x 24: height and width exchanged\? or a turned camera: it needs turn_deg: 90 \(or 270\)"
    ):
        vts.Sensor(**GOOD).rectify(torch.zeros(1, 3, 32, 24))


@pytest.mark.parametrize("turn_deg", [0, 90, 180, 270])
@pytest.mark.parametrize("mirror", [False, True])
def test_frames_are_turned_and_mirrored_before_they_are_cut(turn_deg, mirror):
    turned = np.rot90(frame()[0].permute(1, 2, 0).numpy(), turn_deg // 90)
    turned = torch.from_numpy((np.fliplr(turned) if mirror else turned).copy()).permute(2, 0, 1)[None]
    height, width = turned.shape[2:]
    view = {"turn_deg": turn_deg, "mirror": mirror}
    whole = vts.Sensor("rig", height, width, 0.1, **view)
    assert torch.equal(whole.rectify(frame()), turned)
    if turn_deg or mirror:
        half = whole.resized(height // 2, width // 2)  # frames of the camera's size are still turned
        assert (half.rectify(frame()) - torch.nn.functional.avg_pool2d(turned, 2)).abs().max() < 0.05
    part = vts.Sensor("rig", 50, 40, 0.1, roi_px=(12, 34, 40, 50), **view)
    assert torch.equal(part.rectify(frame()), turned[:, :, 34:84, 12:52])
    corners = vts.Sensor("rig", 50, 40, 0.1, corners_px=((12, 34), (51, 34), (51, 83), (12, 83)), **view)
    assert (corners.rectify(frame()) - turned[:, :, 34:84, 12:52]).abs().max() < 1e-9


def test_rectify_cuts_the_region_of_interest():
    sensor = vts.Sensor("rig", 50, 70, 0.1, roi_px=(12, 34, 70, 50))
    assert torch.equal(sensor.rectify(frame()), frame()[:, :, 34:84, 12:82])
    halved = vts.Sensor("rig", 25, 35, 0.2, roi_px=(12, 34, 70, 50)).rectify(frame())
    x, y = 12.5 + 2 * torch.arange(35, dtype=torch.float64), 34.5 + 2 * torch.arange(25, dtype=torch.float64)
    assert (halved - smooth(x[None, :], y[:, None]))[..., 2:-2, 2:-2].abs().max() < 0.02


def test_rectify_straightens_a_quadrilateral():
    """The picture seen through an exact perspective map: every pixel has the value of the place it shows."""
    corners = [[20.0, 15.0], [140.0, 25.0], [130.0, 105.0], [25.0, 95.0]]
    sensor = vts.Sensor("rig", 60, 80, 0.1, corners_px=corners)
    target = [[0.0, 0.0], [79.0, 0.0], [79.0, 59.0], [0.0, 59.0]]
    lines, right = [], []
    for (u, v), (x, y) in zip(target, corners, strict=True):
        lines += [[u, v, 1, 0, 0, 0, -u * x, -v * x], [0, 0, 0, u, v, 1, -u * y, -v * y]]
        right += [x, y]
    a, b, c, d, e, f, g, h = torch.linalg.solve(torch.tensor(lines, dtype=torch.float64), torch.tensor(right, dtype=torch.float64))
    u, v = torch.arange(80, dtype=torch.float64)[None, :], torch.arange(60, dtype=torch.float64)[:, None]
    w = g * u + h * v + 1
    expected = smooth((a * u + b * v + c) / w, (d * u + e * v + f) / w)
    result = sensor.rectify(frame().repeat(2, 1, 1, 1))
    assert result.shape == (2, 3, 60, 80)
    assert (result - expected).abs().max() < 0.4 * 0.36**2 / 4  # bilinear: curvature (0.33^2 + 0.07^2) / 8 per axis


LENS = np.array([[110.0, 0.0, 79.5], [0.0, 110.0, 59.5], [0.0, 0.0, 1.0]])
BARREL = np.array([-0.196, 0.0, 0.0, 0.0])  # moves a corner of 120 x 160 by 16 %
STRAIGHT = {"camera_matrix": LENS.tolist(), "distortion_coefficients": BARREL.tolist()}


def through_the_lens(height=120, width=160):
    """Where each pixel of a frame would lie without distortion, (2, H, W)."""
    x, y = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    place = cv2.undistortPoints(np.stack([x, y], -1).reshape(-1, 1, 2), LENS, BARREL, P=LENS)
    return torch.from_numpy(place.reshape(height, width, 2)).permute(2, 0, 1)


def test_a_lens_is_taken_out_of_raw_frames():
    raw = smooth(*through_the_lens())
    assert (raw - frame()).abs().max() > 0.5
    sensor = vts.Sensor("rig", 120, 160, 0.1, **STRAIGHT)
    straight = sensor.rectify(raw)
    assert (straight - frame()).abs().max() < 0.02  # bilinear
    view = {"turn_deg": 90, "mirror": True, "corners_px": ((12, 34), (90, 30), (100, 120), (9, 133))}
    at_once, after = (vts.Sensor("rig", 60, 50, 0.1, **view, **lens) for lens in (STRAIGHT, {}))
    assert (at_once.rectify(raw) - after.rectify(straight)).abs().max() < 0.02
    pincushion = {**STRAIGHT, "distortion_coefficients": (0.2, 0, 0, 0)}
    with pytest.raises(ValueError, match=r"frame: of 120 x 160 sensor 'rig' needs pixels up to 13 beyond its edge.*raw_crop"):
        vts.Sensor("rig", 120, 160, 0.1, **pincushion).rectify(raw)
    assert vts.Sensor("rig", 60, 80, 0.1, roi_px=(40, 30, 80, 60), **pincushion).rectify(raw).shape[2:] == (60, 80)


def test_depth_in_a_corner_behind_a_lens():
    """Without the lens in the sensor file this press, of 0.6 mm, is read 11 % too flat."""
    scene = vts.scenes.sphere_press(4.0, 0.6, (5.0, 3.6), 120, 160, 0.1)
    grid = (2 * through_the_lens() / torch.tensor([159.0, 119.0])[:, None, None] - 1).permute(1, 2, 0)[None]
    images = [vts.scenes.render(one, ring_lights()).double() for one in (vts.scenes.undeformed(scene), scene)]
    raw = [torch.nn.functional.grid_sample(image, grid, padding_mode="border", align_corners=True) for image in images]
    sensor = vts.Sensor("rig", 120, 160, 0.1, **STRAIGHT)
    background, press = (sensor.rectify(image).float() for image in raw)
    calibration = vts.Calibration.from_lights(ring_lights(), sensor, background[0])
    depth = vts.DepthPipeline.from_calibration(calibration, mode="precise")(press).depth_mm
    assert float(depth.max()) == pytest.approx(float(scene.depth_mm.max()), rel=0.02)
    assert float((depth - scene.depth_mm).abs().max()) < 0.03


@pytest.mark.parametrize(
    "options, size, message",
    [
        ({"roi_px": (100, 0, 80, 60)}, (120, 160), "frame: 120 x 160 does not contain roi_px of sensor 'rig', columns 100.*179"),
        ({"corners_px": ((0, 0), (300, 0), (300, 210), (0, 210))}, (120, 160), "frame: 120 x 160 does not contain corners_px"),
        (
            {},
            (36, 48),
            "frame: expected 24 x 32 for sensor 'rig', got 36 x 48: resize it, load the sensor with height=36, width=48, "
            "or give it roi_px: .0, 0, 48, 36.",
        ),
    ],
)
def test_a_frame_that_does_not_fit_is_refused(options, size, message):
    with pytest.raises(ValueError, match=message):
        vts.Sensor(**GOOD, **options).rectify(torch.zeros(1, 3, *size))


def test_a_frame_of_twice_the_resolution_is_scaled_with_a_sentence():
    raw = torch.rand(1, 3, 48, 64)
    with pytest.warns(UserWarning, match=r"48 x 64, 2 times the resolution of sensor 'rig', is scaled.*raw_size_px: \[\[48, 64"):
        image = vts.Sensor(**GOOD).rectify(raw)
    assert torch.equal(image, vts.Sensor(**GOOD, raw_size_px=((48, 64),)).rectify(raw))
    with pytest.raises(ValueError, match="got 48 x 64"):
        vts.Sensor(**GOOD, mirror=True).rectify(raw)


def test_the_wedge_video_is_rectified_to_its_gel(data):
    video = next(path for path in sorted((data / "wedge_video").iterdir()) if path.suffix in (".avi", ".mp4", ".mov"))
    _, first = next(iter(vts.frames(video)))
    gel = vts.Sensor.load("gelsight_wedge").rectify(first[None])
    assert gel.shape == (1, 3, 300, 400)
    assert float(gel.amin()) >= 0 and float(gel.mean(dim=1).amin()) > 0.02, "no pixel from beyond the frame"


@pytest.mark.long
def test_shipped_sensors_are_found_from_an_installed_wheel(tmp_path):
    pytest.importorskip("build")
    pytest.importorskip("hatchling")
    root = Path(vts.__file__).resolve().parents[1]
    if not (root / "pyproject.toml").is_file():
        pytest.skip("torchvts is installed, there is no source to build a wheel from")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path / "dist"), str(root)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    with zipfile.ZipFile(next((tmp_path / "dist").glob("*.whl"))) as wheel:
        wheel.extractall(tmp_path / "site")
        folders = {name.split("/")[0] for name in wheel.namelist()}
    # nothing of scripts or tests
    assert folders == {"torchvts", "lerobot_camera_torchvts", f"torchvts-{vts.__version__}.dist-info"}
    program = (
        "import torchvts; print(torchvts.__file__); "
        "print(torchvts.Sensor.load('gelsight_mini').mm_per_pixel, *torchvts.shipped_sensors())"
    )
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "site")}
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False, cwd=tmp_path, env=environment
    )
    assert done.returncode == 0, done.stderr
    where, found = done.stdout.splitlines()
    assert where.startswith(str(tmp_path / "site"))
    assert found.split() == ["0.0634", *vts.shipped_sensors()]
    assert (tmp_path / "site" / "torchvts" / "py.typed").is_file()


def test_raw_frames_are_cropped_and_resized():
    sensor = vts.Sensor(**GOOD, raw_size_px=((84, 112), (240, 320)), raw_crop=1 / 7)
    y, x = torch.meshgrid(torch.arange(84.0), torch.arange(112.0), indexing="ij")
    frame = (torch.stack((x / 112, y / 84, 0 * x + 0.5)))[None]
    image = sensor.rectify(frame)[0]  # 12 rows and 16 columns are cut off each side; 60 x 80 become 24 x 32
    assert image.shape == (3, 24, 32)
    assert float(image[0, 12].diff().mean()) == pytest.approx(80 / 112 / 32, rel=0.02)
    assert float(image[0, :, 0].mean()) == pytest.approx((16 + 80 / 64 - 0.5) / 112, abs=0.005)
    assert float(image[1, 0].mean()) == pytest.approx((12 + 60 / 48 - 0.5) / 84, abs=0.005)
    cropped = torch.rand(1, 3, 24, 32, generator=torch.Generator().manual_seed(0))
    assert torch.equal(sensor.rectify(cropped), cropped)
    with pytest.raises(
        ValueError,
        match="frame: expected 24 x 32, or raw frames of 84 x 112 or 240 x 320, for sensor 'rig', got 30 x 32: another aspect",
    ):
        sensor.rectify(torch.zeros(1, 3, 30, 32))
    assert sensor.resized(240, 320).raw_size_px == ((84, 112),)  # images of this size are cropped already


@pytest.mark.parametrize(
    "place", [{"roi_px": (8, 4, 64, 48)}, {"corners_px": ((7.5, 3.5), (71.5, 3.5), (71.5, 51.5), (7.5, 51.5))}]
)
def test_a_place_is_cut_from_frames_of_its_size_alone(place):
    sensor = vts.Sensor(**GOOD, **place, raw_size_px=((60, 100),))
    frame = torch.rand(1, 3, 60, 100, generator=torch.Generator().manual_seed(0))
    assert torch.equal(sensor.rectify(frame), vts.Sensor(**GOOD, **place).rectify(frame))
    for size in ((120, 200), (24, 32)):
        with pytest.raises(
            ValueError, match=f"frames of 60 x 100, .* has its {next(iter(place))}, got {size[0]} x {size[1]}: another mode"
        ):
            sensor.rectify(torch.zeros(1, 3, *size))
    assert sensor.resized(48, 64).raw_size_px == ((60, 100),)


@pytest.mark.parametrize(
    "options, name",
    [
        ({"roi_px": (0, 0, 70, 50)}, "roi_px"),
        ({"roi_px": (0, 0, 400, 400)}, "roi_px"),
        ({"raw_size_px": ((90, 160),)}, "raw_size_px"),
    ],
)
def test_pixels_that_would_not_be_square_are_refused(options, name):
    with pytest.raises(ValueError, match=rf"^{name}: expected .* 32 x 24, 1\.333, got \d+ x \d+, \d\.\d+: pixels would not be"):
        vts.Sensor(**GOOD, **options)
    assert vts.Sensor(**GOOD, roi_px=(1, 2, 321, 239)).roi_px == (1, 2, 321, 239)  # 0.7 %: whole pixels
    assert vts.Sensor(**GOOD, corners_px=((0, 0), (70, 0), (70, 50), (0, 50))).corners_px is not None


def test_frames_of_the_mini_as_its_camera_gives_them(data, tmp_path):
    raw = vts.read_image(data / "gelsight_mini_c" / "frame_1.jpg")  # 240 x 320, with the frame of the gel around it
    sensor = vts.Sensor.load("gelsight_mini")
    top, left = 240 / 7, 320 / 7
    box = [round(left), round(top), round(320 - 2 * left), round(240 - 2 * top)]
    direct = vts.Sensor("mini", 240, 320, 0.0634, roi_px=box).rectify(raw[None])
    for size in sensor.raw_size_px:
        larger = torch.nn.functional.interpolate(raw[None], size, mode="bilinear", align_corners=False)
        vts.write_image(tmp_path / "raw.png", larger[0])
        assert float((sensor.read_image(tmp_path / "raw.png") - direct).abs().mean()) < 0.005
    vts.write_image(tmp_path / "wide.png", torch.rand(3, 90, 160))
    with pytest.raises(ValueError, match=r"wide\.png: frame: expected 240 x 320, or raw frames of 2464 x 3280 or 480 x 640"):
        sensor.read_image(tmp_path / "wide.png")


def test_a_recording_of_a_digit_reads_the_same_upright_and_lying(data, tmp_path):
    sensor, file = vts.Sensor.load("digit"), data / "digit_a" / "background.png"
    cv2.imwrite(str(tmp_path / "lying.png"), cv2.rotate(cv2.imread(str(file)), cv2.ROTATE_90_CLOCKWISE))
    assert torch.equal(sensor.read_image(tmp_path / "lying.png"), sensor.read_image(file))


def test_a_mount_in_metres_is_asked_about():
    with pytest.warns(UserWarning, match="sensor_to_robot: its shift is at most 0.12 mm: was it meant in m?"):
        vts.Sensor(**GOOD, sensor_to_robot=((0, 0, 1, 0.05), (0, 1, 0, 0), (-1, 0, 0, 0.12), (0, 0, 0, 1)))


@pytest.mark.parametrize("options", [{}, {"roi_px": [10, 20, 160, 120]}, {"turn_deg": 90}, {"raw_size_px": [[240, 320]]}])
def test_pixels_that_are_not_square_are_made_so(options):
    """A plane of colours in mm keeps its slope along both axes."""
    values = {"name": "rig", "height": 120, "width": 160, "mm_per_pixel": [0.1, 0.12], **options}
    sensor = vts.Sensor.from_dict(values, "rig.yaml")
    assert (sensor.mm_per_pixel, sensor.height, sensor.width) == (0.12, 120, 133)
    assert vts.Sensor.from_dict(sensor.to_dict(), "again") == sensor
    rows, columns = {"turn_deg": (160, 120), "raw_size_px": (240, 320)}.get(next(iter(options), ""), (200, 240))
    rows, columns = (rows, columns) if options else (120, 160)
    y, x = torch.meshgrid(torch.arange(rows, dtype=torch.float64), torch.arange(columns, dtype=torch.float64), indexing="ij")
    if "turn_deg" in options:
        x, y = y, columns - 1 - x  # as seen after the turn
    scale = 1.0 if "raw_size_px" not in options else 159 / 319
    raw = torch.stack((0.1 * scale * x, 0.12 * scale * y, 0 * x))[None] / 40
    image = sensor.rectify(raw)[0] * 40
    slopes = [float((image[0, 60, 130] - image[0, 60, 2]) / 128), float((image[1, 110, 60] - image[1, 10, 60]) / 100)]
    assert slopes == pytest.approx([0.12, 0.12], rel=5e-3)
    assert image.shape == (3, 120, 133)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"mm_per_pixel": [0.1, 0.2]}, r"rig\.yaml: mm_per_pixel: expected a pitch, or .along x, along y. within 1\.5, got"),
        ({"mm_per_pixel": [0.1]}, "mm_per_pixel: expected"),
        ({"raw_crop": 0.1}, r"mm_per_pixel: expected one pitch beside raw_crop, got .*: give roi_px, or one pitch"),
    ],
)
def test_pitches_that_cannot_be_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        vts.Sensor.from_dict({**GOOD, "mm_per_pixel": [0.1, 0.11], **options}, "rig.yaml")
