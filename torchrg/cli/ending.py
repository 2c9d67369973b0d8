"""Printed lines, exit codes and interrupts of commands."""

import contextlib
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from typing import Any, NoReturn, TextIO

USAGE_ERROR = 2
"""Exit code of a usage error or an invalid input."""
SOME_FAILED = 3
"""Exit code if some inputs failed; the results of the remaining ones are complete."""
INTERRUPTED = 130
"""Exit code after Ctrl-C by shell convention: 128 plus the signal number."""
INTERRUPTED_LINE = "interrupted; every file written is complete."
_INTERRUPTS = (signal.SIGINT, signal.SIGTERM)
"""Ctrl-C, and the termination signal of batch systems."""


class Output:
    """A standard stream that keeps its first error, so that a command still ends its work.

    Attributes:
        stream: The stream.
        error: The first error of writing, such as a closed pipe or a full disk, or None.
    """

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream
        self.error: OSError | None = None

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401
        return getattr(self.stream, name)

    def write(self, text: str) -> int:
        """Write a text unless an earlier one could not be written; return its length."""
        if self.error is None:
            with self._keeping_error():
                self.stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Write buffered text."""
        if self.error is None:
            with self._keeping_error():
                self.stream.flush()

    @contextlib.contextmanager
    def _keeping_error(self) -> Iterator[None]:
        """Keep an error, and discard what Python would write again at its exit."""
        try:
            yield
        except OSError as error:
            self.error = error
            with contextlib.suppress(OSError, AttributeError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), self.stream.fileno())


@contextlib.contextmanager
def writing_to(stream: TextIO) -> Iterator[Output]:
    """Replace ``sys.stdout`` or ``sys.stderr`` in a block by a stream that keeps its errors."""
    output, name = Output(stream), "stdout" if stream is sys.stdout else "stderr"
    setattr(sys, name, output)
    try:
        yield output
    finally:
        output.flush()
        setattr(sys, name, stream)


def printable(text: str) -> str:
    r"""Escape characters that move the cursor, reverse or hide text.

    File and field names may contain such characters, and undecodable bytes.
    """
    return "".join(char if char.isprintable() else repr(char)[1:-1] for char in text)


def print_lines(*lines: str) -> None:
    """Print lines to stdout."""
    print(*map(printable, lines), sep="\n", flush=True)


def fail(message: str, *, code: int = USAGE_ERROR) -> int:
    """Print one line to stderr and return the exit code."""
    print(f"torchrg: {printable(message)}", file=sys.stderr)
    return code


def warn(message: str) -> None:
    """Print a one-line warning to stderr."""
    fail(f"warning: {message}")


@contextlib.contextmanager
def print_warnings() -> Iterator[None]:
    """Print the warnings of a block as single lines, without duplicates."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        yield
    for line in dict.fromkeys(" ".join(str(warning.message).split()) for warning in caught):
        warn(line)


def exit_interrupted(*_: object) -> NoReturn:
    """Exit immediately after an interrupt, with one line."""
    with contextlib.suppress(OSError):
        os.write(2, f"torchrg: {INTERRUPTED_LINE}\n".encode())
    os._exit(INTERRUPTED)


def handle_interrupts(handler: Callable[..., Any] | signal.Handlers) -> dict[signal.Signals, Any]:
    """Set the handler of interrupts and return the previous handlers.

    Ignored signals stay ignored, as for background jobs of a shell.
    """
    before = {number: signal.getsignal(number) for number in _INTERRUPTS}
    heard = {number: old for number, old in before.items() if old not in (signal.SIG_IGN, None)}
    for number in heard:
        signal.signal(number, handler)
    return heard


@contextlib.contextmanager
def raising_interrupts() -> Iterator[None]:
    """Raise KeyboardInterrupt on interrupts, so that partial files are removed."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = handle_interrupts(signal.default_int_handler)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
