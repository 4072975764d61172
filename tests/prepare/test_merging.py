"""Exposure brackets among photographs: which folders contain brackets, and a capture from them end to end."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from neilfpp_method.cli import main
from neilfpp_method.data.brackets import folder as bracket_folder
from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.files.images import read_image
from neilfpp_method.errors import UserError
from neilfpp_method.prepare.merging import brackets_among, merge_photos
from neilfpp_method.prepare.photos import Photos, survey
from neilfpp_method.prepare.progress import bars
from tests.data.make_capture import srgb
from tests.prepare.test_command import to_truth
from tests.prepare.textured_corner import photograph, pose

POSES, SIZE = 8, (240, 180)
TIMES = (1 / 16, 1 / 4, 1.0)
MAKE, EXIF_FOLDER, TIME, FOCAL_35MM = 0x010F, 0x8769, 0x829A, 0xA405


def write(path: Path, radiance: np.ndarray, time: float, focal: float | None = None) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    exif[MAKE] = "Pinhole"
    exif[EXIF_FOLDER] = {TIME: time} | ({FOCAL_35MM: focal} if focal else {})
    Image.fromarray(np.rint(255 * srgb(radiance * time)).astype(np.uint8)).save(path, exif=exif)


def radiance(i: int) -> np.ndarray:
    """The corner with highlights on its texture that are clipped even at the shortest exposure."""
    seen = photograph(pose(i, POSES), SIZE)
    return np.where(seen.min(axis=-1, keepdims=True) > 0.75, 40.0 * seen, 4.0 * seen)


def plain(root: Path, times: Sequence[Sequence[float]], name: str = "{p}_{i}.png") -> Path:
    """Small images without content; each entry of `times` is a pose with its exposures."""
    ramp = np.linspace(0.02, 1.5, 24 * 16).reshape(16, 24, 1).repeat(3, axis=2)
    for p, exposures in enumerate(times):
        for i, time in enumerate(exposures):
            write(root / name.format(p=p, i=i, n=sum(map(len, times[:p])) + i), ramp, time, focal=28.0)
    return root


def among(root: Path, wanted="auto"):
    return brackets_among(survey(root, "auto"), wanted)


# ---------------------------------------------------------------------------------------------- the whole way


def test_brackets_become_a_linear_capture(tmp_path: Path, capsys) -> None:
    for i in range(POSES):
        for k, time in enumerate(TIMES):
            write(tmp_path / "photos" / f"{i:03}_{k}.png", radiance(i), time)
    assert (
        main(["prepare", str(tmp_path / "photos"), "--out", str(tmp_path / "out"), "--cloud", "sparse"]) == 0
    )
    assert "24 photographs in 8 exposure brackets were merged into 8 linear images" in capsys.readouterr().out
    capture = load_capture(tmp_path / "out")
    assert capture.hdr
    assert [view.name for view in capture.views] == [f"{i:03}" for i in range(POSES)]
    *_, centers, rotations = to_truth(capture, {f"{i:03}": pose(i, POSES) for i in range(POSES)})
    assert centers < 0.01
    assert rotations < 0.3
    scales = []
    for i, view in enumerate(capture.views):
        truth, found = radiance(i), read_image(view.image).pixels
        valid = read_image(view.valid).pixels[..., 0] == 1
        clipped = (srgb(truth * TIMES[0]) > 0.98).any(axis=-1)
        assert (valid == ~clipped).mean() > 0.999
        assert 0 < clipped.mean() < 0.2
        lit = valid[..., None] & (truth > 0.1)
        scale = np.median(found[lit] / truth[lit])
        assert np.quantile(np.abs(found[lit] / truth[lit] / scale - 1), 0.95) < 0.03
        scales.append(scale)
    assert np.ptp(scales) < 0.01 * np.mean(scales)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["remarks"][0].startswith("24 photographs")
    assert (
        main(["prepare", str(tmp_path / "photos"), "--out", str(tmp_path / "out"), "--cloud", "sparse"]) == 0
    )
    assert "already finished" in capsys.readouterr().out


def stop_after_two_merges(patch: pytest.MonkeyPatch) -> list[tuple]:
    """Press Ctrl-C at the third merge; returns the list of the arguments of all merges before."""
    merge, merges = bracket_folder.merge, []

    def counted(*arguments):
        if len(merges) == 2:
            raise KeyboardInterrupt
        merges.append(arguments)
        return merge(*arguments)

    patch.setattr(bracket_folder, "merge", counted)
    return merges


def test_handheld_brackets_are_reported_also_after_a_stop(tmp_path: Path, monkeypatch) -> None:
    for p in range(3):
        for i, time in enumerate((1 / 32, 1 / 10, 1 / 3)):
            write(tmp_path / "photos" / f"{p}_{i}.png", np.roll(radiance(p), 3 * i if p else 0, axis=1), time)
    photos = survey(tmp_path / "photos", "auto")
    with monkeypatch.context() as patch:
        stop_after_two_merges(patch)
        with pytest.raises(KeyboardInterrupt):
            merged(photos, tmp_path / "merged")
    done = merged(photos, tmp_path / "merged")
    assert "those of 2 brackets were aligned, by up to 3." in done.remark
    assert merged(photos, tmp_path / "merged").remark == done.remark
    assert [photo.name for photo in done.photos.items] == ["0", "1", "2"]


def merged(photos: Photos, folder: Path):
    with bars(Console(quiet=True)) as open_bar:
        return merge_photos(photos, brackets_among(photos, "auto"), "srgb", folder, open_bar)


def test_a_stopped_merge_continues_and_repeats_nothing(tmp_path: Path, monkeypatch) -> None:
    photos = survey(plain(tmp_path / "photos", [TIMES] * 4), "auto")
    merges = stop_after_two_merges(monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        merged(photos, tmp_path / "merged")
    kept = (tmp_path / "merged" / "images" / "0.exr").stat().st_mtime_ns
    merges.clear()
    done = merged(photos, tmp_path / "merged")
    assert len(merges) == 2
    assert (tmp_path / "merged" / "images" / "0.exr").stat().st_mtime_ns == kept
    monkeypatch.setattr(bracket_folder, "_response", None)
    assert merged(photos, tmp_path / "merged").photos == done.photos
    monkeypatch.undo()
    write(tmp_path / "photos" / "1_0.png", np.full((16, 24, 3), 0.5), TIMES[0])
    merged(photos, tmp_path / "merged")
    assert (tmp_path / "merged" / "images" / "0.exr").stat().st_mtime_ns > kept


def test_camera_and_focal_length_come_from_the_photographs(tmp_path: Path) -> None:
    done = merged(survey(plain(tmp_path / "photos", [TIMES] * 3), "auto"), tmp_path / "merged")
    assert done.photos.linear
    for photo in done.photos.items:
        assert photo.focal == pytest.approx(28 / 36)
        assert "Pinhole" in photo.device
        assert photo.path.is_file()
        assert photo.valid.is_file()


# ------------------------------------------------------------------------------------------ what is a bracket


@pytest.mark.parametrize("name", ["{p}_{i}.png", "{p}/{i}.png", "IMG_{n:04}.png"])
def test_brackets_are_found(tmp_path: Path, name: str) -> None:
    root = plain(tmp_path / "photos", [TIMES] * 3, name)
    assert [list(bracket.values()) for bracket in among(root).values()] == [pytest.approx(TIMES)] * 3
    assert among(root, "off") is None


def test_brackets_around_a_metered_exposure_are_found(tmp_path: Path) -> None:
    assert len(among(plain(tmp_path, [[t * f for t in TIMES] for f in (1, 1.6, 0.5)]))) == 3


@pytest.mark.parametrize(
    ("name", "times"),
    [
        ("IMG_{n:04}.png", [[0.1]] * 8),
        ("IMG_{n:04}.png", [[0.1 * 1.3**i] for i in range(8)]),
        ("{p}/{i}.png", [[0.1, 0.12, 0.16], [0.2, 0.1, 0.05], [0.3, 0.31, 0.5]]),
        ("{p}_{i}.png", [TIMES, TIMES]),
        ("{p}_{i}.png", [TIMES, TIMES, TIMES[:2]]),
    ],
    ids=["one exposure", "metered", "metered, in folders", "two poses", "one is missing"],
)
def test_single_photographs_stay_single(tmp_path: Path, name: str, times) -> None:
    assert among(plain(tmp_path, times, name)) is None


def test_photographs_beside_brackets_in_folders_are_not_lost(tmp_path: Path) -> None:
    plain(tmp_path, [TIMES] * 3, "{p}/deeper/{i}.png")
    plain(tmp_path, [TIMES] * 3, "{p}/{i}.png")
    assert among(tmp_path) is None


@pytest.mark.parametrize(
    "name", ["{p}_{i}.png", "{p}/{i}.png", "IMG_{n:04}.png", "IMG{n:04}.png", "listed_{n:04}.png"]
)
@pytest.mark.parametrize("damaged", [0, 4, 11])
def test_a_damaged_photograph_removes_only_its_own_bracket(tmp_path: Path, name: str, damaged: int) -> None:
    root = plain(tmp_path / "photos", [TIMES] * 4, name)
    paths = sorted(path for path in root.rglob("*.png"))
    if name.startswith("listed"):
        poses = {f"pose{p}": [path.name for path in paths[3 * p : 3 * p + 3]] for p in range(4)}
        (root / "brackets.json").write_text(json.dumps(poses))
    paths[damaged].write_bytes(b"no picture")
    if not name.startswith("IMG"):  # another file would change the order of the sequence
        (root / "scrap.jpg").write_bytes(b"nor this")
    spoilt = {path for path in paths if paths.index(path) // 3 == damaged // 3}
    photos = survey(root, "auto")
    brackets = brackets_among(photos, "auto")
    assert {path for bracket in brackets.values() for path in bracket} == set(paths) - spoilt
    assert "2 photographs in no bracket were left out" in merged(photos, tmp_path / "merged").remark


def test_a_list_selects_the_photographs(tmp_path: Path) -> None:
    root = plain(tmp_path / "photos", [TIMES] * 4, "IMG_{n:04}.png")
    listed = {f"pose{p}": [f"IMG_{3 * p + i:04}.png" for i in range(3)] for p in range(3)}
    (root / "brackets.json").write_text(json.dumps(listed))
    photos = survey(root, "auto")
    assert list(brackets_among(photos, "auto")) == ["pose0", "pose1", "pose2"]
    assert "3 photographs in no bracket were left out" in merged(photos, tmp_path / "merged").remark


@pytest.mark.parametrize(
    ("lists", "complaint"),
    [
        ({"brackets.json": '{"a": ["0_0.png", "0_1.png"]}'}, r"brackets\.json: 1 bracket; .*--brackets off"),
        ({"brackets.json": '{"a": ["0_0.png", "x.png"]}'}, r"there is no .*x\.png; .*--brackets off"),
        (
            {"brackets.json": '{"a": ["0_0.png", "notes.txt"]}', "exposures.txt": "0_0.png 1\nnotes.txt 2"},
            "is not a readable photograph",
        ),
        ({"brackets.json": '{"a:b": ["0_0.png", "0_1.png"]}'}, "is not a valid file name on all systems"),
        ({"exposures.txt": "0_0.png 1/60"}, r"0_1\.png: no exposure time; .*--brackets off"),
    ],
)
def test_a_wrong_list_is_refused(tmp_path: Path, lists, complaint: str) -> None:
    plain(tmp_path, [TIMES] * 3)
    (tmp_path / "notes.txt").write_text("sunny")
    for name, content in lists.items():
        (tmp_path / name).write_text(content)
    with pytest.raises(UserError, match=complaint):
        among(tmp_path)
    assert among(tmp_path, "off") is None
