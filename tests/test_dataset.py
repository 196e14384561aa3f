"""Large data sets: every frame once and the same, whatever the batch, the workers, the processes, and wherever a run was killed."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import torchvts as vts
from torchvts import dataset
from torchvts.core.files import read_depth_png
from torchvts.dataset import STATE, list_items, output_stems, reconstruct_dataset

ROOT = Path(__file__).resolve().parents[1]
SCRIPT = ROOT / "scripts" / "reconstruct.py"
HEIGHT, WIDTH, PITCH = 48, 64, 0.6
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}


def image(k):
    lights = vts.PointLights([[20.0, 9.0, 25.0], [-18.0, 13.0, 25.0], [-2.0, -22.0, 25.0]], [600.0, 600.0, 600.0])
    scene = vts.scenes.sphere_press(6.0 + k % 5, 0.5 + 0.01 * (k % 50), (0.1 * (k % 30) - 1.5, 0), HEIGHT, WIDTH, PITCH)
    return vts.scenes.render(scene if k >= 0 else vts.scenes.undeformed(scene), lights, noise_std=0.002, bits=8, seed=abs(k))[0]


@pytest.fixture(scope="module")
def unit(tmp_path_factory):
    path = tmp_path_factory.mktemp("unit") / "unit.safetensors"
    lights = vts.PointLights([[20.0, 9.0, 25.0], [-18.0, 13.0, 25.0], [-2.0, -22.0, 25.0]], [600.0, 600.0, 600.0])
    vts.Calibration.from_lights(lights, vts.Sensor("rig", HEIGHT, WIDTH, PITCH), image(-1)).save(path)
    return path


def fill(folder, names):
    for k, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        vts.write_image(folder / name, image(k))
    return folder


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    return fill(tmp_path_factory.mktemp("frames"), [f"{k // 40}/{k:03d}.png" for k in range(120)])


@pytest.fixture(scope="module")
def whole(unit, frames, tmp_path_factory):
    """What one process makes of the frames without being disturbed."""
    out = tmp_path_factory.mktemp("whole")
    report = reconstruct_dataset(unit, frames, out, workers=0)
    assert (report.rows, report.before, report.failed) == (120, 0, [])
    return contents(out)


def contents(out):
    """Every result with its bytes; nothing half written beside them."""
    return {str(p.relative_to(out)): p.read_bytes() for p in sorted(out.rglob("*")) if p.is_file() and STATE not in p.parts}


def logged(out):
    return sum(path.read_bytes().count(b"\n") for path in (out / STATE).glob("log-*.jsonl"))


def torchrun(*arguments):
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2", SCRIPT, *arguments]
    return subprocess.Popen(
        list(map(str, command)), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=ROOT, env=ENVIRONMENT
    )


def family(pid):
    """A process and all below it."""
    found = [pid]
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in task.read_text().split():
            found += family(int(child))
    return found


def until(condition, process, limit_s=60.0):
    deadline = time.monotonic() + limit_s
    while not condition():
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_batch_and_workers_do_not_matter(unit, frames, whole, tmp_path):
    for batch, workers in ((1, 0), (7, 2)):
        out = tmp_path / f"{batch}"
        reconstruct_dataset(unit, frames, out, batch=batch, workers=workers)
        assert contents(out) == whole


@pytest.mark.parametrize("mode", ["fast", "precise", "auto"])
def test_one_thread_gives_the_same_bits_for_any_batch(unit, mode):
    pipe = vts.DepthPipeline.from_calibration(vts.Calibration.load(unit), mode)
    images = torch.stack([image(k) for k in range(8)])
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.inference_mode():
            single = torch.cat([pipe(one).depth_mm for one in images.split(1)])
            assert all(torch.equal(torch.cat([pipe(some).depth_mm for some in images.split(n)]), single) for n in (2, 3, 8))
    finally:
        torch.set_num_threads(threads)


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="finds processes through /proc")
def test_two_processes_killed_half_way_and_started_again_give_the_same_bytes(unit, frames, whole, tmp_path):
    out = tmp_path / "out"
    first = torchrun(unit, frames, "--out", out, "--batch", 2)
    until(lambda: logged(out) >= 40, first)
    for pid in family(first.pid):
        with contextlib.suppress(ProcessLookupError):  # its parent's death may have ended it
            os.kill(pid, signal.SIGKILL)
    first.communicate()
    assert 40 <= logged(out) < 120 and not (out / "frames.csv").exists()
    second = torchrun(unit, frames, "--out", out)
    printed = second.communicate(timeout=60)[0]
    assert second.returncode == 0, printed
    assert "wrote 120 frames" in printed and "; 0 were there before" not in printed
    assert contents(out) == whole


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="finds processes through /proc")
def test_one_killed_process_ends_the_run_and_the_next_one_goes_on(unit, frames, whole, tmp_path):
    out = tmp_path / "out"
    first = torchrun(unit, frames, "--out", out, "--workers", 0)
    until(lambda: logged(out) >= 20, first)
    last = max(pid for pid in family(first.pid) if pid != first.pid)
    os.kill(last, signal.SIGKILL)
    first.communicate(timeout=60)
    assert first.returncode != 0 and not (out / "frames.csv").exists()
    report = reconstruct_dataset(unit, frames, out)  # other numbers of processes may go on
    assert report.before >= 20 and contents(out) == whole


@pytest.fixture
def pair(unit, frames, tmp_path):
    """Two processes without torchrun, which nobody stops if one of them dies."""
    started = []

    def start(rank, out, port, *options):
        environment = {**ENVIRONMENT, "RANK": f"{rank}", "WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": f"{port}"}
        command = [sys.executable, SCRIPT, unit, frames, "--out", out, "--workers", 0, *options]
        started.append(subprocess.Popen(
            list(map(str, command)), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
        ))  # fmt: skip
        return started[-1]

    yield start
    for process in started:
        if process.poll() is None:
            process.kill()
            process.communicate()


def free_port():
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_a_silent_process_is_named_and_does_not_hold_up_the_others(pair, tmp_path):
    out, port = tmp_path / "out", free_port()
    first, second = (pair(rank, out, port, "--timeout", 10) for rank in (0, 1))
    until(lambda: len(list((out / STATE).glob("log-*-1.jsonl"))) == 1, second)
    second.kill()
    second.communicate()
    start = time.monotonic()
    printed = first.communicate(timeout=60)[1]
    assert first.returncode == 1 and time.monotonic() - start < 40
    assert "error: rank 1 has not been heard of for 10 s" in printed, printed
    assert not (out / "frames.csv").exists()


def test_a_process_that_fails_stops_the_others(pair, frames, unit, tmp_path):
    out, port = tmp_path / "out", free_port()
    first, second = pair(0, out, port, "--mode", "fast"), pair(1, out, port, "--mode", "precise")
    errors = [process.communicate(timeout=60)[1] for process in (first, second)]
    assert (first.returncode, second.returncode) == (1, 1)
    assert "mode 'fast' then, 'precise' now" in errors[1], errors
    assert "error: rank 1 stopped" in errors[0], errors


def test_a_torn_line_a_lost_file_and_a_changed_image_are_computed_again(unit, whole, frames, tmp_path):
    source = fill(tmp_path / "in", [f"{k}.png" for k in range(6)])
    out = tmp_path / "out"
    reconstruct_dataset(unit, source, out, pictures=False)
    before = contents(out)
    log = next((out / STATE).glob("log-*-0.jsonl"))
    log.write_bytes(log.read_bytes()[:-10])  # 5.png
    (out / "2_depth.png").unlink()
    (out / ".3_depth-abcd_123.png").write_bytes(b"left half written")
    vts.write_image(source / "4.png", image(17))
    report = reconstruct_dataset(unit, source, out, pictures=False)
    assert (report.rows, report.before, report.ranks[0][0]) == (6, 3, 3)
    after = contents(out)
    assert after.keys() == before.keys()
    changed = {name for name in before if after[name] != before[name]}
    assert changed == {"4_depth.png", "frames.csv"}


def test_other_settings_are_refused_and_overwrite_begins_anew(unit, tmp_path):
    source, out = fill(tmp_path / "in", ["a.png"]), tmp_path / "out"
    reconstruct_dataset(unit, source, out, mode="fast", pictures=False)
    other = tmp_path / "other.safetensors"
    calibration = vts.Calibration.load(unit)
    vts.Calibration.from_lights(calibration.lights, calibration.sensor).save(other)
    for calibration, options, part in (
        (unit, {"mode": "precise"}, "mode 'fast' then, 'precise' now: give another --out, or --overwrite"),
        (unit, {"mode": "fast", "depth": "npy"}, "depth 'png' then, 'npy' now"),
        (unit, {"mode": "fast", "pictures": True}, "pictures 'False' then, 'True' now"),
        (other, {"mode": "fast"}, "calibration file '"),
    ):
        with pytest.raises(ValueError, match="was begun with other settings") as caught:
            reconstruct_dataset(calibration, source, out, **options)
        assert part in str(caught.value)
    report = reconstruct_dataset(unit, source, out, mode="precise", depth="npy", pictures=False, overwrite=True)
    assert (report.rows, report.before) == (1, 0) and (out / "a_depth.npy").is_file()


def test_unusable_images_are_named_and_left_out(unit, tmp_path, capsys):
    source, out = fill(tmp_path / "in", [f"{k}.png" for k in range(5)]), tmp_path / "out"
    (source / "1.png").write_bytes(b"no image")
    vts.write_image(source / "3.png", torch.zeros(3, 40, 64))
    (source / "film.avi").write_bytes(b"no film")
    report = reconstruct_dataset(unit, source, out, pictures=False)
    assert [name for name, _ in report.failed] == ["1.png", "3.png", "film.avi"] and report.rows == 3
    assert "expected 48 x 64" in report.failed[1][1]
    assert "left out 1.png: " in capsys.readouterr().err
    assert len((out / "failed.csv").read_text().splitlines()) == 4
    with pytest.raises(ValueError, match=r"1\.png: .*not an image"):
        reconstruct_dataset(unit, source, tmp_path / "strict", strict=True)
    fill(source, [f"{k}.png" for k in range(5)])
    (source / "film.avi").unlink()
    report = reconstruct_dataset(unit, source, out, pictures=False)
    assert report.failed == [] and report.rows == 5 and not (out / "failed.csv").exists()


def test_the_script_ends_with_status_1_where_a_frame_was_left_out(unit, tmp_path):
    source = fill(tmp_path / "in", ["a.png", "b.png"])
    (source / "b.png").write_bytes(b"")
    command = [sys.executable, SCRIPT, unit, source, "--out", tmp_path / "out", "--no-pictures"]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, env=ENVIRONMENT)
    assert done.returncode == 1 and "| b.png | " in done.stdout and "wrote 1 frames" in done.stdout
    assert "frames/s" in done.stdout


def test_same_stems_keep_apart_and_folders_stay(unit, tmp_path):
    names = ["a.bmp", "a.png", "sub/a.png", "sub/deeper/a.png"]
    source, out = fill(tmp_path / "in", names), tmp_path / "in" / "out"
    for _ in range(2):  # results inside the source are no sources
        report = reconstruct_dataset(unit, source, out, pictures=False)
        assert (report.rows, report.failed) == (4, [])
    results = sorted(name for name in contents(out) if name.endswith("_depth.png"))
    assert results == ["a.bmp_depth.png", "a.png_depth.png", "sub/a_depth.png", "sub/deeper/a_depth.png"]
    assert [line.split(",")[0] for line in (out / "frames.csv").read_text().splitlines()[1:]] == names
    with pytest.raises(ValueError, match="is the source itself"):
        reconstruct_dataset(unit, source, source)


def test_no_two_files_of_a_folder_share_a_stem():
    names = ["a.png", "A.jpg", "a.png.bmp", "film.avi", "film_000001.png", "film.mp4", "b.png"]
    stems = output_stems(names)
    assert len(set(stems.values())) == len(names) and stems["film_000001.png"] == "film_000001.png"


def test_listing_is_sorted_by_folder_and_name(tmp_path):
    names = ["b.png", "a/z.png", "a.png", "a/b/c.PNG", "a-b.png", ".hidden.png", "notes.txt"]
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    paths = [item.path for item in list_items(tmp_path)]
    assert paths == ["a/b/c.PNG", "a/z.png", "a-b.png", "a.png", "b.png"] and paths == sorted(paths, key=lambda p: p.split("/"))


def test_a_name_that_is_no_text_is_left_out(unit, tmp_path):
    source = fill(tmp_path / "in", ["a, b.png"])
    try:
        (source / os.fsdecode(b"bad\xff.png")).write_bytes((source / "a, b.png").read_bytes())
    except OSError:
        pytest.skip("this file system takes UTF-8 names only")
    report = reconstruct_dataset(unit, source, tmp_path / "out", pictures=False)
    assert report.rows == 1 and [reason for _, reason in report.failed] == ["its name is not UTF-8: rename it"]
    assert '"a, b.png",' in (tmp_path / "out" / "frames.csv").read_text()


def write_film(path, count):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (WIDTH, HEIGHT))
    for k in range(count):
        writer.write(np.ascontiguousarray((image(k) * 255).round().byte().flip(0).permute(1, 2, 0).numpy()))
    writer.release()


def test_a_film_is_shared_and_continued(unit, pair, tmp_path):
    write_film(tmp_path / "film.avi", 12)
    single, shared = tmp_path / "single", tmp_path / "shared"
    report = reconstruct_dataset(unit, tmp_path / "film.avi", single, pictures=False)
    assert report.rows == 12 and (single / "film_000011_depth.png").is_file()
    process = torchrun(unit, tmp_path / "film.avi", "--out", shared, "--no-pictures")
    assert process.communicate(timeout=60)[0] is not None and process.returncode == 0
    assert contents(shared) == contents(single)
    for name in ("film_000003_depth.png", "film_000004_depth.png", "film_000009_depth.png"):
        (shared / name).unlink()
    report = reconstruct_dataset(unit, tmp_path / "film.avi", shared, pictures=False, workers=1)
    assert (report.rows, report.before, report.ranks[0][0]) == (12, 9, 3) and contents(shared) == contents(single)


def test_depth_beyond_a_png_is_left_out_and_a_full_disk_stops(unit, tmp_path, monkeypatch):
    source = fill(tmp_path / "in", ["a.png", "b.png"])

    def refuse(path, depth_mm):
        raise ValueError("depth_mm: too deep") if Path(path).name.startswith("a_") else OSError("no space left")

    monkeypatch.setattr(dataset, "write_depth_png", refuse)
    with pytest.raises(OSError, match="no space left"):
        reconstruct_dataset(unit, source, tmp_path / "out", pictures=False)
    monkeypatch.undo()
    lines = [json.loads(line) for log in (tmp_path / "out" / STATE).glob("log-*-0.jsonl") for line in log.read_text().splitlines()]
    assert lines[0]["failed"] == "depth_mm: too deep"
    report = reconstruct_dataset(unit, source, tmp_path / "out", pictures=False)
    assert report.rows == 2 and read_depth_png(tmp_path / "out" / "a_depth.png").shape == (1, 1, HEIGHT, WIDTH)


def test_pictures_are_drawn_for_few_frames_only(unit, frames, whole, tmp_path):
    assert not any(name.endswith("_picture.png") for name in whole)
    reconstruct_dataset(unit, fill(tmp_path / "in", ["a.png"]), tmp_path / "out")
    assert (tmp_path / "out" / "a_picture.png").stat().st_size > 5000


@pytest.mark.parametrize(
    "options, message",
    [
        ({"mode": "slow"}, "mode: expected one of fast, precise, auto, got 'slow'"),
        ({"depth": "jpg"}, "depth: expected one of png, npy, none"),
        ({"batch": 0}, "batch: expected"),
        ({"workers": -1}, "workers: expected"),
    ],
)
def test_impossible_options_are_refused(unit, tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        reconstruct_dataset(unit, tmp_path, tmp_path / "out", **options)


def test_an_empty_folder_is_refused(unit, tmp_path):
    (tmp_path / "in").mkdir()
    with pytest.raises(ValueError, match="no images or videos in this folder"):
        reconstruct_dataset(unit, tmp_path / "in", tmp_path / "out")
