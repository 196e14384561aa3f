"""Images, depth maps, frames and point clouds on disk."""

import cv2
import numpy as np
import pytest
import torch
from conftest import write_film

import torchvts as vts
from torchvts.core.files import count_frames, read_depth_png, read_frames, write_depth_png
from torchvts.pose import read_cloud


def picture(height=12, width=16, seed=0):
    levels = torch.randint(0, 256, (3, height, width), generator=torch.Generator().manual_seed(seed))
    return levels.float() / 255


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tif", ".PNG"])
def test_an_image_comes_back_as_it_was(tmp_path, suffix):
    vts.write_image(tmp_path / f"image{suffix}", picture())
    assert torch.equal(vts.read_image(str(tmp_path / f"image{suffix}")), picture())


def test_values_beyond_the_range_are_cut_and_halves_rounded(tmp_path):
    image = torch.full((3, 8, 8), 0.25)
    image[0], image[1] = -0.5, 1.5
    vts.write_image(tmp_path / "image.png", image)
    assert vts.read_image(tmp_path / "image.png")[:, 0, 0].tolist() == pytest.approx([0.0, 1.0, 64 / 255])


def test_sixteen_bits_keep_their_steps(tmp_path):
    bgr = np.zeros((5, 6, 3), np.uint16)
    bgr[..., 2], bgr[..., 0] = 65535, 1
    cv2.imwrite(str(tmp_path / "deep.png"), bgr)
    assert vts.read_image(tmp_path / "deep.png")[:, 0, 0].tolist() == pytest.approx([1.0, 0.0, 1 / 65535])


def test_transparency_is_left_out(tmp_path):
    bgra = np.full((5, 6, 4), (10, 20, 30, 77), np.uint8)
    cv2.imwrite(str(tmp_path / "clear.png"), bgra)
    assert vts.read_image(tmp_path / "clear.png")[:, 0, 0].tolist() == pytest.approx([30 / 255, 20 / 255, 10 / 255])


@pytest.mark.parametrize(
    "pixels, message",
    [
        (np.zeros((5, 6), np.uint8), r"expected a colour image, got one of shape \(5, 6\): three lights need three channels"),
        (np.zeros((5, 6, 3), np.float32), "expected 8 or 16 bits per channel, got float32"),
    ],
)
def test_other_images_are_refused(tmp_path, pixels, message):
    cv2.imwrite(str(tmp_path / "image.tiff"), pixels)
    with pytest.raises(ValueError, match=message):
        vts.read_image(tmp_path / "image.tiff")


@pytest.mark.parametrize("content", [b"", b"not an image", b"\x89PNG\r\n\x1a\n"])
def test_what_is_no_image_is_refused(tmp_path, content):
    (tmp_path / "image.png").write_bytes(content)
    with pytest.raises(ValueError, match=r"image\.png: not an image, or cut short"):
        vts.read_image(tmp_path / "image.png")


def test_a_missing_image_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="expected an image, got a folder"):
        vts.read_image(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"nowhere\.png: no such image"):
        vts.read_image(tmp_path / "nowhere.png")


@pytest.mark.parametrize("shape", [(1, 3, 8, 8), (8, 8, 3), (8, 8)])
def test_only_one_colour_image_is_written(tmp_path, shape):
    with pytest.raises(ValueError, match=r"image: expected \(3, H, W\), got "):
        vts.write_image(tmp_path / "image.png", torch.zeros(shape))


def test_another_suffix_or_folder_is_refused_and_leaves_nothing(tmp_path):
    with pytest.raises(ValueError, match=r"image.gif: expected a name ending in .png, .jpg"):
        vts.write_image(tmp_path / "image.gif", picture())
    with pytest.raises(FileNotFoundError, match="does not exist: make it first"):
        vts.write_image(tmp_path / "nowhere" / "image.png", picture())
    assert list(tmp_path.iterdir()) == []


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


def test_frames_of_a_folder_come_by_name(tmp_path):
    for k in (2, 0, 1):
        vts.write_image(tmp_path / f"{k:03d}.png", picture(seed=k))
    (tmp_path / "notes.txt").write_text("no image")
    frames = list(read_frames(tmp_path))
    assert [name for name, _ in frames] == ["000", "001", "002"] and count_frames(tmp_path) == 3
    assert all(torch.equal(frame, picture(seed=k)) for k, (_, frame) in enumerate(frames))


