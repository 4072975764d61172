"""The pixel dataset: colours and rays compared with the analytic sphere, its statistics, and its draws."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
import torch
from scipy import stats

from neilfpp_method.data.cameras.lens import Lens
from neilfpp_method.data.capture import Capture, load_capture
from neilfpp_method.data.files.images import write_exr, write_png
from neilfpp_method.data.pixels.backdrop import border_color, border_colors, border_median
from neilfpp_method.data.pixels.dataset import BACKGROUND_TRUST, PixelDataset
from neilfpp_method.demo.command import demo_scene
from neilfpp_method.errors import UserError
from neilfpp_method.shading.color import tone_map
from tests.data.make_capture import RADIUS, SCALE, make_capture, radiance, srgb
from tests.data.skies import GROUND, make_sky_capture

SPHERE = RADIUS / SCALE
WIDTH, HEIGHT = 24, 18


def without_background(capture: Capture) -> Capture:
    """The capture with a ramp added to its images, so that no constant background identifies the object."""
    for view in capture.views:
        color = OpenEXR.File(str(view.image)).channels()["RGB"].pixels
        ramp = np.linspace(0.1, 0.2, HEIGHT * WIDTH, dtype=np.float32).reshape(HEIGHT, WIDTH, 1)
        write_exr(view.image, {"RGB": color + ramp})
    return capture


def dataset(root: Path, **options) -> PixelDataset:
    capture = load_capture(make_capture(root, **options))
    return PixelDataset(capture, capture.views)


def sphere_normals(batch) -> tuple[np.ndarray, np.ndarray]:
    """For each ray of a batch, whether it hits the sphere at the scene's origin, and the normal there."""
    o, d = batch.origins.double().numpy(), batch.directions.double().numpy()
    b = (o * d).sum(-1)
    inside = b**2 - (o**2).sum(-1) + SPHERE**2
    t = -b - np.sqrt(inside.clip(0))
    return inside > 1e-4, (o + t[:, None] * d) / SPHERE


@pytest.mark.parametrize("hdr", [True, False])
def test_rays_and_pixels_agree_with_the_sphere(tmp_path: Path, hdr: bool) -> None:
    pixels = dataset(tmp_path, hdr=hdr, masks=True)
    for batch in (*(pixels.view(i) for i in range(6)), pixels.sample(500)):
        hit, normal = sphere_normals(batch)
        expected = radiance(normal) if hdr else srgb(radiance(normal))
        assert np.allclose(
            batch.color.numpy()[hit],
            expected[hit],
            atol=2e-4 if hdr else 0.6 / 255,
            rtol=2**-11 if hdr else 0,
        )
        assert (batch.mask.numpy()[hit] == 1).all()
        assert hit.mean() > 0.2
    background = pixels.view(0).mask == 0
    assert (pixels.view(0).color[background] == 0).all()


def test_views_are_row_major_and_numbered(tmp_path: Path) -> None:
    pixels = dataset(tmp_path)
    assert len(pixels) == 6 * WIDTH * HEIGHT
    batch = pixels.view(5)
    assert (batch.view == 5).all()
    right, down = batch.directions[1] - batch.directions[0], batch.directions[WIDTH] - batch.directions[0]
    w2c = torch.from_numpy(pixels.views[5].camera.w2c).float()
    assert (w2c[:3, :3] @ right)[0] > 0
    assert (w2c[:3, :3] @ down)[1] > 0


def test_views_of_different_sizes(tmp_path: Path) -> None:
    small = load_capture(make_capture(tmp_path / "small", size=(10, 8)))
    large = load_capture(make_capture(tmp_path / "large", size=(24, 18)))
    pixels = PixelDataset(small, [small.views[1], large.views[2], small.views[3]])
    assert len(pixels) == 80 + 432 + 80
    for i, (capture, view) in enumerate([(small, 1), (large, 2), (small, 3)]):
        alone = PixelDataset(capture, [capture.views[view]]).view(0)
        assert torch.equal(pixels.view(i).color, alone.color)
        assert torch.equal(pixels.view(i).directions, alone.directions)


