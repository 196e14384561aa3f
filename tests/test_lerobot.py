"""The camera for LeRobot, and data sets that LeRobot itself writes and reads: where its package is, which needs Python 3.12."""

import importlib.util

import numpy as np
import pytest
import torch

import torchvts as vts
from torchvts.stream import TactileFrame, messages

INSTALLED = importlib.util.find_spec("lerobot") is not None
needs_lerobot = pytest.mark.skipif(
    not INSTALLED, reason="lerobot 0.6 is not installed: it needs Python 3.12, and PyTorch and NumPy older than constraints.txt's"
)
without_contact = 12


@pytest.fixture(scope="module")
def unit(tmp_path_factory, ring, small_sensor, small_press):
    """A recording of a press, the calibration's file, and the pressed frame."""
    folder, lights = tmp_path_factory.mktemp("unit"), ring()
    still = vts.scenes.render(vts.scenes.undeformed(small_press()), lights)[0].detach()
    pressed = vts.scenes.render(small_press(), lights).detach()
    (folder / "frames").mkdir()
    for number in range(without_contact + 30):
        vts.write_image(folder / "frames" / f"{number:03}.png", still if number < without_contact else pressed[0])
    calibration = vts.Calibration.from_lights(lights, small_sensor, still)
    calibration.save(folder / "unit.safetensors")
    with torch.inference_mode():
        return folder, TactileFrame(0, 0.0, pressed[0], vts.DepthPipeline.from_calibration(calibration)(pressed))


@pytest.mark.skipif(INSTALLED, reason="lerobot is installed")
def test_without_lerobot_the_package_is_imported_and_its_use_says_what_to_install():
    plugin = importlib.import_module("lerobot_camera_torchvts")
    with pytest.raises(ImportError, match=r"lerobot: expected 0.6 or newer, found none.*pip install 'torchvts\[lerobot\]'"):
        _ = plugin.TactileCamera
    assert not hasattr(plugin, "other")


def make_camera(folder, **more):
    """As lerobot-record makes it from its arguments."""
    import draccus
    from lerobot.cameras import CameraConfig, make_cameras_from_configs
    from lerobot.configs.parser import load_plugin

    load_plugin("lerobot_camera_torchvts")
    values = {"type": "torchvts", "source": str(folder / "frames"), "calibration": str(folder / "unit.safetensors"), **more}
    return make_cameras_from_configs({"finger": draccus.decode(CameraConfig, values)})["finger"]


@needs_lerobot
def test_lerobot_finds_the_camera_and_reads_image_and_depth(unit, small_sensor):
    from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

    folder, pressed = unit
    camera = make_camera(folder, width=160, height=120, fps=30)
    with pytest.raises(DeviceNotConnectedError):
        camera.read_latest()
    with camera:
        with pytest.raises(DeviceAlreadyConnectedError):
            camera.connect()
        assert (camera.width, camera.height, camera.fps, camera.use_rgb, camera.use_depth) == (160, 120, 30, True, True)
        first = camera.read_latest_depth(max_age_ms=5000)
        assert first.shape == (120, 160, 1) and first.dtype == np.float32 and first.max() < 5e-5
        while (depth_m := camera.read_latest_depth(max_age_ms=5000)).max() < 5e-4:
            assert camera.async_read(timeout_ms=5000).shape == (120, 160, 3)
        np.testing.assert_allclose(1e3 * depth_m[..., 0], pressed.output.depth_mm[0, 0], atol=0.02)
        expected = messages.lerobot_frame(pressed, small_sensor.mm_per_pixel)["observation.images.tactile"]
        assert np.abs(camera.read().astype(int) - expected).max() <= 3
        with pytest.raises(TimeoutError, match=r"the newest frame is \d+ ms old"):
            camera.read_latest_depth(max_age_ms=0)
        with pytest.raises(TimeoutError, match="the recording has ended"):
            for _ in range(50):
                camera.async_read(timeout_ms=5000)
    assert not camera.is_connected


@needs_lerobot
def test_a_size_that_the_calibration_does_not_have_is_refused(unit):
    with pytest.raises(ValueError, match="width: expected 160, which sensor"):
        make_camera(unit[0], width=640, height=120)


@needs_lerobot
@pytest.mark.filterwarnings("ignore")  # of the libraries that LeRobot brings
@pytest.mark.parametrize(("kind", "steps_mm"), [("video", 0.0011), ("image", 1e-6)])
def test_lerobot_writes_depth_and_reads_it_back_in_metres(unit, small_sensor, tmp_path, kind, steps_mm):
    from lerobot.configs import DepthEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    pressed, features = unit[1], messages.lerobot_features(small_sensor, "finger", kind)
    encoder = DepthEncoderConfig(**messages.LEROBOT_DEPTH)
    written = LeRobotDataset.create("torchvts/press", 10, features, tmp_path / "set", use_videos=True, depth_encoder=encoder)
    assert messages.record_episode([pressed] * 4, small_sensor.mm_per_pixel, written, "press a ball", "finger") == 4
    written.finalize()
    read = LeRobotDataset("torchvts/press", root=tmp_path / "set", depth_output_unit="m", video_backend="pyav")
    assert read.meta.depth_keys == ["observation.images.finger_depth"]
    assert read.meta.features["observation.images.finger_depth"]["info"]["depth_unit"] == "m"
    depth_m = read[2]["observation.images.finger_depth"]
    assert float((1e3 * depth_m - pressed.output.depth_mm[0]).abs().max()) < steps_mm
