"""The protocol of TensoIR against a second implementation of its formulas."""

from __future__ import annotations

import math
from pathlib import Path
from statistics import median_low

import numpy as np
import pytest

from neilfpp_method.data.files.images import write_png
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.published import PROTOCOLS, tensoir
from neilfpp_method.evaluate.published.tensoir import albedo_factor
from neilfpp_method.train.run import Run
from tests.data.make_capture import make_capture
from tests.evaluate.published.by_hand import random_view, run_with_images, similarity, srgb, unit

WIDTH, HEIGHT = 16, 14
PROTOCOL = PROTOCOLS["tensoir"]


@pytest.fixture
def truth(tmp_path: Path) -> dict[str, dict[str, np.ndarray]]:
    """Pictures of three test views, 8-bit RGBA, in the dataset's layout."""
    make_capture(tmp_path / "c", size=(WIDTH, HEIGHT), views=6, test=(0, 2, 4))
    draw, codes = np.random.default_rng(1), {}
    for name in ("000", "002", "004"):
        alpha = draw.choice([0, 128, 255], (HEIGHT, WIDTH, 1))
        codes[name] = {}
        for file in ("rgba_sunset", "albedo", "normal"):
            colors = draw.integers(1, 256, (HEIGHT, WIDTH, 3))
            codes[name][file] = np.concatenate([colors, alpha], axis=-1).astype(np.uint8)
            write_png(tmp_path / "c" / f"test_{name}" / f"{file}.png", codes[name][file])
    return codes


def run_of(tmp_path: Path, truth: dict) -> Run:
    root = tmp_path / "c"
    return run_with_images(root, {name: root / f"test_{name}" / "rgba_sunset.png" for name in truth})


def white(values: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Over white, pixel by pixel."""
    found = np.zeros(values.shape)
    for y, x, c in np.ndindex(*values.shape):
        a = float(alpha[y, x, 0])
        found[y, x, c] = float(values[y, x, c]) * a + 1 * (1 - a)
    return found


def psnr(estimate: np.ndarray, true: np.ndarray) -> float:
    errors = [(float(e) - float(t)) ** 2 for e, t in zip(estimate.flat, true.flat, strict=True)]
    return -10 * math.log10(sum(errors) / len(errors))


def inner(similar: np.ndarray) -> float:
    return float(similar[5:-5, 5:-5].mean())


def test_agrees_with_the_official_formula(tmp_path, truth, monkeypatch):
    monkeypatch.setattr(tensoir, "VIEWS_OF_THE_FACTOR", 2)  # 3 views: ⌊3/2⌋ = 1, so views 0 and 1
    run = run_of(tmp_path, truth)
    rendered = [random_view(name, HEIGHT, WIDTH, i) for i, name in enumerate(truth)]
    PROTOCOL.check(run)
    figures = PROTOCOL.measure(run, rendered)

    true = {
        name: {k: white(v[..., :3] / 255, v[..., 3:] / 255) for k, v in files.items()}
        for name, files in truth.items()
    }
    masks = {name: files["rgba_sunset"][..., 3] > 0 for name, files in truth.items()}
    albedo = {v.name: white(v.maps["base_color"], v.maps["opacity"]) for v in rendered}
    display = np.vectorize(lambda c: srgb(min(max(float(c), 0), 1)))
    shown = {v.name: white(display(v.maps["rgb"]), v.maps["opacity"]) for v in rendered}
    factor = [
        median_low(
            float(t) / max(float(e), 1e-6)
            for name in ("000", "002")
            for t, e in zip(
                true[name]["albedo"][masks[name]][:, c], albedo[name][masks[name]][:, c], strict=True
            )
        )
        for c in range(3)
    ]
    expected = {
        "render_psnr": np.mean([psnr(shown[n], true[n]["rgba_sunset"]) for n in truth]),
        "render_ssim": np.mean(
            [inner(similarity(shown[n], true[n]["rgba_sunset"], 11, "zero")) for n in truth]
        ),
    }
    for key, factors in (("albedo", factor), ("albedo_single", [factor[0]] * 3)):
        aligned = {n: np.ones((HEIGHT, WIDTH, 3)) for n in truth}
        for n in truth:
            aligned[n][masks[n]] = np.clip(albedo[n][masks[n]] * factors, 0, 1)
        both = [
            np.stack([side[n] for n in truth]) for side in (aligned, {n: true[n]["albedo"] for n in truth})
        ]
        expected[f"{key}_psnr"] = psnr(both[0] ** (1 / 2.2), both[1] ** (1 / 2.2))
        expected[f"{key}_ssim"] = np.mean(
            [inner(similarity(aligned[n], true[n]["albedo"], 11, "zero")) for n in truth]
        )
    angles = []
    for view in rendered:
        for y, x in np.ndindex(HEIGHT, WIDTH):
            *codes, alpha = truth[view.name]["normal"][y, x] / 255
            t = unit((np.array(codes) - 0.5) * 2 * alpha + np.array([0, 0, 1]) * (1 - alpha))
            o = float(view.maps["opacity"][y, x, 0])
            e = unit(view.maps["normal"][y, x].astype(float) * o + np.array([0, 0, 1]) * (1 - o))
            angles.append(math.degrees(math.acos(max(-1, min(1, sum(t * e))))))
    expected["normal_mae_deg"] = sum(angles) / len(angles)
    assert figures == pytest.approx(expected, abs=2e-4)


def test_known_answers():
    # Ratios 2, 4, 6, 8 of red: the lower of the middle two is 4. Green 1 throughout; blue divides by 1e-6.
    estimate = np.array([[0.1, 0.5, 0.0]] * 4)
    truth = np.array([[0.2, 0.5, 1e-6], [0.4, 0.5, 1e-6], [0.6, 0.5, 1e-6], [0.8, 0.5, 1e-6]])
    assert albedo_factor(estimate, truth) == pytest.approx([4, 1, 1])


def test_with_too_few_views_the_factor_comes_from_the_first(tmp_path, truth):
    run = run_of(tmp_path, truth)
    rendered = [random_view(name, HEIGHT, WIDTH, i) for i, name in enumerate(truth)]
    before = PROTOCOL.measure(run, rendered)["albedo_psnr"]
    scaled = dict(rendered[1].maps) | {"base_color": rendered[1].maps["base_color"] * 0.5}
    changed = [rendered[0], type(rendered[1])("002", scaled), rendered[2]]
    # With a factor over all views, halving one view would change how the others are scaled.
    assert PROTOCOL.measure(run, [rendered[0]] * 3)["albedo_psnr"] != before
    assert PROTOCOL.measure(run, changed)["render_psnr"] == PROTOCOL.measure(run, rendered)["render_psnr"]


def test_missing_files_are_named(tmp_path, truth):
    run = run_of(tmp_path, truth)
    (tmp_path / "c" / "test_002" / "normal.png").unlink()
    with pytest.raises(UserError, match="tensoir needs true normals") as told:
        PROTOCOL.check(run)
    assert "test_002/normal.png" in told.value.remedy
    write_png(tmp_path / "c" / "test_002" / "normal.png", np.zeros((3, 4, 3), np.uint8))
    with pytest.raises(UserError, match="4×3 pixels, but the view has 16×14"):
        PROTOCOL.measure(run, [random_view(name, HEIGHT, WIDTH, i) for i, name in enumerate(truth)])
