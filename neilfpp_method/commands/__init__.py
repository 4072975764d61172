"""The commands of `neilfpp`, a module each: its options, what runs it, and examples for its help.

What a command needs to run is imported when it runs, so that help and a mistyped option cost no second.
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
