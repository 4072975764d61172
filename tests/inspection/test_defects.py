"""Inspection finds no defect in a good capture, and exactly the planted one in every other."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from PIL import Image

import neilfpp_method
from neilfpp_method.cli import main
from neilfpp_method.data.capture import Capture, load_capture
from neilfpp_method.data.files.images import write_exr, write_png
from neilfpp_method.inspection.defects import Inspection, inspect_capture, problems_of_poses
from tests.data.make_capture import make_capture, srgb, write_ply

SCENE = Path(neilfpp_method.__file__).parent / "demo" / "scene"
VICTIM = 7


def radiance(path: Path) -> np.ndarray:
    return OpenEXR.File(str(path)).channels()["RGB"].pixels.astype(np.float32)


def change(path: Path, how: Callable[[np.ndarray], np.ndarray]) -> None:
    write_exr(path, {"RGB": how(radiance(path)).astype(np.float32)})


@pytest.fixture
def capture(tmp_path: Path) -> Capture:
    """A copy of the demo scene, which a test may change."""
    shutil.copytree(
        SCENE, tmp_path / "scene", ignore=shutil.ignore_patterns("light", "ground_truths", "*_maps")
    )
    return load_capture(tmp_path / "scene")


def found(of: Capture | Inspection) -> dict[str, tuple[str, ...]]:
    """The defects' kinds, and the views that they name."""
    inspection = inspect_capture(of) if isinstance(of, Capture) else of
    return {defect.kind: defect.views for defect in inspection.defects}


def test_the_demo_scene_has_no_defects() -> None:
    inspection = inspect_capture(load_capture(SCENE))
    assert inspection.defects == ()
    assert inspection.radiance.level == "good"
    assert np.allclose(inspection.factors, 1, atol=0.25)


@pytest.mark.parametrize("stops", [2.0, -2.0, 1.0])
def test_an_exposure_jump(capture: Capture, stops: float) -> None:
    view = capture.views[VICTIM]
    change(view.image, lambda pixels: pixels * 2.0**stops)
    inspection = inspect_capture(capture)
    assert found(inspection) == {"exposure_jump": (view.name,)}
    assert inspection.factors[VICTIM] == pytest.approx(2.0**stops, rel=0.2)
    assert inspection.radiance.level == "poor"
    known = replace(view, exposure=2.0**stops)
    mended = replace(capture, views=(*capture.views[:VICTIM], known, *capture.views[VICTIM + 1 :]))
    assert found(mended) == {}, "an exposure that is known is no jump"


@pytest.mark.parametrize("kind", ["motion", "focus"])
def test_a_blurred_view(capture: Capture, kind: str) -> None:
    view = capture.views[VICTIM]
    kernel = (
        np.full((1, 7), 1 / 7) if kind == "motion" else np.outer(*2 * (cv2.getGaussianKernel(9, 1.5)[:, 0],))
    )
    change(view.image, lambda pixels: cv2.filter2D(pixels, -1, kernel, borderType=cv2.BORDER_REPLICATE))
    assert found(capture) == {"blurred": (view.name,)}


def test_a_duplicate(capture: Capture) -> None:
    first, second = capture.views[3], capture.views[9]
    noise = np.random.default_rng(0)
    change(
        second.image,
        lambda _: radiance(first.image) * noise.normal(1, 0.01, radiance(first.image).shape).clip(0),
    )
    assert found(capture) == {"duplicate": (second.name,)}


def test_a_camera_that_looks_away(capture: Capture) -> None:
    view = capture.views[VICTIM]
    w2c = np.diag([-1.0, 1.0, -1.0, 1.0]) @ view.camera.w2c  # half a turn about the camera's own axis
    turned = replace(view, camera=replace(view.camera, w2c=w2c))
    views = (*capture.views[:VICTIM], turned, *capture.views[VICTIM + 1 :])
    assert found(replace(capture, views=views)) == {"looking_away": (view.name,)}
    (line,) = problems_of_poses(replace(capture, views=views))  # what `neilfpp train` prints, without a pixel
    assert line.startswith("problem: the cameras look away")
    assert view.name in line
    assert "leave these views out" in line


def test_cameras_with_the_axes_of_opengl(capture: Capture) -> None:
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    flipped = [replace(v, camera=replace(v.camera, w2c=flip @ v.camera.w2c)) for v in capture.views]
    (line,) = problems_of_poses(replace(capture, views=tuple(flipped)))
    assert "the cameras look away" in line
    assert "OpenGL: y up, z back" in line
    assert "leave these views out" not in line
    assert problems_of_poses(capture) == ()


