"""Whether a given mesh lies where the photographs show the object."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.hosts.mesh import MeshHost

__all__ = ["MeshFit", "measure_mesh_fit"]

PIXELS = 32_768
"""Number of training pixels, drawn evenly from all views, that are compared with the mesh."""
MIN_SHOWN = 0.01
"""Smallest share of the pixels that must show the mesh if the capture has no masks."""
MIN_OVERLAP = 0.8
"""Smallest overlap of the mesh with the masks. The true mesh of `spot_city` has 0.99; moved by a tenth of
a scene unit it has 0.63, and made 1.3 times as large 0.58.
"""


@dataclass(frozen=True)
class MeshFit:
    """How a mesh and the photographs agree.

    Attributes:
        shown: share of the pixels whose rays meet the mesh.
        overlap: pixels that meet the mesh and lie on the masks, divided by those that do either; None without
            masks.
    """

    shown: float
    overlap: float | None

    @property
    def warning(self) -> str | None:
        """One line for the console, with a remedy; None if nothing is wrong."""
        if self.overlap is None:
            what = f"only {self.shown:.1%} of the training pixels show the mesh"
            fits = self.shown >= MIN_SHOWN
        else:
            what = f"the mesh covers the masks badly (intersection over union {self.overlap:.0%})"
            fits = self.overlap >= MIN_OVERLAP
        remedy = "give it in the world frame and the unit of length of the capture, and check the masks"
        return None if fits else f"warning: {what}; {remedy}"


def measure_mesh_fit(host: MeshHost, pixels: PixelDataset) -> MeshFit:
    """Compare the mesh with the masks at random training pixels, without the global random generator."""
    numbers = torch.randint(len(pixels), (PIXELS,), generator=torch.Generator().manual_seed(0))
    batch = pixels.on(host.triangles.device).numbered(numbers)
    meets = torch.zeros_like(batch.mask, dtype=torch.bool)
    meets[host.intersect(batch.rays).rows] = True
    # Some views may have no mask. If the background is recognised by its colour, only its pixels are known.
    known = torch.isin(batch.view, batch.view[batch.mask_known > 0])
    inside = batch.mask > 0.5
    shared, either = ((both & known).sum().item() for both in (meets & inside, meets | inside))
    return MeshFit(meets.float().mean().item(), shared / either if either else None)