def test_samples_are_uniform_and_follow_the_global_seed(tmp_path: Path) -> None:
    capture = without_background(load_capture(make_capture(tmp_path)))
    pixels = PixelDataset(capture, capture.views)
    torch.manual_seed(3)
    first = pixels.sample(12_000)
    torch.manual_seed(3)
    assert torch.equal(first.color, pixels.sample(12_000).color)
    assert stats.chisquare(np.bincount(first.view, minlength=6)).pvalue > 1e-3
    local = torch.from_numpy(np.stack([view.camera.w2c[:3, :3] for view in pixels.views])).float()[first.view]
    plane = torch.einsum("nij,nj->ni", local, first.directions)
    left = int(
        (plane[:, 0] < -plane[:, 2] * 0.5 / 25.2).sum()
    )  # the principal point lies half a pixel right of the middle
    assert stats.binomtest(left, 12_000, 0.5).pvalue > 1e-3


def test_alpha_serves_as_the_mask(tmp_path: Path) -> None:
    root = make_capture(tmp_path / "alpha")
    color = np.ones((HEIGHT, WIDTH, 4), np.float32)
    color[:, :10, 3] = 0.2
    write_exr(root / "inputs" / "images" / "002.exr", {"RGBA": color})
    capture = load_capture(root)
    mask = PixelDataset(capture, [capture.views[2]]).view(0).mask.reshape(HEIGHT, WIDTH)
    assert (mask[:, :10] == 0).all()
    assert (mask[:, 10:] == 1).all()


@pytest.mark.parametrize("exposure", [1.0, 1000.0])
def test_image_gradient_of_a_ramp_does_not_depend_on_the_exposure(tmp_path: Path, exposure: float) -> None:
    root = make_capture(tmp_path)
    x, y = np.meshgrid(np.arange(WIDTH) - (WIDTH - 1) / 2, np.arange(HEIGHT) - (HEIGHT - 1) / 2)
    display = 1.055 * 0.18 ** (1 / 2.4) - 0.055 + 0.02 * x + 0.01 * y  # about middle grey
    linear = exposure * ((display + 0.055) / 1.055) ** 2.4  # the sRGB curve, inverted
    write_exr(root / "inputs" / "images" / "000.exr", {"RGB": np.repeat(linear[..., None], 3, axis=2)})
    capture = load_capture(root)
    gradient = PixelDataset(capture, [capture.views[0]]).view(0).image_gradient.reshape(HEIGHT, WIDTH)
    # The median is next to middle grey. Scharr's weights 3, 10, 3 and the two pixels between make 32
    # (published code).
    assert np.allclose(gradient[1:-1, 1:-1], 32 * np.hypot(0.02, 0.01), rtol=0.02)
    assert np.allclose(
        gradient[1:-1, 0], 32 * np.hypot(0.01, 0.01), rtol=0.02
    )  # half a difference at the border
    shown = tone_map(torch.from_numpy(linear / np.median(linear) * 0.18)).numpy().astype(np.float32)
    right, down = (cv2.Sobel(shown, cv2.CV_32F, *axis, ksize=cv2.FILTER_SCHARR) for axis in ((1, 0), (0, 1)))
    assert np.allclose(gradient[1:-1, 1:-1], np.hypot(right, down)[1:-1, 1:-1], rtol=0.02)


# -------------------------------------------------------------------------- invalid pixels, exposure, balance


def with_views(capture: Capture, **changes) -> Capture:
    return replace(capture, views=tuple(replace(view, **changes) for view in capture.views))


def marked(root: Path, columns: slice, **options) -> Capture:
    """The capture with some columns of every view marked as invalid, and NaN in a corner of them."""
    capture = load_capture(make_capture(root, **options))
    valid = np.full((HEIGHT, WIDTH), 255, np.uint8)
    valid[:, columns] = 0
    write_png(root / "valid.png", valid)
    for view in capture.views:
        color = OpenEXR.File(str(view.image)).channels()["RGB"].pixels
        color[0, columns] = np.nan
        color[1, columns] = -1
        write_exr(view.image, {"RGB": color})
    return with_views(capture, valid=root / "valid.png")


