"""Result files hold what the pipeline gave, are read without this package or by read_result, and damage is refused."""

import hashlib
import json
import zipfile
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import torch
from conftest import TINY_SENSOR, bgr, tiny_image, write_film

import torchvts as vts
from torchvts.core.results import UNITS
from torchvts.dataset import items, reconstruct_dataset
from torchvts.pipeline import unit_pipeline
from torchvts.pose import OutputFrame
from torchvts.pose.surface_files import write_obj

HEIGHT, WIDTH, PITCH = TINY_SENSOR.height, TINY_SENSOR.width, TINY_SENSOR.mm_per_pixel


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A folder of five images and a film of seven frames."""
    folder = tmp_path_factory.mktemp("source")
    for k in range(5):
        vts.write_image(folder / f"{k}.png", tiny_image(k))
    write_film(folder / "film.avi", [bgr(tiny_image(k)) for k in range(7)])
    return folder


@pytest.fixture(scope="module")
def results(unit, source, tmp_path_factory):
    out = tmp_path_factory.mktemp("results")
    reconstruct_dataset(unit, source, out, workers=1, pictures=False, background_frames=0)
    return out


def test_a_frame_is_what_the_pipeline_gave(unit, source, results):
    calibration = vts.Calibration.load(unit)
    result = vts.read_result(results / "3.npz")
    with torch.inference_mode():
        out = vts.stream.Recording(calibration)(vts.read_image(source / "3.png")[None])
    assert repr(result).startswith("Result(1 frame of 48 x 64 px, 0.6 mm per pixel, deepest 0.") and len(repr(result)) < 150
    for ours, theirs in zip(result, (out.depth_mm, out.normal, out.gradient, out.contact, out.deformed)):
        assert torch.equal(ours, theirs)
    assert result[5:] == (PITCH, UNITS, "unit.safetensors", "rig", ["3.png"], True, [], [""])
    with np.load(results / "3.npz") as plain:  # without this package
        assert plain["depth_mm"].shape == (HEIGHT, WIDTH) and plain["normals"].shape == (3, HEIGHT, WIDTH)
        assert float(plain["mm_per_pixel"]) == PITCH and json.loads(str(plain["units"])) == UNITS
    summary = json.loads((results / "summary.json").read_text())
    assert (summary["frames"], summary["mm_per_pixel"], summary["units"]) == (12, PITCH, UNITS)


def test_a_video_in_one_file_holds_its_frames(unit, source, results, tmp_path):
    options = {"workers": 1, "pictures": False, "background_frames": 0, "format": "video-npz"}
    reconstruct_dataset(unit, source, tmp_path, **options)
    assert sorted(path.name for path in tmp_path.glob("*.npz")) == ["0.npz", "1.npz", "2.npz", "3.npz", "4.npz", "film.npz"]
    film = vts.read_result(tmp_path / "film.npz")
    assert film.depth_mm.shape == (7, 1, HEIGHT, WIDTH) and film.frames[6] == "film_000006"
    frames = [vts.read_result(results / f"film_{k:06d}.npz") for k in range(7)]
    for joined, single in zip(film[:5], zip(*(frame[:5] for frame in frames))):
        assert torch.equal(joined, torch.cat(single))
    before = (tmp_path / "film.npz").read_bytes()
    assert reconstruct_dataset(unit, source, tmp_path, **options).before == 12
    (tmp_path / "film.npz").unlink()
    assert reconstruct_dataset(unit, source, tmp_path, **options).before == 5
    assert (tmp_path / "film.npz").read_bytes() == before and not list(tmp_path.glob(".torchvts/parts/*"))


def test_a_recording_as_zarr_has_a_row_for_each_frame(unit, tmp_path):
    zarr = pytest.importorskip("zarr")
    pixels = np.stack([bgr(tiny_image(k)) for k in range(7)])[..., ::-1].copy()
    pixels[2] = 0  # a frame that cannot be used
    np.save(tmp_path / "hand.npy", pixels)
    options = {"workers": 1, "pictures": False, "background_frames": 0}
    reconstruct_dataset(unit, tmp_path / "hand.npy", tmp_path / "single", **options)
    for run in range(2):  # the second finds all done
        report = reconstruct_dataset(unit, tmp_path / "hand.npy", tmp_path / "out", format="video-zarr", **options)
        assert (report.rows, report.before, len(report.failed)) == (6, 6 * run, 1)
    path = tmp_path / "out/hand.zarr.zip"
    before = path.read_bytes()
    store = zarr.open(zarr.storage.ZipStore(path, mode="r"), mode="r")
    for k in (0, 1, 3, 4, 5, 6):
        single = vts.read_result(tmp_path / f"single/hand_{k:06d}.npz")
        for name, values in zip(("depth_mm", "normals", "gradient", "contact", "deformed"), single):
            assert np.array_equal(store[name][k], values[0].squeeze(0).numpy())
    assert np.isnan(store["depth_mm"][2]).all() and not store["contact"][2].any()
    assert "one colour" in store.attrs["left_out"]["2"] and store.attrs["units"] == UNITS
    assert (store.attrs["mm_per_pixel"], store.attrs["metric"], store.attrs["frame_doubts"]) == (PITCH, True, {})
    path.unlink()
    reconstruct_dataset(unit, tmp_path / "hand.npy", tmp_path / "out", format="video-zarr", **options)
    assert path.read_bytes() == before and not list(tmp_path.glob("out/.torchvts/parts/*"))
    reconstruct_dataset(unit, tmp_path / "hand.npy", tmp_path / "out", overwrite=True, format="npy", **options)
    assert not path.exists()


def test_every_third_frame_of_several_inputs(unit, source, tmp_path):
    (tmp_path / "more").mkdir()
    vts.write_image(tmp_path / "more" / "0.png", tiny_image(9))
    inputs = [source / "0.png", source / "film.avi", source / "2.png", tmp_path / "more", source / "0.png"]
    report = reconstruct_dataset(unit, inputs, tmp_path / "out", every=2, workers=1, pictures=False, format="npy")
    table = (tmp_path / "out" / "frames.csv").read_text().splitlines()[1:]
    rows = [line.split(",")[0].rpartition(f"{source.name}/")[2] for line in table]
    assert rows[:1] == ["0.png"] and rows[1:5] == [f"film_{k:06d}" for k in (0, 2, 4, 6)] and rows[5].endswith("more/0.png")
    assert report.rows == len(rows) == 6
    again = reconstruct_dataset(unit, inputs, tmp_path / "out", every=2, workers=1, pictures=False, format="npy")
    assert (again.before, again.rows) == (6, 6)


def test_pictures_are_drawn_where_a_run_has_few_frames(source, monkeypatch):
    monkeypatch.setattr(items, "PICTURES_UP_TO", 6)  # five images and seven frames
    assert not items.has_few_frames(source) and not items.has_few_frames(source, every=2) and items.has_few_frames(source, every=3)


def test_the_depth_png_and_the_surface(unit, source, tmp_path):
    reconstruct_dataset(unit, source / "4.png", tmp_path, format="png16", cloud="obj", pictures=False)
    reconstruct_dataset(unit, source / "4.png", tmp_path / "all", pictures=False)
    result = vts.read_result(tmp_path / "all" / "4.npz")
    values = cv2.imread(str(tmp_path / "4_depth.png"), cv2.IMREAD_UNCHANGED)
    assert values.dtype == np.uint16
    says = json.loads((tmp_path / "summary.json").read_text())["depth_png"]
    depth_mm = eval(says.removeprefix("depth_mm = "), {"value": values.astype(float)})
    assert np.abs(depth_mm - result.depth_mm[0, 0].numpy()).max() <= 0.00006
    lines = [line.split() for line in (tmp_path / "4.obj").read_text().splitlines()]
    points = torch.tensor([[float(v) for v in line[1:]] for line in lines if line[0] == "v"])
    assert torch.allclose(points, vts.depth_to_points(result.depth_mm, PITCH, result.contact), atol=1e-5)
    faces = torch.tensor([[int(part.split("//")[0]) for part in line[1:]] for line in lines if line[0] == "f"]) - 1
    a, b, c = points[faces].unbind(1)
    facing = torch.linalg.cross(b - a, c - a)
    assert (facing[:, 2] > 0).all()  # towards the camera
    area = 0.5 * facing[:, 2].sum() / PITCH**2
    assert 0.7 * float(result.contact.sum()) < float(area) <= float(result.contact.sum())


def test_a_slanted_plane_is_written_with_its_own_normals(tmp_path):
    x = torch.arange(6.0).expand(5, 6) * 0.5
    contact = torch.ones(1, 1, 5, 6, dtype=torch.bool)
    normal = torch.tensor([-0.6, 0.0, 0.8])[None, :, None, None].expand(1, 3, 5, 6)  # of z = 0.75 x
    write_obj(tmp_path / "plane.obj", (0.75 * x)[None, None], normal, contact, 0.5, OutputFrame())
    lines = [line.split() for line in (tmp_path / "plane.obj").read_text().splitlines()]
    points = np.array([[float(v) for v in line[1:]] for line in lines if line[0] == "v"])
    faces = np.array([[int(part.split("//")[0]) - 1 for part in line[1:]] for line in lines if line[0] == "f"])
    assert len(points) == 30 and len(faces) == 2 * 4 * 5
    cross = np.cross(points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]])
    assert np.allclose(cross / np.linalg.norm(cross, axis=1, keepdims=True), [-0.6, 0.0, 0.8], atol=1e-5)
    assert {tuple(line[1:]) for line in lines if line[0] == "vn"} == {("-0.600000", "0.000000", "0.800000")}


def test_x3p_holds_the_contact_in_metres(unit, source, tmp_path):
    """As any zip and XML: sizes, units, checksums, rows from the bottom, NaN where the object does not touch."""
    reconstruct_dataset(unit, source / "4.png", tmp_path, cloud="x3p", pictures=False)
    result = vts.read_result(tmp_path / "4.npz")
    with zipfile.ZipFile(tmp_path / "4.x3p") as archive:
        xml, data, sums = (archive.read(name) for name in ("main.xml", "bindata/data.bin", "md5checksum.hex"))
    root = ElementTree.fromstring(xml)

    def text(path):
        return root.findtext(path)

    assert root.tag == "{http://www.opengps.eu/2008/ISO5436_2}ISO5436_2"
    assert (text("Record3/MatrixDimension/SizeX"), text("Record3/MatrixDimension/SizeY")) == (str(WIDTH), str(HEIGHT))
    for axis, size in (("CX", WIDTH), ("CY", HEIGHT)):
        assert float(text(f"Record1/Axes/{axis}/Increment")) == pytest.approx(1e-3 * PITCH)
        assert float(text(f"Record1/Axes/{axis}/Offset")) == pytest.approx(-0.5e-3 * (size - 1) * PITCH)
    assert text("Record1/Axes/CZ/DataType") == "D" and text("Record3/DataLink/PointDataLink") == "bindata/data.bin"
    assert text("Record2/Comment").startswith("m, x right, y up, z to the camera") and text("Record2/Instrument/Model") == "rig"
    assert text("Record3/DataLink/MD5ChecksumPointData") == hashlib.md5(data).hexdigest()
    assert sums.decode() == f"{hashlib.md5(xml).hexdigest()} *main.xml\n"
    heights_m = torch.from_numpy(np.frombuffer(data, "<f8").reshape(HEIGHT, WIDTH).copy()).flip(0)
    contact = result.contact[0, 0]
    assert torch.equal(heights_m.isnan(), ~contact) and bool(contact.any())
    assert torch.allclose(heights_m[contact], 1e-3 * result.depth_mm[0, 0][contact].double(), atol=1e-15)


def damaged(path, tmp_path, how):
    """A copy of a result file, damaged in one way."""
    target = tmp_path / "damaged.npz"
    with np.load(path) as stored:
        arrays = dict(stored)
    how(arrays)
    np.savez(target, **arrays)
    return target


@pytest.mark.parametrize(
    "how, message",
    [
        (lambda a: a.pop("contact"), "it has no contact"),
        (lambda a: a.update(format=np.asarray(3)), "it has layout 3, this version reads 2: update torchvts"),
        (lambda a: a.update(normals=a["normals"][:2]), r"normals: expected \(3, 48, 64\), float32, got \(2, 48, 64\)"),
        (
            lambda a: a.update(depth_mm=a["depth_mm"].astype("f8")),
            r"depth_mm: expected \(48, 64\), float32, got \(48, 64\), float64",
        ),
        (lambda a: a.update(contact=a["contact"][:, :-1]), r"contact: expected \(48, 64\), bool"),
        (
            lambda a: a.update(frames=np.array(["a", "b"])),
            r"depth_mm: expected \(H, W\), or \(N, H, W\) for N frames, got \(48, 64\) for 2",
        ),
        (lambda a: a.update(units=np.array([{}], dtype=object)), "damaged: Object arrays cannot be loaded"),
        (lambda a: a.update(units=np.array("{")), "not a result of torchvts reconstruct, or damaged"),
        (lambda a: a.update(depth_mm=np.float32(1.0)), "depth_mm: expected"),
    ],
)
def test_a_damaged_result_is_refused(results, tmp_path, how, message):
    with pytest.raises(ValueError, match=message) as caught:
        vts.read_result(damaged(results / "0.npz", tmp_path, how))
    assert "damaged.npz: " in str(caught.value)


def test_what_is_no_result_is_refused(results, tmp_path):
    data = (results / "0.npz").read_bytes()
    for content in (b"", b"PK", data[: len(data) // 2], data[:200] + bytes(400) + data[600:]):
        (tmp_path / "bad.npz").write_bytes(content)
        with pytest.raises(ValueError, match=r"bad\.npz: "):
            vts.read_result(tmp_path / "bad.npz")
    for path, error, message in (
        (tmp_path / "none.npz", FileNotFoundError, "no such result file"),
        (results, FileNotFoundError, r"name one of its \.npz files"),
        (results / "frames.csv", ValueError, r"expected a name ending in \.npz"),
    ):
        with pytest.raises(error, match=message):
            vts.read_result(path)


def test_a_network_takes_the_models_place(unit, source, tmp_path):
    calibration = vts.Calibration.load(unit)
    vts.NormalFromMLP(HEIGHT, WIDTH, calibration.background.float(), hidden=(8, 8), seed=3).save(tmp_path / "net.safetensors")
    torch.save(vts.NormalFromMLP.load(tmp_path / "net.safetensors").gs_sdk_state(), tmp_path / "nnmodel.pth")
    options = {"workers": 1, "pictures": False}
    for name in ("net.safetensors", "nnmodel.pth"):
        out = tmp_path / name.replace(".", "_")
        reconstruct_dataset(unit, source / "1.png", out, network=tmp_path / name, **options)
        pipe = vts.DepthPipeline.from_gs_sdk(tmp_path / name, calibration.background.float(), calibration.sensor)
        with torch.inference_mode():
            expected = pipe(vts.read_image(source / "1.png")[None]).depth_mm
        assert torch.allclose(vts.read_result(out / "1.npz").depth_mm, expected, atol=1e-5)
    with pytest.raises(ValueError, match="another network than then"):
        reconstruct_dataset(unit, source / "1.png", tmp_path / "net_safetensors", **options)
    with pytest.raises(ValueError, match="expected a network"):
        reconstruct_dataset(unit, source / "1.png", tmp_path / "bad", network=unit, **options)
    assert not (tmp_path / "bad").exists()
    with pytest.raises(ValueError, match="mode: 'precise'"):
        unit_pipeline(calibration, "precise", tmp_path / "net.safetensors")
    with pytest.raises(ValueError, match="contact: expected None beside a network"):
        unit_pipeline(calibration, "fast", tmp_path / "net.safetensors", vts.ContactSettings())