def test_a_single_image_is_one_frame(tmp_path):
    vts.write_image(tmp_path / "one.png", picture())
    ((name, frame),) = read_frames(str(tmp_path / "one.png"))
    assert name == "one" and torch.equal(frame, picture()) and count_frames(tmp_path / "one.png") == 1


def test_frames_of_a_video(tmp_path):
    red = np.array([0, 0, 1], np.uint8)
    path = write_film(tmp_path / "film.avi", [np.full((48, 64, 3), 40 * k, np.uint8) * red for k in range(5)])
    frames = list(read_frames(path))
    assert [name for name, _ in frames] == [f"film_{k:06d}" for k in range(5)] and count_frames(path) == 5
    for k, (_, frame) in enumerate(frames):
        assert frame.shape == (3, 48, 64)
        assert frame.mean(dim=(1, 2)).tolist() == pytest.approx([40 * k / 255, 0, 0], abs=0.01)


def test_missing_and_broken_sources_are_refused(tmp_path):
    with pytest.raises(ValueError, match="no images in this folder"):
        read_frames(tmp_path)
    with pytest.raises(FileNotFoundError, match="nowhere: no such file or folder"):
        read_frames(tmp_path / "nowhere")
    (tmp_path / "film.avi").write_bytes(b"no film")
    with pytest.raises(ValueError, match=r"film\.avi: not a video, or cut short"):
        list(read_frames(tmp_path / "film.avi"))


@pytest.fixture(scope="module")
def clouds():
    from torchvts.pose import clouds

    try:
        read_cloud.open3d()
    except ImportError as error:
        pytest.skip(str(error))
    return clouds


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
@pytest.mark.parametrize("with_normals", [False, True])
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


@pytest.mark.parametrize(
    "points, normals, message",
    [
        (torch.zeros(0, 3), None, r"points: expected \(N, 3\) with N above 0, got \(0, 3\): no contact\?"),
        (torch.zeros(5, 2), None, r"points: expected \(N, 3\)"),
        (torch.full((5, 3), float("nan")), None, "points: expected finite values"),
        (torch.zeros(5, 3), torch.zeros(4, 3), r"normals: expected \(5, 3\)"),
    ],
)
def test_impossible_clouds_are_refused(tmp_path, clouds, points, normals, message):
    with pytest.raises(ValueError, match=message):
        clouds.write_point_cloud(tmp_path / "cloud.ply", points, normals)
    assert list(tmp_path.iterdir()) == []


def test_broken_clouds_are_refused(tmp_path, clouds):
    with pytest.raises(ValueError, match=r"cloud.xyz: expected a name ending in .pcd or .ply"):
        clouds.write_point_cloud(tmp_path / "cloud.xyz", torch.zeros(5, 3))
    with pytest.raises(FileNotFoundError, match=r"cloud\.ply: no such point cloud"):
        clouds.read_point_cloud(tmp_path / "cloud.ply")
    (tmp_path / "cloud.ply").write_bytes(b"no cloud")
    with pytest.raises(ValueError, match=r"cloud\.ply: no points could be read"):
        clouds.read_point_cloud(tmp_path / "cloud.ply")


@pytest.mark.parametrize("form", [{}, {"write_ascii": True}, {"compressed": True}])
@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_clouds_are_read_as_open3d_reads_them(tmp_path, clouds, suffix, form):
    o3d, path = read_cloud.open3d(), tmp_path / f"cloud{suffix}"
    points = np.random.default_rng(0).integers(0, 4, (300, 3)).astype(float)  # values repeat, so that the file can be compressed
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.colors = o3d.utility.Vector3dVector(points / 4)
    cloud.normals = o3d.utility.Vector3dVector(points)
    o3d.io.write_point_cloud(str(path), cloud, **form)
    found, normals = clouds.read_point_cloud(path)
    expected = o3d.io.read_point_cloud(str(path))
    assert np.array_equal(found.numpy(), np.asarray(expected.points))
    assert np.array_equal(normals.numpy(), np.asarray(expected.normals))
