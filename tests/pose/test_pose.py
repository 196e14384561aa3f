"""Pose from touch: known motions come back, motions that the data do not determine are named, misfits do not converge."""

import json
import math
import sys

import pytest
import torch

import torchvts as vts
from lab import pose_accuracy as pose_bench
from lab.rigid import invert, motion, turn_deg
from torchvts.pose import clouds, contact_cloud, read_cloud
from torchvts.scenes import objects

PITCH = 0.125
SIZE = (120, 160)


def frame(height_mm, T):
    """An exact press as a DepthOutput."""
    scene = objects.press(height_mm, T, *SIZE, PITCH)
    return vts.DepthOutput(scene.depth_mm, scene.gradient, scene.normal, scene.contact, scene.contact)


def off(found, truth, middle=(0.0, 0.0, 0.0)):
    """Degrees, and mm at a point of the target."""
    difference = found @ invert(truth)
    at = torch.tensor(middle, dtype=torch.float64)
    return float(turn_deg(difference)), float((difference[:3, :3] @ at + difference[:3, 3] - at).norm())


@pytest.fixture(scope="module")
def letters():
    return objects.stamp("VTS", 4.2)


@pytest.fixture(scope="module")
def reference(letters):
    return frame(letters, objects.pose(0.0, (0.2, -0.1), 0.45, (1.0, -0.5)))


# objects


def test_a_pressed_object_has_the_gradient_of_its_depth():
    T = objects.pose(33.0, (0.7, -0.4), 0.4, (2.0, -1.5))
    errors = []
    for refine in (1, 2):
        scene = objects.press(objects.textured_patch(), T, 80 * refine, 80 * refine, 0.15 / refine, dtype=torch.float64)
        q, p = torch.gradient(scene.depth_mm[0, 0], spacing=0.15 / refine)
        inside = scene.depth_mm[0, 0] > 0.1
        errors.append(float((torch.stack((p, q)) - scene.gradient[0])[:, inside].abs().mean()))
    assert errors[1] < errors[0] / 3.4  # second order


@pytest.mark.parametrize("name", objects.TARGETS)
def test_targets_have_the_symmetry_they_state(name):
    target = objects.TARGETS[name]
    axis = torch.linspace(-5, 5, 41, dtype=torch.float64)
    v, u = torch.meshgrid(axis, axis, indexing="ij")

    def turned(angle_deg):
        c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
        return target.height_mm(c * u - s * v, s * u + c * v)

    assert (turned(target.period_deg) - turned(0.0)).abs().max() < 1e-6
    assert (turned(0.5 * target.period_deg) - turned(0.0)).abs().max() > 0.02


# two depth frames


@pytest.mark.parametrize("angle_deg", [17.0, 260.0])
def test_a_press_turned_moved_tilted_and_deeper_is_found(letters, reference, angle_deg):
    T = objects.pose(angle_deg, (2.0, -1.2), 0.6, (-1.5, 1.0))
    truth = objects.pose(0.0, (0.2, -0.1), 0.45, (1.0, -0.5)) @ invert(T)
    moved = frame(letters, T)
    forth = vts.register_depth(moved, reference, PITCH)
    back = vts.register_depth(reference, moved, PITCH)
    assert forth.converged and not forth.ambiguous and not forth.alternatives, forth.message
    deg, mm = off(forth.T_target_source, truth)
    assert deg < 0.1 and mm < 0.02
    deg, mm = off(forth.T_target_source @ back.T_target_source, torch.eye(4, dtype=torch.float64))
    assert deg < 0.05 and mm < 0.02
    assert torch.allclose(forth.inverse() @ forth.T_target_source, torch.eye(4, dtype=torch.float64), atol=1e-12)


def test_a_frame_on_itself_stays(reference):
    found = vts.register_depth(reference, reference, PITCH)
    assert off(found.T_target_source, torch.eye(4, dtype=torch.float64))[0] < 1e-3
    assert found.rmse_mm < 1e-5 and found.fitness == 1.0


