"""The truth beside a capture: light, maps and scans."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import trimesh
from scipy.io import savemat

from neilfpp_method.data.truth import Truth
from neilfpp_method.evaluate.published.dtu import read_scan
from neilfpp_method.evaluate.published.truth_files import read_array
from tests.data.make_capture import make_capture
from tests.hard_cases.hostile.readers.reader import Reader, capture_beside

__all__ = ["TRUTH"]

SHAPE = (5, 7, 3)


def _truth(folder: Path) -> list[Path]:
    make_capture(folder)
    rng = np.random.default_rng(3)
    arrays = {"points": (5, 3), "normals": (5, 3), "base_color": (5, 3), "roughness": (5,), "metallic": (5,)}
    arrays |= {"wi": (5, 7, 3), "incident": (5, 7, 3), "wo": (5, 2, 3), "outgoing": (5, 2, 3)}
    path = folder / "light" / "light_field_gt.npz"
    path.parent.mkdir()
    np.savez_compressed(
        path, **{name: rng.random(shape).astype(np.float32) for name, shape in arrays.items()}
    )
    return [path]


def _read_truth(folder: Path, damaged: Path) -> None:
    field = Truth(capture_beside(folder)).light_field()
    assert field is not None
    assert field.position.shape == (len(field.position), 3)
    assert field.position.isfinite().all()
    assert field.incident.isfinite().all()


def _make_numbers(folder: Path) -> list[Path]:
    """Arrays of a protocol's truth."""
    values = np.random.default_rng(5).random(SHAPE)
    np.save(folder / "single.npy", values.astype(np.float32))
    np.save(folder / "big-endian.npy", values.astype(">f8"))
    np.save(folder / "columns.npy", np.asfortranarray(values))
    return sorted(folder.iterdir())


def _read_numbers(folder: Path, damaged: Path) -> None:
    values = read_array(damaged, SHAPE)
    assert values.shape == SHAPE
    assert values.dtype == np.float32


def _make_scan(folder: Path) -> list[Path]:
    """The scanner's data of DTU beside a capture."""
    make_capture(folder / "scan24")
    masks, points = folder / "ObsMask", folder / "Points" / "stl"
    masks.mkdir()
    points.mkdir(parents=True)
    mask = {"ObsMask": np.ones((5, 5, 5), np.uint8), "BB": np.array([[0.0, 0, 0], [4, 4, 4]]), "Res": [[1.0]]}
    savemat(masks / "ObsMask24_10.mat", mask)
    savemat(masks / "Plane24.mat", {"P": np.array([[0.0], [0], [1], [5]])}, do_compression=True)
    trimesh.PointCloud(np.random.default_rng(6).random((20, 3))).export(points / "stl024_total.ply")
    return [masks / "ObsMask24_10.mat", masks / "Plane24.mat", points / "stl024_total.ply"]


def _read_scanned(folder: Path, damaged: Path) -> None:
    scan = read_scan(capture_beside(folder / "scan24"))
    assert scan.mask.ndim == 3
    assert scan.cell > 0
    for values in (scan.low, scan.high, scan.plane, scan.points):
        assert np.isfinite(values).all()


TRUTH: Mapping[str, Reader] = {
    "NPZ of a light field": Reader(_truth, _read_truth),
    "NPY of a protocol's truth": Reader(_make_numbers, _read_numbers),
    "scan of DTU (MAT, PLY)": Reader(_make_scan, _read_scanned, 0.2),
}
