"""The documentation: every page and picture exists, every public name is in the reference, and it builds without a warning."""

import importlib
import pkgutil
import re
import subprocess
import sys
import zlib
from types import ModuleType

import pytest
import yaml
from conftest import ROOT
from PIL import Image

import torchvts as vts
from torchvts.cli.main import COMMANDS, make_parser

DOCS = ROOT / "docs"
PAGES = [*DOCS.glob("*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]


def packages():
    """Every package of torchvts, and every module that its package exports, with what is public there: (name, public names)."""
    found = [vts, *(importlib.import_module(one.name) for one in pkgutil.walk_packages(vts.__path__, "torchvts.") if one.ispkg)]
    found += [value for package in found for value in vars(package).values() if isinstance(value, ModuleType)]
    named = {one.__name__: list(getattr(one, "__all__", [])) for one in found if one.__name__.startswith("torchvts")}
    return {name: public for name, public in named.items() if public and name != "torchvts.cli"}


def names_of(package, public):
    """Where the reference may have each name of a package, its submodules left out: they are packages of their own."""
    for name in public:
        if not isinstance(getattr(importlib.import_module(package), name), ModuleType):
            yield {f"torchvts.{name}", f"{package}.{name}"} if name in vts.__all__ else {f"{package}.{name}"}


def test_every_package_has_a_page_of_the_reference():
    pages = "\n".join(path.read_text() for path in (DOCS / "api").glob("*.md"))
    shown = set(re.findall(r"(?:automodule|currentmodule):: (\S+)", pages))
    assert set(packages()) <= shown


def test_links_and_pictures_exist():
    for path in [*PAGES, *DOCS.glob("api/*.md")]:
        for link in re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", path.read_text()):
            assert (path.parent / link).exists(), f"{path.name}: {link}"


def rows_of(table):
    """Cells of the learning curve's table in a text, in one order of columns."""
    lines = [[cell.strip() for cell in line.strip().strip("|").split("|")] for line in table.splitlines() if line.startswith("|")]
    at = next(k for k, line in enumerate(lines) if "without tilt um" in line)
    wanted = [
        lines[at].index(head) for head in ("given", "number", "normals deg", "relief um", "without tilt um", "radius %, median")
    ]
    return [[line[k] for k in wanted] for line in lines[at + 2 :] if len(line) == len(lines[at])]


def test_the_learning_curve_shows_the_table_beside_it():
    with Image.open(DOCS / "learning_curve.png") as picture:
        drawn = rows_of(picture.text["Description"])
    assert drawn == rows_of((DOCS / "calibration.md").read_text())


def commands(text):
    """What a document says to type: (subcommand of torchvts, the words after it)."""
    fenced = re.findall(r"^```(?:bash)?\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    code = "\n".join([*fenced, *re.findall(r"^ {4}(.*)$", text, re.MULTILINE), *re.findall(r"`([^`\n]+)`", text)])
    return re.findall(r"(?:^|\$\(|-m )torchvts ([a-z]+)(.*)$", code.replace("\\\n", " "), re.MULTILINE)


def test_commands_of_the_documents_can_be_typed():
    found = [(path.name, *words) for path in PAGES for words in commands(path.read_text())]
    assert len(found) > 20
    for name, subcommand, rest in found:
        assert subcommand in COMMANDS, f"{name}: torchvts {subcommand}"
        options = make_parser(subcommand, importlib.import_module(f"torchvts.cli.{subcommand}"))._option_string_actions
        assert set(re.findall(r"(?<!\S)--[a-z-]+", rest)) <= set(options), f"{name}: torchvts {subcommand}{rest}"
    for path in PAGES:
        for script in re.findall(r"(?:scripts|examples)/\w+\.py", path.read_text()):
            assert (ROOT / script).is_file(), f"{path.name}: {script}"


def test_code_and_help_fit_into_88_columns():
    for path in PAGES:
        blocks = "".join(re.findall(r"^```.*?\n(.*?)^```", path.read_text(), re.DOTALL | re.MULTILINE))
        assert [line for line in blocks.splitlines() if len(line) > 88] == [], path.name
    for name in COMMANDS:
        parser = make_parser(name, importlib.import_module(f"torchvts.cli.{name}"))
        assert [line for line in parser.format_help().splitlines() if len(line) > 88] == [], name


def test_the_citation_names_this_version_and_the_paper():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == vts.__version__ and citation["license"] == "Apache-2.0" and citation["authors"]
    assert citation["references"][0]["doi"] == "10.3390/s22176470"


@pytest.mark.long
def test_every_public_name_is_in_the_reference(tmp_path):
    pytest.importorskip("sphinx", reason="Sphinx is not installed: make setup installs it")
    command = [sys.executable, "-m", "sphinx", "--fail-on-warning", "--keep-going", "--quiet", str(DOCS), str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-4000:]
    inventory = zlib.decompress((tmp_path / "objects.inv").read_bytes().split(b"\n", 4)[4]).decode()
    shown = {line.split()[0] for line in inventory.splitlines() if " py:" in line}
    wanted = [places for package, public in packages().items() for places in names_of(package, public)]
    assert len(wanted) > 100
    assert [places for places in wanted if not places & shown] == []


@pytest.mark.long
def test_the_picture_of_readme_is_drawn(data, run_script, tmp_path):
    done = run_script("hero", "--data", data, "--out", tmp_path / "hero.png")
    assert done.returncode == 0, done.stderr
    assert "12 presses of the other ball" in done.stdout
    picture = vts.read_image(tmp_path / "hero.png")
    committed = vts.read_image(DOCS / "hero.png")
    assert picture.shape == committed.shape
    assert float((picture - committed).abs().mean()) < 0.02


def test_the_picture_of_readme_needs_its_presses(run_script, tmp_path):
    done = run_script("hero", "--data", tmp_path)
    assert done.returncode == 2 and "expected presses in" in done.stderr
