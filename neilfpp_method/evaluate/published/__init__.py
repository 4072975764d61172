"""Evaluation protocols of published benchmarks, each computed as the official code computes it."""

from __future__ import annotations

from neilfpp_method.evaluate.published.dtu import DTU
from neilfpp_method.evaluate.published.neilf_synthetic import NEILF_SYNTHETIC
from neilfpp_method.evaluate.published.protocol import Protocol
from neilfpp_method.evaluate.published.shiny_normals import SHINY_NORMALS
from neilfpp_method.evaluate.published.stanford_orb import STANFORD_ORB
from neilfpp_method.evaluate.published.synthetic4relight import SYNTHETIC4RELIGHT
from neilfpp_method.evaluate.published.tensoir import TENSOIR

__all__ = ["PROTOCOLS"]

PROTOCOLS: dict[str, Protocol] = {
    protocol.name: protocol
    for protocol in (NEILF_SYNTHETIC, TENSOIR, STANFORD_ORB, SYNTHETIC4RELIGHT, DTU, SHINY_NORMALS)
}
"""All published protocols by the name that `neilfpp eval --protocol` takes."""
