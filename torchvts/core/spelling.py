"""The word that was probably meant, for errors about names."""

import difflib
from collections.abc import Iterable


def suggest(word: object, known: Iterable[str]) -> str:
    """``: did you mean 'x'?`` where a known word is close to ``word``, else nothing.

    Example:
        >>> suggest("presise", ["fast", "precise"]), suggest("Fast", ["fast", "precise"]), suggest("slow", ["fast", "precise"])
        (": did you mean 'precise'?", ": did you mean 'fast'?", '')
    """
    if not isinstance(word, str):
        return ""
    by_key = {_key(name): name for name in known}
    close = difflib.get_close_matches(_key(word), list(by_key), 1, cutoff=0.7)
    return f": did you mean {by_key[close[0]]!r}?" if close else ""


def _key(word: str) -> str:
    """Case, hyphens and spaces are no differences."""
    return word.strip().lower().replace("-", "_").replace(" ", "_")
