"""argparse with one-line errors that name the option that was probably meant."""

import argparse
from typing import Any, NoReturn

from ..core.spelling import suggest


class UsageError(ValueError):
    """A request that a subcommand does not understand."""


class Parser(argparse.ArgumentParser):
    """A parser that raises :class:`UsageError` instead of printing its usage and ending the process."""

    def error(self, message: str) -> NoReturn:
        """Raise with the message, the option that was probably meant, and where the options are explained."""
        if message.startswith("unrecognized arguments: "):
            word = message.split()[2]
            message = f"unknown option {word!r}{suggest(word, self._option_string_actions)}"
        raise UsageError(f"{message} ({self.prog} --help explains)")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            choices = [str(choice) for choice in action.choices]
            raise argparse.ArgumentError(action, f"expected {', '.join(choices)}, got {value!r}{suggest(str(value), choices)}")
