"""gs_sdk's folders, sensor files, height maps, gradients and images."""

import argparse

import cv2
import numpy as np
import pytest
import torch
import yaml

import torchvts as vts
from torchvts.cli.calibrate import read_given
from torchvts.model.gs_sdk import (
    depth_from_height_map,
    gradient_from_gs_sdk,
    gradient_to_gs_sdk,
    height_map_from_depth,
    image_from_bgr,
    image_to_bgr,
    read_calibration_folder,
    read_labels,
)

HEIGHT, WIDTH = 12, 16
HEADER = "experiment_reldir,diameter(mm)"


def pixels(seed=0, height=HEIGHT, width=WIDTH):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def write_press(folder, name, seed=1, **size):
    (folder / name).mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(folder / name / "gelsight.png"), pixels(seed, **size))


@pytest.fixture
def folder(tmp_path):
    """Two presses with a 4 mm ball, one with a 6.31 mm ball."""
    folder = tmp_path / "calibration"
    folder.mkdir()
    cv2.imwrite(str(folder / "background.png"), pixels(0))
    for seed, name in enumerate(("4.000mm/0", "4.000mm/1", "6.310mm/0")):
        write_press(folder, name, seed + 1)
    catalog(folder, "4.000mm/0,4.0", "4.000mm/1,4.0", "6.310mm/0,6.31")
    return folder


def catalog(folder, *lines, header=HEADER):
    (folder / "catalog.csv").write_text("\n".join((header, *lines)) + "\n")


def test_a_folder_is_read(folder):
    background, presses = read_calibration_folder(str(folder))
    assert torch.equal(background, image_from_bgr(pixels(0)))
    assert [press.name for press in presses] == ["4.000mm/0", "4.000mm/1", "6.310mm/0"]
    assert [press.ball_diameter_mm for press in presses] == [4.0, 4.0, 6.31]
    assert torch.equal(presses[2].image, image_from_bgr(pixels(3)))
    assert all(press.center_px is None and press.radius_px is None for press in presses)


def test_labels_of_gs_sdk_are_read(folder):
    np.savez(folder / "4.000mm/1" / "label.npz", center=np.array([7, 5]), radius=3.5)
    press = read_calibration_folder(folder)[1][1]
    assert press.center_px == (7.0, 5.0) and press.radius_px == 3.5


def test_images_that_gs_sdk_has_cropped_are_not_cropped_again(folder, tmp_path):
    config = {"ppmm": 0.1, "imgh": HEIGHT, "imgw": WIDTH, "raw_imgh": HEIGHT, "raw_imgw": WIDTH}
    (tmp_path / "same.yaml").write_text("".join(f"{key}: {value}\n" for key, value in config.items()))
    given = argparse.Namespace(source=[folder], sensor=str(tmp_path / "same.yaml"), no_prior=False, use_labels=False)
    background, _, presses = read_given(given)
    kept, pressed = read_calibration_folder(folder)
    assert torch.equal(background, kept) and torch.equal(presses[0].image, pressed[0].image)


def test_a_catalog_of_windows_is_read(folder):
    text = f"\ufeff{HEADER}\r\n4.000mm\\0, 4.0\r\n\r\n".encode()
    (folder / "catalog.csv").write_bytes(text)
    _, (press,) = read_calibration_folder(folder)
    assert press.image.shape == (3, HEIGHT, WIDTH) and press.ball_diameter_mm == 4.0


def test_a_damaged_image_is_refused(folder):
    image = folder / "4.000mm/0" / "gelsight.png"
    image.write_bytes(image.read_bytes()[:60])
    with pytest.raises(ValueError, match=r"gelsight\.png: not an image, or cut short"):
        read_calibration_folder(folder)


@pytest.mark.parametrize("missing", ["catalog.csv", "background.png", "4.000mm/1/gelsight.png"])
def test_a_missing_file_is_named(folder, missing):
    (folder / missing).unlink()
    with pytest.raises(FileNotFoundError, match=rf"{missing.split('/')[-1]}: no such"):
        read_calibration_folder(folder)


