"""argparse with one-line errors that name the option that was probably meant."""

import argparse
import shutil
import textwrap
from typing import Any, NoReturn

from ..core.spelling import suggest

COLUMNS = 88
"""Width of help where the terminal is no narrower."""


def wrapped(text: str, indent: str = "") -> str:
    """Text in lines of at most :data:`COLUMNS`: paragraphs are filled, lines that begin with a space stay as they are."""
    paragraphs = [
        block if "\n " in f"\n{block}" else textwrap.fill(block, COLUMNS, subsequent_indent=indent, break_on_hyphens=False)
        for block in text.split("\n\n")
    ]
    return "\n\n".join(paragraphs)


class UsageError(ValueError):
    """A request that a subcommand does not understand."""


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Help that stays short: options and their text on one line, IMAGE... in place of IMAGE [IMAGE ...]."""

    def __init__(self, prog: str) -> None:
        width = min(shutil.get_terminal_size().columns, COLUMNS + 2) - 2
        super().__init__(prog, max_help_position=28, width=width)

    def _format_args(self, action: argparse.Action, default_metavar: str) -> str:
        if action.nargs == argparse.ONE_OR_MORE:
            return f"{self._metavar_formatter(action, default_metavar)(1)[0]}..."
        return super()._format_args(action, default_metavar)


class Parser(argparse.ArgumentParser):
    """A parser that raises :class:`UsageError` instead of printing its usage and ending the process."""

    def error(self, message: str) -> NoReturn:
        """Raise with the message, the option that was probably meant, and where the options are explained."""
        if message.startswith("unrecognized arguments: "):
            word = message.split()[2]
            kind = "unknown option" if word.startswith("-") else "one argument too many:"
            message = f"{kind} {word!r}{suggest(word, self._option_string_actions)}"
        raise UsageError(f"{message} ({self.prog} --help explains)")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            choices = [str(choice) for choice in action.choices]
            raise argparse.ArgumentError(action, f"expected {', '.join(choices)}, got {value!r}{suggest(str(value), choices)}")
