"""The command ``torchvts``: one module per subcommand, each thin over the package.

A module has its help as docstring, ``USAGE``, ``add_arguments(parser)`` and ``run(arguments)``, which returns the exit status.
"""

from .main import COMMANDS, main

__all__ = ["COMMANDS", "main"]