@pytest.mark.parametrize(
    "lines, header, message",
    [
        ((), HEADER, r"catalog\.csv: no presses"),
        (("4.000mm/0,4.0,1",), HEADER + ",depth", r"expected the columns experiment_reldir,diameter\(mm\), got .*depth"),
        (("4.000mm/0",), HEADER, r"line 2: expected 2 values, got 1"),
        ((",4.0",), HEADER, r"line 2: experiment_reldir: expected the folder of the press, got nothing"),
        (("4.000mm/0,four",), HEADER, r"line 2: diameter\(mm\): expected a number, got 'four'"),
        (("4.000mm/0,4", "4.000mm/1,-4"), HEADER, r"line 3: diameter\(mm\): expected a ball's diameter in mm, got '-4'"),
        (("4.000mm/0,4", "4.000mm/./0,4"), HEADER, r"line 3: experiment_reldir: '4.000mm/./0' is given twice"),
    ],
)
def test_a_bad_catalog_is_refused(folder, lines, header, message):
    catalog(folder, *lines, header=header)
    with pytest.raises(ValueError, match=message):
        read_calibration_folder(folder)


@pytest.mark.parametrize("content", [b"\xff\xfe\x00\x01", b'experiment_reldir,diameter(mm)\n"4.000mm/0,4\n'])
def test_what_is_no_table_is_refused(folder, content):
    (folder / "catalog.csv").write_bytes(content)
    with pytest.raises(ValueError, match=r"catalog\.csv: not a CSV table"):
        read_calibration_folder(folder)


@pytest.mark.parametrize("name", ["../outside", "4.000mm/../../outside", "..\\outside", "/etc", ".", "4.000mm/..", "a\0b"])
def test_no_name_leads_out_of_the_folder(folder, name):
    write_press(folder.parent, "outside")
    with (folder / "catalog.csv").open("w", newline="") as stream:
        stream.write(f"{HEADER}\n{name},4.0\n")
    with pytest.raises(ValueError, match=r"experiment_reldir: expected a folder inside|not a CSV table"):
        read_calibration_folder(folder)


def test_no_link_leads_out_of_the_folder(folder):
    write_press(folder.parent, "outside")
    (folder / "link").symlink_to(folder.parent / "outside")
    catalog(folder, "link,4.0")
    with pytest.raises(ValueError, match=r"experiment_reldir: expected a folder inside"):
        read_calibration_folder(folder)
    (folder / "own").mkdir()
    (folder / "own" / "gelsight.png").symlink_to(folder.parent / "outside" / "gelsight.png")
    catalog(folder, "own,4.0")
    with pytest.raises(ValueError, match=r"experiment_reldir: expected a folder inside"):
        read_calibration_folder(folder)


def test_an_image_of_another_size_is_refused(folder):
    write_press(folder, "4.000mm/1", height=HEIGHT + 1)
    with pytest.raises(ValueError, match=r"gelsight\.png: expected 12 x 16 like background\.png, got 13 x 16"):
        read_calibration_folder(folder)


@pytest.mark.parametrize(
    "arrays, message",
    [
        ({"center": [1.0, 2.0]}, "expected the arrays 'center' and 'radius', one is missing"),
        ({"center": [1.0, 2.0, 3.0], "radius": 2.0}, r"expected center \(x, y\) and one radius, got shapes \(3,\) and \(1,\)"),
        ({"center": [1.0, 2.0], "radius": -2.0}, "expected finite pixels and a radius above 0"),
        ({"center": np.zeros((200, 200)), "radius": 2.0}, "larger than a centre and a radius"),
    ],
)
def test_a_bad_label_is_refused(folder, arrays, message):
    np.savez(folder / "4.000mm/0" / "label.npz", **arrays)
    with pytest.raises(ValueError, match=message):
        read_calibration_folder(folder)


def test_a_label_that_would_be_unpickled_or_is_cut_is_refused(folder):
    label = folder / "4.000mm/0" / "label.npz"
    np.savez(label, center=np.array([object(), None], dtype=object), radius=2.0)
    with pytest.raises(ValueError, match=r"label\.npz: not a label of gs_sdk.*allow_pickle"):
        read_calibration_folder(folder)
    for content in (label.read_bytes()[:100], b"", b"\x93NUMPY"):
        label.write_bytes(content)
        with pytest.raises(ValueError, match=r"label\.npz: not a label of gs_sdk, or cut short"):
            read_calibration_folder(folder)


def test_labels_table(tmp_path):
    header = "experiment_reldir,diameter_mm,center_x_px,center_y_px,contact_radius_px"
    (tmp_path / "labels.csv").write_text(f"{header}\n4.000mm/0,4.0,10.5,-3,30\n4.000mm/1,4.0,1,2,\n")
    assert read_labels(tmp_path) == {"4.000mm/0": (10.5, -3.0, 30.0), "4.000mm/1": (1.0, 2.0, None)}
    for line, message in (
        ("a,4,1,x,3", r"line 2: center_y_px: expected a number, got 'x'"),
        ("a,4,1,2,0", r"line 2: contact_radius_px: expected a number above 0, or nothing"),
        ("a,4,1,2,3\na,4,1,2,3", r"line 3: experiment_reldir: 'a' is given twice"),
    ):
        (tmp_path / "labels.csv").write_text(f"{header}\n{line}\n")
        with pytest.raises(ValueError, match=message):
            read_labels(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"labels\.csv: no such file"):
        read_labels(tmp_path / "elsewhere")


