"""Captures written in other formats are read back: cameras, pixels, masks, scene box and split; lenses and
exposures if the format has them.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from neilfpp_method.data.cameras.lens import Lens
from neilfpp_method.data.cameras.projection import project
from neilfpp_method.data.capture import Capture, load_capture
from neilfpp_method.data.files.images import read_image, write_exr, write_png
from neilfpp_method.data.formats.write_sfm_scene import write_sfm_scene
from neilfpp_method.data.formats.write_transforms import write_transforms
from neilfpp_method.data.views import View
from neilfpp_method.errors import UserError
from tests.data.cameras.test_lens import COEFFICIENTS
from tests.data.formats.scenes import POINTS, pinhole_pixels
from tests.data.make_capture import make_capture

WRITERS: dict[str, Callable[[Capture, Path], Path]] = {
    "transforms": write_transforms,
    "sfm_scene": write_sfm_scene,
}


@pytest.fixture(params=WRITERS)
def writer(request) -> str:
    return request.param


def capture(root: Path, hdr: bool = True, masks: bool = True) -> Capture:
    return load_capture(make_capture(root, hdr=hdr, masks=masks, test=(1, 4)))


def written(captured: Capture, writer: str, out: Path) -> Capture:
    assert WRITERS[writer](captured, out) == out
    back = load_capture(out)
    assert back.format == writer
    return back


def with_views(captured: Capture, change: Callable[[View], View]) -> Capture:
    return replace(captured, views=tuple(change(view) for view in captured.views))


def bent(captured: Capture, model: str) -> Capture:
    lens = Lens(model, tuple(COEFFICIENTS[model]))
    return with_views(captured, lambda view: replace(view, camera=replace(view.camera, lens=lens)))


@pytest.mark.parametrize("hdr", [True, False])
@pytest.mark.parametrize("masks", [True, False])
def test_a_written_capture_is_read_back(tmp_path: Path, writer: str, hdr: bool, masks: bool) -> None:
    first = capture(tmp_path / "in", hdr, masks)
    back = written(first, writer, tmp_path / "out")
    assert back.normalization == first.normalization
    assert back.scene_from == "box"
    assert (back.hdr, back.test) == (first.hdr, first.test)
    assert back.point_cloud.read_bytes() == first.point_cloud.read_bytes()
    for i, (new, old) in enumerate(zip(back.views, first.views, strict=True)):
        assert new.name == old.name
        assert new.image.read_bytes() == old.image.read_bytes()
        assert new.image.is_relative_to(tmp_path / "out")
        assert not new.image.is_symlink()
        assert (new.mask and new.mask.read_bytes()) == (old.mask and old.mask.read_bytes())
        assert (
            np.abs(project(new.camera, torch.from_numpy(POINTS)).pixel.numpy() - pinhole_pixels(i)).max()
            < 1e-6
        )


def test_validity_masks_are_read_back(tmp_path: Path, writer: str) -> None:
    usable = np.full((18, 24), 255, np.uint8)
    usable[3:5, 7:9] = 0
    write_png(tmp_path / "usable.png", usable)
    first = with_views(capture(tmp_path / "in"), lambda view: replace(view, valid=tmp_path / "usable.png"))
    for view in written(first, writer, tmp_path / "out").views:
        assert np.array_equal(read_image(view.valid).pixels[..., 0] == 1, usable == 255)


def test_exposures_are_divided_out(tmp_path: Path, writer: str) -> None:
    first = with_views(
        capture(tmp_path / "in"), lambda view: replace(view, exposure=0.25, white_balance=(2.0, 1.0, 0.5))
    )
    back = written(first, writer, tmp_path / "out")
    for new, old in zip(back.views, first.views, strict=True):
        assert (new.exposure, new.white_balance) == (1.0, (1.0, 1.0, 1.0))
        expected = read_image(old.image).pixels / np.float32(0.25) / np.float32([2.0, 1.0, 0.5])
        assert np.allclose(read_image(new.image).pixels, expected, rtol=1e-6)


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"])
def test_nerfstudio_keeps_supported_lenses(tmp_path: Path, model: str) -> None:
    first = bent(capture(tmp_path / "in"), model)
    back = written(first, "transforms", tmp_path / "out")
    points = torch.from_numpy(POINTS)
    for new, old in zip(back.views, first.views, strict=True):
        assert new.image.read_bytes() == old.image.read_bytes()
        assert torch.allclose(project(new.camera, points).pixel, project(old.camera, points).pixel)


@pytest.mark.parametrize("hdr", [True, False])
def test_other_lenses_are_resampled_to_pinholes(tmp_path: Path, writer: str, hdr: bool) -> None:
    first = bent(capture(tmp_path / "in", hdr), "THIN_PRISM_FISHEYE")
    back = written(first, writer, tmp_path / "out")
    assert back.hdr == hdr
    for new, old in zip(back.views, first.views, strict=True):
        assert new.camera.lens is None
        assert new.image.suffix == (".exr" if hdr else ".png")
        # A pixel well inside the sphere has the value of the distorted image at the same point, to within a
        # pixel's step.
        point = torch.from_numpy(POINTS.mean(axis=0, keepdims=True))
        there, here = (project(view.camera, point).pixel[0].long() for view in (old, new))
        shown = read_image(new.image).pixels[here[1], here[0]]
        around = read_image(old.image).pixels[there[1] - 1 : there[1] + 2, there[0] - 1 : there[0] + 2]
        assert (shown >= around.min(axis=(0, 1)) - 1e-3).all()
        assert (shown <= around.max(axis=(0, 1)) + 1e-3).all()
        inside, outside = read_image(new.mask).pixels.mean(), read_image(old.mask).pixels.mean()
        assert 0.7 * outside < inside < 1.4 * outside


def test_a_resampled_pixel_is_valid_if_all_its_sources_are(tmp_path: Path, writer: str) -> None:
    first = bent(capture(tmp_path / "in", masks=False), "THIN_PRISM_FISHEYE")
    usable = np.random.default_rng(0).random((18, 24)) > 0.1
    write_png(tmp_path / "usable.png", np.where(usable, 255, 0).astype(np.uint8))
    write_exr(tmp_path / "clipped.exr", {"RGB": np.where(usable, 1.0, 1e6)[..., None].repeat(3, axis=2)})
    files = {"image": tmp_path / "clipped.exr", "valid": tmp_path / "usable.png"}
    for view in written(
        with_views(first, lambda view: replace(view, **files)), writer, tmp_path / "out"
    ).views:
        kept, pixels = read_image(view.valid).pixels[..., 0] == 1, read_image(view.image).pixels
        assert (pixels[kept] == 1.0).all()
        assert (pixels[~kept] > 1.0).all()
        assert 0.3 < kept.mean() < 0.9


def test_a_fisheye_among_pinholes_is_resampled(tmp_path: Path) -> None:
    first = capture(tmp_path / "in")
    lens = Lens("OPENCV_FISHEYE", tuple(COEFFICIENTS["OPENCV_FISHEYE"]))
    mixed = with_views(first, lambda v: v if v.index else replace(v, camera=replace(v.camera, lens=lens)))
    back = written(mixed, "transforms", tmp_path / "out")
    assert all(view.camera.lens is None for view in back.views)
    assert json.loads((tmp_path / "out" / "transforms.json").read_text())["camera_model"] == "OPENCV"


def test_every_split_of_nerfstudio_has_a_list(tmp_path: Path) -> None:
    write_transforms(capture(tmp_path / "in"), tmp_path / "out")
    content = json.loads((tmp_path / "out" / "transforms.json").read_text())
    assert content["test_filenames"] == content["val_filenames"] == ["images/001.exr", "images/004.exr"]
    assert len(content["train_filenames"]) == 4


def test_a_folder_that_cannot_be_written(tmp_path: Path, writer: str) -> None:
    (tmp_path / "out").write_text("a file, and no folder")
    with pytest.raises(UserError, match="out: cannot be written"):
        WRITERS[writer](capture(tmp_path / "in"), tmp_path / "out")
    assert (tmp_path / "out").read_text() == "a file, and no folder"


def test_the_description_is_written_last(tmp_path: Path, writer: str) -> None:
    first = capture(tmp_path / "in")
    first.views[3].image.unlink()
    with pytest.raises(UserError):
        WRITERS[writer](first, tmp_path / "out")
    assert not list((tmp_path / "out").rglob("*.json"))
    assert not [path for path in (tmp_path / "out").rglob(".*")]
