"""The package's own layout: written captures are read back, and the example of docs/captures.md can be
read.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from neilfpp_method.data.cameras.lens import Lens
from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.capture_folder import write_capture
from neilfpp_method.data.files.images import write_exr, write_png
from neilfpp_method.data.views import CaptureFiles, Normalization
from neilfpp_method.errors import UserError
from tests.data.make_capture import CENTER, SCALE, camera_pose, make_capture

DOCS = Path(__file__).parents[2] / "docs" / "captures.md"


def folder(root: Path, **changes) -> Path:
    """A capture in the package's own layout, made from that of `make_capture`; `changes` apply to the first
    view.
    """
    made = load_capture(make_capture(root, masks=True))
    (root / "inputs" / "sfm_scene.json").unlink()
    (root / "split.json").unlink()
    first, *rest = made.views
    write_capture(
        root, replace(made, views=(replace(first, **changes), *rest)), response="linear", test=["002"]
    )
    return root


def edit(root: Path, change: Callable[[dict], object]) -> Path:
    path = root / "capture.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    return root


def test_a_written_capture_is_read_back(tmp_path: Path) -> None:
    write_png(tmp_path / "usable.png", np.full((18, 24), 255, np.uint8))
    lens = Lens("OPENCV", (0.1, -0.01, 0.001, 0.0))
    made = load_capture(make_capture(tmp_path, masks=True))
    folder_views = tuple(
        replace(
            view,
            name=f"view {view.index}",
            camera=replace(view.camera, lens=lens if view.index else None),
            valid=tmp_path / "usable.png",
            exposure=0.5 + view.index,
            white_balance=(1.5, 1.0, 0.1 + 0.2),
        )
        for view in made.views
    )
    files = CaptureFiles(
        tmp_path, folder_views, Normalization(0.1 + 0.2, (1 / 3, -2.0, 0.0)), made.point_cloud
    )
    write_capture(tmp_path, files, response="srgb", test=["view 4", "view 1"])
    (tmp_path / "split.json").unlink()
    back = load_capture(tmp_path)
    assert (back.format, back.hdr, back.test) == ("neilfpp", False, {"view 1", "view 4"})
    assert back.normalization == files.normalization
    assert back.point_cloud == made.point_cloud
    for new, old in zip(back.views, folder_views, strict=True):
        assert np.array_equal(new.camera.w2c, old.camera.w2c)
        assert np.array_equal(new.camera.intrinsics, old.camera.intrinsics)
        assert new.camera.lens == old.camera.lens
        assert replace(new, camera=old.camera) == old


def test_the_response_can_be_overridden(tmp_path: Path) -> None:
    folder(tmp_path)
    assert load_capture(tmp_path).hdr
    assert not load_capture(tmp_path, response="srgb").hdr


def test_the_split_can_be_overridden(tmp_path: Path) -> None:
    folder(tmp_path)
    assert load_capture(tmp_path).test == {"002"}
    assert load_capture(tmp_path, test_every=3).test == {"002", "005"}
    (tmp_path / "split.json").write_text('{"test": ["000"]}')
    assert load_capture(tmp_path).test == {"000"}


def test_the_example_in_the_documentation_is_a_capture(tmp_path: Path) -> None:
    example = re.search(r"```json\n(.*?)```", DOCS.read_text("utf-8"), re.DOTALL).group(1)
    content = json.loads(example)
    for view in content["views"]:
        size = view["camera"]["height"], view["camera"]["width"]
        (tmp_path / view["image"]).parent.mkdir(parents=True, exist_ok=True)
        write_exr(tmp_path / view["image"], {"RGB": np.ones((*size, 3), np.float16)})
        for name in ("mask", "valid"):
            if view[name]:
                write_png(tmp_path / view[name], np.full(size, 255, np.uint8))
    (tmp_path / content["point_cloud"]).touch()
    (tmp_path / "capture.json").write_text(example)
    capture = load_capture(tmp_path)
    assert len(capture.views) == len(content["views"])
    assert capture.test == set(content["test"])


def test_a_minimal_folder_is_read(tmp_path: Path) -> None:
    write_exr(tmp_path / "a.exr", {"RGB": np.ones((18, 24, 3), np.float32)})
    camera = {
        "fx": 20,
        "fy": 20,
        "cx": 12,
        "cy": 9,
        "width": 24,
        "height": 18,
        "w2c": camera_pose(0, 6).tolist(),
    }
    content = {
        "format": "neilfpp-capture",
        "version": 1,
        "response": "linear",
        "scene": {"centre": CENTER.tolist(), "radius": SCALE},
        "views": [{"name": "a", "image": "a.exr", "camera": camera}],
    }
    (tmp_path / "capture.json").write_text(json.dumps(content))
    (view,) = load_capture(tmp_path).views
    assert (view.mask, view.valid, view.exposure, view.white_balance) == (None, None, 1.0, (1.0, 1.0, 1.0))


def view(content: dict) -> dict:
    return content["views"][3]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c.update(format="another"), "no capture in this folder"),
        (
            lambda c: c.update(version=2),
            "version 2 of the format; this version of the package reads version 1",
        ),
        (lambda c: c.pop("version"), "version is missing"),
        (lambda c: c.update(response="log"), "response: not linear or srgb"),
        (lambda c: c.update(views=[]), "no views"),
        (lambda c: c.update(views=3), "views: not a JSON list"),
        (lambda c: c["scene"].update(radius=0), "scene.radius: not positive"),
        (lambda c: c["scene"].update(centre=[1, 2]), "scene.centre: not 3 finite numbers"),
        (lambda c: c["scene"].update(centre=[1, 2, 1e308]), "times the radius of the scene box away"),
        (lambda c: c["scene"].update(radius=1e-9), "times the radius of the scene box away"),
        (lambda c: c.update(test=["999"]), "there is no view '999'"),
        (lambda c: c.update(test=[f"{i:03d}" for i in range(6)]), "all 6 views are held out"),
        (lambda c: c.update(point_cloud="gone.ply"), "point_cloud: there is no"),
        (lambda c: c.update(point_cloud="../cloud.ply"), "not a path within the capture"),
        (lambda c: view(c).pop("image"), "views.3.image is missing"),
        (lambda c: view(c).update(image="gone.exr"), "views.3.image: there is no"),
        (lambda c: view(c).update(image="/etc/hostname"), "not a path within the capture"),
        (lambda c: view(c).update(mask="../mask.png"), "not a path within the capture"),
        (lambda c: view(c).update(valid=5), "views.3.valid: not a file name"),
        (lambda c: view(c).update(name="../003"), "'../003' is not a valid file name"),
        (lambda c: view(c).update(name=""), "'' is not a valid file name"),
        (lambda c: view(c).update(name="000"), "have the same name"),
        (lambda c: view(c).update(exposure=0), "exposure and white balance are not all positive"),
        (
            lambda c: view(c).update(white_balance=[1, -1, 1]),
            "exposure and white balance are not all positive",
        ),
        (lambda c: view(c)["camera"].update(w2c=[1] * 16), "not a rotation and a translation"),
        (lambda c: view(c)["camera"].update(width=0), "width: not a positive whole number"),
        (lambda c: view(c)["camera"].update(fx=0), "focal length is not positive"),
        (
            lambda c: view(c)["camera"].update(lens={"model": "OPENCV", "coefficients": [1]}),
            "OPENCV has 4 finite",
        ),
        (
            lambda c: view(c)["camera"].update(lens={"model": "OPENCV", "coefficients": "x"}),
            "not a list of finite",
        ),
    ],
)
def test_bad_entries_are_refused(tmp_path: Path, change: Callable[[dict], object], words: str) -> None:
    edit(folder(tmp_path), change)
    with pytest.raises(UserError) as caught:
        load_capture(tmp_path)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_only_readable_captures_are_written(tmp_path: Path) -> None:
    root = folder(tmp_path / "capture")
    before = (root / "capture.json").read_bytes()
    capture = load_capture(root)
    (tmp_path / "stray.png").touch()
    first, *rest = capture.views
    strayed = replace(capture, views=(replace(first, mask=tmp_path / "stray.png"), *rest))
    with pytest.raises(UserError, match=r"stray.png: not a path within"):
        write_capture(root, strayed, response="linear")
    with pytest.raises(UserError, match="there is no view '999'"):
        write_capture(root, capture, response="linear", test=["999"])
    assert (root / "capture.json").read_bytes() == before
