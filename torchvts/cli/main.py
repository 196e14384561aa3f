"""Finds the subcommand, runs it, and turns what goes wrong into one line and an exit status."""

import argparse
import importlib
import os
import sys
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

from ..core import __version__
from ..core.checks import in_one_line
from ..core.spelling import suggest
from .parser import HelpFormatter, Parser, UsageError, wrapped

COMMANDS = {
    "calibrate": "calibrate a unit from its own images",
    "reconstruct": "depth of images, folders and videos, in files",
    "stream": "depth of a camera or a recording, frame by frame, into files",
    "view": "live 3D view of a camera or a recording",
    "pose": "pose of a pressed object relative to a reference press",
    "track": "pose of a touched object in every frame of a camera or a recording",
    "diagnose": "what is wrong with a frame or its calibration",
    "export": "files that run without torchvts: TorchScript, ONNX and others",
    "train": "train gs_sdk's network on presses of balls",
    "samples": "images of a real sensor to try the commands on",
}
"""Subcommand: what it does. Its module has its name; it is imported only where it is asked for."""

FAILED, USAGE_OR_INPUT, BUG, INTERRUPTED = 1, 2, 70, 130
"""Exit statuses, as docs/command.md explains them; FAILED also where nobody reads the output."""

PACKAGE = f"{Path(__file__).parents[1]}{os.sep}"


def overview() -> str:
    """The text of ``torchvts --help``."""
    rows = "\n".join(f"  {name:<12} {text}" for name, text in COMMANDS.items())
    return f"""usage: torchvts COMMAND ...

Camera images of visual-tactile sensors into depth, normals, contact and pose.

{rows}

example:
  torchvts calibrate background.png --sensor gelsight_mini --out unit.safetensors
  torchvts reconstruct unit.safetensors press.png --out out/press

torchvts COMMAND --help explains a command; torchvts --version prints the version."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a subcommand by the words after ``torchvts``, None for those of the process; returns the exit status.

    Example:
        >>> main(["--version"])  # doctest: +ELLIPSIS
        torchvts ...
        0
    """
    words = list(sys.argv[1:] if argv is None else argv)
    if not words or words[0] in ("-h", "--help", "help"):
        print(overview())
        return 0 if words else USAGE_OR_INPUT
    if words[0] == "--version":
        print(f"torchvts {__version__}")
        return 0
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")  # before it is loaded: a camera that does not open is one line, ours
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # quiet: so is a video that does not open
    debug = "--debug" in words
    words = [word for word in words if word != "--debug"]
    try:
        with _plain_warnings():
            return _run(words)
    except KeyboardInterrupt:
        return _say("stopped", INTERRUPTED, debug)
    except BrokenPipeError:  # the reader of the output has gone, as head does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except Exception as error:
        text = in_one_line(error)
        if _is_refusal(error):
            return _say(f"error: {text}", USAGE_OR_INPUT, debug)
        text = f"error: {type(error).__name__}: {text}: a bug in torchvts: please report it with the lines above"
        return _say(text, BUG, debug=True)


def _is_refusal(error: Exception) -> bool:
    """Whether an error is about the request, the input or the machine: a statement ``raise`` of torchvts, or no file or memory.

    What Python or torch raises within torchvts, torchvts has not foreseen.
    """
    if isinstance(error, OSError | ImportError | MemoryError) or (isinstance(error, RuntimeError) and "allocate" in str(error)):
        return True
    last = traceback.extract_tb(error.__traceback__)[-1]
    return last.filename.startswith(PACKAGE) and (not last.line or last.line.startswith("raise"))


def _run(words: list[str]) -> int:
    name = words[0]
    if name not in COMMANDS:
        raise UsageError(f"expected a command ({', '.join(COMMANDS)}), got {name!r}{suggest(name, COMMANDS)}")
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")  # names of files may not be text
    module = importlib.import_module(f"{__package__}.{name}")
    return int(module.run(make_parser(name, module).parse_intermixed_args(words[1:])))


def make_parser(name: str, module: ModuleType) -> Parser:
    """The parser of a subcommand."""
    parser = Parser(
        prog=f"torchvts {name}",
        usage=wrapped(f"usage: torchvts {name} {module.USAGE}", indent=" " * 7).removeprefix("usage: "),
        description=wrapped(module.__doc__ or ""),
        formatter_class=HelpFormatter,
        allow_abbrev=False,
    )
    module.add_arguments(parser)
    parser.add_argument("--debug", action="store_true", help=argparse.SUPPRESS)
    return parser


def _say(text: str, status: int, debug: bool) -> int:
    if debug:
        traceback.print_exc()
    print(f"torchvts: {text}", file=sys.stderr)
    return status


@contextmanager
def _plain_warnings() -> Iterator[None]:
    """Warnings as one line each, without the place in the code that raised them."""

    def show(message: Warning | str, *_: object) -> None:
        print(f"torchvts: warning: {' '.join(str(message).split())}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.showwarning = show  # type: ignore[assignment]  # it takes what the warning's place is, and leaves it out
        yield
