"""The start of the command line, `neilfpp` or `python -m neilfpp_method`."""

from __future__ import annotations

import os
import signal
import sys

__all__ = ["main"]

SPIN_COUNT = "1000"
"""Checks of a waiting OpenMP thread before it sleeps (`GOMP_SPINCOUNT` of GNU's OpenMP library, which torch
uses on Linux). By default a thread spins for milliseconds. On a machine with other work it uses up its time
slice in this way, and the other threads of this process then wait for it.
"""


def main() -> int:
    """Run the command of this process, `cli.main`.

    Ctrl-C and SIGTERM wait until the command handles them (`commands.ending`). After the command, while
    Python ends, they end the process without a traceback.
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", SPIN_COUNT)  # read when torch is imported
    if not hasattr(signal, "pthread_sigmask"):  # Windows has no signal masks
        from neilfpp_method.cli import main as run

        return run()
    signals = {signal.SIGINT, signal.SIGTERM}
    signal.pthread_sigmask(signal.SIG_BLOCK, signals)
    # A shell starts background jobs with Ctrl-C ignored.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        from neilfpp_method.cli import main as run

        return run()
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, signals)


if __name__ == "__main__":
    sys.exit(main())
