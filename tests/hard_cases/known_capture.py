"""Write images and masks of a known object into a folder, as a capture that `neilfpp train` reads.

The cameras are written in NumPy, apart from the package's. The scene frame is the world frame, unless the
world has another unit and origin.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh

from neilfpp_method.data.files.images import write_exr, write_png
from tests.data.make_capture import srgb
from tests.hard_cases.known_ball import RADIUS, KnownBall
from tests.hard_cases.known_shapes import INSIDE, Distance, Seen, meet

Array = np.ndarray
Look = Callable[[Array, Array], tuple[Array, Array]]
"""Origins and unit directions (N, 3) to whether the rays meet the object (N,), and linear radiance (N, 3)."""

DISTANCE = 3.0
"""Distance of the cameras from the origin, scene units."""
AT_ONCE = 1024
"""Rays that are rendered together: each of them takes 512 half vectors."""


def look_at_ball(ball: KnownBall, by_lobe: bool = True) -> Look:
    """The look of a ball about the origin, by quadrature."""

    def look(origins: Array, directions: Array) -> tuple[Array, Array]:
        # |o + t d|² = r²
        b = (origins * directions).sum(-1)
        under_root = b**2 - (origins**2).sum(-1) + RADIUS**2
        hit = under_root > 0
        normal = (origins + (-b - np.sqrt(under_root.clip(0)))[:, None] * directions)[hit] / RADIUS
        color = np.zeros_like(origins)
        parts = [slice(k, k + AT_ONCE) for k in range(0, len(normal), AT_ONCE)]
        wo = -directions[hit]
        color[hit] = np.concatenate([ball.outgoing(normal[part], wo[part], by_lobe) for part in parts])
        return hit, color

    return look


def look_at_shape(shape: Distance) -> Look:
    """The look of a shape with an exact distance, whose radiance depends on position and normal only."""

    def look(origins: Array, directions: Array) -> tuple[Array, Array]:
        hits = meet(shape, origins, directions)
        return hits.hit, hits.color

    return look


def write_capture(
    root: Path,
    look: Look,
    views: int = 20,
    size: int = 32,
    frame: float = 2.0,
    hdr: bool = True,
    inside: bool = False,
    cloud: Seen | None = None,
    mesh: trimesh.Trimesh | None = None,
    masks: bool = True,
    gains: Array | None = None,
    unit: float = 1.0,
    away: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Path:
    """Write a capture in the layout of the NeILF datasets, without maps.

    The cameras are spread over the sphere, as in `known_shapes.photograph`.

    Args:
        size: width and height of the images in pixels.
        frame: width of an image at the origin, scene units.
        hdr: linear EXR, or PNG with 8-bit sRGB values.
        inside: the cameras stand near the origin and look away from it, with a field of view of 90°.
        cloud: the point cloud of the capture, if it has one.
        mesh: the mesh of the capture, if it has one, scene frame.
        gains: factor on the radiance of each view, (V,); if None, all are 1.
        unit: length of a scene unit in the world.
        away: the centre of the scene in the world, scene units.
    """
    inputs, suffix = root / "inputs", ".exr" if hdr else ".png"
    distance = INSIDE if inside else DISTANCE
    focal, center = size / 2 if inside else DISTANCE * size / frame, size / 2
    across, up = np.meshgrid(np.arange(size) + 0.5 - center, np.arange(size) + 0.5 - center)
    local = np.stack((across, up, np.full_like(across, focal)), -1).reshape(-1, 3)
    local /= np.linalg.norm(local, axis=-1, keepdims=True)
    tracks, files = {}, {}
    for view in range(views):
        height, turn = 0.9 * (1 - (2 * view + 1) / views), view * np.pi * (3 - np.sqrt(5))
        flat = np.sqrt(1 - height**2)
        outward = np.array([flat * np.cos(turn), flat * np.sin(turn), height])
        forward = outward if inside else -outward
        right = np.cross(forward, [0.0, 0.0, 1.0]) / flat
        rotation = np.stack((right, np.cross(forward, right), forward))
        hit, color = look(np.broadcast_to(distance * outward, local.shape), local @ rotation)
        color, name = color.reshape(size, size, 3), f"{view:03d}"
        color = color if gains is None else gains[view] * color
        if hdr:
            write_exr(inputs / "images" / f"{name}.exr", {"RGB": color.astype(np.float32)})
        else:
            write_png(inputs / "images" / f"{name}.png", np.rint(255 * srgb(color)).astype(np.uint8))
        if masks:
            write_png(inputs / "masks" / f"{name}.png", 255 * hit.reshape(size, size).astype(np.uint8))
        w2c = np.eye(4)
        w2c[:3, :3], w2c[2, 3] = rotation, -distance if inside else distance
        w2c[:3, 3] = unit * (w2c[:3, 3] - rotation @ away)
        camera = {
            "intrinsic": {"focal": [focal, focal], "ppt": [center, center]},
            "extrinsic": w2c.reshape(-1).tolist(),
        }
        tracks[str(view)] = {"flg": 2, "size": [size, size], "camera": camera}
        files[str(view)] = f"images/{name}{suffix}"
    box = np.diag([2.0 * unit, 2.0 * unit, 2.0 * unit, 1.0])
    box[:3, 3] = unit * np.array(away)
    scene = {
        "camera_track_map": {"images": tracks},
        "image_path": {"file_paths": files},
        "bbox": {"transform": box.reshape(-1).tolist()},
    }
    if cloud is not None:
        write_cloud(inputs / "model" / "oriented_pcd.ply", unit * (cloud.position + away), cloud)
    if mesh is not None:
        corners = trimesh.Trimesh(unit * (mesh.vertices + away), mesh.faces, process=False)
        (inputs / "model").mkdir(exist_ok=True)
        corners.export(inputs / "model" / "mesh.ply")
    (inputs / "sfm_scene.json").write_text(json.dumps(scene))
    (root / "split.json").write_text(json.dumps({"test": [0]}))
    return root


def write_cloud(path: Path, position: Array, seen: Seen) -> None:
    """Write the world positions of the visible points of a shape with their normals as a PLY file."""
    columns = np.concatenate((position, seen.normal), -1)[seen.hit]
    properties = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    path.parent.mkdir()
    with path.open("w") as file:
        file.write(f"ply\nformat ascii 1.0\nelement vertex {len(columns)}\n{properties}end_header\n")
        np.savetxt(file, columns, fmt="%.9g")
