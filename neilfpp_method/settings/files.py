"""Read settings from a YAML or JSON file: all or some of them. The `config.json` of a run folder is one."""

from __future__ import annotations

import json
import re
from collections.abc import Hashable, Mapping
from pathlib import Path
from typing import Any

import yaml

from neilfpp_method.errors import UserError

__all__ = ["read_settings"]

MAX_BYTES = 1 << 17
"""Largest size of a settings file, in bytes: eighty times that of a file with all settings."""


class _Loader(yaml.SafeLoader):
    """Loader with plain values as in YAML 1.2: `off`, `on`, `no`, `12:30` are strings and `5e-4` is a number.

    YAML 1.1, which PyYAML implements, reads `mode: off` as False and `5e-4` as a string. A name that is set
    twice in one mapping is an error, and so is an alias of a list or a mapping: by aliases of aliases, a few
    lines describe more values than fit into memory.
    """

    yaml_implicit_resolvers: dict[str, list] = {}  # noqa: RUF012 (PyYAML keeps its resolvers in the class)

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node:
        event = self.peek_event()
        node = super().compose_node(parent, index)
        if isinstance(event, yaml.AliasEvent) and not isinstance(node, yaml.ScalarNode):
            what = f"'*{event.anchor}' stands for several values; write them here"
            raise yaml.composer.ComposerError(None, None, what, event.start_mark)
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        mapping = super().construct_mapping(node, deep)  # refuses names that cannot be hashed
        names: set[Hashable] = set()
        for key, _ in node.value:
            name = self.construct_object(key, deep=True)
            if name in names:
                raise yaml.constructor.ConstructorError(None, None, f"'{name}' is set twice", key.start_mark)
            names.add(name)
        return mapping


PLAIN_VALUES = {
    "null": (r"~|null|Null|NULL|none|None|", ["~", "n", "N", ""]),
    "bool": (r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    "int": (r"[-+]?[0-9]+(_[0-9]+)*", list("-+0123456789")),
    "float": (r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?", list("-+.0123456789")),
}
"""Types of plain values other than strings: the pattern of each, and the characters it can begin with."""
for _name, (_pattern, _first) in PLAIN_VALUES.items():
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_name}", re.compile(f"^(?:{_pattern})$"), _first)
_Loader.add_constructor("tag:yaml.org,2002:float", lambda loader, node: float(loader.construct_scalar(node)))
_Loader.add_constructor("tag:yaml.org,2002:int", lambda loader, node: int(loader.construct_scalar(node)))


def read_settings(path: Path) -> Mapping[str, Any]:
    """Read the settings of a file, as nested mappings or with dotted names.

    Raises:
        UserError: the file does not exist, cannot be parsed, or holds no settings.
    """
    if path.suffix not in (".yaml", ".yml", ".json"):
        raise UserError(f"{path}: not a .yaml, .yml or .json file", "name a settings file with --config")
    try:
        if path.stat().st_size > MAX_BYTES:
            raise UserError(f"{path}: too large for a settings file", "name a settings file with --config")
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise UserError(f"{path}: no such file", "name a settings file with --config") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: not a text file", "name a settings file with --config") from error
    except OSError as error:
        raise UserError(
            f"{path}: cannot be read ({error.strerror})", "name a settings file with --config"
        ) from error
    try:
        content = json.loads(text) if path.suffix == ".json" else yaml.load(text, Loader=_Loader)
    except json.JSONDecodeError as error:
        raise UserError(f"{path}:{error.lineno}: not JSON ({error.msg})", "correct the file") from error
    except yaml.MarkedYAMLError as error:
        line = f":{error.problem_mark.line + 1}" if error.problem_mark else ""
        raise UserError(f"{path}{line}: not YAML ({error.problem})", "correct the file") from error
    except Exception as error:
        # PyYAML and Python raise many types of exceptions for values that do not fit their tags, for numbers
        # with thousands of digits and for deep nesting.
        raise UserError(f"{path}: not a settings file", "correct the file") from error
    if content is None:
        return {}
    if not isinstance(content, Mapping):
        raise UserError(f"{path}: holds no settings", "write names and values, such as `train: {rays: 512}`")
    # The config.json of a run folder holds the folder's format version and, under "config", the settings.
    inner = content.get("config") if content.keys() <= {"format", "config"} else content
    if not isinstance(inner, Mapping):
        raise UserError(f"{path}: holds no settings", "write names and values, such as `train: {rays: 512}`")
    return inner
