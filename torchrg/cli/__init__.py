"""Command line: ``torchrg COMMAND ...``."""

import functools
import gc
import importlib
import sys
import warnings
from collections.abc import Sequence

from torchrg._limits import system_limit
from torchrg._synonyms import nearest_name
from torchrg.cli import ending
from torchrg.errors import ConfigError, PrecisionWarning, TorchrgError

COMMANDS = {
    "segment": "segment point clouds into planes",
    "depth": "segment depth images and organized clouds into planes",
    "normals": "estimate normals and curvature of scans",
    "align": "make scans upright, with walls along x and y",
    "convert": "segment every scan of a data set, on one machine or a cluster",
    "score": "evaluate labels and normals against ground truth",
    "sample": "generate a synthetic room with ground truth",
    "view": "render a cloud or a result",
    "info": "print a summary of a point cloud file",
    "settings": "list all settings with their defaults",
}
"""Purpose of each command by name; each command is a module with the same name."""
_OVERVIEW = """usage: torchrg COMMAND ...

Normals, curvature and plane labels for indoor point clouds.

{}

torchrg COMMAND --help lists the options. torchrg --version prints the version.""".format(
    "\n".join(f"  {name:<9}{purpose}" for name, purpose in COMMANDS.items())
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code.

    Args:
        argv: Arguments after ``torchrg``. Default: the arguments of the process.

    Returns:
        0 success; 2 usage error or invalid input; 3 some inputs of a batch failed; 130 interrupted.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    with ending.writing_to(sys.stdout) as output, ending.writing_to(sys.stderr):
        code = _exit_code(arguments)
    if output.error is None or isinstance(output.error, BrokenPipeError):
        return code
    message = f"standard output: {output.error.strerror or output.error}."
    return ending.fail(message, code=code or ending.USAGE_ERROR)


def _exit_code(arguments: list[str]) -> int:
    """Run a command, print its errors, and return the exit code."""
    name = next(iter(arguments), "")
    try:
        return _run(arguments)
    except TorchrgError as error:
        return ending.fail(str(error))
    except OSError as error:
        return ending.fail(f"{error.filename or name}: {error.strerror or error}.")
    except Exception as error:
        if limit := system_limit(error):
            return ending.fail(f"{name}: {limit}")
        raise
    except KeyboardInterrupt:
        return ending.fail(ending.INTERRUPTED_LINE, code=ending.INTERRUPTED)


def _run(arguments: list[str]) -> int:
    """Run the command named by the first argument."""
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(_OVERVIEW)
        return 0 if arguments else ending.USAGE_ERROR
    name, *remaining = arguments
    if name in ("--version", "-V", "version"):
        from torchrg.version import __version__

        print(f"torchrg {__version__}")
        return 0
    if name not in COMMANDS:
        near = nearest_name(name, COMMANDS)
        hint = f" Did you mean {near}?" if near else ""
        raise ConfigError(f"expected a command ({', '.join(COMMANDS)}), got {name!r}.{hint}")
    command = importlib.import_module(f"torchrg.cli.{name}")
    if not gc.isenabled():  # See torchrg.__main__: loaded modules are no garbage.
        gc.freeze()
        gc.enable()
    with ending.raising_interrupts(), warnings.catch_warnings():
        # Commands print the precision of each file themselves (check_finite).
        warnings.simplefilter("ignore", PrecisionWarning)
        warn_once = functools.cache(ending.warn)  # Settings are checked after every change.
        warnings.showwarning = lambda message, *_, **__: warn_once(" ".join(str(message).split()))
        code: int = command.run(remaining)
    return code
