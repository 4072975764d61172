"""The protocol of Stanford-ORB against a second implementation of its formulas."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from neilfpp_method.data.files.images import write_exr, write_png
from neilfpp_method.data.scaling import at_scale
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.published import PROTOCOLS, stanford_orb
from neilfpp_method.evaluate.published.stanford_orb import albedo_scores, eroded, image_scores
from neilfpp_method.train.run import Run
from tests.data.make_capture import make_capture
from tests.evaluate.published.by_hand import linear, random_view, run_with_images, similarity, srgb

SIDE = 16
PROTOCOL = PROTOCOLS["stanford-orb"]
NAMES = ("000", "003")


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    monkeypatch.setattr(stanford_orb, "SIDE", SIDE)


@pytest.fixture
def files(tmp_path: Path) -> dict[str, dict[str, np.ndarray]]:
    """The truth of two views at four times the size, in the dataset's layout."""
    root, full = tmp_path / "blender_HDR" / "ball", 4 * SIDE
    make_capture(root, size=(full, full), views=6, test=(0, 3))
    truth = tmp_path / "ground_truth" / "ball"
    draw, made = np.random.default_rng(5), {}
    for folder in ("surface_normal", "z_depth"):
        (truth / folder).mkdir(parents=True)
    for name in NAMES:
        mask = np.zeros((full, full), np.uint8)
        mask[8:-8, 8:-12] = 255
        made[name] = {
            "image": draw.uniform(-0.1, 3, (full, full, 3)).astype(np.float32),
            "mask": mask,
            "albedo": draw.integers(0, 256, (full, full, 3)).astype(np.uint8),
            "normal": draw.normal(size=(full, full, 3)).astype(np.float32),
            "depth": draw.uniform(1, 2, (full, full)).astype(np.float32),
        }
        write_exr(root / "test" / f"{name}.exr", {"RGB": made[name]["image"]})
        write_png(root / "test_mask" / f"{name}.png", mask)
        write_png(truth / "pseudo_gt_albedo" / f"{name}.png", made[name]["albedo"])
        np.save(truth / "surface_normal" / f"{name}.npy", made[name]["normal"])
        np.save(truth / "z_depth" / f"{name}.npy", made[name]["depth"])
    return made


def run_of(tmp_path: Path) -> Run:
    root = tmp_path / "blender_HDR" / "ball"
    run = run_with_images(root, {name: root / "test" / f"{name}.exr" for name in NAMES}, hdr=True)
    return dataclasses.replace(run, capture=at_scale(run.capture, 0.25))


def quarter(values: np.ndarray) -> np.ndarray:
    """The mean of each 4 by 4 pixels."""
    side = len(values) // 4
    return values.reshape(side, 4, side, 4, *values.shape[2:]).astype(float).mean((1, 3))


def shrunk(mask: np.ndarray) -> np.ndarray:
    found = np.zeros((SIDE, SIDE))
    for y, x in np.ndindex(SIDE, SIDE):
        near = [(y + i, x + j) for i in range(-2, 3) for j in range(-2, 3)]
        found[y, x] = all(mask[p] > 0.5 for p in near if 0 <= p[0] < SIDE and 0 <= p[1] < SIDE)
    return found


def psnr(estimate: np.ndarray, truth: np.ndarray, inner: np.ndarray) -> float:
    error = ((estimate - truth) ** 2).sum() / truth.size
    gray = ((0.5 * inner[..., None] - truth) ** 2).sum() / truth.size
    return max(-10 / math.log(10) * math.log(error), -10 / math.log(10) * math.log(gray))


def ssim(estimate: np.ndarray, truth: np.ndarray) -> float:
    loss = ((1 - similarity(estimate, truth, 3, "mirror")) / 2).clip(0, 1).mean()
    return 1 - 2 * float(loss)


