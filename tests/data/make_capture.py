"""A tiny capture whose truth is known: a sphere, traced analytically, in the layout of the NeILF datasets.

It is written in NumPy without the package's cameras, so that it is an independent reference for them. In the
scene frame, the sphere is at the origin and has the radius RADIUS / SCALE = 0.8.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import trimesh

from neilfpp_method.data.files.images import write_exr, write_png

CENTER = np.array([0.3, -0.2, 0.5])
RADIUS = 1.2
SCALE = 1.5
DISTANCE = 5.0
LIGHT = np.array([0.48, 0.6, 0.64])
ROUGHNESS, METALLIC = 0.6, 0.2


def base_color(normal: np.ndarray) -> np.ndarray:
    """The sphere's base colour as a function of its normal."""
    return 0.5 + 0.3 * normal


def radiance(normal: np.ndarray) -> np.ndarray:
    """The linear radiance that the sphere sends to every viewer; above 1 where it faces the light."""
    return 2.0 * base_color(normal) * (0.2 + 0.8 * np.maximum(normal @ LIGHT, 0.0))[..., None]


def srgb(linear: np.ndarray) -> np.ndarray:
    """Display values in [0, 1]."""
    clipped = linear.clip(0, 1)
    return np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1 / 2.4) - 0.055)


def camera_pose(i: int, views: int) -> np.ndarray:
    """World to camera of view i: on a ring around the sphere, alternately above and below it, looking at its
    centre.
    """
    azimuth, elevation = 2 * np.pi * i / views, np.radians(35 if i % 2 else -10)
    outward = np.array(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    )
    forward = -outward
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    w2c = np.eye(4)
    w2c[:3, :3] = rotation
    w2c[:3, 3] = -rotation @ (CENTER + DISTANCE * outward)
    return w2c


def make_capture(
    root: Path,
    views: int = 6,
    size: tuple[int, int] = (24, 18),
    hdr: bool = True,
    masks: bool = False,
    background: float = 0.0,
    test: tuple[int, ...] | None = (0,),
) -> Path:
    """Write the capture into `root` and return it.

    Args:
        views: number of images, `000`, `001`, …
        size: width and height in pixels.
        hdr: linear float EXR, or 8-bit sRGB PNG.
        masks: write `inputs/masks`.
        background: linear radiance beside the sphere.
        test: the views held out by `split.json`, which alone have material maps; none writes no split.
    """
    width, height = size
    focal, center = (1.4 * height, 1.5 * height), (width / 2 + 0.5, height / 2 - 0.25)
    inputs, suffix = root / "inputs", ".exr" if hdr else ".png"
    tracks, files = {}, {}
    for i in range(views):
        w2c = camera_pose(i, views)
        rotation, eye = w2c[:3, :3], -w2c[:3, :3].T @ w2c[:3, 3]
        u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        local = np.stack([(u - center[0]) / focal[0], (v - center[1]) / focal[1], np.ones_like(u)], axis=-1)
        rays = local @ rotation
        # |eye + t·ray − centre| = radius; rays have unit depth, so t is the z-depth.
        a, b = (rays**2).sum(-1), rays @ (eye - CENTER)
        root_term = b**2 - a * (((eye - CENTER) ** 2).sum() - RADIUS**2)
        hit = root_term > 0
        depth = np.where(hit, (-b - np.sqrt(root_term.clip(0))) / a, 0.0)
        normal = np.where(hit[..., None], (eye + depth[..., None] * rays - CENTER) / RADIUS, 0.0)
        color = np.where(hit[..., None], radiance(normal), background)
        if hdr:
            write_exr(inputs / "images" / f"{i:03d}.exr", {"RGB": color.astype(np.float32)})
        else:
            write_png(inputs / "images" / f"{i:03d}.png", np.rint(255 * srgb(color)).astype(np.uint8))
        if masks:
            write_png(inputs / "masks" / f"{i:03d}.png", np.where(hit, 255, 0).astype(np.uint8))
        write_exr(inputs / "depth_maps" / f"{i:03d}.exr", {"Y": depth.astype(np.float32)})
        write_exr(inputs / "normal_maps" / f"{i:03d}.exr", {"RGB": normal.astype(np.float32)})
        if i in (test or ()):
            maps = {
                "kd": base_color(normal),
                "roughness": np.full(u.shape, ROUGHNESS),
                "metallic": np.full(u.shape, METALLIC),
            }
            for name, values in maps.items():
                values = values * hit.reshape(hit.shape + (1,) * (values.ndim - 2))
                path = root / "ground_truths" / "materials" / name / f"{i:03d}.png"
                write_png(path, np.rint(255 * values).astype(np.uint8))
        camera = {
            "intrinsic": {"focal": list(focal), "ppt": list(center)},
            "extrinsic": w2c.reshape(-1).tolist(),
        }
        tracks[str(i)] = {"flg": 2, "size": [width, height], "camera": camera}
        files[str(i)] = f"images/{i:03d}{suffix}"
    box = np.diag([2 * SCALE, 2 * SCALE, 2 * RADIUS, 1.0])
    box[:3, 3] = CENTER
    scene = {
        "camera_track_map": {"images": tracks},
        "image_path": {"file_paths": files},
        "bbox": {"transform": box.reshape(-1).tolist()},
    }
    (inputs / "sfm_scene.json").write_text(json.dumps(scene))
    if test is not None:
        (root / "split.json").write_text(json.dumps({"test": list(test)}))
    _write_surface(inputs / "model")
    return root


def _write_surface(folder: Path) -> None:
    """The sphere as a mesh and as 500 oriented points."""
    folder.mkdir()
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS)
    sphere.apply_translation(CENTER)
    sphere.export(folder / "mesh.ply")
    k = np.arange(500)
    z, azimuth = 1 - (k + 0.5) / 250, k * np.pi * (3 - np.sqrt(5))
    normal = np.stack([np.sqrt(1 - z**2) * np.cos(azimuth), np.sqrt(1 - z**2) * np.sin(azimuth), z], axis=1)
    write_ply(folder / "oriented_pcd.ply", CENTER + RADIUS * normal, normal)


def write_ply(path: Path, position: np.ndarray, normal: np.ndarray) -> None:
    """An oriented point cloud, binary."""
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(position)}\n{names}end_header\n"
    path.write_bytes(header.encode() + np.concatenate([position, normal], axis=1).astype("<f4").tobytes())
