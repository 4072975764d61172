"""The extracted surface in a run folder: it is used again, and replaced if it is stale or damaged."""

from __future__ import annotations

import io
import resource
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from neilfpp_method.export import surface_cache
from neilfpp_method.export.surface_cache import ShadedSurface, extracted_surface, shaded_surface
from neilfpp_method.relight.recovered import surface_of_run
from neilfpp_method.train.run import Run, load_run
from tests.calls import train_tiny
from tests.train.small_runs import few_steps

RESOLUTION = 32


@pytest.fixture(scope="module")
def trained(tmp_path_factory, masked_capture) -> Path:
    return train_tiny(masked_capture, tmp_path_factory.mktemp("runs") / "run", config=few_steps)


@pytest.fixture
def run(trained, tmp_path) -> Run:
    # The report of the training has kept a surface.
    shutil.copytree(trained, tmp_path / "run", ignore=shutil.ignore_patterns("cache"))
    return load_run(tmp_path / "run")


@pytest.fixture
def extractions(monkeypatch) -> list[int]:
    """The resolution of every extraction."""
    done, extract = [], surface_cache.extract_mesh

    def counted(sdf, radius, resolution, **options):
        done.append(resolution)
        return extract(sdf, radius, resolution, **options)

    monkeypatch.setattr(surface_cache, "extract_mesh", counted)
    return done


def file(run: Run) -> Path:
    return run.path / "cache" / f"surface-{RESOLUTION}.npz"


def shaded(run: Run, say: Callable[[str], None] = lambda text: None) -> ShadedSurface:
    return shaded_surface(run, RESOLUTION, say)


def same(one: ShadedSurface, other: ShadedSurface) -> bool:
    pairs = zip(vars(one).values(), vars(other).values(), strict=True)
    return all(np.array_equal(a, b) and a.dtype == b.dtype for a, b in pairs)


def test_the_second_time_nothing_is_extracted_and_every_bit_is_the_same(run, extractions):
    first, said = shaded(run), []
    assert extractions == [RESOLUTION]
    again = shaded(load_run(run.path), said.append)
    assert extractions == [RESOLUTION]
    assert same(first, again)
    assert said == []
    traced = surface_of_run(run, RESOLUTION)
    assert torch.equal(traced.triangles, torch.from_numpy(first.vertices[first.faces]))
    assert torch.equal(traced.corner_normals, torch.from_numpy(first.normals[first.faces]))


def test_normals_are_added_to_a_surface_that_was_kept_without(run, extractions, monkeypatch):
    assert extracted_surface(run, RESOLUTION).normals is None
    assert shaded(run).normals is not None
    assert extractions == [RESOLUTION]
    monkeypatch.setattr(
        surface_cache, "shading_normals", lambda *_: pytest.fail("normals are computed again")
    )
    assert shaded(run).normals is not None


def test_another_resolution_has_its_own_file(run, extractions):
    shaded(run)
    extracted_surface(run, 40)
    assert extractions == [RESOLUTION, 40]
    assert {path.name for path in file(run).parent.iterdir()} == {"surface-32.npz", "surface-40.npz"}


def _weights(run: Run) -> Run:
    with torch.no_grad():
        next(run.model.host.sdf_field.mlp.parameters()).mul_(1.001)
    return run


def _tilts(run: Run) -> Run:
    with torch.no_grad():
        run.model.tilts.grid.add_(0.1)
    return run


@pytest.mark.parametrize("change", [_weights, _tilts])
def test_what_determines_the_surface_makes_the_file_stale(run, extractions, change):
    shaded(run)
    changed, said = change(run), []
    shaded(changed, said.append)
    assert extractions == [RESOLUTION] * 2
    assert len(said) == 1
    assert "surface-32.npz: made from other weights" in said[0]
    # The file has been replaced.
    shaded(changed, said.append)
    assert len(extractions) == 2


def test_what_a_render_changes_does_not(run, extractions):
    """The grid for traced rays is sampled at its first use."""
    shaded(run)
    host = run.model.host
    host.distance_grid = torch.ones(4, 4, 4)
    shaded(run)
    assert extractions == [RESOLUTION]


def _flip(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]


def _with(**changes: np.ndarray) -> Callable[[bytes], bytes]:
    def changed(data: bytes) -> bytes:
        with np.load(io.BytesIO(data)) as stored:
            arrays = {name: stored[name] for name in stored.files} | changes
        out = io.BytesIO()
        np.savez(out, **arrays)
        return out.getvalue()

    return changed


def _compressed(data: bytes) -> bytes:
    out = io.BytesIO()
    with np.load(io.BytesIO(data)) as stored:
        np.savez_compressed(out, **stored)
    return out.getvalue()


def _forged_size(data: bytes) -> bytes:
    """A header announces more vertices than the file has."""
    header = io.BytesIO()
    described = {"descr": "<f4", "fortran_order": False, "shape": (2**40, 3)}
    np.lib.format.write_array_header_1_0(header, described)
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(out, "w") as new:
        for name in old.namelist():
            new.writestr(name, header.getvalue() if name == "vertices.npy" else old.read(name))
    return out.getvalue()


DAMAGE = {
    "a flipped bit": _flip,
    "cut off": lambda data: data[: len(data) // 2],
    "empty": lambda data: b"",
    "a face without a vertex": _with(faces=np.array([[0, 1, 10**6]], np.int32)),
    "a negative face": _with(faces=np.array([[0, 1, -1]], np.int32)),
    "no faces": _with(faces=np.zeros((0, 3), np.int32)),
    "other types": _with(vertices=np.zeros((3, 3))),
    "another shape": _with(vertices=np.zeros((3, 2), np.float32)),
    "NaN": _with(normals=np.full((3, 3), np.nan, np.float32)),
    "few normals": _with(normals=np.ones((3, 3), np.float32)),
    "objects": _with(vertices=np.array([[print, 1, 2]], object)),
    "compressed": _compressed,
    "a forged size": _forged_size,
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_a_damaged_file_is_replaced(run, extractions, damage):
    first, said = shaded(run), []
    whole = file(run).read_bytes()
    file(run).write_bytes(damage(whole))
    assert same(shaded(run, said.append), first)
    assert extractions == [RESOLUTION] * 2
    assert len(said) == 1
    assert "surface-32.npz: damaged (" in said[0]
    assert "\n" not in said[0]
    assert file(run).read_bytes() == whole


def test_a_folder_that_cannot_be_written(run):
    """Also if the disk is full while the file is written: no part of a file is left."""
    before, said = resource.getrlimit(resource.RLIMIT_FSIZE), []
    resource.setrlimit(resource.RLIMIT_FSIZE, (1500, before[1]))
    try:
        assert len(shaded(run, said.append).faces)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert len(said) == 1
    assert "surface-32.npz: cannot be written" in said[0]
    assert list(file(run).parent.iterdir()) == []
    file(run).parent.rmdir()
    file(run).parent.write_text("")
    assert len(shaded(run, said.append).faces)
    assert len(said) == 2


def test_a_surface_that_is_not_to_be_kept_is_not_written(run):
    extracted_surface(run, RESOLUTION, keep=False)
    assert not file(run).parent.exists()