def test_clipped_highlights_in_linear_files(capture: Capture) -> None:
    shares = []
    for view in capture.views:
        pixels = radiance(view.image)
        level = np.quantile(pixels[pixels > 0], 0.95)
        shares.append((pixels >= level).any(-1).sum() / pixels.any(-1).sum())
        change(view.image, lambda pixels, level=level: pixels.clip(0, level))
    inspection = inspect_capture(capture)
    assert set(found(inspection)) == {"clipped"}
    assert np.allclose([view.clipped for view in inspection.views], shares, atol=0.005)
    assert inspection.radiance.level == "poor"


def test_clipped_pixels_that_are_marked_do_not_count(capture: Capture) -> None:
    views = []
    for view in capture.views:
        change(view.image, lambda pixels: pixels.clip(0, 0.5))
        valid = capture.root / "valid" / f"{view.name}.png"
        write_png(valid, np.where((radiance(view.image) < 0.5).all(-1), 255, 0).astype(np.uint8))
        views.append(replace(view, valid=valid))
    inspection = inspect_capture(replace(capture, views=tuple(views)))
    assert "clipped" not in found(inspection)
    assert max(view.invalid for view in inspection.views) > 0


def test_display_values_in_linear_files(capture: Capture) -> None:
    for view in capture.views:
        change(view.image, lambda pixels: np.rint(255 * srgb(pixels)) / 255)
    inspection = inspect_capture(capture)
    assert found(inspection)["few_levels"] == ()
    assert inspection.radiance.level == "poor"


def test_broken_pixels_must_be_marked(capture: Capture) -> None:
    view = capture.views[VICTIM]
    change(
        view.image,
        lambda pixels: np.where(np.indices(pixels.shape[:2]).sum(0)[..., None] < 5, np.nan, pixels),
    )
    assert found(capture) == {"broken_pixels": (view.name,)}


def test_a_damaged_image_among_good_ones(capture: Capture) -> None:
    view = capture.views[VICTIM]
    view.image.write_bytes(view.image.read_bytes()[:3000])
    assert found(capture) == {"unreadable": (view.name,)}


def test_black_views(capture: Capture) -> None:
    change(capture.views[VICTIM].image, lambda pixels: 0 * pixels)
    assert found(capture) == {"black": (capture.views[VICTIM].name,)}


@pytest.mark.parametrize(("jitter", "is_one_place"), [(0.0, True), (0.002, True), (0.05, False)])
def test_cameras_at_one_place(capture: Capture, jitter: float, is_one_place: bool) -> None:
    eye = capture.views[0].camera.c2w[:, 3]
    views = []
    for i, view in enumerate(capture.views):
        w2c = view.camera.w2c.copy()
        w2c[:3, 3] = -w2c[:3, :3] @ (eye + jitter * np.array([np.cos(i), np.sin(i), 0]))
        views.append(replace(view, camera=replace(view.camera, w2c=w2c)))
    placed = replace(capture, views=tuple(views))
    assert any("all cameras are at one place" in line for line in problems_of_poses(placed)) == is_one_place


def test_too_few_views_from_one_side(capture: Capture) -> None:
    assert set(found(replace(capture, views=capture.views[:2]))) == {"few_views"}
    near = sorted(
        capture.views,
        key=lambda view: np.linalg.norm(view.camera.c2w[:, 3] - capture.views[0].camera.c2w[:, 3]),
    )
    kinds = set(found(replace(capture, views=tuple(near[:4]))))
    assert {"few_views", "coverage"} <= kinds


def test_points_and_cameras_that_contradict_the_scene_box_are_found(capture: Capture) -> None:
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(500, 3))
    for size, severity in ((2.0, "problem"), (0.05, "warning")):
        points = np.array(capture.normalization.center) + capture.normalization.scale * size * rng.uniform(
            -1, 1, (500, 3)
        )
        write_ply(capture.root / "cloud.ply", points, normal)
        defects = inspect_capture(replace(capture, point_cloud=capture.root / "cloud.ply")).defects
        assert [(defect.kind, defect.severity) for defect in defects] == [("scale", severity)]
    closer = replace(capture.normalization, scale=10 * capture.normalization.scale)
    kinds = found(replace(capture, normalization=closer, point_cloud=None))
    assert len(kinds["camera_inside"]) == len(capture.views)
    assert "scale_guessed" in found(replace(capture, scene_from="cameras"))


