"""Folders of photographs are merged to radiance in every layout of brackets; invalid folders are refused by
name.
"""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from PIL import Image

from neilfpp_method.data.brackets.folder import find_brackets, merge_brackets
from neilfpp_method.errors import UserError
from tests.data.brackets.test_merging import TIMES, photographs, relative_error, scene


def write_photograph(path: Path, pixels: np.ndarray, time: float | None = None, **options) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    if time is not None:
        exif[0x8769] = {0x829A: time}
    Image.fromarray(np.rint(255 * pixels).astype(np.uint8)).save(path, exif=exif, **options)


@pytest.mark.parametrize("response", ["srgb", "auto"])
@pytest.mark.parametrize("layout", ["folders", "suffixes", "sequence", "list"])
def test_a_folder_of_photographs_becomes_radiance(tmp_path: Path, layout: str, response: str) -> None:
    truths = {name: scene(seed) for seed, name in enumerate(["left", "right"])}
    photos, listed = tmp_path / "photos", {}
    for p, (name, truth) in enumerate(truths.items()):
        for i, (pixels, time) in enumerate(zip(photographs(truth, "srgb"), TIMES, strict=True)):
            path = {
                "folders": f"{name}/{i}.png",
                "suffixes": f"{name}_{i}.png",
                "sequence": f"IMG_{5 * p + i:04d}.png",
                "list": f"{i}{name}{17 * i % 5}.png",
            }[layout]
            write_photograph(photos / path, pixels, time)
            listed.setdefault(name, []).append(path)
    if layout == "list":
        (photos / "brackets.json").write_text(json.dumps(listed))
    seen: list[tuple[str, float | None]] = []
    brackets = find_brackets(photos)
    merge_brackets(
        brackets, tmp_path / "images", tmp_path / "valid", response, on_merged=lambda *done: seen.append(done)
    )
    names = tuple(brackets)
    assert seen == [(name, 0.0) for name in names]  # a tripod's
    assert names == (("IMG_0000", "IMG_0005") if layout == "sequence" else ("left", "right"))
    scales = []
    for name, truth in zip(names, truths.values(), strict=True):
        found = OpenEXR.File(str(tmp_path / "images" / f"{name}.exr")).channels()["RGB"].pixels
        valid = np.asarray(Image.open(tmp_path / "valid" / f"{name}.png")) > 0
        assert found.dtype == np.float32
        assert np.quantile(relative_error(found, truth)[valid & (truth.min(-1) > 12 / 255)], 0.99) < 0.02
        scales.append(np.median(found / truth))
    assert scales[0] == pytest.approx(scales[1], rel=0.005), "all poses share one radiance scale"


def bad_folder(root: Path, kind: str) -> None:
    gray, times = np.full((4, 4, 3), 0.5), (0.1, 0.2)
    for i, time in enumerate(times):
        size = (4 + i, 4) if kind == "two sizes" else (4, 4)
        same = kind in ("same exposure", "one image") or (kind == "no exif" and i)
        exposure = None if kind == "no exif" and i else 0.1 if same else time
        if kind != "one image" or i == 0:
            write_photograph(root / f"a_{i}.png", np.full((*size, 3), 0.5), exposure)
    lists = {
        "leaves the folder": '{"a": ["../x.png", "a_0.png"]}',
        "missing": '{"a": ["b.png"]}',
        "no list": "[1]",
    }
    lists["bad name"] = '{"../a": ["a_0.png", "a_1.png"]}'
    if kind in lists:
        write_photograph(root.parent / "x.png", gray)
        (root / "brackets.json").write_text(lists[kind])
    if kind == "hdr":
        cv2.imwrite(str(root / "b_0.hdr"), gray.astype(np.float32))
        cv2.imwrite(str(root / "b_1.hdr"), gray.astype(np.float32))
        (root / "exposures.txt").write_text("a_0.png 1\na_1.png 2\nb_0.hdr 1\nb_1.hdr 2\n")


@pytest.mark.parametrize(
    ("kind", "complaint"),
    [
        ("two sizes", r"a_1\.png: another size than a_0\.png"),
        ("same exposure", "are not a bracket"),
        ("one image", "are not a bracket"),
        ("no exif", r"a_1\.png: no exposure time"),
        ("leaves the folder", "not a path within"),
        ("missing", r"brackets\.json: there is no .*b\.png"),
        ("no list", r"brackets\.json: no list of brackets"),
        ("bad name", r"brackets\.json: a pose cannot be called '\.\./a'"),
        ("hdr", r"b_0\.hdr: holds linear radiance already"),
    ],
)
def test_bad_folders_are_named(tmp_path: Path, kind: str, complaint: str) -> None:
    bad_folder(tmp_path / "photos", kind)
    with pytest.raises(UserError, match=complaint):
        merge_brackets(find_brackets(tmp_path / "photos"), tmp_path / "images", tmp_path / "valid", "srgb")


def test_an_empty_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no images"):
        find_brackets(tmp_path)


def test_the_response_of_camera_raw_cannot_be_srgb(tmp_path: Path) -> None:
    brackets = {"a": {tmp_path / "a.dng": 0.1, tmp_path / "b.dng": 0.2}}
    with pytest.raises(UserError, match=r"a\.dng: camera RAW is developed to linear radiance"):
        merge_brackets(brackets, tmp_path / "images", tmp_path / "valid", "srgb")


def test_camera_raw_and_other_images_are_not_merged_together(tmp_path: Path) -> None:
    brackets = {"a": {tmp_path / "a.dng": 0.1, tmp_path / "b.jpg": 0.2}}
    with pytest.raises(UserError, match=r"a\.dng is camera RAW, and other images of the folder are not"):
        merge_brackets(brackets, tmp_path / "images", tmp_path / "valid")