def test_turning_both_frames_turns_the_pose(letters, reference):
    """The same pose, seen by a sensor that is mounted upside down."""
    moved = frame(letters, objects.pose(40.0, (1.0, 1.5), 0.5))
    found = vts.register_depth(moved, reference, PITCH)

    def half_turn(f):
        signs = (1, -1, torch.tensor([-1, -1, 1])[:, None, None], True, True)
        return vts.DepthOutput(*(t.flip((2, 3)) * s for t, s in zip(f, signs)))

    other = vts.register_depth(half_turn(moved), half_turn(reference), PITCH)
    half = objects.pose(180.0, press_mm=0.0)
    deg, mm = off(half @ other.T_target_source @ half, found.T_target_source)
    assert deg < 0.02 and mm < 0.003


def test_a_symmetric_object_lists_its_other_poses():
    target = objects.TARGETS["gear"]
    T_t, T_s = objects.pose(0.0, press_mm=0.45), objects.pose(100.0, (1.0, 0.5), 0.5, (1.0, 1.0))
    found = vts.register_depth(frame(target.height_mm, T_s), frame(target.height_mm, T_t), PITCH)
    assert found.converged and not found.ambiguous and len(found.alternatives) == 11
    every = [found.T_target_source, *found.alternatives]
    for k in range(12):
        truth = T_t @ objects.pose(30.0 * k, press_mm=0.0) @ invert(T_s)
        deg, mm = min(off(T, truth) for T in every)
        assert deg < 0.1 and mm < 0.01


@pytest.mark.parametrize(
    "shape, names, ends",
    [
        (objects.sphere(), ["rotation about x", "rotation about y", "rotation about z"], 1),
        (objects.cylinder(), ["translation along 30 degrees", "rotation about 30 degrees"], 2),
        (objects.plane(), ["translation along x", "translation along y", "rotation about z"], 1),
    ],
)
def test_surfaces_that_slide_on_themselves_are_ambiguous(shape, names, ends):
    tilt = (2.5, 1.0)
    one = frame(shape, objects.pose(30.0, (0.3, 0.2), 0.3, tilt))
    two = frame(shape, objects.pose(75.0, (-0.5, 0.6), 0.35, (-1.0, 2.0)))
    found = vts.register_depth(two, one, PITCH)
    assert found.converged and len(found.alternatives) == ends - 1
    for name, expected in zip(found.ambiguous, names, strict=True):
        kind, angle = name.rsplit(" ", 2)[0], name.split()[2]
        assert expected.startswith(kind.split(" degrees")[0].rsplit(" ", 1)[0]) or name == expected
        if "degrees" in expected:
            assert abs(float(angle) - 30.0) <= 3.0
    assert found.covariance.diagonal().max() > 1.0 and torch.linalg.eigvalsh(found.covariance).min() > 0


def test_a_pose_that_is_told_again_and_again_does_not_drift_along_what_is_unknown(mini_presses, mini_by_prior):
    """Balls beside the middle of the image, each pose the start of the next: up to 0.6 mm along z, which slopes do not see."""
    pipe, generator = vts.DepthPipeline.from_calibration(mini_by_prior, "fast").freeze(), torch.Generator().manual_seed(0)
    for press in mini_presses[1][0:30:10]:
        seen, told = pipe(press.image[None]), torch.eye(4, dtype=torch.float64)
        for _ in range(4):
            noisy = (press.image + torch.randn(press.image.shape, generator=generator) / 255.0).clamp(0.0, 1.0)
            found = vts.register_depth(pipe(noisy[None]), seen, mini_by_prior.sensor.mm_per_pixel, initial=told)
            told = found.T_target_source
            assert found.converged and abs(float(told[2, 3])) < 0.02 and found.rmse_mm < 0.02


def hanging_ball(x0, y0, press, seed):
    """A ball as a sensor shows it: the skin leaves it at a slope of 0.6 and sinks slowly, and slopes are off by 0.03."""

    def depth(x, y):
        r = torch.sqrt((x - x0) ** 2 + (y - y0) ** 2 + 1e-12)
        edge = 3.2 * 0.6 / math.sqrt(1.36)
        cap = torch.sqrt(3.2**2 - r.clamp_max(edge) ** 2) - 3.2 + press
        rim = math.sqrt(3.2**2 - edge**2) - 3.2 + press
        return torch.where(r < edge, cap, rim * torch.exp(-0.6 / rim * (r - edge)) - 0.02)

    scene = vts.scenes.surface(depth, *SIZE, PITCH)
    coarse = 0.03 * torch.randn(1, 2, 8, 10, generator=torch.Generator().manual_seed(seed))
    error = torch.nn.functional.interpolate(coarse, SIZE, mode="bicubic", align_corners=True)
    gradient = (scene.gradient + error) * scene.contact
    depth = vts.integration.poisson_background(gradient, PITCH)
    return vts.DepthOutput(depth, gradient, scene.normal, scene.contact, scene.contact)


