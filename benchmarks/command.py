"""How a benchmark ends: like the commands of the package, with one line if its input is wrong."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import NoReturn

from rich.console import Console

from neilfpp_method.errors import UserError

__all__ = ["run_benchmark"]


def run_benchmark(main: Callable[[], int | None]) -> NoReturn:
    """Run a benchmark and exit with the status that it returns, or with that of a `UserError`."""
    try:
        sys.exit(main())
    except UserError as error:
        Console(stderr=True).print(f"error: {error}", markup=False)
        sys.exit(error.status)
