"""The process of a command: ``torchrg`` and ``python -m torchrg``."""

import sys

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
    try:
        on_interrupts(end_at_once)
        return cli.main()
    except KeyboardInterrupt:
        end_at_once()
    finally:
        on_interrupts(signal.SIG_IGN)


if __name__ == "__main__":
    sys.exit(main())
