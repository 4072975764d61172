"""The Chamfer distance of DTU: jzhangbs/DTUeval-python `eval.py`, which follows the Matlab code of the
dataset.

The truth lies in the layout of the dataset's SampleSet, in the capture's folder or beside it; the scan's
number is that in the name of the capture's folder:

    ObsMask/ObsMask<scan>_10.mat, ObsMask/Plane<scan>.mat, Points/stl/stl<scan, 3 digits>_total.ply

What is particular about it:

- The surface is sampled about every 0.2 mm, and of two points closer than that one is left out.
- Points 20 mm away or farther are left out of the mean, not counted as 20 mm: a surface with far pieces does
  not lose by them.
- From the estimate, points count that lie in cells that the scanner observed. From the truth, points count
  that lie above the ground plane; they look for their neighbour among all points of the estimate in the box.
- The box of the observed cells is widened by 60 mm below, and by twice that above.
- The order in which points are left out is random there; here it is always the same.

Papers cut the mesh with the dilated masks of the images before; this does not. It is in millimetres where
the capture is in the frame of the dataset, as the reader `dtu` leaves it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Integer
from scipy.io import loadmat, whosmat

from neilfpp_method.data.capture import Capture
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.published.dtu_surface import capped_mean, surface_samples, thinned
from neilfpp_method.evaluate.published.protocol import Protocol
from neilfpp_method.evaluate.published.truth_files import existing
from neilfpp_method.evaluate.views import RenderedView
from neilfpp_method.export.mesh import has_surface, surface_mesh
from neilfpp_method.train.run import Run

__all__ = ["DTU", "Observed", "chamfer_of_scan"]

NAME = "dtu"
RESOLUTION = 512
"""Grid points along an edge of the scene, where the surface is extracted from a distance field."""
SPACING = 0.2
CAP = 20.0
PATCH = 60.0
SEED = 0
LARGEST_MASK = 2**30
"""Cells of the observation mask; those of the dataset have up to 30 million."""
LARGEST_CLOUD = 2**31
"""Bytes of the true points."""


@dataclass(frozen=True)
class Observed:
    """What the scanner saw of a scan.

    Attributes:
        mask: not 0 in cells that it observed.
        low, high: the box of the cells, mm.
        cell: size of a cell, mm.
        plane: (a, b, c, d); points with a x + b y + c z + d > 0 are above the ground.
        points: the true surface, mm.
    """

    mask: Integer[np.ndarray, "X Y Z"]
    low: Float[np.ndarray, " 3"]
    high: Float[np.ndarray, " 3"]
    cell: float
    plane: Float[np.ndarray, " 4"]
    points: Float[np.ndarray, "P 3"]


def chamfer_of_scan(
    vertices: Float[np.ndarray, "V 3"], faces: Integer[np.ndarray, "F 3"], scan: Observed
) -> dict[str, float]:
    """The distances from the estimate to the truth, the other way, and half their sum, mm.

    Raises:
        UserError: nothing of the estimate lies where the scanner looked, or nothing within 20 mm of the
        truth.
    """
    points = thinned(surface_samples(vertices, faces, SPACING), SPACING, SEED)
    inside = ((points >= scan.low - PATCH) & (points < scan.high + 2 * PATCH)).all(-1)
    points = points[inside]
    cells = np.around((points - scan.low) / scan.cell).astype(np.int64)
    on_grid = ((cells >= 0) & (cells < scan.mask.shape)).all(-1)
    observed = points[on_grid][scan.mask[tuple(cells[on_grid].T)] != 0]
    above = scan.points[scan.points @ scan.plane[:3] + scan.plane[3] > 0]
    if not len(observed) or not len(above):
        raise UserError(
            f"the protocol {NAME}: no point of the surface lies where the scanner looked",
            "give the capture in the frame of the dataset, millimetres",
        )
    accuracy = capped_mean(observed, scan.points, CAP)
    completeness = capped_mean(above, points, CAP)
    if accuracy is None or completeness is None:
        raise UserError(
            f"the protocol {NAME}: no point of the surface lies within {CAP:g} mm of the truth",
            "give the capture in the frame of the dataset, millimetres",
        )
    return {
        "chamfer_mm": (accuracy + completeness) / 2,
        "chamfer_accuracy_mm": accuracy,
        "chamfer_completeness_mm": completeness,
    }


def read_scan(capture: Capture) -> Observed:
    """The truth of the scan that a capture is of.

    Raises:
        UserError: a file is missing, damaged, or too large.
    """
    mask_file, plane_file, cloud_file = _files(capture)
    mask = _matrices(mask_file, {"ObsMask": 3, "BB": 2, "Res": 2})
    plane = _matrices(plane_file, {"P": 2})["P"].reshape(-1).astype(np.float64)
    box, cell = mask["BB"].astype(np.float64), mask["Res"].reshape(-1).astype(np.float64)
    good = box.shape == (2, 3) and cell.shape == (1,) and plane.shape == (4,)
    if not good or not np.isfinite([*box.flat, *cell, *plane]).all() or cell[0] <= 0:
        raise UserError(f"{mask_file}: not an observation mask of DTU", "download the SampleSet again")
    return Observed(mask["ObsMask"], box[0], box[1], float(cell[0]), plane, _points(cloud_file))


def _files(capture: Capture) -> tuple[Path, Path, Path]:
    scans = re.findall(r"\d+", capture.root.resolve().name)
    if not scans:
        raise UserError(
            f"{capture.root}: the protocol {NAME} takes the number of the scan from the folder's name, which "
            "has none",
            "name the folder scan24, for instance",
        )
    scan = int(scans[-1])
    names = (
        f"ObsMask/ObsMask{scan}_10.mat",
        f"ObsMask/Plane{scan}.mat",
        f"Points/stl/stl{scan:03d}_total.ply",
    )
    found = []
    above = capture.root.resolve().parent
    for name in names:
        path = existing(above, capture.root.resolve() / name, above / name)
        if path is None:
            raise UserError(
                f"{capture.root}: the protocol {NAME} needs the scanner's truth, and {name} is neither in "
                "this folder nor beside it",
                "put ObsMask and Points of the dataset's SampleSet there",
            )
        found.append(path)
    return found[0], found[1], found[2]


def _matrices(path: Path, wanted: Mapping[str, int]) -> dict[str, np.ndarray]:
    """Arrays of numbers by name, each of so many axes, from a Matlab file; sizes are looked at first."""
    try:
        shapes = {name: (shape, kind) for name, shape, kind in whosmat(str(path))}
        for name, axes in wanted.items():
            shape, kind = shapes[name]
            if (
                len(shape) != axes
                or np.prod(shape, dtype=float) > LARGEST_MASK
                or kind in ("cell", "struct", "object")
            ):
                raise ValueError(f"{name} is {kind} of shape {shape}")
        return {name: np.asarray(loadmat(str(path), variable_names=[name])[name]) for name in wanted}
    except Exception as error:  # a damaged or forged file can fail anywhere in the reader
        raise UserError(f"{path}: cannot be read ({error})", "download the SampleSet again") from error


def _points(path: Path) -> Float[np.ndarray, "P 3"]:
    if path.stat().st_size > LARGEST_CLOUD:
        raise UserError(f"{path}: larger than 2 GiB", "give the points of the dataset's SampleSet")
    try:
        points = np.asarray(trimesh.load(path, process=False).vertices, dtype=np.float64)
    except Exception as error:  # as above
        raise UserError(f"{path}: cannot be read ({error})", "download the SampleSet again") from error
    if not len(points) or not np.isfinite(points).all():
        raise UserError(f"{path}: no points, or some that are not finite", "download the SampleSet again")
    return points


def _check(run: Run) -> None:
    if not has_surface(run):
        raise UserError(
            f"{run.path}: the host of this run has no surface to measure", "use --protocol neilfpp"
        )
    _files(run.capture)


def _measure(run: Run, rendered: Sequence[RenderedView]) -> dict[str, float]:
    scan = read_scan(run.capture)
    mesh = surface_mesh(run, RESOLUTION)
    vertices = run.capture.normalisation.to_world(torch.from_numpy(np.array(mesh.vertices, np.float64)))
    return chamfer_of_scan(vertices.numpy(), np.asarray(mesh.faces), scan)


DTU = Protocol(
    name=NAME,
    source="jzhangbs/DTUeval-python eval.py",
    left_out="nothing; the mesh is not cut with the images' masks, as some papers do before",
    check=_check,
    measure=_measure,
    needs_views=False,
)
