"""Frames as records for robots: layouts that NumPy reads back, and features that a data set of LeRobot's form accepts."""

from functools import partial

import numpy as np
import pytest
import torch
from rosbags.typesys import Stores, get_typestore

import torchvts as vts
from torchvts.stream import TactileFrame, TactileStream, messages

PITCH = 0.25

ROS = get_typestore(Stores.ROS2_HUMBLE)
ROS_TYPES = {
    messages.ImageMessage: "sensor_msgs/msg/Image",
    messages.CloudMessage: "sensor_msgs/msg/PointCloud2",
    messages.PointField: "sensor_msgs/msg/PointField",
}


@pytest.fixture(scope="module")
def frame(ring, small_sensor, small_press):
    """A ball on a sensor, reconstructed, as a stream gives it."""
    lights = ring()
    scene = small_press(center_mm=(4.0, -3.0))
    image = vts.scenes.render(scene, lights)
    pipe = vts.DepthPipeline.from_calibration(vts.Calibration.from_lights(lights, small_sensor), mode="precise")
    with torch.inference_mode():
        return TactileFrame(7, 0.25, image[0], pipe(image))


@pytest.fixture(scope="module")
def dragged():
    """A skin with dots that is dragged, as a stream gives it, and the module that follows them."""
    skin, drag = vts.scenes.DottedSkin(120, 160, 0.125), vts.scenes.Drag(shift_mm=(0.3, -0.2), press_mm=0.5)
    calibration = vts.Calibration.from_lights(skin.lights, vts.Sensor("rig", 120, 160, 0.125), skin.image())
    image = skin.image(drag)
    with torch.inference_mode():
        frame = TactileFrame(7, 0.25, image, vts.DepthPipeline.from_calibration(calibration)(image[None]))
    return frame, vts.SkinMotion.from_calibration(calibration)


def as_ros(record):
    """A record as ROS's own type of message, whose constructor takes no other fields."""
    if isinstance(record, messages.Header):
        stamp = ROS.types["builtin_interfaces/msg/Time"](sec=record.sec, nanosec=record.nanosec)
        return ROS.types["std_msgs/msg/Header"](stamp=stamp, frame_id=record.frame_id)
    values = {name: as_ros(value) if isinstance(value, messages.Header) else value for name, value in vars(record).items()}
    if "data" in values:
        values["data"] = np.frombuffer(record.data, np.uint8)
    if "fields" in values:
        values["fields"] = [as_ros(field) for field in record.fields]
    return ROS.types[ROS_TYPES[type(record)]](**values)


def same(found, record):
    """Whether a message that was read holds what a record says, field by field."""
    if isinstance(record, messages.Header):
        return (found.stamp.sec, found.stamp.nanosec, found.frame_id) == (record.sec, record.nanosec, record.frame_id)
    if isinstance(record, messages.ImageMessage | messages.CloudMessage | messages.PointField):
        return all(same(getattr(found, name), value) for name, value in vars(record).items())
    if isinstance(record, tuple):
        return len(found) == len(record) and all(map(same, found, record))
    return found.tobytes() == record if isinstance(record, bytes) else found == record


@pytest.mark.parametrize(
    "make", [messages.image_message, messages.depth_message, partial(messages.cloud_message, mm_per_pixel=PITCH)]
)
@pytest.mark.parametrize("contact", [True, False])
def test_ros_reads_each_message_as_it_was_written(frame, make, contact):
    if not contact:
        frame = frame._replace(output=frame.output._replace(contact=torch.zeros_like(frame.output.contact)))
    record = make(frame, frame_id="finger", start_s=1.8e9)
    kind = ROS_TYPES[type(record)]
    assert same(ROS.deserialize_cdr(ROS.serialize_cdr(as_ros(record), kind), kind), record)
    assert ROS.types["sensor_msgs/msg/PointField"].FLOAT32 == messages.FLOAT32


def cloud_of(message):
    """The points of a message, read by nothing but its own layout."""
    order = ">" if message.is_bigendian else "<"
    dtype = np.dtype({
        "names": [field.name for field in message.fields],
        "formats": [f"{order}f4" for _ in message.fields],
        "offsets": [field.offset for field in message.fields],
        "itemsize": message.point_step,
    })  # fmt: skip
    return np.frombuffer(message.data, dtype)


