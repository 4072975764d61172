"""The start of the command line, `neilfpp` or `python -m neilfpp_method`."""

from __future__ import annotations

import sys

__all__ = ["main"]


def main() -> int:
    """Run the command of this process: `cli.main`, without a traceback if Ctrl-C stops its imports."""
    try:
        from neilfpp_method.cli import main as run
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return 130
    return run()


if __name__ == "__main__":
    sys.exit(main())