def test_a_ball_with_skin_hanging_around_it_is_still_a_ball():
    """The skin around a ball moves with the contact: only its deep part shows that it rolls."""
    target = hanging_ball(0.0, 0.0, 0.9, 0)
    for seed, (x, y, press) in enumerate([(1.5, 0.5, 0.9), (-2.0, 1.0, 0.75)], 1):
        found = vts.register_depth(hanging_ball(x, y, press, seed), target, PITCH)
        assert found.converged and found.ambiguous == ["rotation about x", "rotation about y", "rotation about z"], found.message


def test_real_presses_of_a_ball_are_ambiguous(mini_presses):
    background, presses = mini_presses
    counts = pose_bench.ball_pairs(background, presses[:20:5], vts.Sensor.load("gelsight_mini"))
    assert counts["pairs"] >= 6 and counts["converged"] >= 3
    assert counts["not named"] == 0 and counts["named"] >= counts["converged"] - 1


def test_different_objects_do_not_fit(reference):
    other = frame(objects.TARGETS["gear"].height_mm, objects.pose(20.0, (0.5, 0.0), 0.5))
    found = vts.register_depth(other, reference, PITCH)
    assert not found.converged and not found.ambiguous and "nothing fits" in found.message


def test_a_flat_face_shows_three_motions_and_fits_no_relief(reference):
    face = reference._replace(**{name: torch.zeros_like(getattr(reference, name)) for name in ("depth_mm", "gradient")})
    face = face._replace(depth_mm=face.depth_mm + 0.4, contact=torch.ones_like(face.contact))
    found = vts.register_depth(face, face, PITCH)
    assert found.converged and found.ambiguous == ["translation along x", "translation along y", "rotation about z"]
    for pair in ((face, reference), (reference, face)):
        assert not vts.register_depth(*pair, PITCH).converged


def test_a_sequence_starts_from_the_pose_before(letters, reference, monkeypatch):
    truth = objects.pose(0.0, (0.2, -0.1), 0.45, (1.0, -0.5)) @ invert(objects.pose(5.0, (0.5, 0.3), 0.5))
    moved = frame(letters, objects.pose(5.0, (0.5, 0.3), 0.5))
    near = motion(torch.tensor([0.01, -0.01, 0.05, 0.2, -0.2, 0.05], dtype=torch.float64)) @ truth
    monkeypatch.setattr("torchvts.pose.direct.search_plane", None)  # no search is needed
    found = vts.register_depth(moved, reference, PITCH, initial=near)
    assert found.converged and off(found.T_target_source, truth)[0] < 0.1


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.long) for k in (1, 2))])
def test_a_key_is_not_found_a_tooth_or_two_away(seed):
    """Slopes of its long sides agree under any shift along it, and its teeth are 1.2 mm apart."""
    turn, x, y, tilt = (2.0 * torch.rand(2, 4, generator=torch.Generator().manual_seed(seed)) - 1.0).unbind(1)
    before, after = (
        objects.pose(float(180 * turn[k]), (3 * float(x[k]), 2 * float(y[k])), 0.45, (float(tilt[k]), 1.0)) for k in (0, 1)
    )
    frames = [objects.press(objects.key(), pose, 120, 160, 0.125) for pose in (before, after)]
    found = vts.register_depth(*frames, 0.125)
    off = found.T_target_source @ invert(after @ invert(before))
    assert found.converged and float(turn_deg(off)) < 0.2
    assert float((off[:3, :3] @ after[:3, 3] + off[:3, 3] - after[:3, 3]).norm()) < 0.05


