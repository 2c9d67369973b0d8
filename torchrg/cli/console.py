"""What the commands share: parsing through tyro, one-line errors, exit codes, checks of paths."""

import contextlib
import io
import re
import sys
from pathlib import Path
from typing import Any, TypeVar

from torchrg.config import DEFAULT_PRESET, PipelineConfig, load_config
from torchrg.errors import ConfigError, FormatError
from torchrg.io import FORMATS, check_output

USAGE_ERROR = 2
SOME_FAILED = 3
INTERRUPTED = 130

Arguments = TypeVar("Arguments")


def fail(message: str, *, code: int = USAGE_ERROR) -> int:
    """Print one line on stderr and return the exit code."""
    print(f"torchrg: {' '.join(message.split())}", file=sys.stderr)
    return code


def warn(message: str) -> None:
    """Print one warning line on stderr."""
    fail(f"warning: {message}")


def parse(
    kind: type[Arguments],
    arguments: list[str],
    *,
    prog: str,
    default: Any = None,  # noqa: ANN401
) -> Arguments:
    """Parse arguments into a dataclass; ``--help`` prints and exits.

    Raises:
        ConfigError: If an argument is wrong, as one line.
    """
    import tyro

    stderr = io.StringIO()
    options: dict[str, Any] = {} if default is None else {"default": default}
    try:
        with contextlib.redirect_stderr(stderr):
            parsed: Arguments = tyro.cli(kind, args=arguments, prog=prog, **options)
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        raise ConfigError(f"{_one_line(stderr.getvalue())} See {prog} --help.") from None
    return parsed


def _one_line(boxed: str) -> str:
    """Return the first message of a boxed error as one line."""
    lines = [re.sub(r"^[│╭╰]\s?|\s*[│╮╯]$", "", line).rstrip() for line in boxed.splitlines()]
    message: list[str] = []
    for line in lines[1:]:
        if re.match(r"^[─╰]{3,}", line) and message:
            break
        message.append(line.strip())
    text = " ".join(part for part in message if part)
    text = re.sub(r"^Error parsing [\w.-]+: (?=\w+Config: )", "", text)
    return text if text.endswith((".", "!", "?")) else f"{text}."


def settings_asked_for(argv: list[str]) -> PipelineConfig:
    """Return the settings of the preset or the file that is asked for: defaults of other flags.

    Raises:
        ConfigError: If there is no such preset or file, or it is wrong.

    Example:
        >>> settings_asked_for(["scan.pcd", "--preset=classic"]).normals.method
        'pca'
    """
    values = {"--preset": DEFAULT_PRESET, "--config": ""}
    for position, argument in enumerate(argv):
        name, equals, value = argument.partition("=")
        if name in values:
            values[name] = value if equals else "".join(argv[position + 1 : position + 2])
    return load_config(values["--config"] or values["--preset"])


def output_paths(inputs: tuple[Path, ...], out: Path, *, suffix: str = ".npz") -> list[Path]:
    """Return where the result of each input goes.

    One input goes to the file ``out``, or under its own name into an existing directory; several
    need a directory, which is made.

    Raises:
        FormatError: If there is no input, two results would share a name, or ``out`` cannot be
            written.
    """
    if not inputs:
        raise FormatError("expected at least one input file, got none.")
    if len(inputs) == 1 and not out.is_dir():
        check_output(out)
        return [out]
    if out.suffix.lower() in FORMATS and not out.is_dir():
        raise FormatError(f"{out}: expected a directory for {len(inputs)} inputs, got a file name.")
    paths = [out / f"{path.stem}{suffix}" for path in inputs]
    for path, source in zip(paths, inputs, strict=True):
        if paths.count(path) > 1:
            raise FormatError(f"{source}: another input has the same name; run them one by one.")
    out.mkdir(parents=True, exist_ok=True)
    return paths
