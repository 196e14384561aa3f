"""What all commands of scripts/ share: their parser, and errors as one line."""

import argparse
import sys
from collections.abc import Callable
from typing import NoReturn


def parser_of(text: str | None) -> argparse.ArgumentParser:
    """A parser whose help begins with the text of the command as it stands."""
    return argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)


def main_of(main: Callable[[], int]) -> NoReturn:
    """Run a command and leave with its status; what cannot be read or used is one line and status 1."""
    try:
        sys.exit(main())
    except (OSError, ValueError, TypeError, ImportError) as error:
        sys.exit(f"error: {error}")
