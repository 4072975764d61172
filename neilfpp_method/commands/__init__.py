"""The commands of `neilfpp`: a module for each, with its options, its implementation and examples.

Heavy libraries are imported when a command runs, so that help and errors in the options appear at once.
"""

from __future__ import annotations

from neilfpp_method.commands import (
    compare,
    completion,
    demo,
    evaluate,
    export,
    inspect,
    prepare,
    relight,
    render,
    replay,
    report,
    tradeoff,
    train,
    view,
)

__all__ = ["COMMANDS"]

COMMANDS = {
    "demo": demo.COMMAND,
    "inspect": inspect.COMMAND,
    "prepare": prepare.COMMAND,
    "train": train.COMMAND,
    "tradeoff": tradeoff.COMMAND,
    "eval": evaluate.COMMAND,
    "render": render.COMMAND,
    "export": export.COMMAND,
    "relight": relight.COMMAND,
    "report": report.COMMAND,
    "compare": compare.COMMAND,
    "replay": replay.COMMAND,
    "view": view.COMMAND,
    "completion": completion.COMMAND,
}