CONFIG = {"ppmm": 0.0634, "imgh": 240, "imgw": 320, "raw_imgh": 2464, "raw_imgw": 3280, "framerate": 25}


def loaded(folder, config):
    (folder / "mini.yaml").write_text(yaml.safe_dump(config))
    return vts.Sensor.load(folder / "mini.yaml")


def test_a_sensor_file_is_read(tmp_path):
    expected = vts.Sensor("mini", 240, 320, 0.0634, raw_size_px=((2464, 3280),), raw_crop=1 / 7)
    assert loaded(tmp_path, CONFIG) == expected
    same = loaded(tmp_path, CONFIG | {"raw_imgh": 240, "raw_imgw": 320})
    frame = torch.linspace(0, 1, 320).expand(1, 3, 240, 320)
    assert same.rectify(frame)[0, 0, 0].tolist() == pytest.approx(torch.linspace(45 / 320, 275 / 320, 320).tolist(), abs=0.005)
    assert loaded(tmp_path, {"ppmm": 0.0634, "imgh": 240, "imgw": 320}).raw_size_px == ()


@pytest.mark.parametrize(
    "change, message",
    [
        ({"gain": 2}, "key 'gain': unknown; expected ppmm, imgh, imgw, raw_imgh"),
        ({"ppmm": None}, "key ppmm: expected a number"),
        ({"ppmm": 15.8}, r"key ppmm: expected mm per pixel in \(0, 1\], got 15.8: the name misleads"),
        ({"imgw": 0}, "key imgw: expected at least 8"),
    ],
)
def test_a_bad_sensor_file_is_refused(tmp_path, change, message):
    with pytest.raises(ValueError, match=rf"mini\.yaml: {message}"):
        loaded(tmp_path, CONFIG | change)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_height_map_and_gradient_describe_one_surface(dtype):
    # a ball pressed 1 mm: gs_sdk's gradient is the derivative of its height map by pixels
    pitch = 0.05
    z = vts.scenes.sphere_press(10.0, 1.0, (0.3, -0.2), 40, 48, pitch, dtype).depth_mm
    height_map = height_map_from_depth(z, pitch)
    assert height_map.shape == (40, 48) and height_map.min() < -15 and height_map.max() <= 0
    gy, gx = np.gradient(height_map)
    true_gy, true_gx = np.gradient(z[0, 0].numpy(), pitch)
    gradient = gradient_from_gs_sdk(gx, gy)
    assert gradient.dtype == dtype and gradient.shape == (1, 2, 40, 48)
    assert np.allclose(gradient[0, 0], true_gx, atol=1e-4) and np.allclose(gradient[0, 1], true_gy, atol=1e-4)
    for one, two in zip(gradient_to_gs_sdk(gradient), (gx, gy)):
        assert np.array_equal(one, two)
    back = depth_from_height_map(height_map, pitch)
    assert back.dtype == dtype and torch.allclose(back, z, atol=1e-6)


def test_zero_stays_a_positive_zero():
    assert not torch.signbit(depth_from_height_map(np.zeros((2, 2)), 0.1)).any()
    assert not torch.signbit(gradient_from_gs_sdk(np.zeros((2, 2)), np.zeros((2, 2)))).any()


def test_channels_are_turned_and_come_back():
    image = image_from_bgr(pixels(4))
    assert torch.equal(image[0], torch.from_numpy(pixels(4)[..., 2].astype(np.float32)) / 255)
    assert np.array_equal(image_to_bgr(image), pixels(4))
    assert np.array_equal(image_to_bgr(image.double()), pixels(4))
    assert image_to_bgr(torch.tensor([2.0, 0.5, -1.0]).reshape(3, 1, 1)).tolist() == [[[0, 128, 255]]]


def test_a_real_folder(data):
    folder = data / "gelsight_mini_a"
    (background, presses), labels = read_calibration_folder(folder), read_labels(folder)
    assert background.shape == presses[0].image.shape == (3, 240, 320) and len(presses) == 34
    assert {press.name for press in presses} == set(labels)
    assert sorted({press.ball_diameter_mm for press in presses}) == [6.31, 9.5]
    assert sum(radius is None for _, _, radius in labels.values()) == 4
