"""A run whose distance field has no surface."""

from __future__ import annotations

import shutil
from pathlib import Path

import torch

from neilfpp_method.train.checkpoint import last_checkpoint

FAR = 9.0
"""Added to the distance everywhere; the scene is smaller."""


def without_surface(run: Path, out: Path) -> Path:
    """Copy a run of the VolSDF host, with a field that is positive everywhere."""
    shutil.copytree(run, out, ignore=shutil.ignore_patterns("cache", "relit", "export"))
    weights = last_checkpoint(out)
    saved = torch.load(weights, weights_only=True)
    layers = [name for name in saved["model"] if name.startswith("host.sdf_field.mlp.") and "bias" in name]
    saved["model"][layers[-1]][0] += FAR
    torch.save(saved, weights)
    return out
