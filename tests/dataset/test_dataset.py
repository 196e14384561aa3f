"""Large data sets: every frame once and the same, whatever the workers, the processes, and wherever a run was killed."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from conftest import ROOT, bgr, tiny_image, write_film

import torchvts as vts
from torchvts import viz
from torchvts.core.files import read_depth_png
from torchvts.dataset import STATE, list_items, output_stems, reconstruct_dataset, writing

ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}


def fill(folder, names):
    for k, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        vts.write_image(folder / name, tiny_image(k))
    return folder


def film(path, count):
    return write_film(path, [bgr(tiny_image(k)) for k in range(count)])


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """40 images in folders and a film of 20 frames."""
    folder = fill(tmp_path_factory.mktemp("frames"), [f"{k // 15}/{k:03d}.png" for k in range(40)])
    film(folder / "film.avi", 20)
    return folder


@pytest.fixture(scope="module")
def whole(unit, frames, tmp_path_factory):
    """What one process makes of the frames when nothing disturbs it."""
    out = tmp_path_factory.mktemp("whole")
    report = reconstruct_dataset(unit, frames, out, workers=1)
    assert (report.rows, report.before, report.failed) == (60, 0, [])
    assert (out / "film_000019.npz").is_file()
    return contents(out)


def contents(out):
    """Every result with its bytes; nothing half written is beside them."""
    return {str(p.relative_to(out)): p.read_bytes() for p in sorted(out.rglob("*")) if p.is_file() and STATE not in p.parts}


def finished(out):
    """Number of frames that are done."""
    return len(list(out.rglob("*.npz")))


TORCHRUN = ("torch.distributed.run", "--standalone", "--nproc_per_node=2", "-m")


def started(launcher, *arguments):
    command = [sys.executable, "-m", *launcher, "torchvts", "reconstruct", *arguments]
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


def wait_for(condition, process):
    deadline = time.monotonic() + 900.0
    while not condition():
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_workers_do_not_matter(unit, frames, whole, tmp_path):
    reconstruct_dataset(unit, frames, tmp_path, workers=2)
    assert contents(tmp_path) == whole


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="finds processes through /proc")
@pytest.mark.parametrize("killed", ["the only", *(pytest.param(some, marks=pytest.mark.long) for some in ("all", "one"))])
def test_killed_processes_lose_nothing_and_the_next_run_goes_on(unit, frames, whole, tmp_path, run_script, killed):
    out = tmp_path / "out"
    launcher = () if killed == "the only" else TORCHRUN
    first = started(launcher, unit, frames, "--out", out, "--workers", 1)
    wait_for(lambda: finished(out) >= 10, first)
    processes = family(first.pid)
    for pid in [max(processes)] if killed == "one" else processes:
        with contextlib.suppress(ProcessLookupError):  # its parent's death may have ended it
            os.kill(pid, signal.SIGKILL)
    first.communicate()
    done = finished(out)
    assert first.returncode != 0 and 10 <= done < 60 and not (out / "frames.csv").exists()
    if killed == "one":  # any number of processes may go on
        report = reconstruct_dataset(unit, frames, out, workers=1)
        assert report.rows == 60 and 0 < report.before <= done
    else:
        if killed == "the only":
            second = run_script("reconstruct", unit, frames, "--out", out)
            printed = second.stdout + second.stderr
        else:
            second = started(launcher, unit, frames, "--out", out)
            printed = second.communicate()[0]
        assert second.returncode == 1 and "in doubt: 20 of 60 frames" in printed, printed  # the film is compressed
        assert "wrote 60 frames" in printed and "by an earlier run" in printed
    written = contents(out)
    assert written.pop("sheet.png", b"")  # the command draws it
    assert written == whole


def test_pictures_of_a_run_have_one_exaggeration_and_depths_of_their_own(unit, tmp_path, monkeypatch):
    for k, name in ((0, "a"), (49, "b")):  # 0.5 and 0.99 mm
        (tmp_path / "in").mkdir(exist_ok=True)
        vts.write_image(tmp_path / "in" / f"{name}.png", tiny_image(k))
    drawn = []
    save = viz.save_figure
    monkeypatch.setattr(viz, "save_figure", lambda figure, path: (drawn.append(figure), save(figure, path)))
    reconstruct_dataset(unit, tmp_path / "in", tmp_path / "out", workers=1)
    surfaces = [figure.axes[2] for figure in drawn]
    assert len({axes.get_title() for axes in surfaces}) == 1 and "height x " in surfaces[0].get_title()
    assert surfaces[1].get_zlim()[1] > 1.5 * surfaces[0].get_zlim()[1]


def test_a_torn_record_a_lost_file_and_a_changed_image_are_computed_again(unit, tmp_path):
    source = fill(tmp_path / "in", [f"{k}.png" for k in range(6)])
    film(source / "film.avi", 6)
    out = tmp_path / "out"
    reconstruct_dataset(unit, source, out, pictures=False)
    before = contents(out)
    record = out / STATE / "frames" / "5.json"
    record.write_bytes(record.read_bytes()[:-10])
    (out / "2.npz").unlink()
    (out / "film_000003.npz").write_bytes(b"")
    (out / ".3-abcd0123.npz").write_bytes(b"left half written")
    vts.write_image(source / "4.png", tiny_image(17))
    report = reconstruct_dataset(unit, source, out, pictures=False)
    assert (report.rows, report.before) == (12, 8)
    after = contents(out)
    assert after.keys() == before.keys()
    changed = {name for name in before if after[name] != before[name]}
    assert changed == {"4.npz", "frames.csv"}


def test_other_settings_are_refused_and_overwrite_begins_anew(unit, tmp_path):
    source, out = fill(tmp_path / "in", ["a.png"]), tmp_path / "out"
    reconstruct_dataset(unit, source, out, mode="fast", pictures=False)
    other = tmp_path / "other.safetensors"
    calibration = vts.Calibration.load(unit)
    vts.Calibration.from_lights(calibration.lights, calibration.sensor).save(other)
    for calibration, options, part in (
        (unit, {"mode": "precise"}, "mode 'fast' then, 'precise' now: give another --out, or --overwrite"),
        (unit, {"mode": "fast", "format": "npy"}, "format 'npz' then, 'npy' now"),
        (unit, {"mode": "fast", "pictures": True}, "pictures 'False' then, 'True' now"),
        (other, {"mode": "fast"}, f"on {time.strftime('%Y-%m-%d')} "),
        (other, {"mode": "fast"}, ": another calibration than then, or its file was written anew: give another --out"),
    ):
        with pytest.raises(ValueError, match="was begun with other settings") as caught:
            reconstruct_dataset(calibration, source, out, **options)
        assert part in str(caught.value)
    with pytest.raises(ValueError, match=r"holds the results of .*, not of .*: give each input another --out"):
        reconstruct_dataset(unit, fill(tmp_path / "second", ["b.png"]), out, mode="fast", pictures=False)
    report = reconstruct_dataset(unit, source, out, mode="precise", format="npy", pictures=False, overwrite=True)
    assert (report.rows, report.before) == (1, 0)
    assert sorted(contents(out)) == ["a_depth.npy", "frames.csv", "summary.json"]  # a.npz is gone
    assert json.loads((out / "summary.json").read_text())["metric"] is True


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
    for k in range(20, 27):
        (source / f"{k}.png").write_bytes(b"no image")
    assert len(reconstruct_dataset(unit, source, out, pictures=False).failed) == 10
    assert capsys.readouterr().err.count("left out ") == 5
    for k in range(20, 27):
        (source / f"{k}.png").unlink()
    with pytest.raises(ValueError, match=r"1\.png: .*not an image"):
        reconstruct_dataset(unit, source, tmp_path / "strict", strict=True)
    fill(source, [f"{k}.png" for k in range(5)])
    (source / "film.avi").unlink()
    report = reconstruct_dataset(unit, source, out, pictures=False)
    assert report.failed == [] and report.rows == 5 and not (out / "failed.csv").exists()


def test_a_video_of_unusable_frames_goes_on(unit, tmp_path):
    source = fill(tmp_path / "in", ["a.png"])
    vts.write_image(source / "b.png", tiny_image(3) / 16)
    write_film(source / "film.avi", [bgr(tiny_image(k if k > 13 else -1 - k) * (k != 15)) for k in range(18)])
    report = reconstruct_dataset(unit, source, tmp_path / "out", pictures=False)
    assert [name for name, _ in report.failed] == ["b.png", "film_000015"] and report.rows == 18
    assert "6% of the background's brightness" in report.failed[0][1] and "one colour" in report.failed[1][1]
    rows = [line.split(",") for line in (tmp_path / "out" / "frames.csv").read_text().splitlines()[2:]]
    assert [float(row[1]) > 0 for row in rows] == [False] * 14 + [True] * 3


def test_a_video_that_starts_in_contact_is_noted_and_loses_nothing(unit, tmp_path):
    (tmp_path / "in").mkdir()
    film(tmp_path / "in" / "film.avi", 14)
    report = reconstruct_dataset(unit, tmp_path / "in", tmp_path / "out", pictures=False)
    assert report.rows == 14 and report.failed == []
    name, note = report.notes[0]
    assert name == "film.avi" and "the calibration is used as it is: background: " in note
    short = reconstruct_dataset(unit, tmp_path / "in", tmp_path / "long", pictures=False, background_frames=40)
    assert "expected at least 40 frames, got 14" in short.notes[0][1] and short.rows == 14


def test_frames_in_another_light_are_named(unit, tmp_path):
    """An LED fails under a contact: its depth may be 0, and no frame is left out."""
    off = torch.tensor([0.0, 1.0, 1.0]).reshape(3, 1, 1)
    (tmp_path / "images").mkdir()
    for k, name in enumerate(("a.png", "b.png", "c.png")):
        vts.write_image(tmp_path / "images" / name, tiny_image(k) * (off if k else 1.0))
    report = reconstruct_dataset(unit, tmp_path / "images", tmp_path / "out", pictures=False)
    assert [name for name, _ in report.doubted] == ["b.png", "c.png"] and report.rows == 3
    assert all("channel R is black" in doubt and "check the LEDs" in doubt for _, doubt in report.doubted)
    assert vts.read_result(tmp_path / "out" / "b.npz").frame_doubts == [report.doubted[0][1]]
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["doubted_frames"] == 2
    assert reconstruct_dataset(unit, tmp_path / "images", tmp_path / "out", pictures=False).doubted == report.doubted  # all done
    pictures = [bgr(tiny_image(-1 - k)) for k in range(14)] + [bgr(tiny_image(k) * (off if k > 3 else 1.0)) for k in range(8)]
    (tmp_path / "film").mkdir()
    write_film(tmp_path / "film" / "film.avi", pictures)
    report = reconstruct_dataset(unit, tmp_path / "film", tmp_path / "films", pictures=False)
    rows = (tmp_path / "films" / "frames.csv").read_text().splitlines()[1:]
    assert ["channel R is black" in row for row in rows] == [False] * 18 + [True] * 4 and report.rows == 22


def test_a_video_that_is_cut_short_is_named(unit, tmp_path):
    (tmp_path / "in").mkdir()
    whole = film(tmp_path / "in" / "film.avi", 40)
    content = whole.read_bytes()
    whole.write_bytes(content[: int(0.6 * len(content))])
    report = reconstruct_dataset(unit, tmp_path / "in", tmp_path / "out", pictures=False, background_frames=0)
    assert [name for name, text in report.failed if "cut short? it announces 40 frames" in text] == [
        "film.avi"
    ] and report.rows < 30
    assert reconstruct_dataset(unit, tmp_path / "in", tmp_path / "out", pictures=False, background_frames=0).failed == report.failed


def test_the_script_ends_with_status_1_where_a_frame_was_left_out(unit, tmp_path, run_script):
    source = fill(tmp_path / "in", ["a.png", "b.png"])
    (source / "b.png").write_bytes(b"")
    done = run_script("reconstruct", unit, source, "--out", tmp_path / "out", "--no-pictures")
    assert done.returncode == 1 and "1 left out, all of them in" in done.stdout and "wrote 1 frame to" in done.stdout
    assert done.stderr.count("left out b.png: ") == 1 and "b.png" not in done.stdout and "table in frames.csv" in done.stdout


def test_the_callers_threads_are_as_before(unit, tmp_path):
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        reconstruct_dataset(unit, fill(tmp_path / "in", ["a.png"]), tmp_path / "out", pictures=False)
        assert torch.get_num_threads() == 2
        with pytest.raises(ValueError, match="begun with other settings"):
            reconstruct_dataset(unit, tmp_path / "in", tmp_path / "out", pictures=False, mode="fast", every=2)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_same_stems_keep_apart_and_folders_stay(unit, tmp_path):
    names = ["a.bmp", "a.png", "sub/a.png", "sub/deeper/a.png"]
    source, out = fill(tmp_path / "in", names), tmp_path / "in" / "out"
    for _ in range(2):  # results inside the source are no sources
        report = reconstruct_dataset(unit, source, out, pictures=False)
        assert (report.rows, report.failed) == (4, [])
    results = sorted(name for name in contents(out) if name.endswith(".npz"))
    assert results == ["a.bmp.npz", "a.png.npz", "sub/a.npz", "sub/deeper/a.npz"]
    assert [line.split(",")[0] for line in (out / "frames.csv").read_text().splitlines()[1:]] == names
    with pytest.raises(ValueError, match="is the source itself"):
        reconstruct_dataset(unit, source, source)


def test_listing_is_sorted_by_folder_and_name(tmp_path):
    names = ["b.png", "a/z.png", "a.png", "a/b/c.PNG", "a-b.png", ".hidden.png", "notes.txt"]
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    paths = [item.path for item in list_items(tmp_path)]
    assert paths == ["a/b/c.PNG", "a/z.png", "a-b.png", "a.png", "b.png"] and paths == sorted(paths, key=lambda p: p.split("/"))


def test_an_image_whose_name_is_no_text_is_read_and_such_a_video_left_out(unit, tmp_path):
    source = fill(tmp_path / "in", ["a, b.png"])
    try:
        (source / os.fsdecode(b"bad\xff.png")).write_bytes((source / "a, b.png").read_bytes())
    except OSError:
        pytest.skip("this file system takes UTF-8 names only")
    (source / os.fsdecode(b"film\xff.avi")).write_bytes(b"RIFF")
    report = reconstruct_dataset(unit, source, tmp_path / "out", pictures=False)
    assert report.rows == 2 and "expected a name in UTF-8, which OpenCV needs, got" in report.failed[0][1]
    assert (tmp_path / "out" / os.fsdecode(b"bad\xff.npz")).is_file()
    table = (tmp_path / "out" / "frames.csv").read_text()
    assert '"a, b.png",' in table and "bad\\udcff.png," in table


def test_depth_beyond_a_png_is_left_out_and_a_full_disk_stops(unit, tmp_path, monkeypatch):
    source = fill(tmp_path / "in", ["a.png", "b.png"])

    def refuse(path, depth_mm):
        raise ValueError("depth_mm: too deep") if Path(path).name.startswith("a_") else OSError("no space left")

    monkeypatch.setattr(writing, "write_depth_png", refuse)
    with pytest.raises(OSError, match="no space left"):
        reconstruct_dataset(unit, source, tmp_path / "out", pictures=False, format="png16")
    monkeypatch.undo()
    assert '"failed": "depth_mm: too deep"' in (tmp_path / "out" / STATE / "frames" / "a.json").read_text()
    report = reconstruct_dataset(unit, source, tmp_path / "out", pictures=False, format="png16")
    assert report.rows == 2 and read_depth_png(tmp_path / "out" / "a_depth.png").shape == (1, 1, 48, 64)


def test_an_empty_folder_is_refused(unit, tmp_path):
    (tmp_path / "in").mkdir()
    with pytest.raises(ValueError, match="no images or videos in this folder"):
        reconstruct_dataset(unit, tmp_path / "in", tmp_path / "out")


@pytest.fixture
def run(unit, tmp_path):
    """Reconstructs two images of ``in`` into ``out``; both folders are in ``folder``."""
    fill(tmp_path / "in", ["a.png", "b.png"])

    def reconstruct(**options):
        return reconstruct_dataset(unit, tmp_path / "in", tmp_path / "out", **{"pictures": False, "workers": 1, **options})

    reconstruct.folder = tmp_path
    return reconstruct


@pytest.mark.parametrize("damage", [b"{", b"[]", b'{"mark": [1, 2]}', b'{"mark": 3}', b"[" * 10_000, b"\xff\x00"])
def test_a_damaged_record_is_done_again(run, damage):
    run()
    for record in (run.folder / "out" / STATE / "frames").glob("a*.json"):
        mark = json.loads(record.read_bytes())["mark"]
        record.write_bytes(damage.replace(b"[1, 2]", json.dumps(mark).encode()))
    report = run()
    assert (report.rows, report.before) == (2, 1)


def test_overwriting_leaves_no_old_files_beside_new_ones(run):
    run(format="npy")
    (run.folder / "out" / "notes.txt").write_text("the user's own")
    before = contents(run.folder / "out").keys()
    run(format="none", overwrite=True)
    after = contents(run.folder / "out").keys()
    assert before - after == {"a_depth.npy", "b_depth.npy"} and {"frames.csv", "notes.txt"} <= after


def test_names_do_not_break_tables_and_links_do_not_end_a_run(run):
    source = run.folder / "in"
    content = (source / "a.png").read_bytes()
    for name in ("=1+1.png", "-2.png", "two\nlines.png", "cr\r.png", "tab\t.png"):
        (source / name).write_bytes(content)
    (source / "loop.png").symlink_to(source / "loop.png")
    (source / "loop").symlink_to(source / "loop")
    (source / "gone.png").symlink_to(source / "nowhere")
    report = run()
    assert report.rows == 7 and sorted(name for name, _ in report.failed) == ["gone.png", "loop.png"]
    lines = (run.folder / "out" / "frames.csv").read_text(encoding="utf-8").splitlines()
    assert {"'=1+1.png", "'-2.png", "two\\nlines.png", "cr\\r.png", "tab\\t.png"} <= {line.split(",")[0] for line in lines}


def test_no_two_files_of_a_folder_share_a_stem():
    names = ["a.png", "A.jpg", "a.png.bmp", "film.avi", "film_000001.png", "film.mp4", "b.png"]
    stems = output_stems(names)
    assert len(set(stems.values())) == len(names) and stems["film_000001.png"] == "film_000001.png"


def test_folders_above_keep_results_within_and_files_come_once(tmp_path, monkeypatch):
    fill(tmp_path / "data", ["x.png", "inner/y.png"])
    monkeypatch.chdir(tmp_path / "data" / "inner")
    assert [item.stem for item in list_items((Path(".."), Path("y.png"), Path(".")))] == ["data/inner/y", "data/x"]
    assert [item.stem for item in list_items((Path("."), Path("../x.png")))] == ["inner/y", "x"]


def test_doubts_stand_in_every_output_and_not_metric_once_in_print(unit, tmp_path, run_script, monkeypatch):
    calibration = vts.Calibration.load(unit)
    doubt, unchecked = "background: it is odd: take it again", "not checked: no image shows the scale"
    report = calibration.report | {"doubts": [doubt, unchecked], "not_metric": [doubt]}
    calibration = vts.Calibration.from_lights(calibration.lights, calibration.sensor, calibration.background, report)
    calibration.save(tmp_path / "odd.safetensors")
    duller = 0.9 * tiny_image(30) + 0.1 * tiny_image(30).mean(0)  # a smaller saturation of the colours
    vts.write_image(tmp_path / "a.png", duller)
    done = run_script("reconstruct", tmp_path / "odd.safetensors", tmp_path / "a.png", "--out", tmp_path / "out")
    assert done.returncode == 1 and done.stdout.count("NOT METRIC") == 1 and "(not in mm)" in done.stdout, done.stdout
    assert done.stdout.count(doubt) == 1 and "in doubt: 1 of 1 frames" in done.stdout and ", IN DOUBT" in done.stdout
    result = vts.read_result(tmp_path / "out" / "a.npz")
    assert not result.metric and result.doubts == [doubt, unchecked] and "the light is not that" in result.frame_doubts[0]
    assert "NOT METRIC" in repr(result) and "1 IN DOUBT" in repr(result)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["metric"], summary["doubts"], summary["doubted_frames"]) == (False, [doubt, unchecked], 1)
    assert result.frame_doubts[0] in (tmp_path / "out" / "frames.csv").read_text()
    drawn = []
    monkeypatch.setattr(viz, "save_figure", lambda figure, path: (drawn.append(figure), Path(path).touch()))
    for cloud in ("ply", "pcd", "obj"):
        options = {"cloud": cloud, "pictures": cloud == "ply", "workers": 1}
        reconstruct_dataset(tmp_path / "odd.safetensors", tmp_path / "a.png", tmp_path / cloud, **options)
        head = (tmp_path / cloud / f"a.{cloud}").read_bytes()[:500]
        assert b"; NOT METRIC; IN DOUBT: the light is not that" in head
    title, said = drawn[0].texts
    assert title.get_text() == "a.png, NOT METRIC"
    assert said.get_text().startswith(f"{doubt}\nIN DOUBT: the light is not") and unchecked not in said.get_text()
