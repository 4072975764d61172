"""The pixel store: exact to its number of bits, reused if nothing has changed, and rebuilt otherwise."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch

from neilfpp_method.data.capture import Capture, load_capture
from neilfpp_method.data.files.images import read_image, write_exr, write_png
from neilfpp_method.data.pixels import store
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.data.pixels.drawing import near_object
from neilfpp_method.data.pixels.encoding import HALF, MEDIAN_SAMPLES
from neilfpp_method.data.scaling import at_scale
from neilfpp_method.errors import UserError
from tests.data.make_capture import make_capture

WIDTH, HEIGHT = 24, 18


def opened(capture: Capture, folder: Path) -> tuple[PixelDataset, list[str]]:
    """The pixels of all views, and the names of those that had to be read."""
    names: list[str] = []
    return PixelDataset(capture, capture.views, on_view=names.append, folder=folder), names


def batches(pixels: PixelDataset) -> list[torch.Tensor]:
    views = [pixels.view(i) for i in range(len(pixels.views))]
    return [
        getattr(view, name) for view in views for name in ("color", "mask", "mask_known", "image_gradient")
    ]


def same(one: PixelDataset, other: PixelDataset) -> bool:
    return all(torch.equal(a, b) for a, b in zip(batches(one), batches(other), strict=True))


# ---------------------------------------------------------------------------------------------- what it holds


def test_8_bit_images_are_stored_exactly(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path / "c", hdr=False))
    pixels, _ = opened(capture, tmp_path / "pixels")
    assert (tmp_path / "pixels" / "color.npy").stat().st_size < 3 * len(pixels) + 200
    for i, view in enumerate(capture.views):
        assert np.array_equal(pixels.view(i).color.numpy(), read_image(view.image).pixels.reshape(-1, 3))


def test_16_bit_images_are_stored_exactly(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path / "c", hdr=False))
    samples = np.random.default_rng(0).integers(0, 65_536, (HEIGHT, WIDTH, 3), dtype=np.uint16)
    write_png(capture.views[3].image, samples)  # among others of 8 bits, which 16 hold as well
    pixels, _ = opened(capture, tmp_path / "pixels")
    for i, view in enumerate(capture.views):
        assert np.array_equal(pixels.view(i).color.numpy(), read_image(view.image).pixels.reshape(-1, 3))


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_radiance_is_stored_in_half_precision_in_any_unit(tmp_path: Path, unit: float) -> None:
    capture = load_capture(make_capture(tmp_path / "c"))
    color = unit * np.random.default_rng(0).lognormal(0, 3, (HEIGHT, WIDTH, 3)).astype(np.float32)
    write_exr(capture.views[0].image, {"RGB": color})
    pixels, _ = opened(capture, tmp_path / "pixels")
    assert np.load(tmp_path / "pixels" / "color.npy", mmap_mode="r").dtype == np.float16
    found = pixels.view(0).color.numpy().reshape(color.shape)
    bright = color > 1e-3 * color.mean()
    assert np.allclose(found[bright], color[bright], rtol=2**-11, atol=0)
    assert np.allclose(found, color, rtol=2**-11, atol=1e-6 * color.mean())


def test_a_range_beyond_half_precision_is_kept_in_single(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path / "c"))
    color = np.full((HEIGHT, WIDTH, 3), 1e-3, np.float32)
    color[5, 7] = 1e6  # a sun; half cannot hold it beside what it shines on
    write_exr(capture.views[2].image, {"RGB": color})
    pixels, names = opened(capture, tmp_path / "pixels")
    assert np.array_equal(pixels.view(2).color.numpy(), color.reshape(-1, 3))
    assert names == [view.name for view in capture.views], (
        "each view is reported once, though some were read twice"
    )


def test_a_factor_that_single_precision_cannot_hold_is_refused() -> None:
    dark = np.zeros((MEDIAN_SAMPLES, 1, 3), np.float32)
    dark[0, 0, 1] = 1e-40  # not among the sampled values
    assert HALF.encode(dark) is None


def test_in_memory_and_in_a_folder_are_the_same(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path / "c", masks=True))
    assert same(PixelDataset(capture, capture.views), opened(capture, tmp_path / "pixels")[0])


def test_single_pixels_are_those_of_their_views(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path / "c", masks=True))
    pixels, _ = opened(capture, tmp_path / "pixels")
    torch.manual_seed(0)
    numbers = pixels.draw(3000)
    torch.manual_seed(0)
    batch = pixels.sample(3000)
    whole = [pixels.view(i) for i in range(6)]
    for name in ("color", "mask", "mask_known", "image_gradient", "view", "origins", "directions"):
        expected = torch.cat([getattr(view, name) for view in whole])[numbers]
        torch.testing.assert_close(getattr(batch, name), expected, atol=1e-6, rtol=0)
    edges = numbers % WIDTH == 0
    assert edges.any(), "gradients at the border are compared, too"


def test_the_image_gradient_of_a_pixel_does_not_depend_on_how_many_are_drawn(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path / "c"))
    pixels, _ = opened(capture, tmp_path / "pixels")
    whole = torch.cat([pixels.view(i).image_gradient for i in range(6)])
    for count in range(1, 40):
        torch.manual_seed(count)
        numbers = pixels.draw(count)
        torch.manual_seed(count)
        assert torch.equal(pixels.sample(count).image_gradient, whole[numbers]), count


# ------------------------------------------------------------------------------------- found again, made anew


def test_an_unchanged_store_is_reused(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path / "c", masks=True))
    first, names = opened(capture, tmp_path / "pixels")
    assert len(names) == 6
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "pixels").iterdir()}
    again, names = opened(load_capture(tmp_path / "c"), tmp_path / "pixels")
    assert names == []
    assert same(first, again)
    assert before == {path: path.stat().st_mtime_ns for path in (tmp_path / "pixels").iterdir()}


def changed_image(root: Path) -> None:
    write_png(root / "inputs" / "images" / "002.png", np.full((HEIGHT, WIDTH, 3), 77, np.uint8))


def touched_mask(root: Path) -> None:
    os.utime(root / "inputs" / "masks" / "001.png", ns=(1, 1))


def moved_camera(root: Path) -> None:
    path = root / "inputs" / "sfm_scene.json"
    scene = json.loads(path.read_text())
    scene["camera_track_map"]["images"]["1"]["camera"]["intrinsic"]["focal"][0] += 1
    path.write_text(json.dumps(scene))


@pytest.mark.parametrize("change", [changed_image, touched_mask, moved_camera])
def test_changed_files_are_read_again(tmp_path: Path, change) -> None:
    root = make_capture(tmp_path / "c", hdr=False, masks=True)
    opened(load_capture(root), tmp_path / "pixels")
    change(root)
    capture = load_capture(root)
    pixels, names = opened(capture, tmp_path / "pixels")
    assert len(names) == 6
    assert same(pixels, PixelDataset(capture, capture.views))


def test_another_scale_is_another_store(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path / "c", hdr=False))
    opened(capture, tmp_path / "pixels")
    pixels, names = opened(at_scale(capture, 0.5), tmp_path / "pixels")
    assert (len(names), len(pixels)) == (6, 6 * 12 * 9)


def cut_off(folder: Path) -> None:
    path = folder / "color.npy"
    path.write_bytes(path.read_bytes()[:-1000])


def of_other_shape(folder: Path) -> None:
    np.save(folder / "bits.npy", np.zeros(7, np.uint8))


def pickled(folder: Path) -> None:
    np.save(folder / "color.npy", np.array([{"not": "pixels"}]), allow_pickle=True)


def without_description(folder: Path) -> None:
    (folder / "store.json").unlink()


def foreign_description(folder: Path) -> None:
    (folder / "store.json").write_text('{"format": "something else"}')


def negative_scale(folder: Path) -> None:
    known = json.loads((folder / "store.json").read_text())
    (folder / "store.json").write_text(json.dumps(known | {"scales": [-1.0] * 6}))


@pytest.mark.parametrize(
    "damage", [cut_off, of_other_shape, pickled, without_description, foreign_description, negative_scale]
)
def test_a_damaged_or_foreign_store_is_rebuilt(tmp_path: Path, damage) -> None:
    capture = load_capture(make_capture(tmp_path / "c"))
    opened(capture, tmp_path / "pixels")
    damage(tmp_path / "pixels")
    pixels, names = opened(capture, tmp_path / "pixels")
    assert len(names) == 6
    assert same(pixels, PixelDataset(capture, capture.views))
    assert opened(capture, tmp_path / "pixels")[1] == []


def test_a_failure_leaves_no_half_store(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path / "c"))
    whole = capture.views[4].image.read_bytes()
    capture.views[4].image.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UserError, match=r"004\.exr"):
        opened(capture, tmp_path / "pixels")
    assert list((tmp_path / "pixels").iterdir()) == []


def test_a_full_disk_is_an_error_before_anything_is_read(tmp_path: Path, monkeypatch) -> None:
    capture = load_capture(make_capture(tmp_path / "c"))
    monkeypatch.setattr(store.shutil, "disk_usage", lambda path: type("Usage", (), {"free": 10**6}))
    with pytest.raises(
        UserError, match=r"pixels: the pixels of the training views take 0\.0 GB, and 0\.0 GB are free"
    ):
        opened(capture, tmp_path / "pixels")
    assert not (tmp_path / "pixels").exists()


def test_mapped_pages_are_released_after_drawing(tmp_path: Path, monkeypatch) -> None:
    capture = load_capture(make_capture(tmp_path / "c"))
    pixels, _ = opened(capture, tmp_path / "pixels")
    given_back: list[int] = []
    monkeypatch.setattr(store, "MAX_MAPPED", 100 * store.BYTES_OF_A_DRAW)
    monkeypatch.setattr(store, "_advise", lambda array, what: given_back.append(array.nbytes))
    before = pixels.view(3).color
    for _ in range(4):
        pixels.sample(60)
    assert given_back, "the map is not left to grow with every draw"
    assert torch.equal(before, pixels.view(3).color)


# ------------------------------------------------------------------------------------------------ near or far


def test_pixels_near_the_object_form_a_disc_around_it() -> None:
    mask = np.zeros((100, 200), bool)
    mask[40:60, 90:110] = True
    rows, columns = np.mgrid[:100, :200]
    outside = np.hypot(np.maximum(abs(rows - 49.5) - 9.5, 0), np.maximum(abs(columns - 99.5) - 9.5, 0))
    near = near_object(mask)
    assert near[outside <= 15].all(), "8 % of 200 pixels, to a pixel"
    assert not near[outside > 17].any()