def test_agrees_with_the_official_formula(tmp_path, files):
    run = run_of(tmp_path)
    rendered = [random_view(name, SIDE, SIDE, i) for i, name in enumerate(NAMES)]
    PROTOCOL.check(run)
    figures = PROTOCOL.measure(run, rendered)
    curve, line = np.vectorize(srgb), np.vectorize(linear)
    scores: dict[str, list[float]] = {}
    depths = []
    for view in rendered:
        true = files[view.name]
        inner = shrunk(quarter(true["mask"] / 255))
        assert 0 < inner.sum() < SIDE * SIDE
        m = inner[..., None]
        e, t = view.maps["rgb"] * m, np.maximum(quarter(true["image"]) * m, 0)
        gain = curve(t.clip(0, 1)).mean() / t.clip(0, 1).mean()
        shown, display = curve(e.clip(0, 1)), curve(t.clip(0, 1))
        found = {
            "render_psnr_h": psnr((e * gain).clip(0, 4), (t * gain).clip(0, 4), inner),
            "render_psnr_l": psnr(shown, display, inner),
            "render_ssim": ssim(shown, display),
        }
        e, t = view.maps["base_color"] * m, line(quarter(true["albedo"] / 255)) * m
        for c in range(3):
            e[..., c] *= (e[..., c] * t[..., c]).sum() / (e[..., c] ** 2).sum()
        found |= {"albedo_psnr": psnr(e.clip(0, 1), t, inner), "albedo_ssim": ssim(e.clip(0, 1), t)}
        camera = next(v for v in run.capture.views if v.name == view.name).camera
        distance = []
        for y, x in zip(*np.nonzero(inner), strict=True):
            right, down, ahead = camera.w2c[:3, :3] @ (view.maps["normal"][y, x] * view.maps["opacity"][y, x])
            a, b = np.array([right, -down, -ahead]), quarter(true["normal"])[y, x]
            distance.append(1 - (a / (np.linalg.norm(a) + 1e-6)) @ (b / (np.linalg.norm(b) + 1e-6)))
        found["normal_distance"] = float(np.mean(distance))
        depth = np.zeros((SIDE, SIDE))
        for y, x in np.ndindex(SIDE, SIDE):
            ray = np.array([(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy, 1])
            depth[y, x] = view.maps["depth"][y, x, 0] / np.linalg.norm(ray)
        depths.append((depth, quarter(true["depth"]), inner))
        for name, value in found.items():
            scores.setdefault(name, []).append(value)
    factor = sum((d * t * m).sum() for d, t, m in depths) / sum((d * d * m).sum() for d, _, m in depths)
    expected = {name: np.mean(values) for name, values in scores.items()}
    expected["depth_mse"] = np.mean([(((factor * d - t) ** 2) * m).sum() / SIDE**2 for d, t, m in depths])
    assert figures == pytest.approx(expected, abs=5e-4)


def test_no_image_scores_below_gray():
    full = np.ones((SIDE, SIDE))
    gray = np.full((SIDE, SIDE, 3), 0.5)
    # sRGB of 1 and of 0 are 1 apart, and 0.5 from grey: 10 log10(1 / 0.25) = 6.02 dB.
    found = image_scores("render", 2 * gray, 0 * gray, full)
    assert found["render_psnr_l"] == pytest.approx(6.0206, abs=1e-4)


def test_albedo_is_aligned_and_views_are_not():
    draw, full = np.random.default_rng(0), np.ones((SIDE, SIDE))
    truth = draw.uniform(0.1, 0.9, (SIDE, SIDE, 3)).astype(np.float32)
    estimate = truth * np.array([0.5, 2.0, 0.1], np.float32)
    assert albedo_scores(estimate, truth, full)["albedo_psnr"] > 90
    assert image_scores("render", estimate, truth, full)["render_psnr_l"] < 20


def test_masks_shrink_by_two_pixels():
    mask = np.zeros((SIDE, SIDE))
    mask[3:10, 4:12] = 1
    expected = np.zeros((SIDE, SIDE))
    expected[5:8, 6:10] = 1
    assert (eroded(mask) == expected).all()


def test_missing_truth_is_not_measured_and_masks_are_required(tmp_path, files):
    run = run_of(tmp_path)
    for folder in ("pseudo_gt_albedo", "surface_normal", "z_depth"):
        for name in NAMES:
            next((tmp_path / "ground_truth" / "ball" / folder).glob(f"{name}.*")).unlink()
    rendered = [random_view(name, SIDE, SIDE, i) for i, name in enumerate(NAMES)]
    assert set(PROTOCOL.measure(run, rendered)) == {"render_psnr_h", "render_psnr_l", "render_ssim"}
    (tmp_path / "blender_HDR" / "ball" / "test_mask" / "003.png").unlink()
    with pytest.raises(UserError, match="needs a mask") as told:
        PROTOCOL.check(run)
    assert "test_mask/003.png" in told.value.remedy


def test_arrays_are_numbers_of_the_right_shape(tmp_path, files):
    run, place = run_of(tmp_path), tmp_path / "ground_truth" / "ball" / "z_depth" / "003.npy"
    rendered = [random_view(name, SIDE, SIDE, i) for i, name in enumerate(NAMES)]
    for bad in (np.zeros((3, 3)), np.array([{"a": 1}], dtype=object)):
        np.save(place, bad, allow_pickle=True)
        with pytest.raises(UserError, match=r"003\.npy"):
            PROTOCOL.measure(run, rendered)


def test_views_of_another_size_are_refused(tmp_path, files):
    run = run_of(tmp_path)
    with pytest.raises(UserError, match="16×16 pixels, and view 000 has 32×32"):
        PROTOCOL.check(dataclasses.replace(run, capture=at_scale(run.capture, 0.5)))
