"""Thresholds of contact as options of a command."""

import argparse

from .settings import ContactSettings


def add_contact_arguments(parser: argparse._ActionsContainer) -> None:
    """``--contact-sigmas``, ``--contact-min-size-px`` and ``--contact-share``, for :func:`contact_from_arguments`.

    Args:
        parser: to add them to.
    Example:
        >>> parser = argparse.ArgumentParser()
        >>> add_contact_arguments(parser)
        >>> contact_from_arguments(parser.parse_args(["--contact-sigmas", "6"]))
        ContactSettings(sigmas=6.0, min_size_px=8.0, share=0.8)
    """
    usual = ContactSettings()
    group = parser.add_argument_group("contact")
    for name, text in (
        ("sigmas", "change, in units of the noise, from which the skin has moved"),
        ("min_size_px", "diameter of the smallest area that counts, pixels"),
        ("share", "pressure, in units of what lifts free skin, from which the object touches"),
    ):
        value = getattr(usual, name)
        group.add_argument(
            f"--contact-{name.replace('_', '-')}", type=float, default=value, metavar="X", help=f"{text} ({value:g})"
        )


def contact_from_arguments(arguments: argparse.Namespace) -> ContactSettings:
    """The thresholds that were given.

    Args:
        arguments: parsed, of a parser with :func:`add_contact_arguments`.
    Raises:
        ValueError: a value that is not above zero.
    """
    return ContactSettings(arguments.contact_sigmas, arguments.contact_min_size_px, arguments.contact_share)