@pytest.mark.parametrize("columns", [slice(0, 5), slice(3, 20)])
def test_invalid_pixels_are_never_drawn_and_the_others_uniformly(tmp_path: Path, columns: slice) -> None:
    capture = without_background(marked(tmp_path, columns))
    pixels = PixelDataset(capture, capture.views)
    number = pixels.draw(20_000)
    column = number % WIDTH
    dead = torch.zeros(WIDTH, dtype=torch.bool)
    dead[columns] = True
    assert not dead[column].any()
    drawn = np.bincount(number.numpy(), minlength=len(pixels)).reshape(-1, WIDTH)[:, ~dead.numpy()]
    assert stats.chisquare(drawn.reshape(6, -1).sum(1)).pvalue > 1e-3
    assert stats.chisquare(drawn.sum(0)).pvalue > 1e-3
    assert pixels.sample(500).color.isfinite().all()
    assert torch.equal(pixels.valid(2).reshape(HEIGHT, WIDTH), ~dead.expand(HEIGHT, WIDTH))
    assert (pixels.view(2).color.reshape(HEIGHT, WIDTH, 3)[:2, columns] == 0).all()


def test_draws_do_not_change_where_all_pixels_are_valid(tmp_path: Path) -> None:
    capture = without_background(load_capture(make_capture(tmp_path)))
    write_png(tmp_path / "valid.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
    masked = with_views(capture, valid=tmp_path / "valid.png")
    numbers = []
    for known in (capture, masked):
        torch.manual_seed(11)
        numbers.append(PixelDataset(known, known.views).draw(100))
    torch.manual_seed(11)
    assert torch.equal(numbers[0], torch.randint(6 * WIDTH * HEIGHT, (100,)))
    assert torch.equal(numbers[0], numbers[1])


def test_statistics_leave_invalid_pixels_out(tmp_path: Path) -> None:
    capture = marked(tmp_path / "a", slice(0, 12), background=0.25)
    pixels = PixelDataset(capture, capture.views)
    whole = dataset(tmp_path / "b", background=0.25)
    right = torch.cat(
        [whole.view(i).color.reshape(HEIGHT, WIDTH, 3)[:, 12:].reshape(-1, 3) for i in range(6)]
    )
    object_ = right[(right != 0.25).any(-1)]
    assert pixels.median_radiance() == pytest.approx(
        float((object_ @ torch.tensor([0.2126, 0.7152, 0.0722])).median())
    )
    assert pixels.radiance_quantile(1.0) == float(object_.max())
    assert torch.equal(border_color(pixels), torch.tensor([0.25, 0.25, 0.25]))


def test_a_capture_without_valid_pixels_is_refused(tmp_path: Path) -> None:
    capture = marked(tmp_path, slice(0, WIDTH))
    with pytest.raises(UserError, match="no pixel is valid"):
        PixelDataset(capture, capture.views)


def test_pixels_at_which_a_lens_shows_nothing_are_never_drawn(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path, masks=True))
    whole = PixelDataset(capture, capture.views)
    bent = [
        replace(view, camera=replace(view.camera, lens=Lens("RADIAL", (-0.6, 0.0))))
        for view in capture.views[:3]
    ]
    pixels = PixelDataset(replace(capture, views=(*bent, *capture.views[3:])), (*bent, *capture.views[3:]))
    assert 0.5 < pixels.valid(1).float().mean() < 0.98
    assert pixels.valid(4).all()
    everywhere = torch.cat([pixels.valid(i) for i in range(6)])
    assert everywhere[pixels.draw(5000)].all()
    blind = pixels.view(1).directions[~pixels.valid(1)]
    axis = torch.from_numpy(bent[1].camera.w2c[2, :3]).float()
    assert torch.allclose(blind @ axis, torch.tensor(-1.0))
    assert torch.equal(pixels.view(4).directions, whole.view(4).directions)


def test_invalid_pixels_must_be_marked(tmp_path: Path) -> None:
    capture = with_views(marked(tmp_path, slice(0, 2)), valid=None)
    with pytest.raises(UserError, match=r"000\.exr: 4 pixels are NaN, infinite or negative.*validity mask"):
        PixelDataset(capture, capture.views)


