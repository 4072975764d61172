"""The contact sheet and the rendered files of a small run: an untrained sphere on a capture with known
truth.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
import torch

from neilfpp_method.data.capture import load_capture
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.light_panels import light_sections
from neilfpp_method.evaluate.panels import albedo_scale, view_sections
from neilfpp_method.evaluate.pictures import display
from neilfpp_method.evaluate.render_views import render_run
from neilfpp_method.evaluate.sheet import write_contact_sheet, write_light_picture
from neilfpp_method.evaluate.views import RenderedView, known_test_views, render_test_views, render_view
from neilfpp_method.fields.lamps import Lamps
from neilfpp_method.train.run import Run
from tests.data.make_capture import make_capture
from tests.scenes import sphere_model, tiny_config


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return make_capture(tmp_path_factory.mktemp("captures") / "ball & <stick>", views=4, test=(0, 2))


def make_run(root: Path, step: int = 12) -> Run:
    model = sphere_model().eval()
    return Run(Path("run"), tiny_config(), load_capture(root), model.facts, model, step)


def without_truth(root: Path, copy: Path) -> Path:
    shutil.copytree(root, copy)
    for part in ("inputs/depth_maps", "inputs/normal_maps", "ground_truths"):
        shutil.rmtree(copy / part)
    return copy


def sections_of(run: Run):
    rendered = render_test_views(run)
    known = known_test_views(run, rendered).views
    return view_sections(run, rendered, known, albedo_scale(rendered, known))


# ----------------------------------------------------------------------------------------------------- report


def test_contact_sheet_shows_views_and_light(root: Path, tmp_path: Path):
    write_contact_sheet(make_run(root), tmp_path / "sheet.png")
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    assert sheet.shape[1] > 1000
    assert sheet.std() > 5


def test_a_run_without_material_shows_only_geometry(root: Path):
    titles = [row.title for section in sections_of(make_run(root, step=4)) for row in section.rows]
    assert titles == ["Image", "Normal"]


def test_maps_without_truth_have_no_truth_column(root: Path, tmp_path: Path):
    known = sections_of(make_run(root))
    assert [[row.title for row in s.rows] for s in known] == [
        ["Image", "Base colour", "Base colour", "Roughness", "Metallic", "Normal"]
    ]
    blind = sections_of(make_run(without_truth(root, tmp_path / "blind")))
    assert [[row.title for row in s.rows] for s in blind] == [
        ["Image"],
        ["Base colour", "Roughness", "Metallic", "Normal"],
    ]
    assert [group.columns for group in blind[1].groups] == 2 * [("estimate",)]
    assert all(len(row.pictures) == 2 for row in blind[1].rows)


def test_maps_are_shown_beside_truth_and_error(root: Path):
    run = make_run(root)
    roughness = sections_of(run)[0].rows[3]
    truth, estimate, error = roughness.pictures[:3]
    middle = truth.shape[0] // 2, truth.shape[1] // 2
    assert truth[middle][0] == 153  # the sphere of the capture has roughness 0.6 · 255
    shown = display("roughness", render_view(run, 0).maps["roughness"])
    assert estimate[middle][0] == shown[middle][0]
    colors = cv2.applyColorMap(np.arange(256, dtype=np.uint8), cv2.COLORMAP_INFERNO)[:, 0, ::-1]
    # Full brightness is an error of 0.5.
    expected = round(min(abs(153 - int(shown[middle][0])) / 255 / 0.5, 1.0) * 255)
    np.testing.assert_array_equal(error[middle], colors[expected])


def test_albedo_scale_undoes_a_factor_per_channel(root: Path):
    run = make_run(root)
    known = known_test_views(run, render_test_views(run)).views
    factors = np.array([0.5, 0.8, 1.25])
    halved = [
        RenderedView(k.view.name, {"base_color": (k.material["base_color"] * factors).astype(np.float32)})
        for k in known
    ]
    np.testing.assert_allclose(albedo_scale(halved, known), 1.0 / factors, rtol=1e-5)


# ------------------------------------------------------------------------------------------------------ light


def write_light_field(root: Path, sky: Callable[[np.ndarray], np.ndarray]) -> None:
    """Three points at which the incident light is `sky` in all directions."""
    generator = np.random.default_rng(0)
    wi = generator.normal(size=(3, 6000, 3))
    wi /= np.linalg.norm(wi, axis=-1, keepdims=True)
    normals = np.eye(3)
    wi *= np.sign((wi * normals[:, None]).sum(-1, keepdims=True))
    arrays = {
        "points": np.zeros((3, 3)),
        "normals": normals,
        "base_color": np.full((3, 3), 0.5),
        "roughness": np.full(3, 0.5),
        "metallic": np.zeros(3),
        "wi": wi,
        "incident": sky(wi),
        "wo": wi[:, :2],
        "outgoing": np.ones((3, 2, 3)),
    }
    (root / "light").mkdir()
    np.savez(
        root / "light" / "light_field_gt.npz", **{name: a.astype(np.float32) for name, a in arrays.items()}
    )


def test_known_light_is_shown_beside_the_estimate(root: Path, tmp_path: Path, monkeypatch):
    lit = Path(shutil.copytree(root, tmp_path / "lit"))
    write_light_field(lit, lambda wi: 1.0 + 0.5 * wi)
    run = make_run(lit)
    monkeypatch.setattr(run.model, "incident_light", lambda x, wi: 1.0 + 0.5 * wi)
    sections = light_sections(run, render_test_views(run), scale=np.array([2.0, 1.0, 1.0]))
    columns = [group.columns for section in sections for group in section.groups]
    assert columns == 3 * [("truth", "estimate", "estimate, scaled")]  # the capture knows three points
    pictures = [picture for section in sections for picture in section.rows[0].pictures]
    for truth, estimate, scaled in (pictures[3 * i : 3 * i + 3] for i in range(3)):
        # The known directions lie 1.9° apart: the sky changes by less than 2 % on the way to the nearest.
        assert np.abs(truth.astype(int) - estimate).max() <= 6
        lit_pixels = (estimate != scaled).any(-1)
        # Half of all directions, which are not half of the pixels where the poles are in view.
        assert 0.4 < lit_pixels.mean() < 0.6
        assert (scaled[lit_pixels][:, 0] < estimate[lit_pixels][:, 0]).all()
        np.testing.assert_array_equal(scaled[..., 1:], estimate[..., 1:])


def test_without_known_light_points_of_the_surface_are_shown(root: Path):
    run = make_run(root)
    groups = [
        group
        for section in light_sections(run, render_test_views(run), scale=None)
        for group in section.groups
    ]
    assert [group.columns for group in groups] == 4 * [("estimate",)]
    for group in groups:
        position = np.array(eval(group.title.removeprefix("Light at ")))
        # The sphere that every field starts as, seen at β = 0.02, blended where it is seen from the side.
        assert np.linalg.norm(position) == pytest.approx(0.6, abs=0.15)


def test_rings_mark_the_lamps_above_the_surface(root: Path, tmp_path: Path):
    lit = Path(shutil.copytree(root, tmp_path / "lit"))
    write_light_field(lit, lambda wi: 0 * wi + 1.0)  # at the world's origin, facing along x, y and z
    run = make_run(lit)
    origin = run.capture.normalization.to_scene(torch.zeros(3))
    run.model.lamps = Lamps(4, 0.06)
    run.model.lamps.place(origin + torch.tensor([[2.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), torch.ones(2, 3))
    pictures = [
        p for s in light_sections(run, render_test_views(run), scale=None) for p in s.rows[0].pictures
    ]
    red = [(estimate[..., 0] > 200) & (estimate[..., 1:] < 110).all(-1) for estimate in pictures[1::2]]
    facing_x = [found for found in red if found.any()]
    assert len(facing_x) == 1  # the other lamp is below or level with all three
    rows, columns = np.nonzero(facing_x[0])
    # +x is at θ = 90° and φ = 90°: half of the height, a quarter of the width.
    assert rows.mean() == pytest.approx(60, abs=1)
    assert columns.mean() == pytest.approx(60, abs=1)


def test_the_light_picture_is_written_separately(root: Path, tmp_path: Path):
    path = tmp_path / "light.png"
    assert write_light_picture(make_run(root), path)
    assert cv2.imread(str(path)).std() > 5
    path.unlink()
    assert not write_light_picture(make_run(root, step=4), path)  # no stage has trained the light
    assert not path.exists()


# ---------------------------------------------------------------------------------------------------- renders


def test_rendered_files_hold_the_values_and_rendering_continues(root: Path, tmp_path: Path):
    run = make_run(root)
    shares: list[float] = []
    written = render_run(run, tmp_path, ("test",), on_progress=shares.append)
    assert [path.name for path in written] == ["000.exr", "002.exr"]
    assert shares[-1] == 1.0
    assert shares == sorted(shares)
    maps = render_view(run, 0).maps
    channels = OpenEXR.File(str(written[0]), separate_channels=True).channels()
    np.testing.assert_array_equal(channels["base_color.G"].pixels, maps["base_color"][..., 1])
    np.testing.assert_array_equal(channels["normal.Z"].pixels, maps["normal"][..., 2])
    np.testing.assert_array_equal(channels["depth"].pixels, maps["depth"][..., 0])
    png = cv2.imread(str(tmp_path / "roughness" / "002.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(png, display("roughness", render_view(run, 2).maps["roughness"])[..., 0])
    assert {path.name for path in tmp_path.iterdir() if path.is_dir()} == set(maps)

    (tmp_path / "000.exr").unlink()
    kept = (tmp_path / "002.exr").stat().st_mtime_ns
    render_run(run, tmp_path, ("test",))
    assert (tmp_path / "000.exr").is_file()
    assert (tmp_path / "002.exr").stat().st_mtime_ns == kept
    render_run(run, tmp_path, ["002"], overwrite=True)
    assert (tmp_path / "002.exr").stat().st_mtime_ns > kept


def test_views_are_selected_by_group_or_by_name(root: Path):
    capture = load_capture(root)

    def names(*words: str) -> list[str]:
        return [view.name for view in capture.chosen_views(words)]

    assert names("train") == ["001", "003"]
    assert names("all") == ["000", "001", "002", "003"]
    assert names("003", "test", "000") == ["000", "002", "003"]
    with pytest.raises(UserError, match="no view '9'"):
        names("000", "9")
