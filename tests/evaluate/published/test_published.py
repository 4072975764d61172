"""Published protocols against a second implementation of the official formulas, pixel by pixel in plain
Python.
"""

from __future__ import annotations

import math
import shutil
from pathlib import Path
from statistics import median

import numpy as np
import pytest

from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.files.images import read_image, write_png
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.published import PROTOCOLS
from neilfpp_method.evaluate.published.neilf_synthetic import aces, median_gamma
from neilfpp_method.evaluate.published.shiny_normals import weighted_angle
from neilfpp_method.evaluate.views import RenderedView, render_test_views
from neilfpp_method.train.run import Run
from tests.data import make_capture as scene
from tests.evaluate.test_protocols import KnownSphere, make_run


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return scene.make_capture(
        tmp_path_factory.mktemp("capture") / "c", size=(40, 30), views=6, test=(0, 3), masks=True
    )


@pytest.fixture
def run(root) -> Run:
    return make_run(load_capture(root), KnownSphere(base_color_factor=0.6))


def made_up(run: Run) -> tuple[RenderedView, ...]:
    """Estimates with errors, some of them outside of [0, 1], and with soft opacity."""
    generator = np.random.default_rng(3)
    views = []
    for view in render_test_views(run):
        maps = {
            name: (m + generator.normal(0, 0.1, m.shape)).clip(0, None).astype(np.float32)
            for name, m in view.maps.items()
        }
        normal = view.maps["normal"] + generator.normal(0, 0.2, view.maps["normal"].shape).astype(np.float32)
        opacity = (
            generator.uniform(0.8, 1.0, view.maps["opacity"].shape).astype(np.float32) * view.maps["opacity"]
        )
        views.append(RenderedView(view.name, maps | {"normal": normal, "opacity": opacity}))
    return tuple(views)


# -------------------------------------------------------------------------------------------- neilf-synthetic


def mean_psnr(estimates, truths, masks) -> float:
    """The mean over views of PSNR over the whole frame, images multiplied by their masks."""
    scores = []
    for estimate, truth, mask in zip(estimates, truths, masks, strict=True):
        height, width, channels = truth.shape
        total = 0.0
        for y in range(height):
            for x in range(width):
                m = 1.0 if mask[y, x] else 0.0
                total += sum(
                    (float(estimate[y, x, c]) * m - float(truth[y, x, c]) * m) ** 2 for c in range(channels)
                )
        scores.append(10 * math.log10(1 / (total / (height * width * channels))))
    return sum(scores) / len(scores)


def test_neilf_synthetic_is_the_official_formula(run, root):
    rendered = made_up(run)
    figures = PROTOCOLS["neilf-synthetic"].measure(run, rendered)
    masks = [view.maps["opacity"][..., 0] > 0.95 for view in rendered]
    files = root / "ground_truths" / "materials"
    true = {
        name: [read_image(files / folder / f"{view.name}.png").pixels[..., :channels] for view in rendered]
        for name, folder, channels in (
            ("base_color", "kd", 3),
            ("roughness", "roughness", 1),
            ("metallic", "metallic", 1),
        )
    }
    pooled = [
        [float(v) for image, mask in zip(side, masks, strict=True) for v in image[mask].flatten()]
        for side in (true["base_color"], [view.maps["base_color"] for view in rendered])
    ]
    gamma = math.log(median(pooled[0])) / math.log(median(pooled[1]))
    assert figures["base_color_gamma"] == pytest.approx(gamma, abs=1e-5)
    assert abs(gamma - 1) > 0.1, "the power matters in this test"
    aligned = [view.maps["base_color"].clip(0, 1) ** gamma for view in rendered]
    assert figures["base_color_psnr"] == pytest.approx(
        mean_psnr(aligned, true["base_color"], masks), abs=1e-3
    )
    for name in ("roughness", "metallic"):
        estimates = [view.maps[name] for view in rendered]
        assert figures[f"{name}_psnr"] == pytest.approx(mean_psnr(estimates, true[name], masks), abs=1e-3)

    def curve(x):
        return (2.51 * x**2 + 0.03 * x) / (2.43 * x**2 + 0.59 * x + 0.14)

    images = [
        curve(read_image(root / "inputs" / "images" / f"{view.name}.exr").pixels.astype(float))
        for view in rendered
    ]
    shown = [curve(view.maps["rgb"].astype(float)) for view in rendered]
    assert figures["render_psnr"] == pytest.approx(mean_psnr(shown, images, masks), abs=1e-3)


