"""Entry point of ``torchrg`` and ``python -m torchrg``."""

import gc
import os
import sys
from types import ModuleType

# OpenBLAS starts a thread per core, which torchrg never uses, and fails if one cannot start.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Garbage collection during the import of torch takes a fifth of the startup. It is enabled later.
gc.disable()
# Commands do not use the meta device, whose registrations take a quarter of the import of torch.
sys.modules.setdefault("torch._meta_registrations", ModuleType("torch._meta_registrations"))

if __name__ == "__main__" and not getattr(sys.flags, "safe_path", False):
    # Python puts the working directory first; modules there must not be imported.
    sys.path[:1] = sys.path[:1] if __file__ == f"{sys.path[0]}/torchrg/__main__.py" else []

try:
    import signal

    from torchrg import cli
    from torchrg.cli.ending import exit_interrupted, handle_interrupts
except KeyboardInterrupt:
    from torchrg.cli.ending import exit_interrupted

    exit_interrupted()


def main() -> int:
    """Run the command of the process arguments and return its exit code.

    Ctrl-C and SIGTERM end the process with one line. While modules load, nothing is being written
    and libraries may swallow exceptions, so the process exits immediately. After the command,
    interrupts are ignored.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        # Otherwise the next opened file would take the descriptor and receive all output.
        if getattr(sys, name) is None:
            descriptor = os.open(os.devnull, os.O_RDWR)
            os.dup2(descriptor, number)
            os.set_inheritable(number, True)
            setattr(sys, name, os.fdopen(number, "w" if number else "r"))
    try:
        handle_interrupts(exit_interrupted)
        return cli.main()
    except KeyboardInterrupt:
        exit_interrupted()
    finally:
        handle_interrupts(signal.SIG_IGN)


if __name__ == "__main__":
    sys.exit(main())
