"""Make a host of an object, a function or a nerfstudio model, and reject what cannot be one."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

from torch import nn

from neilfpp_method.errors import UserError
from neilfpp_method.hosts.base import HasParameterGroups, Host, ImageHost
from neilfpp_method.hosts.function import CallableHost
from neilfpp_method.hosts.outputs import host_name

__all__ = ["adapt", "check_parameter_groups"]

HOST_FIELDS = ("geometry", "beta", "radiance", "background")
"""Fields of a host that `parameter_groups` may name; the settings have a learning rate for each."""


def adapt(host: object, response: str) -> Host | ImageHost:
    """Wrap what is not a host yet: a nerfstudio model, or a function.

    Args:
        host: what the caller of `attach_neilf` passed.
        response: meaning of its colours, if it is a nerfstudio model.

    Raises:
        UserError: it has none of the forms of docs/hosts.md, is called with other arguments, or is a wrapper
            that hides the methods of a host.
    """
    if isinstance(host, type):
        raise UserError(f"{host.__name__} is a class, not a host", f"give an instance of {host.__name__}")
    if _is_nerfstudio(host):
        from neilfpp_method.hosts.nerfstudio import NerfstudioHost

        return NerfstudioHost(host, response=response)
    if isinstance(host, Host):
        _check_call(host.render, f"{host_name(host)}.render", "one RayBatch (origins and directions)")
        return host
    if isinstance(host, ImageHost):
        return host
    _check_wrapper(host)
    if callable(host):
        adapted = CallableHost(host)
        called = host.forward if isinstance(host, nn.Module) else host
        _check_call(called, adapted.name, "two tensors, origins and directions", 2)
        return adapted
    raise UserError(
        f"{type(host).__name__} is not a host",
        "give an object with render(rays) or render_image(camera), or a function of (origins, directions)",
    )


def _is_nerfstudio(host: object) -> bool:
    return isinstance(host, nn.Module) and hasattr(host, "get_outputs") and hasattr(host, "config")


def _check_wrapper(host: object) -> None:
    """Check that a host is not a wrapper, as of data-parallel training, that hides the methods of a host.

    Called as a function, it would be rendered by its `forward`, and never trained with the material.

    Raises:
        UserError: it is one.
    """
    inner = getattr(host, "module", None) if isinstance(host, nn.Module) else None
    offers = isinstance(inner, Host | ImageHost | HasParameterGroups) or _is_nerfstudio(inner)
    if isinstance(inner, nn.Module) and offers:
        wrapper, wrapped = type(host).__name__, host_name(inner)
        raise UserError(
            f"{wrapper} hides the methods of {wrapped}", "attach the model inside: attach_neilf(host.module)"
        )


def _check_call(function: Callable[..., Any], name: str, what: str, count: int = 1) -> None:
    """Check that a function can be called with `count` arguments, if Python knows its parameters.

    Raises:
        UserError: it cannot.
    """
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        # Functions of extension modules.
        return
    try:
        signature.bind(*range(count))
    except TypeError as error:
        raise UserError(
            f"{name}{signature} is called with {what}: {error}", "wrap it in a function of these arguments"
        ) from error


def check_parameter_groups(host: HasParameterGroups) -> None:
    """Check that the groups of a host are a mapping, and that the settings have a learning rate for each.

    Raises:
        UserError: they are not.
    """
    groups = host.parameter_groups()
    remedy = f"return {{field: [parameters]}}; the fields are {', '.join(HOST_FIELDS)}"
    if not isinstance(groups, Mapping):
        raise UserError(f"{host_name(host)}.parameter_groups() returns a {type(groups).__name__}", remedy)
    unknown = ", ".join(f"'{name}'" for name in groups if name not in HOST_FIELDS)
    if unknown:
        raise UserError(f"{host_name(host)}.parameter_groups() has the unknown field {unknown}", remedy)
