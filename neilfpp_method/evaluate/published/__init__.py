"""Protocols of published benchmarks, each computed as the official code of that benchmark computes it."""

from __future__ import annotations

from neilfpp_method.evaluate.published.neilf_synthetic import NEILF_SYNTHETIC
from neilfpp_method.evaluate.published.protocol import Protocol
from neilfpp_method.evaluate.published.shiny_normals import SHINY_NORMALS

__all__ = ["PROTOCOLS"]

PROTOCOLS: dict[str, Protocol] = {protocol.name: protocol for protocol in (NEILF_SYNTHETIC, SHINY_NORMALS)}
