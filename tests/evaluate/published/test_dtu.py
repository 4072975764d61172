"""The Chamfer distance of DTU against a second implementation, on surfaces with known distances."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.io import savemat

from neilfpp_method.data.capture import load_capture
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.published import PROTOCOLS
from neilfpp_method.evaluate.published.dtu import ScanData, chamfer_of_scan, read_scan
from neilfpp_method.evaluate.published.dtu_surface import capped_mean, surface_samples, thinned
from tests.data.make_capture import make_capture
from tests.evaluate.test_protocols import make_run

FACE = np.array([[0, 1, 2]])


def triangle(height: float = 0.0, size: float = 8.0) -> np.ndarray:
    return np.array([[0, 0, height], [size, 0, height], [0, size, height]], float)


def scan(points: np.ndarray, plane: tuple[float, ...] = (0, 0, 1, 5)) -> ScanData:
    """A scan in which a box of 20 mm is observed completely, and the ground is 5 mm below."""
    low, high = np.array([-5.0, -5, -5]), np.array([15.0, 15, 15])
    return ScanData(np.ones((21, 21, 21), np.uint8), low, high, 1.0, np.array(plane, float), points)


def lattice(vertices: np.ndarray, spacing: float) -> list[tuple[float, ...]]:
    """Sample points of one triangle as in the official code, without arrays."""
    a, b, c = (tuple(map(float, v)) for v in vertices)
    u, v = [q - p for p, q in zip(a, b, strict=True)], [q - p for p, q in zip(a, c, strict=True)]
    l1, l2 = math.hypot(*u), math.hypot(*v)
    cross = (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0])
    cell = spacing * math.sqrt(l1 * l2 / math.hypot(*cross))
    n1, n2 = math.floor(l1 / cell), math.floor(l2 / cell)
    found = [a, b, c]
    for i in range(n1 + 1):
        for j in range(n2 + 1):
            s, t = (i + 0.5) / max(n1, 1e-7), (j + 0.5) / max(n2, 1e-7)
            if s + t < 1:
                found.append(tuple(p + s * q + t * r for p, q, r in zip(a, u, v, strict=True)))
    return found


SLANTED = [[0, 0, 0], [3, 0, 1], [1, 0.05, 4]]
THIN = [[0, 0, 0], [0.1, 0, 0], [0, 5, 0]]


@pytest.mark.parametrize("corners", [triangle(), SLANTED, THIN])
def test_samples_of_a_triangle(corners):
    corners = np.array(corners, float)
    found, expected = surface_samples(corners, FACE, 0.2), np.array(lattice(corners, 0.2))
    assert found.shape == expected.shape
    assert np.abs(np.sort(found, axis=0) - np.sort(expected, axis=0)).max() < 1e-9
    assert len(surface_samples(np.zeros((3, 3)), FACE, 0.2)) == 3  # no area, no lattice


def test_thinned_points_keep_the_spacing_and_cover_all_points():
    points = np.random.default_rng(0).uniform(0, 2, (2000, 3))
    kept = thinned(points, 0.2, 0)
    gaps = np.linalg.norm(kept[:, None] - kept[None], axis=-1)[np.triu_indices(len(kept), 1)]
    assert gaps.min() > 0.2
    assert np.linalg.norm(points[:, None] - kept[None], axis=-1).min(1).max() <= 0.2


def test_far_points_are_left_out_and_not_clipped():
    points = np.array([[1.0, 0, 0], [3, 0, 0], [20, 0, 0], [500, 0, 0]])
    assert capped_mean(points, np.zeros((1, 3)), 20.0) == pytest.approx(2.0)  # (1 + 3) / 2
    assert capped_mean(points[2:], np.zeros((1, 3)), 20.0) is None


def test_the_distance_of_parallel_planes():
    truth = surface_samples(triangle(0.5), FACE, 0.05)
    found = chamfer_of_scan(triangle(), FACE, scan(truth))
    # The nearest lattice points are shifted by at most 0.03 mm.
    assert found["chamfer_accuracy_mm"] == pytest.approx(0.5, abs=0.01)
    assert found["chamfer_completeness_mm"] == pytest.approx(0.5, abs=0.05)
    assert found["chamfer_mm"] == pytest.approx(
        (found["chamfer_accuracy_mm"] + found["chamfer_completeness_mm"]) / 2
    )


def by_hand(vertices: np.ndarray, faces: np.ndarray, seen: ScanData) -> tuple[float, float]:
    """Both means, from a table of all distances."""
    points = [p for face in faces for p in lattice(vertices[face], 0.2)]
    points += [tuple(v) for v in vertices]
    kept: list[np.ndarray] = []
    for p in map(np.array, points):
        if all(math.dist(p, q) > 0.2 for q in kept):
            kept.append(p)
    box = [p for p in kept if (p >= seen.low - 60).all() and (p < seen.high + 120).all()]
    observed = []
    for p in box:
        cell = [round(float(c)) for c in (p - seen.low) / seen.cell]
        if all(0 <= c < n for c, n in zip(cell, seen.mask.shape, strict=True)) and seen.mask[tuple(cell)]:
            observed.append(p)
    above = [q for q in seen.points if q @ seen.plane[:3] + seen.plane[3] > 0]
    there = [min(math.dist(p, q) for q in seen.points) for p in observed]
    back = [min(math.dist(q, p) for p in box) for q in above]
    return tuple(float(np.mean([d for d in side if d < 20])) for side in (there, back))


def test_the_mask_the_box_and_the_plane_select_the_points():
    draw = np.random.default_rng(4)
    # Pieces in the object, out of the observed cells, above the box by less and by more than 120 mm, below
    # it by 65 mm.
    vertices = np.concatenate(
        [
            triangle(0, 3),
            triangle(2, 3) + np.array([9, 9, 0]),
            triangle(100, 3),
            triangle(140, 3),
            triangle(-70, 3),
        ]
    )
    faces = np.arange(15).reshape(5, 3)
    seen = scan(draw.uniform(-5, 15, (300, 3)), plane=(0, 0.2, 1, -1))
    seen.mask[12:] = 0
    found = chamfer_of_scan(vertices, faces, seen)
    accuracy, completeness = by_hand(vertices, faces, seen)
    # Which of two close points is kept is random; this changes a mean of hundreds of distances only slightly.
    assert found["chamfer_accuracy_mm"] == pytest.approx(accuracy, abs=0.05)
    assert found["chamfer_completeness_mm"] == pytest.approx(completeness, abs=0.05)
    everywhere = chamfer_of_scan(vertices, faces, scan(seen.points))
    assert abs(everywhere["chamfer_accuracy_mm"] - accuracy) > 0.1, "the mask matters in this test"
    assert abs(everywhere["chamfer_completeness_mm"] - completeness) > 0.1, "the plane matters in this test"


def test_a_surface_outside_the_observed_region_is_an_error():
    with pytest.raises(UserError, match="that the scanner observed"):
        chamfer_of_scan(triangle() + 1000, FACE, scan(triangle()))
    with pytest.raises(UserError, match="within 20 mm"):
        chamfer_of_scan(triangle(), FACE, scan(triangle() + np.array([0, 0, 400])))


# ------------------------------------------------------------------------------------------------------ files


@pytest.fixture
def capture(tmp_path: Path):
    """The ball of `make_capture` as scan 24, with its truth in the parent folder."""
    root = make_capture(tmp_path / "scan24")
    mesh = trimesh.load(root / "inputs" / "model" / "mesh.ply")
    (tmp_path / "ObsMask").mkdir()
    (tmp_path / "Points" / "stl").mkdir(parents=True)
    low, high = mesh.bounds[0] - 1, mesh.bounds[1] + 1
    cells = np.ones(np.ceil(high - low).astype(int) + 1, np.uint8)
    savemat(tmp_path / "ObsMask" / "ObsMask24_10.mat", {"ObsMask": cells, "BB": [low, high], "Res": 1.0})
    savemat(tmp_path / "ObsMask" / "Plane24.mat", {"P": np.array([[0.0], [0], [1], [1000]])})
    trimesh.PointCloud(mesh.vertices).export(tmp_path / "Points" / "stl" / "stl024_total.ply")
    return load_capture(root)


def test_the_truth_is_read_from_the_folders_of_the_dataset(capture):
    seen = read_scan(capture)
    assert seen.cell == 1.0
    assert seen.plane.tolist() == [0, 0, 1, 1000]
    assert len(seen.points) == 642
    run = make_run(capture)
    PROTOCOLS["dtu"].check(run)


def test_damaged_and_missing_files_are_named(capture, tmp_path):
    plane = tmp_path / "ObsMask" / "Plane24.mat"
    savemat(plane, {"P": np.array([1.0, 2.0])})
    with pytest.raises(UserError, match="not an observation mask"):
        read_scan(capture)
    plane.write_bytes(b"MATLAB 5.0")
    with pytest.raises(UserError, match=r"Plane24\.mat: cannot be read"):
        read_scan(capture)
    plane.unlink()
    with pytest.raises(UserError, match=r"ObsMask/Plane24\.mat is neither in this folder nor in its parent"):
        PROTOCOLS["dtu"].check(make_run(capture))


def test_a_folder_without_a_number_is_refused(tmp_path):
    capture = load_capture(make_capture(tmp_path / "ball"))
    with pytest.raises(UserError, match="number of the scan from the name of the folder"):
        PROTOCOLS["dtu"].check(make_run(capture))
