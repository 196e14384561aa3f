"""Unit and frame of the clouds and poses that commands write."""

import csv
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from conftest import TINY_SENSOR, bgr, tiny_image

import torchvts as vts
from lab.rigid import motion
from torchvts.pose import OutputFrame

MOUNT = motion(torch.tensor([0.8, -0.5, 1.5, 40.0, -20.0, 120.0], dtype=torch.float64))
"""Sensor to robot, mm."""
ON_ROBOT = replace(TINY_SENSOR, sensor_to_robot=MOUNT.tolist())


def read_ply(path):
    """Comment, points and normals."""
    head, _, data = path.read_bytes().partition(b"end_header\n")
    values = np.frombuffer(data, "<f8").reshape(-1, head.count(b"property"))
    return head.split(b"comment ")[1].split(b"\n")[0].decode(), values[:, :3], values[:, 3:]


@pytest.fixture
def places(unit, tmp_path):
    """The same unit beside a robot and on it, and where each is written in m."""
    calibration = vts.Calibration.load(unit)
    calibration.save(tmp_path / "beside.safetensors")
    replace(calibration, sensor=ON_ROBOT).save(tmp_path / "on.safetensors")
    return tmp_path


def test_points_poses_and_covariances_are_those_of_the_robot():
    frame, points = OutputFrame("m", ON_ROBOT), torch.randn(9, 3, generator=torch.Generator().manual_seed(0)).double()
    T = motion(torch.tensor([0.1, 0.2, -0.3, 1.0, 2.0, 3.0], dtype=torch.float64))
    moved, there = points @ T[:3, :3].T + T[:3, 3], frame.pose(T)
    assert torch.allclose(frame.points(points), (points @ MOUNT[:3, :3].T + MOUNT[:3, 3]) / 1000.0, atol=1e-12)
    assert torch.allclose(frame.points(points) @ there[:3, :3].T + there[:3, 3], frame.points(moved), atol=1e-12)
    for k in range(6):  # a small motion after the pose, seen in both frames
        small = 1e-6 * torch.eye(6, dtype=torch.float64)[k]
        change = frame.pose(motion(small) @ T) @ torch.linalg.inv(there) - torch.eye(4)
        seen = torch.stack((change[2, 1], change[0, 2], change[1, 0], *change[:3, 3])) / 1e-6
        covariance = torch.outer(small, small) / 1e-12
        assert torch.allclose(frame.covariance(covariance), torch.outer(seen, seen), atol=1e-4)
    plain = OutputFrame()
    assert torch.equal(plain.points(points), points) and torch.equal(plain.pose(T), T) and plain.axes.startswith("mm, ")
    with pytest.raises(ValueError, match="length_unit: expected one of mm, m, got 'cm'"):
        OutputFrame("cm")


def test_clouds_of_a_data_set(places, run_script):
    vts.write_image(places / "3.png", tiny_image(3))
    for name, kind, options in (("beside", "ply", ()), ("on", "ply", ("--unit", "m")), ("on", "obj", ("--unit", "m"))):
        out = places / f"{name}_{kind}"
        given = (places / f"{name}.safetensors", places / "3.png", "--out", out, "--no-pictures", "--cloud", kind)
        done = run_script("reconstruct", *given, *options)
        assert done.returncode == 0, done.stderr
    (_, points, normals), (says, there, turned) = (read_ply(places / f"{name}_ply" / "3.ply") for name in ("beside", "on"))
    assert says == "m, axes of the robot" == json.loads((places / "on_ply" / "summary.json").read_text())["clouds"]
    turn, shift = MOUNT[:3, :3].numpy(), MOUNT[:3, 3].numpy()
    assert len(points) > 9 and np.allclose(there, (points @ turn.T + shift) / 1000.0, atol=1e-12)
    assert np.allclose(turned, normals @ turn.T, atol=1e-6)
    lines = [line.split() for line in (places / "on_obj" / "3.obj").read_text().splitlines()]
    assert np.allclose([[float(v) for v in line[1:]] for line in lines if line[0] == "v"], there, atol=1e-9)
    done = run_script("reconstruct", places / "on.safetensors", places / "3.png", "--out", places / "on_ply", "--cloud", "ply")
    assert done.returncode == 2 and "length_unit 'm' then, 'mm' now" in done.stderr


def test_a_pose_and_a_track(places, run_script):
    (places / "film").mkdir()
    for k in range(16):
        cv2.imwrite(str(places / "film" / f"{k:02d}.png"), bgr(tiny_image(-1 - k if k < 13 else k)))
    found = []
    for name, options in (("beside", ()), ("on", ("--unit", "m"))):
        unit, out = places / f"{name}.safetensors", ("--out", places / name, *options)
        run_script("track", unit, places / "film", *out, "--video", "none")
        images = (places / "film" / "14.png", places / "film" / "13.png")
        run_script("pose", unit, *images, *out, "--no-pictures", "--cloud", "ply")
        pose = json.loads((places / name / "pose.json").read_text())
        with (places / name / "poses.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        track = [[float(row[f"T{i}{j}"]) for i in range(3) for j in range(4)] for row in rows]
        std = [float(row["std_x_mm"]) for row in rows]
        found.append((pose, track, std, read_ply(places / name / "14_target.ply")[1]))
    (pose, track, _, cloud), (there, turned, std, away) = found
    written = OutputFrame("m", ON_ROBOT)
    assert there["axes"] == "m, axes of the robot" and pose["axes"].startswith("mm, x right")
    assert there["axes"] == json.loads((places / "on" / "summary.json").read_text())["poses"]
    for name, change in (("T_target_source", written.pose), ("covariance", written.covariance)):
        expected = change(torch.tensor(pose[name], dtype=torch.float64))
        assert torch.allclose(torch.tensor(there[name], dtype=torch.float64), expected, rtol=1e-9, atol=1e-12)
    for one, other in zip(track, turned, strict=True):
        T = torch.tensor([*one, 0, 0, 0, 1], dtype=torch.float64).reshape(4, 4)
        assert torch.allclose(written.pose(T)[:3].flatten(), torch.tensor(other, dtype=torch.float64), atol=1e-8)
    assert len(track) >= 1 and all(value > 1e-3 for value in std)  # mm, as their name says
    assert np.allclose(away, written.points(torch.tensor(cloud)).numpy(), atol=1e-12)
