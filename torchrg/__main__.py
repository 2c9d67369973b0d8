"""The process of a command: ``torchrg`` and ``python -m torchrg``."""

import gc
import os
import sys

# The collector would go through the objects of torch several times while they are made: a fifth
# of the time until a command begins. Commands and workers enable it again.
gc.disable()

if __name__ == "__main__" and not getattr(sys.flags, "safe_path", False):
    # Python has put the folder of the command first; what lies there is data, but for this package.
    sys.path[:1] = sys.path[:1] if __file__ == f"{sys.path[0]}/torchrg/__main__.py" else []

try:
    import signal

    from torchrg import cli
    from torchrg.cli.ending import end_at_once, on_interrupts
except KeyboardInterrupt:
    from torchrg.cli.ending import end_at_once

    end_at_once()


def main() -> int:
    """Run the command that the arguments of the process name, and return its exit code.

    Ctrl-C and SIGTERM end it with one line at any moment. While modules load nothing is being
    written, and libraries lose or show exceptions, so the process ends on the spot. When all is
    done they come too late: what is left is Python's own end.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        # One that is closed would be the next file that is opened, with all that is printed in it.
        if getattr(sys, name) is None:
            place = os.open(os.devnull, os.O_RDWR)
            os.dup2(place, number)
            os.set_inheritable(number, True)
            setattr(sys, name, os.fdopen(number, "w" if number else "r"))
    try:
        on_interrupts(end_at_once)
        return cli.main()
    except KeyboardInterrupt:
        end_at_once()
    finally:
        on_interrupts(signal.SIG_IGN)


if __name__ == "__main__":
    sys.exit(main())