def test_known_answers():
    assert median_gamma(np.full((4, 3), 0.5), np.full((4, 3), 0.25)) == pytest.approx(2.0)  # 0.5² = 0.25
    assert aces(np.full((1, 1, 3), 1.0)) == pytest.approx(2.54 / 3.16)
    with pytest.raises(UserError, match="needs a median base colour"):
        median_gamma(np.full((4, 3), 0.5), np.zeros((4, 3)))


def test_an_error_names_the_place_of_missing_materials(root, tmp_path):
    bare = shutil.copytree(root, tmp_path / "bare")
    shutil.rmtree(bare / "ground_truths")
    with pytest.raises(UserError, match="neilf-synthetic needs true base colour") as told:
        PROTOCOLS["neilf-synthetic"].check(make_run(load_capture(bare)))
    assert "ground_truths/materials/kd/000.png" in told.value.remedy


# ---------------------------------------------------------------------------------------------- shiny-normals


def test_shiny_normals_weigh_by_opacity_and_alpha(run, root, tmp_path):
    """The true normals of one copy are 8-bit images beside the photographs, those of the other are float
    maps.
    """
    plain, pictured = load_capture(root), load_capture(shutil.copytree(root, tmp_path / "copied"))
    truths = {}
    for view in pictured.test_views:
        normal = read_image(root / "inputs" / "normal_maps" / f"{view.name}.exr").pixels
        codes = np.rint((normal + 1) / 2 * 255).astype(np.uint8)
        write_png(view.image.with_name(f"{view.name}_normal.png"), codes)
        truths[view.name] = normal, codes * 2.0 / 255 - 1
    rendered = made_up(run)
    for capture, chosen in ((plain, 0), (pictured, 1)):
        means = []
        for view in rendered:
            truth, weights, total = truths[view.name][chosen], 0.0, 0.0
            depth = read_image(root / "inputs" / "depth_maps" / f"{view.name}.exr").pixels[..., 0]
            for (y, x), d in np.ndenumerate(depth):
                # These files are beside images without alpha, so the whole frame counts.
                weight = float(view.maps["opacity"][y, x, 0]) * (chosen == 1 or d > 0)
                a, b = view.maps["normal"][y, x].astype(float), truth[y, x].astype(float)
                if weight:
                    cosine = (
                        sum(a * b) / math.sqrt(max(sum(a * a), 2**-23)) / math.sqrt(max(sum(b * b), 2**-23))
                    )
                    total += weight * math.degrees(math.acos(max(-1.0, min(1.0, cosine))))
                    weights += weight
            means.append(total / weights)
        measured = PROTOCOLS["shiny-normals"].measure(make_run(capture), rendered)["normal_mae_deg"]
        assert measured == pytest.approx(sum(means) / len(means), abs=1e-4)


def test_weights_shift_the_mean_angle():
    up, tilted = np.zeros((1, 2, 3)), np.zeros((1, 2, 3))
    up[..., 2] = 1
    tilted[0, 0], tilted[0, 1] = (0, 0, 3), (1, 0, 1)  # not of unit length: 0° and 45°
    assert weighted_angle(tilted, up, np.array([[1.0, 3.0]])) == pytest.approx(33.75, abs=0.01)
    assert weighted_angle(up, up, np.ones((1, 2))) == pytest.approx(math.degrees(math.acos(1 - 2**-23)))


def test_an_error_names_the_place_of_missing_normals(root, tmp_path):
    bare = shutil.copytree(root, tmp_path / "bare")
    shutil.rmtree(bare / "inputs" / "normal_maps")
    with pytest.raises(UserError, match="shiny-normals needs true normals") as told:
        PROTOCOLS["shiny-normals"].check(make_run(load_capture(bare)))
    assert "000_normal.png, or in the NeILF layout at inputs/normal_maps/000.exr" in told.value.remedy
