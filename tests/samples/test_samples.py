"""Samples are fetched into a cache from a folder or a server, whole and as published, or not at all."""

import functools
import hashlib
import http.server
import json
import threading
from pathlib import Path

import pytest
import torch

import torchvts as vts
from torchvts import samples
from torchvts.samples import fetch


@pytest.fixture
def published(tmp_path, monkeypatch):
    """A folder in the layout of the sample, whose few files are the listed ones, and an empty cache."""
    folder = tmp_path / "published"
    images = {"background.png": 0.4, "6.310mm/0/gelsight.png": 0.5, "9.500mm/3/gelsight.png": 0.6}
    for path, level in images.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        vts.write_image(folder / path, torch.full((3, 16, 24), level))
    listed = samples.read_sample("gelsight_mini")
    digests = {path: hashlib.sha256((folder / path).read_bytes()).hexdigest() for path in images}
    sample = fetch.Sample(**{**vars(listed), "sha256": digests, "diameter_mm": {"6.310mm/0": 6.31, "9.500mm/3": 9.5}})
    monkeypatch.setattr(fetch, "read_sample", lambda name: sample)
    monkeypatch.setenv("TORCHVTS_CACHE", str(tmp_path / "cache"))
    return folder


@pytest.fixture
def server(published):
    """A server on the loopback address that gives the folder, and counts what it is asked for."""
    asked = []

    class Handler(http.server.SimpleHTTPRequestHandler):
        def do_GET(self):
            asked.append(self.path)
            super().do_GET()

        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=published)) as one:
        thread = threading.Thread(target=one.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{one.server_address[1]}", asked
        one.shutdown()
        thread.join()


def test_a_folder_gives_presses_licence_and_catalog(published, run_script):
    assert samples.cached_sample() is None
    done = run_script("samples", "gelsight_mini", "--from", published)
    assert done.returncode == 0, done.stderr
    folder = samples.cached_sample()
    assert done.stdout == f"{folder}\n" and "MIT" in done.stderr
    background, presses = vts.read_presses(folder)
    assert background.shape == (3, 16, 24) and [press.ball_diameter_mm for press in presses] == [6.31, 9.5]
    licence = (folder / "LICENCE.txt").read_text()
    assert "rpl-cmu/gelslam" in licence and "Permission is hereby granted" in licence


def test_a_server_gives_each_file_once(server, monkeypatch):
    address, asked = server
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    folder = samples.fetch_sample("gelsight_mini", address)
    assert sorted(asked) == ["/6.310mm/0/gelsight.png", "/9.500mm/3/gelsight.png", "/background.png"]
    (folder / "background.png").unlink()
    assert samples.fetch_sample("gelsight_mini", address) == folder and len(asked) == 4
    with pytest.raises(FileNotFoundError, match="the server answers 404"):
        (folder / "background.png").unlink()
        samples.fetch_sample("gelsight_mini", f"{address}/nothing")


def test_a_changed_file_is_refused_and_not_kept(published):
    (published / "9.500mm/3/gelsight.png").write_bytes(b"something else")
    with pytest.raises(ValueError, match=r"9\.500mm/3/gelsight\.png: expected sha256 [0-9a-f]{64}, got .*: the copy is damaged"):
        samples.fetch_sample("gelsight_mini", published)
    assert samples.cached_sample() is None
    assert sorted(p.name for p in samples.cache_folder().rglob("*") if p.is_file()) == ["background.png", "gelsight.png"]


def test_what_cannot_be_reached_names_the_way_that_works(published, run_script, monkeypatch):
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    for source, part in (
        ("http://127.0.0.1:9", "name it by --from"),
        ("ftp://127.0.0.1/x", "expected a folder, or an address that begins with https://"),
        (published / "none", "--from names the folder that holds background.png"),
    ):
        done = run_script("samples", "--from", source)
        assert done.returncode == 2 and done.stderr.startswith("torchvts: error: ") and part in done.stderr, done.stderr
        assert len(done.stderr.splitlines()) == 1


def test_the_cache_is_where_the_environment_says(monkeypatch, tmp_path):
    monkeypatch.setenv("TORCHVTS_CACHE", str(tmp_path / "own"))
    assert samples.cache_folder() == tmp_path / "own"
    monkeypatch.delenv("TORCHVTS_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert samples.cache_folder() == tmp_path / "torchvts"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert samples.cache_folder() == Path.home() / ".cache" / "torchvts"


def test_the_list_is_of_one_commit_and_matches_the_images_at_hand(data):
    listed = json.loads((Path(fetch.__file__).parent / "gelsight_mini.json").read_text())
    assert listed["commit"] in listed["url"] and len(listed["commit"]) == 40
    folder = data / "gelsight_mini_a"
    found = {path: hashlib.sha256((folder / path).read_bytes()).hexdigest() for path in listed["sha256"]}
    assert found == listed["sha256"]
