"""The surface that was extracted from the distance field of a run, kept in the run folder.

    RUN/cache/surface-256.npz    triangles, shading normals, and the fingerprint of what they were made from

Extraction at a resolution of 512 takes about ten seconds on a CPU, and the shading normals take longer.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Float32, Int32
from torch import Tensor

from neilfpp_method import __version__
from neilfpp_method.data.files.atomic_file import replacing
from neilfpp_method.data.files.number_arrays import arrays_of_archive
from neilfpp_method.errors import UserError
from neilfpp_method.export.extract import extract_mesh
from neilfpp_method.hosts.base import HasSdf
from neilfpp_method.hosts.volsdf import VolSdfHost
from neilfpp_method.model import NeilfModel
from neilfpp_method.train.run import Run
from neilfpp_method.volume.hits import HIT_RADIUS

__all__ = [
    "ExtractedSurface",
    "ShadedSurface",
    "extracted_surface",
    "read_surface",
    "shaded_surface",
    "shading_normals",
    "write_surface",
]

FORMAT = 2
"""Version of the file."""
NORMALS_AT_ONCE = 2**12
"""Number of points per call of the host's normal smoothing, which evaluates 32 neighbours of each. It bounds
the memory; four times as many take half as long again on a CPU, whose caches they do not fit.
"""


@dataclass(frozen=True)
class ExtractedSurface:
    """Triangles in the scene frame, oriented outwards; `normals` are unit shading normals, if computed."""

    vertices: Float32[np.ndarray, "V 3"]
    faces: Int32[np.ndarray, "F 3"]
    normals: Float32[np.ndarray, "V 3"] | None = None

    def mesh(self) -> trimesh.Trimesh:
        """The triangles as a trimesh mesh."""
        return trimesh.Trimesh(self.vertices, self.faces, process=False)


@dataclass(frozen=True)
class ShadedSurface:
    """Triangles in the scene frame, oriented outwards, with unit shading normals at the vertices."""

    vertices: Float32[np.ndarray, "V 3"]
    faces: Int32[np.ndarray, "F 3"]
    normals: Float32[np.ndarray, "V 3"]


def extracted_surface(
    run: Run, resolution: int, say: Callable[[str], None] = lambda text: None, keep: bool = True
) -> ExtractedSurface:
    """Return the zero set of the distance field of a run, from the file in the run folder if there is one.

    A file that is damaged, or was made from other weights, is replaced. A surface that cannot be written is
    returned all the same. Only the surface of the VolSDF host is kept.

    Args:
        run: a run whose host has a distance field.
        resolution: resolution of `extract_mesh`.
        say: receives a line if a file is replaced, or cannot be written.
        keep: whether a surface that had to be computed is written.

    Raises:
        UserError: the field has no zero set, or its grid does not fit in memory.
    """
    return _kept(run, resolution, lambda surface: surface, say, keep)


def shaded_surface(
    run: Run, resolution: int, say: Callable[[str], None] = lambda text: None, keep: bool = True
) -> ShadedSurface:
    """As `extracted_surface`, with the normals that the run uses for shading."""
    surface = _kept(run, resolution, lambda surface: _with_normals(run, surface), say, keep)
    return ShadedSurface(surface.vertices, surface.faces, surface.normals)


def _kept(
    run: Run,
    resolution: int,
    complete: Callable[[ExtractedSurface], ExtractedSurface],
    say: Callable[[str], None],
    keep: bool,
) -> ExtractedSurface:
    """Read or extract a surface, add what it lacks by `complete`, and write it unless it is unchanged."""
    path = run.path / "cache" / f"surface-{resolution}.npz"
    made_from = _fingerprint(run, resolution)
    stored = None if made_from is None else read_surface(path, made_from, say)
    surface = complete(stored or _extract(run, resolution))
    if keep and made_from is not None and surface is not stored:
        try:
            write_surface(path, surface, made_from)
        except UserError as error:
            say(f"{error.problem}; the surface will be extracted again next time")
    return surface


@torch.no_grad()
def shading_normals(
    model: NeilfModel, position: Float[Tensor, "N 3"], normal: Float[Tensor, "N 3"]
) -> Float[Tensor, "N 3"]:
    """Normals that a model uses for shading.

    Args:
        model: the model.
        position: any number of points on the surface, scene frame.
        normal: unit normals of the geometry there.
    """
    pairs = zip(position.split(NORMALS_AT_ONCE), normal.split(NORMALS_AT_ONCE), strict=True)
    return torch.cat([model.shading_normals(x, n) for x, n in pairs])


def _extract(run: Run, resolution: int) -> ExtractedSurface:
    host = run.model.host
    assert isinstance(host, HasSdf)
    # Stay inside the sphere that may close the scene, which is not part of the object.
    mesh = extract_mesh(host.sdf, run.config.background.radius - HIT_RADIUS, resolution, device=run.device)
    return ExtractedSurface(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32))


def _with_normals(run: Run, surface: ExtractedSurface) -> ExtractedSurface:
    """The surface with shading normals; the same object if it has them."""
    if surface.normals is not None:
        return surface
    position, normal = (
        torch.from_numpy(np.array(values, np.float32)).to(run.device)
        for values in (surface.vertices, surface.mesh().vertex_normals)
    )
    return replace(surface, normals=shading_normals(run.model, position, normal).cpu().numpy())


# --------------------------------------------------------------------------------------------------- the file


def _fingerprint(run: Run, resolution: int) -> str | None:
    """Hash of everything that determines the surface and its normals; None if the host is not known.

    The kind of device is included, because another one rounds differently.
    """
    host, config = run.model.host, run.config
    if not isinstance(host, VolSdfHost):
        return None
    settings = (FORMAT, __version__, resolution, config.background.radius, run.device.type)
    digest = hashlib.sha256(repr(settings).encode())
    for name, tensor in _surface_tensors(run.model, host):
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        digest.update(np.ascontiguousarray(tensor.detach().cpu().numpy()).data)
    return digest.hexdigest()


def _surface_tensors(model: NeilfModel, host: VolSdfHost) -> Iterator[tuple[str, Tensor]]:
    """The weights of G, the free space around the cameras, and the tilts of normals."""
    for part in filter(None, (host.sdf_field, host.free_space, model.tilts)):
        yield from part.named_parameters()
        yield from part.named_buffers()


def read_surface(path: Path, made_from: str, say: Callable[[str], None]) -> ExtractedSurface | None:
    """Read a surface; None if there is no file, or after a message if the file is of no use.

    Args:
        path: the file.
        made_from: the fingerprint that the file must have.
        say: receives the message.
    """
    if not path.is_file():
        return None
    try:
        surface = _checked(path, made_from)
    except Exception as error:
        # For a damaged archive, zipfile, zlib and numpy raise many types of exceptions.
        reason = " ".join(str(error).split())[:100] or type(error).__name__
        say(f"{path}: damaged ({reason}); the surface is extracted again")
        return None
    if surface is None:
        say(f"{path}: made from other weights or by another version; the surface is extracted again")
    return surface


def _checked(path: Path, made_from: str) -> ExtractedSurface | None:
    """Read a surface; None if it was made from something else.

    Raises:
        Exception: the file is damaged.
    """
    # Nothing is compressed, so that no array is larger than the file.
    stored = arrays_of_archive(path, path.stat().st_size)
    if str(stored["made_from"]) != made_from:
        return None
    vertices, faces, normals = (stored[name] for name in ("vertices", "faces", "normals"))
    for values, kind in ((vertices, np.float32), (faces, np.int32), (normals, np.float32)):
        if values.dtype != kind or values.ndim != 2 or values.shape[1] != 3 or not np.isfinite(values).all():
            raise ValueError(f"an array of {values.dtype} with the shape {values.shape}")
    if not len(faces) or faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError("a corner of a triangle does not exist")
    if len(normals) not in (0, len(vertices)):
        raise ValueError(f"{len(normals)} normals for {len(vertices)} vertices")
    return ExtractedSurface(vertices, faces, normals if len(normals) else None)


def write_surface(path: Path, surface: ExtractedSurface, made_from: str) -> None:
    """Write a surface and its fingerprint.

    Raises:
        UserError: the file cannot be written.
    """
    normals = np.zeros((0, 3), np.float32) if surface.normals is None else surface.normals
    with replacing(path) as temporary:
        np.savez(
            temporary,
            made_from=np.array(made_from),
            vertices=surface.vertices,
            faces=surface.faces,
            normals=normals,
        )
