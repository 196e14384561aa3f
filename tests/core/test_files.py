"""Images, depth maps, frames and point clouds on disk."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from conftest import ring_lights, write_film

import torchvts as vts
from torchvts import stream as streams
from torchvts.core.files import read_depth_png, rgb_from_bgr, write_atomically, write_depth_png
from torchvts.core.recordings import count_frames, cut_short
from torchvts.dataset import list_items
from torchvts.pose import read_cloud


def picture(height=12, width=16, seed=0):
    levels = torch.randint(0, 256, (3, height, width), generator=torch.Generator().manual_seed(seed))
    return levels.float() / 255


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tif", ".PNG"])
def test_an_image_comes_back_as_it_was(tmp_path, suffix):
    vts.write_image(tmp_path / f"image{suffix}", picture())
    assert torch.equal(vts.read_image(str(tmp_path / f"image{suffix}")), picture())


def test_sixteen_bits_keep_their_steps(tmp_path):
    bgr = np.zeros((5, 6, 3), np.uint16)
    bgr[..., 2], bgr[..., 0] = 65535, 1
    cv2.imwrite(str(tmp_path / "deep.png"), bgr)
    assert vts.read_image(tmp_path / "deep.png")[:, 0, 0].tolist() == pytest.approx([1.0, 0.0, 1 / 65535])


@pytest.mark.parametrize("kind, suffix", [("PNG", ".png"), ("BMP", ".bmp")])
def test_a_palette_is_refused(tmp_path, kind, suffix):
    """Its 256 colours moved depth by 0.08 mm on a press of 0.5 mm."""
    Image = pytest.importorskip("PIL.Image")
    Image.fromarray((picture() * 255).byte().permute(1, 2, 0).numpy()).convert("P").save(tmp_path / f"image{suffix}")
    with pytest.raises(ValueError, match=f"got a {kind} with a palette, which keeps 256 colours: save frames as PNG"):
        vts.read_image(tmp_path / f"image{suffix}")


def test_transparency_is_left_out(tmp_path):
    bgra = np.full((5, 6, 4), (10, 20, 30, 77), np.uint8)
    cv2.imwrite(str(tmp_path / "clear.png"), bgra)
    assert vts.read_image(tmp_path / "clear.png")[:, 0, 0].tolist() == pytest.approx([30 / 255, 20 / 255, 10 / 255])


@pytest.mark.parametrize(
    "pixels, message",
    [
        (np.zeros((5, 6), np.uint8), r"expected a colour image, got one of shape \(5, 6\): three lights need three channels"),
        (np.full((5, 6, 3), 300.0, np.float32), r"expected values in \[0, 1\] or \[0, 255\], got 300 to 300: scale them before"),
        (np.full((5, 6, 3), np.nan, np.float32), r"expected values in \[0, 1\] or \[0, 255\], got nan to nan"),
        (
            np.full((5, 6, 3), 1020, np.uint16),
            "expected 16 bits that reach beyond 4095, got at most 1020: 8, 10 or 12 bits",
        ),
        (np.zeros((5, 6, 3), np.int16), "expected 8 or 16 bits per channel, got int16"),
    ],
)
def test_other_images_are_refused(tmp_path, pixels, message):
    cv2.imwrite(str(tmp_path / "image.tiff"), pixels)
    with pytest.raises(ValueError, match=message):
        vts.read_image(tmp_path / "image.tiff")


@pytest.mark.parametrize("scale, dtype", [(1.0, np.float32), (255.0, np.float32), (1.0, np.float64)])
def test_floats_are_read_as_the_levels_they_hold(tmp_path, scale, dtype):
    cv2.imwrite(str(tmp_path / "float.tiff"), (picture().flip(0).permute(1, 2, 0).numpy() * scale).astype(dtype))
    assert torch.equal(vts.read_image(tmp_path / "float.tiff"), picture())


def test_depth_comes_back_to_half_a_step(tmp_path):
    depth = torch.linspace(-3.2768, 3.2767, 96).reshape(1, 1, 8, 12)
    write_depth_png(tmp_path / "depth.png", depth)
    back = read_depth_png(tmp_path / "depth.png")
    assert back.shape == depth.shape and float((back - depth).abs().max()) < 0.5e-4 + 1e-6
    write_depth_png(tmp_path / "zero.png", torch.zeros(8, 12))
    assert float(read_depth_png(tmp_path / "zero.png").abs().max()) == 0


@pytest.mark.parametrize("value", [3.28, -3.28, float("nan"), float("inf")])
def test_depth_beyond_the_range_of_a_png_is_refused(tmp_path, value):
    with pytest.raises(
        ValueError, match=r"depth_mm: expected finite values in \[-3.2768, 3.2767\] mm for a PNG, got .*: write .npy"
    ):
        write_depth_png(tmp_path / "depth.png", torch.full((8, 8), value))
    assert list(tmp_path.iterdir()) == []


def test_a_picture_is_no_depth(tmp_path):
    vts.write_image(tmp_path / "image.png", picture())
    with pytest.raises(ValueError, match=r"image\.png: expected a 16-bit grey PNG with depth"):
        read_depth_png(tmp_path / "image.png")


@pytest.mark.parametrize(
    "names",
    [
        ["000", "001", "002"],
        ["frame_1", "frame_2", "frame_10", "frame_11"],  # frame_%d.png of OpenCV
        ["1764241910.25", "1764241910.5", "1764241911.125"],  # f"{time.time()}.png"
        ["press_1_9", "press_1_10", "press_01_11", "press_2_1"],
    ],
)
def test_frames_of_a_folder_come_in_the_order_of_their_numbers(tmp_path, names):
    for k in reversed(range(len(names))):
        vts.write_image(tmp_path / f"{names[k]}.png", picture(seed=k))
    (tmp_path / "notes.txt").write_text("no image")
    frames, reader = list(vts.frames(tmp_path)), streams.open_source(tmp_path)
    assert [name for name, _ in frames] == names and count_frames(tmp_path) == len(names)
    assert [item.stem for item in list_items(tmp_path)] == names
    for k, (_, frame) in enumerate(frames):
        assert torch.equal(frame, picture(seed=k)) and torch.equal(rgb_from_bgr(reader.read()), frame)


def test_frames_of_a_video(tmp_path):
    red = np.array([0, 0, 1], np.uint8)
    path = write_film(tmp_path / "film.avi", [np.full((48, 64, 3), 40 * k, np.uint8) * red for k in range(5)])
    frames = list(vts.frames(path))
    assert [name for name, _ in frames] == [f"film_{k:06d}" for k in range(5)] and count_frames(path) == 5
    for k, (_, frame) in enumerate(frames):
        assert frame.shape == (3, 48, 64)
        assert frame.mean(dim=(1, 2)).tolist() == pytest.approx([40 * k / 255, 0, 0], abs=0.01)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_all_pages_of_a_tiff_are_frames(tmp_path, dtype):
    pages = [np.random.default_rng(k).integers(0, np.iinfo(dtype).max, (12, 16, 3)).astype(dtype) for k in range(37)]
    path = tmp_path / "rec.tif"
    cv2.imwritemulti(str(path), pages)
    frames, reader = list(vts.frames(path)), streams.open_source(path)
    assert [name for name, _ in frames] == [f"rec_{k:06d}" for k in range(37)] and count_frames(path) == 37
    assert all(torch.equal(frame, rgb_from_bgr(page)) for (_, frame), page in zip(frames, pages, strict=True))
    assert all(np.array_equal(reader.read(), page) for page in pages) and reader.read() is None
    (item,) = list_items(tmp_path)
    assert item.is_film and item.frame_stem(3) == "rec_000003"
    with pytest.raises(ValueError, match="expected one image, got a TIFF of 37 pages"):
        vts.read_image(path)
    vts.write_image(tmp_path / "z.tif", picture())  # a folder may hold both
    assert len(list(vts.frames(tmp_path))) == count_frames(tmp_path) == 38
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert (
        0 < count_frames(path) < 38
        and cut_short(path, 3) == f"cut short? it announces {count_frames(path)} frames, 3 could be read"
    )


EXIF_TURNED = bytes.fromhex("ffe100224578696600004d4d002a00000008000101120003000000010003000000000000")
"""The segment of a JPEG that says that it is to be shown turned by 180 degrees."""


def test_an_image_that_its_exif_tag_turns_is_turned(tmp_path):
    image = torch.nn.functional.interpolate(picture(3, 4)[None], (48, 64), mode="bilinear")[0]
    vts.write_image(tmp_path / "up.jpg", image.flip(1, 2))
    plain, content = vts.read_image(tmp_path / "up.jpg"), (tmp_path / "up.jpg").read_bytes()
    (tmp_path / "up.jpg").write_bytes(content[:2] + EXIF_TURNED + content[2:])
    assert torch.equal(vts.read_image(tmp_path / "up.jpg"), plain.flip(1, 2))
    assert float((vts.read_image(tmp_path / "up.jpg") - image).abs().mean()) < 0.02


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"GIF89a" + bytes(60), "got a GIF, which keeps 256 colours: save frames as PNG"),
        (b"RIFF\x00\x00\x00\x00WEBPVP8X\x0a\x00\x00\x00\x02" + bytes(60), "expected one image, got an animation"),
        (b"\x89PNG\r\n\x1a\n" + bytes(25) + b"\x00\x00\x00\x08acTL" + bytes(60), "expected one image, got an animation"),
    ],
)
def test_animations_are_refused_and_not_read_by_their_first_frame(tmp_path, content, message):
    (tmp_path / "film.png").write_bytes(content)
    with pytest.raises(ValueError, match=message):
        vts.read_image(tmp_path / "film.png")


@pytest.mark.parametrize("read", [lambda path: list(vts.frames(path)), streams.open_source])
def test_missing_and_broken_sources_are_refused(tmp_path, read):
    with pytest.raises(ValueError, match="no images"):
        read(tmp_path)
    with pytest.raises(FileNotFoundError, match="nowhere: no such file or folder"):
        read(tmp_path / "nowhere")
    for name, content, message in (
        ("text.txt", b"no film", "(expected a video, an image or a container|not an image, or cut short)"),
        ("film.avi", b"no film", "not a video"),
        ("cut.avi", b"RIFF0000AVI ", "not a video"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=rf"{name}: .*{message}"):
            read(tmp_path / name)


@pytest.fixture(scope="module")
def clouds():
    from torchvts.pose import clouds

    try:
        read_cloud.open3d()
    except ImportError as error:
        pytest.skip(str(error))
    return clouds


@pytest.mark.parametrize(
    "suffix, with_normals",
    [(".ply", True), (".pcd", False), *(pytest.param(*pair, marks=pytest.mark.long) for pair in ((".ply", False), (".pcd", True)))],
)
def test_a_point_cloud_comes_back_as_it_was(tmp_path, clouds, suffix, with_normals):
    scene = vts.scenes.sphere_press(10.0, 1.0, (0, 0), 24, 32, 1.0)
    points = vts.depth_to_points(scene.depth_mm, 1.0, scene.contact)
    normals = torch.nn.functional.normalize(torch.rand(len(points), 3), dim=1) if with_normals else None
    clouds.write_point_cloud(tmp_path / f"cloud{suffix}", points, normals)
    theirs = read_cloud.open3d().io.read_point_cloud(str(tmp_path / f"cloud{suffix}"))
    assert torch.allclose(torch.tensor(np.asarray(theirs.points)).float(), points, atol=1e-6)
    assert theirs.has_normals() == with_normals
    back, back_normals = clouds.read_point_cloud(tmp_path / f"cloud{suffix}")
    assert torch.allclose(back.float(), points, atol=1e-6)
    assert (back_normals is None) == (normals is None)
    if normals is not None:
        assert torch.allclose(back_normals.float(), normals, atol=1e-6)
    assert len(list(tmp_path.iterdir())) == 1


def test_broken_clouds_are_refused(tmp_path, clouds):
    with pytest.raises(ValueError, match=r"cloud.xyz: expected a name ending in .pcd or .ply"):
        clouds.write_point_cloud(tmp_path / "cloud.xyz", torch.zeros(5, 3))
    with pytest.raises(FileNotFoundError, match=r"cloud\.ply: no such point cloud"):
        clouds.read_point_cloud(tmp_path / "cloud.ply")
    (tmp_path / "cloud.ply").write_bytes(b"no cloud")
    with pytest.raises(ValueError, match=r"cloud\.ply: no points could be read"):
        clouds.read_point_cloud(tmp_path / "cloud.ply")


def calibration():
    return vts.Calibration.from_lights(ring_lights(), vts.Sensor("rig", 48, 64, 0.5), torch.rand(3, 48, 64) * 0.2 + 0.4)


@pytest.mark.parametrize("name", ["depth.npy", "unit.safetensors", "image.png", "rig.yaml"])
def test_a_full_disk_is_reported_with_the_name(tmp_path, name, small_files):
    write = {
        "depth.npy": lambda path: write_array(path),
        "unit.safetensors": calibration().save,
        "image.png": lambda path: vts.write_image(path, torch.rand(3, 200, 200)),
        "rig.yaml": lambda path: vts.Sensor.load("gelsight_mini").save(path, ["# " + "x" * 5000]),
    }[name]
    with small_files(4096), pytest.raises(OSError, match=rf"{name}: cannot be written: (File too large|10000 requested)"):
        write(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def write_array(path):
    with write_atomically(path) as temporary:
        np.save(temporary, np.zeros(10_000))


def test_names_that_are_not_utf_8(tmp_path):
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/f\xff"))
    try:
        folder.mkdir()
    except OSError:
        pytest.skip("this file system takes UTF-8 names only")
    name = os.fsdecode(b"n\xfe")
    image = torch.rand(3, 8, 8).mul(255).round() / 255
    vts.write_image(folder / f"{name}.png", image)
    assert torch.allclose(vts.read_image(folder / f"{name}.png"), image)
    assert [frame.shape for _, frame in vts.frames(folder)] == [(3, 8, 8)]
    assert streams.open_source(folder).read().shape == (8, 8, 3)
    calibration().save(folder / f"{name}.safetensors")
    assert vts.Calibration.load(folder / f"{name}.safetensors").sensor.name == "rig"
    vts.Sensor.load("gelsight_mini").save(folder / f"{name}.yaml")
    assert vts.Sensor.load(folder / f"{name}.yaml").height == 240
    (folder / f"{name}.avi").write_bytes(b"RIFF")
    for read in (lambda path: list(vts.frames(path)), streams.open_source):
        with pytest.raises(
            ValueError, match=r"video: expected a name in UTF-8, which OpenCV needs, got '.*\\udcfe\.avi': rename it"
        ):
            read(folder / f"{name}.avi")
    with pytest.raises(ValueError, match="video: expected a name in UTF-8"):
        streams.VideoFile(folder / "out.avi", 10.0)


def test_values_beyond_the_range_are_cut_and_halves_rounded(tmp_path):
    image = torch.full((3, 8, 8), 0.25)
    image[0], image[1] = -0.5, 1.5
    vts.write_image(tmp_path / "image.png", image)
    assert vts.read_image(tmp_path / "image.png")[:, 0, 0].tolist() == pytest.approx([0.0, 1.0, 64 / 255])


@pytest.mark.parametrize("length", [16, 20, 25])
def test_an_image_that_is_cut_in_its_header_is_named(tmp_path, length):
    vts.write_image(tmp_path / "whole.png", torch.rand(3, 8, 8))
    for head in ((tmp_path / "whole.png").read_bytes(), b"RIFF\0\0\0\0WEBPVP8X" + bytes(64)):
        (tmp_path / "cut").write_bytes(head[:length])
        with pytest.raises(ValueError, match="cut: "):
            vts.read_image(tmp_path / "cut")
