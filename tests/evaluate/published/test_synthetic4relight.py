"""The protocol of Synthetic4Relight against a second implementation of its formulas."""

from __future__ import annotations

import math
from pathlib import Path
from statistics import median_low

import numpy as np
import pytest

from neilfpp_method.data.files.images import write_png
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.published import PROTOCOLS
from tests.data.make_capture import make_capture
from tests.evaluate.published.by_hand import linear, random_view, run_with_images, similarity

WIDTH, HEIGHT = 13, 12
PROTOCOL = PROTOCOLS["synthetic4relight"]


def make_truth(root: Path, rough: str) -> dict[str, dict[str, np.ndarray]]:
    make_capture(root, size=(WIDTH, HEIGHT), views=6, test=(0, 3))
    draw, codes = np.random.default_rng(2), {}
    for name in ("000", "003"):
        codes[name] = {}
        for file in ("rgba", "albedo", rough):
            colors = draw.integers(0, 256, (HEIGHT, WIDTH, 3))
            colors = np.repeat(colors[..., :1], 3, axis=-1) if file == rough else colors
            alpha = draw.choice([0, 77, 255], (HEIGHT, WIDTH, 1))
            codes[name][file] = np.concatenate([colors, alpha], axis=-1).astype(np.uint8)
            write_png(root / "test" / f"{name}_{file}.png", codes[name][file])
    return codes


@pytest.mark.parametrize("rough", ["rough", "roughness"])
def test_agrees_with_the_official_formula(tmp_path, rough):
    root = tmp_path / "c"
    truth = make_truth(root, rough)
    run = run_with_images(root, {name: root / "test" / f"{name}_rgba.png" for name in truth})
    rendered = [random_view(name, HEIGHT, WIDTH, i) for i, name in enumerate(truth)]
    PROTOCOL.check(run)
    figures = PROTOCOL.measure(run, rendered)

    curve = np.vectorize(linear)
    albedo = {n: curve(f["albedo"][..., :3] / 255 * (f["albedo"][..., 3:] / 255)) for n, f in truth.items()}
    factor = [
        median_low(
            float(albedo[v.name][y, x, c]) / max(float(v.maps["base_color"][y, x, c]), 1e-6)
            for v in rendered
            for y, x in np.ndindex(HEIGHT, WIDTH)
            if truth[v.name]["albedo"][y, x, 3] > 0
        )
        for c in range(3)
    ]
    psnr, ssim, errors = [], [], []
    for view in rendered:
        alpha = truth[view.name]["rgba"][..., 3:] / 255
        e, t = view.maps["base_color"] * factor * alpha, albedo[view.name] * alpha
        for c in range(3):
            mse = sum((e[y, x, c] - t[y, x, c]) ** 2 for y, x in np.ndindex(HEIGHT, WIDTH)) / (HEIGHT * WIDTH)
            psnr.append(20 * math.log10(1 / math.sqrt(mse)))
        ssim.append(similarity(e, t, 11, "zero").mean())
        code = truth[view.name][rough] / 255
        true = code[..., :3] * code[..., 3:] * alpha
        errors.append(
            np.mean([(view.maps["roughness"][..., 0] * alpha[..., 0] - true[..., c]) ** 2 for c in range(3)])
        )
    expected = {
        "albedo_psnr": np.mean(psnr),
        "albedo_ssim": np.mean(ssim),
        "roughness_mse": np.mean(errors),
    }
    assert figures == pytest.approx(expected, abs=2e-4)


def test_channels_are_averaged_in_decibels(tmp_path):
    root = tmp_path / "c"
    make_truth(root, "rough")
    white = np.full((HEIGHT, WIDTH, 4), 255, np.uint8)
    for name in ("000", "003"):
        for file in ("rgba", "albedo", "rough"):
            write_png(root / "test" / f"{name}_{file}.png", white)
    run = run_with_images(root, {name: root / "test" / f"{name}_rgba.png" for name in ("000", "003")})
    view = random_view("000", HEIGHT, WIDTH, 0)
    brighter = np.array([0.1, 0.01, 0.001], np.float32)
    base_color = np.ones((HEIGHT, WIDTH, 3), np.float32)
    base_color[: HEIGHT // 2] += brighter
    estimate = type(view)("000", dict(view.maps) | {"base_color": base_color})
    # Ratios are 1/(1 + b) in one half and 1 in the other. The lower of the middle two scales one half to
    # the truth, and the other half errs by 1 − 1/(1 + b).
    error = np.square(1 - 1 / (1 + brighter.astype(float))) / 2
    expected = np.mean(-10 * np.log10(error))
    assert PROTOCOL.measure(run, [estimate, estimate])["albedo_psnr"] == pytest.approx(expected, abs=1e-2)


def test_missing_files_are_named(tmp_path):
    root = tmp_path / "c"
    truth = make_truth(root, "rough")
    run = run_with_images(root, {name: root / "test" / f"{name}_rgba.png" for name in truth})
    (root / "test" / "003_rough.png").unlink()
    with pytest.raises(UserError, match="needs true roughness") as told:
        PROTOCOL.check(run)
    assert "test/003_rough.png" in told.value.remedy
