"""Lines that commands print, and how they end: with one line and an exit code, interrupted too."""

import contextlib
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from typing import Any, NoReturn

USAGE_ERROR = 2
"""Exit code where a command was used wrongly, or its input is bad."""
SOME_FAILED = 3
"""Exit code where some inputs failed and the results of the others are complete."""
INTERRUPTED = 130
"""Exit code of shells for a program that Ctrl-C ended: 128, and the number of the signal."""

INTERRUPTED_LINE = "interrupted; every file written is complete."
_INTERRUPTS = (signal.SIGINT, signal.SIGTERM)
"""Ctrl-C, and what batch systems send."""


def printable(text: str) -> str:
    r"""Return text in which what moves the cursor, or turns or hides text, is written as escapes.

    Names of files and fields may hold such characters, and bytes that are no text.

    Example:
        >>> printable("caf\u00e9 \x1b[31m\n\u202e\udce9")
        'café \\x1b[31m\\n\\u202e\\udce9'
    """
    return "".join(char if char.isprintable() else repr(char)[1:-1] for char in text)


def say(*lines: str) -> None:
    """Print lines on stdout."""
    print(*map(printable, lines), sep="\n", flush=True)


def fail(message: str, *, code: int = USAGE_ERROR) -> int:
    """Print one line on stderr and return the exit code."""
    print(f"torchrg: {printable(message)}", file=sys.stderr)
    return code


def warn(message: str) -> None:
    """Print one warning line on stderr."""
    fail(f"warning: {message}")


@contextlib.contextmanager
def warnings_as_lines() -> Iterator[None]:
    """Print warnings as single lines, each once."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        yield
    for line in dict.fromkeys(" ".join(str(warning.message).split()) for warning in caught):
        warn(line)


def end_at_once(*_: object) -> NoReturn:
    """End the process by an interrupt, with its line and nothing else."""
    with contextlib.suppress(OSError):
        os.write(2, f"torchrg: {INTERRUPTED_LINE}\n".encode())
    os._exit(INTERRUPTED)


def on_interrupts(handler: Callable[..., Any] | signal.Handlers) -> dict[signal.Signals, Any]:
    """Let interrupts be handled, and return how they were.

    Those that are ignored, as in the background of a shell, stay so.
    """
    before = {number: signal.getsignal(number) for number in _INTERRUPTS}
    heard = {number: old for number, old in before.items() if old not in (signal.SIG_IGN, None)}
    for number in heard:
        signal.signal(number, handler)
    return heard


@contextlib.contextmanager
def raising_interrupts() -> Iterator[None]:
    """Let interrupts raise KeyboardInterrupt, so that what is being written is taken back."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = on_interrupts(signal.default_int_handler)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