def test_the_whole_chain_keeps_within_its_goal():
    targets = {name: objects.TARGETS[name] for name in ("stamp", "tool handle")} | {"plane": objects.FREE_TARGETS["plane"]}
    rows, shown = pose_bench.run_poses(targets, 1, size=(180, 240), noise_std=0.005)
    for row in rows[:2]:
        assert row.errors["within"] == row.frames and row.errors["wrong"] == 0
        assert max(row.each["deg"]) < 0.3 and max(row.each["mm"]) < 0.05
    assert rows[2].errors["named"] == rows[2].frames and rows[2].errors["wrong"] == 0
    assert pose_bench.pose_table(rows).count("\n") == 4 and set(shown) == set(targets)


@pytest.mark.long
@pytest.mark.parametrize("name", ["textured patch", "key"])
def test_the_covariance_of_a_pose_predicts_its_error(name):
    lights, pipe = pose_bench.rig(*SIZE, PITCH)
    squares = []
    for seed in range(8):
        case = pose_bench.pose_case(objects.TARGETS[name], seed, lights, pipe, SIZE, 0.01)
        found = vts.register_depth(case.source, case.target, PITCH)
        off = found.T_target_source @ invert(case.T_sensor_target @ invert(case.T_sensor_source))
        twist = torch.stack((off[2, 1], off[0, 2], off[1, 0], *off[:3, 3])).double()
        squares.append(float(twist @ torch.linalg.solve(found.covariance.double(), twist)) / 6.0)
    assert 0.25 < sum(squares) / len(squares) < 4.0, squares  # 1 expected


# clouds


def test_the_contact_cloud_is_even_sure_and_has_the_cameras_normals(reference):
    cloud, normals = contact_cloud(reference, PITCH, 400)
    assert 320 <= len(cloud) <= 400 and normals.shape == cloud.shape
    assert float(cloud[:, 2].min()) > 0.03
    assert torch.allclose(normals.norm(dim=1), torch.ones(len(cloud), dtype=torch.float64))
    whole, fine = contact_cloud(reference, PITCH, None)
    assert len(whole) < int(reference.contact.sum())
    assert (torch.cdist(whole, cloud).min(1).values < 1.0).all()  # evenly spread: no part is far from a kept point
    row = (SIZE[0] - 1) / 2 - whole[:, 1] / PITCH
    column = whole[:, 0] / PITCH + (SIZE[1] - 1) / 2
    measured = reference.normal[0, :, row.round().long(), column.round().long()].T * torch.tensor([1.0, -1.0, 1.0])
    assert (measured - fine).abs().max() < 1e-5
    with pytest.raises(ValueError, match="frame: expected a contact deeper than its own noise"):
        contact_cloud(reference._replace(depth_mm=0.01 * reference.depth_mm), PITCH)


@pytest.fixture(scope="module")
def open3d():
    try:
        return read_cloud.open3d()
    except ImportError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("twist", [(0.02, -0.03, 2.0, 3.0, -2.0, 0.1), (1.2, -0.8, 2.0, 3.0, -2.0, 5.0)])
def test_a_known_motion_of_a_cloud_comes_back(open3d, reference, twist):
    cloud = contact_cloud(reference, PITCH, None)[0]
    T = motion(torch.tensor(twist, dtype=torch.float64))
    moved = (cloud @ T[:3, :3].T + T[:3, 3])[torch.randperm(len(cloud), generator=torch.Generator().manual_seed(0))]
    found = vts.register_points(cloud, moved)
    assert found.converged, found.message
    assert (found.T_target_source - T).abs().max() < 1e-4
    near = motion(torch.tensor([0.02, 0.01, -0.02, 0.05, 0.0, 0.02], dtype=torch.float64)) @ T
    assert (vts.register_points(cloud, moved, initial=near).T_target_source - T).abs().max() < 1e-4


@pytest.mark.parametrize(
    "name", ["key", *(pytest.param(n, marks=pytest.mark.long) for n in ("tool handle", "stamp", "textured patch"))]
)
def test_contacts_turned_in_space_are_registered_and_other_objects_are_not(open3d, name):
    T_t, T_s = objects.pose(0.0, press_mm=0.5), objects.pose(110.0, (1.0, -0.8), 0.55, (1.0, 0.5))
    W = motion(torch.tensor([1.2, -0.8, 2.0, 3.0, -2.0, 5.0], dtype=torch.float64))
    (s, n_s), (t, n_t) = (contact_cloud(frame(objects.TARGETS[name].height_mm, T), PITCH) for T in (T_s, T_t))
    moved = {"target_normals": n_t @ W[:3, :3].T}
    found = vts.register_points(s, t @ W[:3, :3].T + W[:3, 3], source_normals=n_s, **moved)
    deg, mm = off(found.T_target_source, W @ T_t @ invert(T_s), (W @ T_t)[:3, 3].tolist())
    assert found.converged and deg < 0.5 and mm < 0.05, found.message
    x, n_x = contact_cloud(frame(objects.TARGETS["bolt head"].height_mm, T_s), PITCH)
    assert not vts.register_points(x, t @ W[:3, :3].T + W[:3, 3], source_normals=n_x, **moved).converged


