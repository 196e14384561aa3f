"""Runs the code and the commands of a document in order, as a reader would."""

import contextlib
import io
import re
import shlex
import subprocess
from pathlib import Path

import torch

from torchvts.cli.main import main


def blocks(path, kinds):
    """Fenced blocks of these kinds: (kind, text)."""
    return re.findall(rf"^```({'|'.join(kinds)})\n(.*?)^```", Path(path).read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def command(line):
    """Run a line of a shell, its torchvts in this process: a process of its own would load torch again. Returns what it prints."""
    line = re.sub(r"\$\((torchvts [^)]*)\)", lambda match: command(match[1]).strip(), line)
    words = shlex.split(line)
    if words[0] != "torchvts":
        return subprocess.run(words, check=True, capture_output=True, text=True).stdout
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        status = main(words[1:])
    assert status == 0, f"{line}: exit status {status}:\n{printed.getvalue()}"
    return printed.getvalue()


def run(path, names=()):
    """Run a document's ``python`` blocks, which share their names, and its ``bash`` blocks; returns the names.

    A document that goes on from an example is given the names of that.
    """
    torch.manual_seed(0)  # a document's networks start somewhere
    names = {**dict(names), "__name__": "document"}
    for kind, text in blocks(path, ("python", "bash")):
        if kind == "python":
            exec(compile(text, str(path), "exec"), names)
        else:
            for line in text.replace("\\\n", " ").splitlines():
                command(line)
    return names
