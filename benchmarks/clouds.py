"""How far the point cloud and the cameras of a prepared capture are from the truth: the figures of
docs/captures.md.

    neilfpp prepare DATA/ring_capture/images --out CAPTURE --cloud dense
    python -m benchmarks.clouds CAPTURE DATA/ring_capture/true_cameras.json \
        DATA/tabletop_env/inputs/model/mesh.ply

The capture's frame is its own, so the camera centres are brought to the true ones by a similarity first. The
mesh of tabletop_env is the surface that ring_capture shows.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
import tyro
from jaxtyping import Float64, Int64
from rich.console import Console
from scipy.spatial import cKDTree

from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.point_cloud import read_oriented_ply

SAMPLES, CANDIDATES = 600_000, 12


@dataclass(frozen=True)
class Similarity:
    """x ↦ scale · rotation · x + shift."""

    scale: float
    rotation: Float64[np.ndarray, "3 3"]
    shift: Float64[np.ndarray, " 3"]

    def __call__(self, points: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
        return self.scale * points @ self.rotation.T + self.shift


@dataclass(frozen=True)
class Nearest:
    """The distance of each point to a mesh, and the nearest face."""

    distance: Float64[np.ndarray, " N"]
    face: Int64[np.ndarray, " N"]


def align(found: Float64[np.ndarray, "N 3"], true: Float64[np.ndarray, "N 3"]) -> Similarity:
    """The similarity that maps points to their true positions with the least squared error (Umeyama 1991)."""
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    u, values, vt = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * signs) @ vt
    scale = float((values * signs).sum() / (a**2).sum())
    return Similarity(scale, rotation, true.mean(axis=0) - scale * rotation @ found.mean(axis=0))


def nearest(mesh: trimesh.Trimesh, points: Float64[np.ndarray, "N 3"]) -> Nearest:
    """Exact distances to the faces that contain the nearest of many samples of the surface."""
    samples, faces = trimesh.sample.sample_surface(mesh, SAMPLES, seed=0)
    candidates = faces[cKDTree(samples).query(points, k=CANDIDATES)[1]]
    distance, face = np.full(len(points), np.inf), np.zeros(len(points), dtype=np.int64)
    for candidate in candidates.T:
        closest = trimesh.triangles.closest_point(mesh.triangles[candidate], points)
        away = np.linalg.norm(closest - points, axis=1)
        face = np.where(away < distance, candidate, face)
        distance = np.minimum(away, distance)
    return Nearest(distance, face)


def main(
    capture: tyro.conf.Positional[Path], cameras: tyro.conf.Positional[Path], mesh: tyro.conf.Positional[Path]
) -> None:
    """Print the figures.

    Args:
        capture: the folder of a prepared capture with a point cloud.
        cameras: JSON, world to camera by view: {"000": {"w2c": …}}.
        mesh: the true surface.
    """
    loaded = load_capture(capture)
    truth = {name: np.array(entry["w2c"]) for name, entry in json.loads(cameras.read_text()).items()}
    true = np.stack([-truth[v.name][:3, :3].T @ truth[v.name][:3, 3] for v in loaded.views])
    found = np.stack([view.camera.c2w[:, 3] for view in loaded.views])
    place = align(found, true)
    surface = trimesh.load_mesh(mesh, process=False)
    radius = float(surface.extents.max()) / 2
    off = np.linalg.norm(place(found) - true, axis=1) / radius
    turns = [truth[view.name][:3, :3] @ place.rotation @ view.camera.w2c[:3, :3].T for view in loaded.views]
    angles = np.degrees(np.arccos(np.clip((np.trace(turns, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    points = read_oriented_ply(loaded.point_cloud)
    there = nearest(surface, place(points.position))
    normals = points.normal @ place.rotation.T
    bent = np.degrees(np.arccos(np.clip((normals * surface.face_normals[there.face]).sum(axis=1), -1, 1)))
    console = Console(highlight=False)
    console.print(f"{len(loaded.views)} of {len(truth)} cameras; radius of the scene {radius:.3f}")
    console.print(f"centres  largest {100 * off.max():.3f} % of the radius, rotations {angles.max():.3f}°")
    console.print(f"points   {len(points.position)}")
    for name, values, unit in (
        ("distance", 100 * there.distance / radius, "% of the radius"),
        ("normals", bent, "°"),
    ):
        console.print(
            f"{name:8} median {np.median(values):.3f}, 90th percentile {np.quantile(values, 0.9):.3f} {unit}"
        )


if __name__ == "__main__":
    tyro.cli(main)