@pytest.mark.parametrize("with_normals, most", [(False, None), (True, 1200)])
def test_contact_clouds_of_two_presses(open3d, with_normals, most):
    shape = objects.textured_patch()
    T_t, T_s = objects.pose(0.0, press_mm=0.5), objects.pose(75.0, (1.0, -0.8), 0.6, (1.0, 0.5))
    (s, n_s), (t, n_t) = (contact_cloud(frame(shape, T), PITCH, most) for T in (T_s, T_t))
    normals = {"source_normals": n_s, "target_normals": n_t} if with_normals else {}
    forth, back = vts.register_points(s, t, **normals), vts.register_points(t, s, **{
        "source_normals": n_t, "target_normals": n_s} if with_normals else {})  # fmt: skip
    assert forth.converged
    deg, mm = off(forth.T_target_source, T_t @ invert(T_s))
    assert deg < 0.3 and mm < 0.05
    deg, mm = off(forth.T_target_source @ back.T_target_source, torch.eye(4, dtype=torch.float64))
    assert deg < (0.05 if most is None else 0.3) and mm < (0.01 if most is None else 0.05)


def test_clouds_of_spheres_are_ambiguous(open3d):
    one, two = (frame(objects.sphere(), objects.pose(press_mm=d)) for d in (0.5, 0.6))
    found = vts.register_points(contact_cloud(one, PITCH, None)[0], contact_cloud(two, PITCH, None)[0])
    assert found.ambiguous == ["rotation about x", "rotation about y", "rotation about z"]


def test_duplicate_points_change_nothing(open3d, reference):
    cloud = contact_cloud(reference, PITCH, None)[0]
    moved = cloud + torch.tensor([0.5, 0.2, 0.0], dtype=torch.float64)
    found = vts.register_points(torch.cat((cloud, cloud[:100])), moved)
    assert found.converged and (found.T_target_source[:3, 3] - (moved - cloud)[0]).abs().max() < 1e-3
    assert (found.T_target_source - vts.register_points(cloud, moved).T_target_source).abs().max() < 1e-9


def test_without_open3d_clouds_are_written_and_its_lack_is_said(monkeypatch, reference, tmp_path):
    monkeypatch.setitem(sys.modules, "open3d", None)
    cloud = contact_cloud(reference, PITCH)[0]
    for suffix in clouds.CLOUD_SUFFIXES:
        clouds.write_point_cloud(tmp_path / f"a{suffix}", cloud)
        assert (tmp_path / f"a{suffix}").stat().st_size > 12 * len(cloud)
    with pytest.raises(ImportError, match=r"pip install 'torchvts\[pose\]'"):
        vts.register_points(cloud, cloud)


@pytest.mark.long
def test_clouds_in_metres_are_read_as_such_or_named(open3d, run_script, tmp_path):
    generator = torch.Generator().manual_seed(1)
    blob = torch.nn.functional.normalize(torch.randn(400, 3, generator=generator, dtype=torch.float64), dim=1)
    blob = 0.001 * blob * torch.tensor([4.0, 2.5, 2.0])
    for name in ("one", "other"):
        clouds.write_point_cloud(tmp_path / f"{name}.ply", blob, None, "m, axes of the robot")
    given = ("pose", tmp_path / "one.ply", tmp_path / "other.ply", "--out", tmp_path / "out", "--no-pictures")
    done = run_script(*given)
    assert done.returncode == 2 and "one.ply: expected points that lie 0.2 to 2000 mm apart, got 0.00" in done.stderr
    assert "--unit m" in done.stderr and not (tmp_path / "out" / "pose.json").exists()
    done = run_script(*given, "--unit", "m")
    assert done.returncode == 0, done.stderr