def test_the_image_message_holds_the_cameras_pixels(frame):
    message = messages.image_message(frame, "finger", start_s=100.0)
    assert (message.height, message.width, message.encoding, message.step) == (120, 160, "rgb8", 480)
    assert message.header == messages.Header(100, 250_000_000, "finger")
    pixels = np.frombuffer(message.data, np.uint8).reshape(message.height, message.step)[:, : 3 * message.width]
    seen = torch.from_numpy(pixels.copy()).reshape(120, 160, 3).permute(2, 0, 1) / 255.0
    assert float((seen - frame.image).abs().max()) <= 0.5 / 255.0 + 1e-6


def test_the_depth_message_is_in_metres(frame):
    message = messages.depth_message(frame)
    assert (message.encoding, message.step, message.is_bigendian) == ("32FC1", 4 * 160, 0)
    depth_m = np.frombuffer(message.data, "<f4").reshape(120, 160)
    np.testing.assert_allclose(1000.0 * depth_m, frame.output.depth_mm[0, 0].numpy(), atol=1e-6)
    assert 0.0009 < depth_m.max() < 0.0011


def test_the_cloud_message_lies_on_the_ball_with_y_up(frame):
    message = messages.cloud_message(frame, PITCH)
    assert (message.height, message.is_dense, message.point_step) == (1, True, 24)
    assert message.row_step == message.width * message.point_step == len(message.data)
    assert message.width == int(frame.output.contact.sum())
    assert {field.datatype for field in message.fields} == {messages.FLOAT32}
    cloud = cloud_of(message)
    points = np.stack([cloud[name] for name in "xyz"], axis=1)
    normals = np.stack([cloud[f"normal_{name}"] for name in "xyz"], axis=1)
    center = np.array([0.004, 0.003, -0.009])  # image y down, point y up: the ball of 10 mm, pressed in by 1 mm
    from_center = points - center
    distance = np.linalg.norm(from_center, axis=1)
    assert abs(float(np.median(distance)) - 0.010) < 5e-5
    assert float(np.median((normals * from_center).sum(1) / distance)) > 0.999


def test_no_contact_is_an_empty_cloud(frame):
    nothing = frame.output._replace(contact=torch.zeros_like(frame.output.contact))
    message = messages.cloud_message(frame._replace(output=nothing), PITCH)
    assert (message.width, message.row_step, message.data) == (0, 0, b"")
    assert messages.lerobot_frame(frame._replace(output=nothing), PITCH)["observation.tactile.state"][0] == 0.0


def test_the_dots_message_says_where_each_dot_is_and_how_far_it_has_moved(dragged):
    frame, motion = dragged
    moved = motion(frame.image[None], frame.output.depth_mm)
    message = messages.dots_message(frame, moved, "finger")
    kind = ROS_TYPES[messages.CloudMessage]
    read = ROS.deserialize_cdr(ROS.serialize_cdr(as_ros(message), kind), kind)
    assert read.width == len(moved.rest_mm) and read.is_dense == bool(moved.seen.all())
    cloud = cloud_of(message)
    seen = moved.seen[0].numpy()
    assert np.array_equal(~np.isnan(cloud["dx"]), seen) and seen.sum() > 0
    middle = int(moved.rest_mm.norm(dim=1).argmin())
    point = [1e3 * float(cloud[name][middle]) for name in messages.DOT_FIELDS]
    x, y = moved.rest_mm[middle].tolist()
    assert point[3:5] == pytest.approx([0.3, 0.2], abs=0.02)  # image y down, point y up
    assert point[:2] == pytest.approx([x + point[3], -y + point[4]], abs=1e-5) and point[2] == point[5] > 0.3


class CheckedDataset:
    """Accepts frames as LeRobot's ``add_frame`` does: all features and a task, each array of its dtype and shape."""

    def __init__(self, features):
        self.features, self.frames, self.episodes = features, [], 0

    def add_frame(self, frame):
        arrays = {name: value for name, value in frame.items() if name != "task"}
        assert set(arrays) == set(self.features) and isinstance(frame["task"], str)
        for name, value in arrays.items():
            feature = self.features[name]
            depth = feature.get("info", {}).get("is_depth_map", False)
            dtype = "uint8" if feature["dtype"] in ("image", "video") and not depth else "float32"
            assert isinstance(value, np.ndarray) and value.dtype == dtype and value.shape == feature["shape"], name
            assert "/" not in name and len(feature["names"]) in (len(value.shape), value.size)
        self.frames.append(arrays)

    def save_episode(self):
        self.episodes += 1