def test_a_validity_mask_of_another_size_is_named(tmp_path: Path) -> None:
    capture = with_views(load_capture(make_capture(tmp_path)), valid=tmp_path / "valid.png")
    write_png(tmp_path / "valid.png", np.full((HEIGHT + 1, WIDTH), 255, np.uint8))
    with pytest.raises(UserError, match=r"valid\.png: the mask has another size"):
        PixelDataset(capture, capture.views)


def test_exposure_and_white_balance_are_divided_out(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path))
    truth = PixelDataset(capture, capture.views)
    views = []
    for i, view in enumerate(capture.views):
        exposure, balance = 2.0 ** (i - 3), (1.0 + 0.1 * i, 1.0, 2.0 - 0.1 * i)
        color = OpenEXR.File(str(view.image)).channels()["RGB"].pixels
        write_exr(view.image, {"RGB": (color * exposure * np.array(balance)).astype(np.float32)})
        views.append(replace(view, exposure=exposure, white_balance=balance))
    pixels = PixelDataset(replace(capture, views=tuple(views)), views)
    for i in range(6):
        assert torch.allclose(pixels.view(i).color, truth.view(i).color, rtol=1e-6)
        assert torch.allclose(pixels.view(i).image_gradient, truth.view(i).image_gradient, atol=1e-5)


def test_display_values_have_no_exposure(tmp_path: Path) -> None:
    capture = with_views(load_capture(make_capture(tmp_path, hdr=False)), exposure=2.0)
    with pytest.raises(UserError, match=r"000\.png: an exposure or white balance for display values"):
        PixelDataset(capture, capture.views)


# ------------------------------------------------------------------------------------------------- statistics


@pytest.mark.parametrize("hdr", [True, False])
def test_median_radiance_is_linear_and_of_the_object(tmp_path: Path, hdr: bool) -> None:
    pixels = dataset(tmp_path, hdr=hdr, masks=True, background=0.9)
    batches = [pixels.view(i) for i in range(6)]
    normal = np.concatenate([sphere_normals(batch)[1][batch.mask.numpy() == 1] for batch in batches])
    seen = radiance(normal) if hdr else radiance(normal).clip(0, 1)
    assert pixels.median_radiance() == pytest.approx(np.median(seen @ [0.2126, 0.7152, 0.0722]), rel=0.02)


def test_black_pixels_do_not_count_in_the_median(tmp_path: Path) -> None:
    without_masks = dataset(tmp_path / "a").median_radiance()
    assert without_masks == pytest.approx(dataset(tmp_path / "b", masks=True).median_radiance(), rel=1e-6)


def test_radiance_quantile_counts_linear_values(tmp_path: Path) -> None:
    hdr, ldr = dataset(tmp_path / "a"), dataset(tmp_path / "b", hdr=False)
    views = [hdr.view(i) for i in range(6)]
    values = np.sort(np.concatenate([view.color[view.mask > 0.5].numpy().ravel() for view in views]))
    assert hdr.radiance_quantile(1.0) == values[-1] > 1
    assert (values <= hdr.radiance_quantile(0.9)).mean() == pytest.approx(0.9, abs=1e-3)
    assert ldr.radiance_quantile(1.0) == pytest.approx(1)


@pytest.mark.parametrize("hdr", [True, False])
@pytest.mark.parametrize("background", [0.0, 0.5])
def test_border_color_is_linear(tmp_path: Path, hdr: bool, background: float) -> None:
    color = border_color(dataset(tmp_path, hdr=hdr, background=background))
    assert np.allclose(color, background, atol=0.004)


def test_no_border_color_if_the_border_varies(tmp_path: Path) -> None:
    root = make_capture(tmp_path)
    noise = np.random.default_rng(0)
    for i in range(6):
        image = noise.uniform(0, 1, (HEIGHT, WIDTH, 3)).astype(np.float32)
        write_exr(root / "inputs" / "images" / f"{i:03d}.exr", {"RGB": image})
    capture = load_capture(root)
    assert border_color(PixelDataset(capture, capture.views)) is None


