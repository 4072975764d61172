"""The settings of `neilfpp train`: a preset, a file, and the options that decide which settings exist."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from neilfpp_method.errors import UserError
from neilfpp_method.settings.files import read_settings
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.presets import PRESETS, fixed_geometry, free_light, preset
from neilfpp_method.settings.types import MapLightConfig, MeshConfig, NeilfConfig

__all__ = ["DEFAULT_PRESET", "base_settings", "with_files"]

DEFAULT_PRESET = "fast"
"""Preset if neither --preset nor a settings file names one."""
PARTS_WITH_KINDS = ("light", "encoding")
"""Parts of the settings whose members depend on their `kind`. The kind of the host is the option --host."""


def base_settings(arguments: Sequence[str]) -> NeilfConfig:
    """The settings of a command line, before its options of single settings.

    The settings file, the preset, the host, and the kinds of light and encoding are read before all other
    options, because they determine which settings exist and what their defaults are.

    Raises:
        UserError: the file, or one of these options, is wrong.
    """
    file = _option(arguments, "--config")
    stored = dict(read_settings(Path(file))) if file is not None else {}
    where = file or "config"
    host = _option(arguments, "--host")
    config = _base(_option(arguments, "--preset"), host, stored, where)
    config = changed(config, stored, where)
    if host is not None and host != config.host.kind:
        raise UserError(
            f"{where}: its host is {config.host.kind}, but --host is {host}", "leave one of them out"
        )
    kinds = {part: _option(arguments, f"--config.{part}.kind") for part in PARTS_WITH_KINDS}
    changes = {f"{part}.kind": kind for part, kind in kinds.items() if kind is not None}
    if kinds["light"] == "free" and config.light.kind != "free":
        config = free_light(config)
    return changed(config, changes, "--config")


def with_files(config: NeilfConfig, mesh: Path | None, light: Path | None) -> NeilfConfig:
    """The settings with the files of --mesh and --light.

    Raises:
        UserError: the host takes no mesh, or the light no map.
    """
    if mesh is not None:
        if not isinstance(config.host, MeshConfig):
            raise UserError(f"--mesh {mesh}: the host {config.host.kind} takes no mesh", "add --host mesh")
        config = changed(config, {"host.path": str(mesh.resolve())})
    if light is not None:
        if not isinstance(config.light, MapLightConfig):
            raise UserError(
                f"{light}: a light that is free at every point takes no map",
                "add --config.light.kind distant, or auto to look for near lamps as well",
            )
        config = changed(config, {"light.map": str(light.resolve())})
    return config


def _base(name: str | None, host: str | None, stored: Mapping[str, Any], where: str) -> NeilfConfig:
    """The preset to which a settings file is applied: that of --preset, of the file, or the default."""
    label = stored.get("preset", DEFAULT_PRESET) if name is None else name
    if not isinstance(label, str):
        raise UserError(f"{where}.preset: {label!r} is not a name", f"choose one of {', '.join(PRESETS)}")
    label = label.removesuffix("-mesh") if name is None else label
    # Settings that no preset made carry the label of the default settings.
    config = NeilfConfig() if name is None and label == NeilfConfig().preset else preset(label)
    if host == "mesh" or _stored_kind(stored, "host") == "mesh" or stored.get("host.kind") == "mesh":
        config = fixed_geometry(config)
    if _stored_kind(stored, "light") == "free" and config.light.kind != "free":
        config = free_light(config)
    return config


def _stored_kind(stored: Mapping[str, Any], part: str) -> Any:
    """The `kind` of a part of the settings of a file; None if the file does not say."""
    settings = stored.get(part)
    return settings.get("kind") if isinstance(settings, Mapping) else None


def _option(arguments: Sequence[str], name: str) -> str | None:
    """The value of an option in a command line; the last one if it occurs several times."""
    value = None
    for i, argument in enumerate(arguments):
        if argument == name and i + 1 < len(arguments):
            value = arguments[i + 1]
        if argument.startswith(f"{name}="):
            value = argument.split("=", 1)[1]
    return value