def test_an_episode_has_the_features_of_its_data_set(frame, small_sensor):
    dataset = CheckedDataset(messages.lerobot_features(small_sensor, "left_finger", image_dtype="image"))
    later = frame._replace(number=8, time_s=0.5, output=frame.output._replace(depth_mm=0.5 * frame.output.depth_mm))
    assert messages.record_episode([frame, later], PITCH, dataset, "press a ball", "left_finger") == 2
    assert dataset.episodes == 1

    def stops():
        yield frame
        raise OSError("unplugged")

    kept = CheckedDataset(dataset.features)
    with pytest.raises(OSError, match="unplugged"):
        messages.record_episode(stops(), PITCH, kept, "press a ball", "left_finger")
    assert len(kept.frames) == kept.episodes == 1
    area, deepest = dataset.frames[0]["observation.left_finger.state"]
    assert area == pytest.approx(int(frame.output.contact.sum()) * PITCH**2)
    assert deepest == pytest.approx(float(frame.output.depth_mm.max()))
    depth_m = dataset.frames[1]["observation.images.left_finger_depth"]
    np.testing.assert_allclose(1e3 * depth_m[..., 0], later.output.depth_mm[0, 0].numpy(), rtol=1e-6)


def test_an_episode_keeps_the_motion_of_dots(dragged):
    frame, motion = dragged
    sensor, dots = vts.Sensor("rig", 120, 160, 0.125), len(motion.rest_px)
    dataset = CheckedDataset(messages.lerobot_features(sensor, image_dtype="image", dots=dots))
    assert messages.record_episode([frame, frame], 0.125, dataset, "drag", motion=motion) == 2
    first = motion(frame.image[None], frame.output.depth_mm)
    second = motion(frame.image[None], frame.output.depth_mm, first)
    for kept, moved in zip(dataset.frames, (first, second)):
        values = kept["observation.tactile.dots"]
        np.testing.assert_array_equal(values[:, :3], moved.displacement_mm[0].detach().numpy())
        np.testing.assert_array_equal(values[:, 3] > 0.5, moved.seen[0].numpy())


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda frame: messages.cloud_message(frame, 0.0), "mm_per_pixel: expected"),
        (lambda frame: messages.lerobot_frame(frame, float("nan")), "mm_per_pixel: expected"),
        (lambda frame: messages.header(frame, "finger", start_s=-1.0), "start_s: expected frame 7 at 0 s or later, got -0.75"),
        (lambda frame: messages.header(frame, "finger", start_s=float("inf")), "start_s: expected"),
        (lambda frame: messages.lerobot_features(vts.Sensor("rig", 8, 8, 0.1), image_dtype="png"), "image_dtype: expected"),
        (lambda frame: messages.lerobot_features(vts.Sensor("rig", 8, 8, 0.1), dots=-1), "dots: expected"),
    ],
)
def test_bad_values_are_named(frame, call, message):
    with pytest.raises(ValueError, match=message):
        call(frame)


def test_a_stream_of_files_becomes_an_episode(tmp_path, ring, small_sensor, small_press):
    lights = ring()
    still = vts.scenes.render(vts.scenes.undeformed(small_press()), lights)[0]
    pressed = vts.scenes.render(small_press(), lights)[0]
    for number in range(6):
        vts.write_image(tmp_path / f"{number}.png", still if number < 4 else pressed)
    dataset = CheckedDataset(messages.lerobot_features(small_sensor))
    calibration = vts.Calibration.from_lights(lights, small_sensor, still)
    with TactileStream(tmp_path, calibration, background_frames=4) as stream, torch.inference_mode():
        assert messages.record_episode(stream, PITCH, dataset, "press a ball") == 6
    areas = [frame["observation.tactile.state"][0] for frame in dataset.frames]
    assert areas[:4] == [0.0] * 4 and min(areas[4:]) > 10.0