def test_an_object_beyond_the_image_does_not_change_the_border_color(tmp_path: Path) -> None:
    """One view shows a part of the object that lies outside of all other views, so no hull contains it."""
    root = make_capture(tmp_path, masks=True)
    image, mask = root / "inputs" / "images" / "002.exr", root / "inputs" / "masks" / "002.png"
    color = OpenEXR.File(str(image)).channels()["RGB"].pixels
    color[:9, :8] = 0.5
    write_exr(image, {"RGB": color})
    on_object = cv2.imread(str(mask), cv2.IMREAD_GRAYSCALE)
    on_object[:9, :7] = 255
    write_png(mask, on_object)
    capture = load_capture(root)
    # The last column of the added part is not in the mask: a mixture of object and background.
    pixels = PixelDataset(capture, capture.views)
    assert 0 < (border_colors(pixels) == 0.5).any(-1).mean() < 0.01
    assert torch.equal(border_color(pixels), torch.zeros(3))


def test_no_border_color_under_a_sky(tmp_path: Path) -> None:
    """Most of the border is ground. The rest is sky, which cannot be a part of the scene."""
    capture = load_capture(make_sky_capture(tmp_path))
    pixels = PixelDataset(capture, capture.views)
    border = border_colors(pixels)
    assert 0.5 < (border == GROUND).all(-1).mean() < 0.95
    assert border_color(pixels) is None
    assert np.allclose(border_median(pixels), GROUND)


def test_a_table_that_extends_beyond_the_image_does_not_change_the_border_color() -> None:
    """The demo capture: a third of the border shows the table."""
    capture = load_capture(demo_scene())
    pixels = PixelDataset(capture, capture.train_views)
    assert (border_colors(pixels) == 0).all(-1).mean() < 0.75
    assert torch.equal(border_color(pixels), torch.zeros(3))


def test_loading_reports_each_view(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path))
    names: list[str] = []
    PixelDataset(capture, capture.train_views, on_view=names.append)
    assert names == ["001", "002", "003", "004", "005"]


def test_exact_background_pixels_are_off_the_object(tmp_path: Path) -> None:
    pixels = dataset(tmp_path, background=0.5)
    for i in range(6):
        view = pixels.view(i)
        background = (view.color == view.color[0]).all(dim=-1)
        assert torch.equal(view.mask_known, BACKGROUND_TRUST * background)
        assert torch.equal(view.mask.bool(), ~background)


def test_a_mask_file_is_known_everywhere(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path, masks=True))
    assert (PixelDataset(capture, capture.views).view(0).mask_known == 1).all()


def test_exact_pixels_are_those_of_the_files(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path))
    color = np.random.default_rng(0).uniform(0, 3, (HEIGHT, WIDTH, 3)).astype(np.float32)
    write_exr(tmp_path / "inputs" / "images" / "001.exr", {"RGB": color})
    kept = [
        PixelDataset(capture, capture.views, exact=exact).view(1).color.numpy() for exact in (False, True)
    ]
    assert np.array_equal(kept[1], color.reshape(-1, 3))
    assert not np.array_equal(kept[0], kept[1]), "a training keeps fewer bits"
    with pytest.raises(ValueError, match="in memory"):
        PixelDataset(capture, capture.views, folder=tmp_path / "pixels", exact=True)


def test_the_alpha_channel_of_a_mask_file_is_the_mask(tmp_path: Path) -> None:
    """Tools that cut out objects write such files: white, or the photograph, with the mask as alpha."""
    capture = load_capture(make_capture(tmp_path, masks=True))
    plain = PixelDataset(capture, capture.views).store.bits.copy()
    for i, view in enumerate(capture.views):
        mask = cv2.imread(str(view.mask), cv2.IMREAD_GRAYSCALE)
        color = np.full((*mask.shape, 3), 255 if i % 2 else 10, np.uint8)
        write_png(view.mask, np.dstack([color, mask]))
    again = PixelDataset(load_capture(tmp_path), capture.views).store.bits
    assert np.array_equal(plain, again)