def test_clipped_pixels_of_display_values_are_counted(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path, views=20, size=(48, 36), hdr=False, masks=True))
    inspection = inspect_capture(capture)
    assert inspection.radiance.level == "poor"  # the sphere of the tests is brighter than white
    for view, figures in zip(capture.views, inspection.views, strict=True):
        pixels, mask = np.asarray(Image.open(view.image)), np.asarray(Image.open(view.mask)) > 0
        assert figures.clipped == pytest.approx((pixels[mask] == 255).any(-1).mean())


# ------------------------------------------------------------------------------------------------ the command


def test_the_command_prints_and_writes_the_defects(capture: Capture, tmp_path: Path, capfd) -> None:
    view = capture.views[VICTIM]
    change(view.image, lambda pixels: 4 * pixels)
    assert main(["inspect", str(capture.root), "--out", str(tmp_path / "out")]) == 0
    said = capfd.readouterr().out
    assert re.search(
        rf"problem: brighter or darker than the views around them: {view.name} ×(3\.[5-9]|4)", said
    )
    assert "radiance: poor" in said
    written = json.loads((tmp_path / "out" / "inspect.json").read_text())
    assert written["radiance"]["level"] == "poor"
    assert [(d["kind"], d["views"]) for d in written["defects"]] == [("exposure_jump", [view.name])]
    assert len(written["views"]) == written["capture"]["views"] == len(capture.views)
    assert (capture.root / written["views"][0]["image"]).is_file()
    picture = np.asarray(Image.open(tmp_path / "out" / "inspect.png"))
    assert picture.shape[2] == 3
    assert (picture == (200, 40, 40)).all(-1).any(), "the flagged view is red"


@pytest.mark.parametrize("unmarked", [0, 2])
def test_the_command_says_what_shows_the_object(tmp_path: Path, capfd, unmarked: int) -> None:
    """Without mask files the alpha channel is the mask, also if only some images have one."""
    root = make_capture(tmp_path, views=6, hdr=False, masks=True, background=0.2)
    for path in sorted((root / "inputs" / "masks").iterdir())[unmarked:]:
        image = Image.open(root / "inputs" / "images" / path.name).convert("RGB")
        image.putalpha(Image.open(path).convert("L"))
        image.save(root / "inputs" / "images" / path.name)
    assert main(["inspect", str(root)]) == 0
    assert "object: shown by the mask file\n" in capfd.readouterr().out
    shutil.rmtree(root / "inputs" / "masks")
    assert main(["inspect", str(root), "--out", str(tmp_path / "out")]) == 0
    said = "object: shown by the alpha channel"
    if unmarked:
        said = "object: shown by the background of one colour in 2 of 6 views and the alpha channel in 4 of 6"
    assert said in capfd.readouterr().out
    written = json.loads((tmp_path / "out" / "inspect.json").read_text())["views"]
    sources = [view["object_from"] for view in written]
    assert sources == ["background of one colour"] * unmarked + ["alpha channel"] * (6 - unmarked)


def test_with_strict_a_problem_gives_status_1(capture: Capture, tmp_path: Path, capfd) -> None:
    assert main(["inspect", str(capture.root), "--strict"]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scene"], "nothing is written without --out"
    change(capture.views[VICTIM].image, lambda pixels: 4 * pixels)
    assert main(["inspect", str(capture.root), "--strict"]) == 1
    assert capfd.readouterr().err.count("\n") == 1
    assert main(["inspect", str(tmp_path / "nowhere")]) == 2


def test_inverted_masks_are_a_problem(tmp_path: Path, capfd) -> None:
    """The background is not black, so that the pixels under the inverted masks look plausible."""
    root = make_capture(tmp_path, views=6, hdr=False, masks=True, background=0.2)
    assert main(["inspect", str(root)]) == 0
    assert "look inverted" not in capfd.readouterr().out
    for path in (root / "inputs" / "masks").iterdir():
        write_png(path, 255 - np.asarray(Image.open(path)))
    assert main(["inspect", str(root)]) == 0
    said = capfd.readouterr().out
    assert "problem: the masks look inverted: they are black on the object" in said
    assert "invert the masks, or the alpha channel: the object is white" in said
