"""Tables of texts in Markdown, and numbers in their cells."""

from collections.abc import Iterable, Sequence


def number(value: float | None, digits: int) -> str:
    """A value with so many digits after the point; empty for None."""
    return "" if value is None else f"{value:.{digits}f}"


def markdown(titles: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """A Markdown table of texts."""
    head = ["| " + " | ".join(titles) + " |", "|" + "---|" * len(titles)]
    return "\n".join(head + ["| " + " | ".join(cells) + " |" for cells in lines])
