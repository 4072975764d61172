"""The Chamfer distance of DTU.

It is computed as in jzhangbs/DTUeval-python `eval.py`, which follows the Matlab code of the dataset. The
truth is read from the capture's folder or its parent, in the layout of the dataset's SampleSet. The number of
the scan is the last number in the name of the capture's folder:

    ObsMask/ObsMask<scan>_10.mat, ObsMask/Plane<scan>.mat, Points/stl/stl<scan, 3 digits>_total.ply

Details of the protocol:

- The surface is sampled about every 0.2 mm; of two points closer than that, one is removed.
- Distances of 20 mm or more are left out of the mean, not counted as 20 mm. Parts of a surface that are far
  from the truth therefore do not increase the figure.
- From the estimate to the truth, only points in cells that the scanner observed count. From the truth to the
  estimate, only points above the ground plane count; their nearest neighbour is searched among all points of
  the estimate in the enlarged box.
- The box of the observed cells is enlarged by 60 mm at its lower corner, and by 120 mm at its upper corner.
- The official code removes points in random order; here the order is fixed by a seed.

Some papers cut the mesh with the dilated masks of the images first; this protocol does not. Figures are in
millimetres if the capture is in the frame of the dataset, which the reader `dtu` keeps.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Integer

from neilfpp_method.data.capture import Capture
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.published.dtu_surface import capped_mean, surface_samples, thinned
from neilfpp_method.evaluate.published.mat_file import read_matrices
from neilfpp_method.evaluate.published.protocol import Protocol
from neilfpp_method.evaluate.published.truth_files import existing
from neilfpp_method.evaluate.views import RenderedView
from neilfpp_method.export.mesh import has_surface, surface_mesh
from neilfpp_method.train.run import Run

__all__ = ["DTU", "ScanData", "chamfer_of_scan"]

NAME = "dtu"
RESOLUTION = 512
"""Number of grid points along an edge of the scene when a surface is extracted from a distance field."""
SPACING = 0.2
"""Distance between surface samples, mm (official code)."""
MAX_DISTANCE = 20.0
"""Distance from which points are left out of the mean, mm (official code)."""
BOX_MARGIN = 60.0
"""Margin around the box of the observed cells, mm (official code)."""
SEED = 0
"""Seed of the order in which points are removed."""
LARGEST_CLOUD = 2**31
"""Largest accepted size of the file of true points, bytes."""


@dataclass(frozen=True)
class ScanData:
    """The scanner's data of one scan.

    Attributes:
        mask: nonzero in cells that the scanner observed.
        low: lower corner of the box of the cells, mm.
        high: upper corner of the box of the cells, mm.
        cell: edge length of a cell, mm.
        plane: ground plane (a, b, c, d); points with a x + b y + c z + d > 0 are above the ground.
        points: points of the true surface, mm.
    """

    mask: Integer[np.ndarray, "X Y Z"]
    low: Float[np.ndarray, " 3"]
    high: Float[np.ndarray, " 3"]
    cell: float
    plane: Float[np.ndarray, " 4"]
    points: Float[np.ndarray, "P 3"]


def chamfer_of_scan(
    vertices: Float[np.ndarray, "V 3"], faces: Integer[np.ndarray, "F 3"], scan: ScanData
) -> dict[str, float]:
    """Compute the distances from the estimate to the truth, from the truth to the estimate, and their mean.

    Args:
        vertices: vertices of the estimate, mm, frame of the dataset.
        faces: triangles of the estimate.
        scan: the scanner's data.

    Returns:
        chamfer_mm, chamfer_accuracy_mm and chamfer_completeness_mm.

    Raises:
        UserError: no point of the estimate lies in an observed cell, or none within 20 mm of the truth.
    """
    points = thinned(surface_samples(vertices, faces, SPACING), SPACING, SEED)
    inside = ((points >= scan.low - BOX_MARGIN) & (points < scan.high + 2 * BOX_MARGIN)).all(-1)
    points = points[inside]
    cells = np.around((points - scan.low) / scan.cell).astype(np.int64)
    on_grid = ((cells >= 0) & (cells < scan.mask.shape)).all(-1)
    observed = points[on_grid][scan.mask[tuple(cells[on_grid].T)] != 0]
    above = scan.points[scan.points @ scan.plane[:3] + scan.plane[3] > 0]
    if not len(observed) or not len(above):
        raise UserError(
            f"the protocol {NAME}: no point of the surface lies in the region that the scanner observed",
            "give the capture in the frame of the dataset, millimetres",
        )
    accuracy = capped_mean(observed, scan.points, MAX_DISTANCE)
    completeness = capped_mean(above, points, MAX_DISTANCE)
    if accuracy is None or completeness is None:
        raise UserError(
            f"the protocol {NAME}: no point of the surface lies within {MAX_DISTANCE:g} mm of the truth",
            "give the capture in the frame of the dataset, millimetres",
        )
    return {
        "chamfer_mm": (accuracy + completeness) / 2,
        "chamfer_accuracy_mm": accuracy,
        "chamfer_completeness_mm": completeness,
    }


def read_scan(capture: Capture) -> ScanData:
    """Read the scanner's data for the scan of a capture.

    Raises:
        UserError: a file is missing, damaged, or too large.
    """
    files = _files(capture)
    mask = read_matrices(files.mask, {"ObsMask": 3, "BB": 2, "Res": 2})
    plane = read_matrices(files.plane, {"P": 2})["P"].reshape(-1).astype(np.float64)
    box, cell = mask["BB"].astype(np.float64), mask["Res"].reshape(-1).astype(np.float64)
    shapes_fit = box.shape == (2, 3) and cell.shape == (1,) and plane.shape == (4,)
    if not shapes_fit or not np.isfinite([*box.flat, *cell, *plane]).all() or cell[0] <= 0:
        raise UserError(f"{files.mask}: not an observation mask of DTU", "download the SampleSet again")
    return ScanData(mask["ObsMask"], box[0], box[1], float(cell[0]), plane, _points(files.points))


@dataclass(frozen=True)
class _Files:
    """The files of the scanner's data of one scan, in the layout of the dataset's SampleSet."""

    mask: Path
    plane: Path
    points: Path


def _files(capture: Capture) -> _Files:
    """The files for the scan of a capture.

    Raises:
        UserError: a file is missing, or the folder of the capture has no number.
    """
    scans = re.findall(r"\d+", capture.root.resolve().name)
    if not scans:
        raise UserError(
            f"{capture.root}: the protocol {NAME} takes the number of the scan from the name of the folder, "
            "which has no number",
            "name the folder scan24, for instance",
        )
    scan = int(scans[-1])
    return _Files(
        mask=_file(capture, f"ObsMask/ObsMask{scan}_10.mat"),
        plane=_file(capture, f"ObsMask/Plane{scan}.mat"),
        points=_file(capture, f"Points/stl/stl{scan:03d}_total.ply"),
    )


def _file(capture: Capture, name: str) -> Path:
    """A file of the dataset, in the folder of the capture or in its parent."""
    root = capture.root.resolve()
    path = existing(root.parent, root / name, root.parent / name)
    if path is None:
        raise UserError(
            f"{capture.root}: the protocol {NAME} needs the scanner's data, and {name} is neither in "
            "this folder nor in its parent",
            "put ObsMask and Points of the dataset's SampleSet there",
        )
    return path


def _points(path: Path) -> Float[np.ndarray, "P 3"]:
    if path.stat().st_size > LARGEST_CLOUD:
        raise UserError(f"{path}: larger than 2 GiB", "give the points of the dataset's SampleSet")
    try:
        cloud = trimesh.load(path, process=False, skip_materials=True)
        points = np.asarray(cloud.vertices, dtype=np.float64)
    # A damaged or forged file can raise any exception in the reader.
    except Exception as error:
        raise UserError(f"{path}: cannot be read ({error})", "download the SampleSet again") from error
    if not len(points) or not np.isfinite(points).all():
        raise UserError(f"{path}: no points, or points that are not finite", "download the SampleSet again")
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
    vertices = run.capture.normalization.to_world(torch.from_numpy(np.array(mesh.vertices, np.float64)))
    return chamfer_of_scan(vertices.numpy(), np.asarray(mesh.faces), scan)


DTU = Protocol(
    name=NAME,
    source="jzhangbs/DTUeval-python eval.py",
    left_out="nothing; the mesh is not cut with the masks of the images first, as in some papers",
    check=_check,
    measure=_measure,
    needs_views=False,
)