# the script


def test_the_script_writes_pose_and_picture(run_script, tmp_path):
    lights, pipe = pose_bench.rig(*SIZE, PITCH)
    del pipe
    T_t, T_s = objects.pose(0.0, press_mm=0.5), objects.pose(50.0, (1.0, 0.5), 0.55)
    undeformed = vts.scenes.undeformed(objects.press(objects.stamp(), T_t, *SIZE, PITCH))
    background = vts.scenes.render(undeformed, lights)[0]
    sensor = vts.Sensor("pose rig", *SIZE, PITCH)
    vts.Calibration.from_lights(lights, sensor, background).save(tmp_path / "unit.safetensors")
    (tmp_path / "film").mkdir()
    vts.write_image(tmp_path / "background.png", background)
    for name, T in (("target", T_t), ("film/a", T_s), ("film/b", objects.pose(54.0, (1.1, 0.5), 0.55))):
        scene = objects.press(objects.stamp(), T, *SIZE, PITCH)
        vts.write_image(tmp_path / f"{name}.png", vts.scenes.render(scene, lights, noise_std=0.003)[0])

    def call(source, target, out, *options):
        return run_script(
            "pose", tmp_path / "unit.safetensors", tmp_path / source, tmp_path / target, "--out", tmp_path / out, *options
        )

    done = call("film/a.png", "target.png", "one")
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "one" / "pose.json").read_text())
    deg, mm = off(torch.tensor(result["T_target_source"], dtype=torch.float64), T_t @ invert(T_s))
    assert result["converged"] and deg < 0.3 and mm < 0.05
    assert (tmp_path / "one" / "a_pose.png").stat().st_size > 10_000
    done = call("film", "target.png", "track", "--no-pictures")
    assert done.returncode == 0, done.stderr
    assert [entry["converged"] for entry in json.loads((tmp_path / "track" / "pose.json").read_text())] == [True, True]
    vts.write_image(tmp_path / "film" / "c.png", background)
    done = call("film", "target.png", "track", "--no-pictures")
    assert done.returncode == 1 and "no pose in 1 of 3 frames, the first c: " in done.stdout
    done = call("background.png", "target.png", "none")
    assert (
        done.returncode == 2 and done.stderr.strip().splitlines()[-1].startswith("torchvts: error: ") and "touched" in done.stderr
    )
    done = call("film/a.png", "target.png", "background.png")
    assert done.returncode == 2 and "background.png: expected the name of a folder for the results" in done.stderr
    done = call("target.png", "target.ply", "none")
    assert done.returncode == 2 and "expected two clouds and nothing beside them" in done.stderr


def test_a_surface_of_revolution_hides_its_turn_only():
    def mound(u, v):
        r = torch.sqrt(u**2 + v**2 + 1e-12)
        return 0.2 * torch.cos(2.0 * r) - 0.04 * r**2 - 0.2

    found = vts.register_depth(frame(mound, objects.pose(50.0, (1.0, -0.4), 0.5)), frame(mound, objects.pose(press_mm=0.6)), PITCH)
    assert found.converged and found.ambiguous == ["rotation about z"]
    assert float(found.T_target_source[:2, 3].norm() - math.hypot(1.0, 0.4)) < 0.01


def test_a_start_that_is_wrong_is_left(letters, reference):
    found = vts.register_depth(frame(letters, objects.pose(5.0, (0.5, 0.3), 0.5)), reference, PITCH, initial=objects.pose(170.0))
    assert found.converged and found.fitness > 0.95


def test_a_cloud_that_is_no_relief_is_registered(open3d):
    generator = torch.Generator().manual_seed(1)
    blob = torch.randn(800, 3, generator=generator, dtype=torch.float64)
    blob = torch.nn.functional.normalize(blob, dim=1) * torch.tensor([4.0, 2.5, 2.0]) + 0.3 * torch.sin(2 * blob)
    T = motion(torch.tensor([0.8, -0.5, 1.5, 1.0, 2.0, -3.0], dtype=torch.float64))
    found = vts.register_points(blob, blob @ T[:3, :3].T + T[:3, 3])
    assert found.converged and (found.T_target_source - T).abs().max() < 1e-4
