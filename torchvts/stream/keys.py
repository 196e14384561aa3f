"""Commands that are typed while a stream runs: single keys in a terminal, letters on standard input otherwise."""

import os
import sys
from typing import Any


class Keys:
    """Reads standard input without waiting for it.

    In a terminal a key counts at once; from a pipe or a file each letter does. It is used as a context, so that the terminal is as
    before afterwards.

    Args:
        source: file descriptor; None takes standard input.
    Example:
        >>> from_program, to_stream = os.pipe()
        >>> with Keys(from_program) as keys:
        ...     _ = os.write(to_stream, b"z s")
        ...     keys.pressed()
        ['z', 's']
    """

    def __init__(self, source: int | None = None) -> None:
        self._fd: int | None = source
        if source is None:
            try:
                self._fd = sys.stdin.fileno()
            except (AttributeError, OSError, ValueError):  # no standard input, as in a notebook or a test
                self._fd = None
        self._terminal: Any = None

    def __enter__(self) -> "Keys":
        if self._fd is None or sys.platform == "win32" or not os.isatty(self._fd):
            return self
        import termios
        import tty

        try:
            if os.tcgetpgrp(self._fd) == os.getpgrp():  # not in the background, where reading would stop the process
                self._terminal = termios.tcgetattr(self._fd)
                tty.setcbreak(self._fd)
                return self
        except (OSError, termios.error):  # a terminal that does not control this process
            pass
        self._fd = None
        return self

    def __exit__(self, *_: object) -> None:
        if self._terminal is not None and self._fd is not None and sys.platform != "win32":
            import termios

            termios.tcsetattr(self._fd, termios.TCSADRAIN, self._terminal)

    def pressed(self) -> list[str]:
        """Letters since the last call, in lower case, in order."""
        if self._fd is None:
            return []
        if sys.platform == "win32":
            return _of_windows()
        import select

        if not select.select([self._fd], [], [], 0.0)[0]:
            return []
        text = os.read(self._fd, 1024)
        if not text:  # the end of a file or pipe
            self._fd = None
        return [letter for letter in text.decode(errors="replace").lower() if letter.isalpha()]


def _of_windows() -> list[str]:
    """Keys of a Windows console."""
    import msvcrt

    letters: list[str] = []
    while getattr(msvcrt, "kbhit")():  # noqa: B009 - other systems know no such function
        letters.append(getattr(msvcrt, "getwch")().lower())  # noqa: B009
    return [letter for letter in letters if letter.isalpha()]
