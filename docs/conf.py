"""Sphinx settings of the documentation: `make docs` builds it from the pages here and the docstrings of the package."""

import importlib
import pkgutil
import sys
import warnings
from typing import Any

from docutils import nodes
from sphinx.pycode import ModuleAnalyzer

import torchvts
from torchvts.cli.main import COMMANDS, make_parser

warnings.filterwarnings("ignore")  # of libraries that autodoc imports; Sphinx's own stay errors

project = "torchvts"
author = "the authors of torchvts"
project_copyright = "the authors of torchvts, Apache-2.0"
version = release = torchvts.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "torchvts"
html_show_sphinx = False
html_static_path: list[str] = []

myst_heading_anchors = 3

autodoc_member_order = "groupwise"
autodoc_typehints_format = "short"
autodoc_default_options = {"members": True, "show-inheritance": True}
python_maximum_signature_line_length = 100
napoleon_custom_sections = ["Source"]
napoleon_use_ivar = True


def _short(name: str) -> str:
    return name.rpartition(".")[2]


def skip(app: Any, what: str, name: str, obj: Any, skipped: bool, options: Any) -> bool | None:
    """Leave out fields of tuples, which the class describes, and names of a package that torchvts exports."""
    if type(obj).__name__ == "_tuplegetter" or (what == "class" and isinstance(obj, type)):
        return True
    if what == "module" and app.env.docname != "api/torchvts" and name in torchvts.__all__:
        return True
    return None


def describe_constants(app: Any) -> None:
    """Give the constants that a package exports the texts beneath their definitions, where autodoc does not look."""
    for found in pkgutil.walk_packages(torchvts.__path__, "torchvts."):
        if found.ispkg:
            importlib.import_module(found.name)
    for package in [name for name, module in sys.modules.items() if name.startswith("torchvts.") and hasattr(module, "__all__")]:
        analyzer = ModuleAnalyzer.for_module(package)
        analyzer.analyze()
        for module in [name for name in sys.modules if name.startswith("torchvts.")]:
            for (holder, constant), text in ModuleAnalyzer.for_module(module).find_attr_docs().items():
                if not holder and constant in sys.modules[package].__all__:
                    analyzer.attr_docs.setdefault(("", constant), text)


def name_the_others(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Say on a package's page which of its names stand on the page of torchvts."""
    if what != "module" or name == "torchvts":
        return
    others = [other for other in getattr(obj, "__all__", []) if other in torchvts.__all__]
    if others:
        lines += ["", "Documented with :doc:`torchvts <torchvts>`: " + ", ".join(f":obj:`~torchvts.{o}`" for o in others) + ".", ""]


def resolve(app: Any, env: Any, node: Any, contnode: Any) -> Any:
    """Find the one object that a docstring means by a name without its module, or by the module that defines it."""
    if node.get("refdomain") != "py":
        return None
    python = env.domains["py"]
    found = [name for name in python.objects if _short(name) == _short(node["reftarget"])]
    if not found:
        return None
    target = min(found, key=lambda name: (name.count("."), name))
    entry = python.objects[target]
    uri = app.builder.get_relative_uri(node.get("refdoc", env.docname), entry.docname)
    reference = nodes.reference("", "", contnode, internal=True, reftitle=target)
    reference["refuri"] = f"{uri}#{entry.node_id}"
    return reference


def add_help(app: Any, docname: str, source: list[str]) -> None:
    """Append the help of every command to the page about the command line."""
    if docname != "command":
        return
    for name, text in COMMANDS.items():
        parser = make_parser(name, importlib.import_module(f"torchvts.cli.{name}"))
        source[0] += f"\n## {name}\n\n{text[0].upper()}{text[1:]}.\n\n```text\n{parser.format_help()}```\n"


def setup(app: Any) -> None:
    """Register the hooks."""
    app.connect("autodoc-skip-member", skip)
    app.connect("source-read", add_help)
    app.connect("builder-inited", describe_constants)
    app.connect("autodoc-process-docstring", name_the_others)
    app.connect("missing-reference", resolve)
