"""`neilfpp prepare` from end to end, on a textured corner whose cameras are known."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from neilfpp_method.cli import main
from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.files.images import read_image, write_exr, write_png
from neilfpp_method.data.files.raw import Developed
from neilfpp_method.data.point_cloud import read_oriented_ply
from neilfpp_method.data.scene_box import find_box
from neilfpp_method.prepare import command
from neilfpp_method.prepare import photos as photo_files
from tests.data.make_capture import make_capture
from tests.prepare.textured_corner import FOCAL, alignment, angle, make_photos, photograph, pose

VIEWS, WIDTH = 9, 240
DATA = Path(os.environ.get("NEILFPP_DATA", Path(__file__).parents[2].parent / "shared" / "data"))


def prepare(images: Path, out: Path, *options: str) -> int:
    """Run the command, without a dense cloud, which takes most of the time, unless a test requests it."""
    cloud = () if "--cloud" in options else ("--cloud", "sparse")
    return main(["prepare", str(images), "--out", str(out), *cloud, *options])


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photos") / "corner"
    make_photos(folder, VIEWS, (WIDTH, 180))
    return folder


@pytest.fixture(scope="module")
def prepared(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("captures") / "corner"
    assert prepare(photos, out, "--cloud", "dense", "--also", "nerfstudio", "neilf") == 0
    return out


@pytest.fixture
def own(photos: Path, tmp_path: Path) -> Path:
    """A copy of the photographs, which a test may change."""
    return Path(shutil.copytree(photos, tmp_path / "photos"))


# ----------------------------------------------------------------------------------------------- the good way


def to_truth(capture, poses: dict[str, np.ndarray]):
    found = np.stack([view.camera.c2w[:, 3] for view in capture.views])
    true = np.stack([-poses[view.name][:3, :3].T @ poses[view.name][:3, 3] for view in capture.views])
    scale, rotation, shift = alignment(found, true)
    centers = np.linalg.norm(scale * found @ rotation.T + shift - true, axis=1)
    rotations = [
        angle(view.camera.w2c[:3, :3] @ rotation.T, poses[view.name][:3, :3]) for view in capture.views
    ]
    return scale, rotation, shift, centers.max(), max(rotations)


def test_the_camera_poses_are_accurate(prepared):
    capture = load_capture(prepared)
    assert len(capture.views) == VIEWS
    _, rotation, _, centers, rotations = to_truth(capture, {f"{i:03}": pose(i, VIEWS) for i in range(VIEWS)})
    assert centers < 0.005
    assert rotations < 0.2
    # The cameras are level, so the up direction of the world is known as well.
    assert rotation[2, 2] == pytest.approx(1.0, abs=1e-4)
    for view in capture.views:
        assert view.camera.lens.model == "SIMPLE_RADIAL"
        assert view.camera.lens.coefficients == pytest.approx((0.0,), abs=0.02)
        assert view.camera.fx == pytest.approx(FOCAL * WIDTH, rel=0.01)


def test_the_pixels_are_linear_and_unchanged(photos, prepared):
    capture = load_capture(prepared)
    assert capture.hdr
    for view in capture.views:
        assert (read_image(view.image).pixels == read_image(photos / f"{view.name}.exr").pixels).all()


def test_the_points_lie_on_the_planes_with_their_normals(prepared):
    capture = load_capture(prepared)
    scale, rotation, shift, _, _ = to_truth(capture, {f"{i:03}": pose(i, VIEWS) for i in range(VIEWS)})
    points = read_oriented_ply(capture.point_cloud)
    assert len(points.position) > 20_000
    # A pixel of disparity between the usual sources is about 0.02 in depth.
    position, normal = scale * points.position @ rotation.T + shift, points.normal @ rotation.T
    distance = np.abs(position)
    assert np.median(distance.min(axis=1)) < 0.005
    assert np.quantile(distance.min(axis=1), 0.9) < 0.01
    facing = np.take_along_axis(
        normal, distance.argmin(axis=1)[:, None], axis=1
    )  # the planes' normals are +x, +y, +z
    assert np.median(facing) > np.cos(np.radians(3))
    assert (facing > 0.8).mean() > 0.95


def test_the_folder_has_a_split_a_summary_and_other_formats(prepared):
    assert load_capture(prepared).test == {"007"}
    summary = json.loads((prepared / "summary.json").read_text())
    assert [p["name"] for p in summary["placements"]] == [f"{i:03}" for i in range(VIEWS)]
    assert all(0 < p["error"] < 0.5 and 50 < p["points"] <= p["features"] for p in summary["placements"])
    assert summary["models"] == [VIEWS]
    assert summary["views"] == VIEWS
    assert summary["cameras"][0]["images"] == VIEWS
    assert any("EXIF" in remark for remark in summary["remarks"])
    assert read_image(prepared / "summary.png").pixels.shape[1] > 1000
    for name, format in (("nerfstudio", "transforms"), ("neilf", "sfm_scene")):
        other = load_capture(prepared / name)
        assert other.format == format
        assert len(other.views) == VIEWS


def test_a_finished_capture_is_unchanged(photos, prepared, capsys):
    before = {path: path.stat().st_mtime_ns for path in prepared.rglob("*")}
    assert prepare(photos, prepared, "--cloud", "dense", "--also", "nerfstudio", "neilf") == 0
    assert "already finished" in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in prepared.rglob("*")} == before


def test_a_stopped_command_prints_how_to_continue_and_continues(photos, tmp_path, monkeypatch, capfd):
    out = tmp_path / "capture"

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(command, "map_scene", stop)
        assert prepare(photos, out, "--undistort", "--test-every", "3") == 130
    assert (
        f"neilfpp prepare {photos} --out {out} --undistort --cloud sparse --test-every 3"
        in capfd.readouterr().err.replace("\n", "")
    )
    assert not (out / "capture.json").exists()
    for done in ("write_copies", "extract_features", "match_features"):
        monkeypatch.setattr(command, done, stop)
    assert prepare(photos, out, "--undistort", "--test-every", "3") == 0
    capture = load_capture(out)
    assert capture.test == {"002", "005", "008"}
    assert capture.views[0].camera.lens is None
    camera = capture.views[4].camera
    assert (camera.cx, camera.cy) == (camera.width / 2, camera.height / 2)
    expected = 4.0 * photograph(pose(4, VIEWS), (camera.width, camera.height), camera.fx / camera.width)
    difference = np.abs(read_image(capture.views[4].image).pixels - expected)[4:-4, 4:-4]
    assert np.median(difference) < 0.03 * np.median(expected)
    # With other photographs, all steps are repeated.
    monkeypatch.undo()
    more = Path(shutil.copytree(photos, tmp_path / "more"))
    (more / "000.exr").unlink()
    assert prepare(more, out) == 0
    assert [view.name for view in load_capture(out).views] == [f"{i:03}" for i in range(1, VIEWS)]
    assert not (out / "images" / "000.exr").exists()


def test_an_image_that_is_copied_when_the_command_ends_is_not_left_in_part(tmp_path, monkeypatch):
    root, out, copyfile = make_capture(tmp_path / "posed"), tmp_path / "out", shutil.copyfile

    def interrupted(source, target, **options):
        if Path(target).parent != out / "images":
            return copyfile(source, target, **options)
        Path(target).write_bytes(Path(source).read_bytes()[:100])
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(shutil, "copyfile", interrupted)
        assert prepare(root, out) == 130
    assert not list((out / "images").iterdir())
    assert prepare(root, out) == 0
    assert len(load_capture(out).views) == len(load_capture(root).views)


def test_blurred_and_duplicate_photographs_are_left_out_with_auto(own, tmp_path, capsys):
    blurred, doubled = "004", "009"
    pixels = read_image(own / f"{blurred}.exr").pixels
    write_exr(own / f"{blurred}.exr", {"RGB": cv2.GaussianBlur(pixels, (0, 0), 1.5)})
    shutil.copy(own / "006.exr", own / f"{doubled}.exr")
    out = tmp_path / "out"
    assert prepare(own, out) == 0
    assert len(load_capture(out).views) == VIEWS + 1
    assert "left out" not in capsys.readouterr().out

    assert prepare(own, out, "--auto") == 0
    kept = [view.name for view in load_capture(out).views]
    assert kept == [f"{i:03}" for i in range(VIEWS) if i != int(blurred)]
    assert sorted(path.stem for path in (out / "images").iterdir()) == kept
    said = capsys.readouterr().out
    assert f"left out: {blurred}, blurred" in said
    assert f"left out: {doubled}, the same picture as another" in said


def test_problems_of_the_photographs_are_reported(own, tmp_path, capsys):
    path = own / "002.exr"
    write_exr(path, {"RGB": 4.0 * read_image(path).pixels})
    assert prepare(own, tmp_path / "out") == 0
    said = capsys.readouterr().out
    assert "problem: brighter or darker than the views around them: 002" in said
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["problems"]


def test_sub_folders_two_sizes_and_display_values(tmp_path):
    left, right = tmp_path / "photos" / "left", tmp_path / "photos" / "right"
    make_photos(left, 6, (WIDTH, 180), hdr=False)
    for i in range(6):  # a second camera with smaller images of the same scene
        pixels = photograph(pose(i, 6), (200, 150))
        write_png(right / f"{i:03}.png", np.rint(255 * pixels ** (1 / 2.2)).astype(np.uint8))
    assert prepare(tmp_path / "photos", tmp_path / "out", "--matching", "sequential") == 0
    capture = load_capture(tmp_path / "out")
    assert not capture.hdr
    assert {view.name for view in capture.views} == {
        f"{side}-{i:03}" for side in ("left", "right") for i in range(6)
    }
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert sorted(camera["size"] for camera in summary["cameras"]) == [[200, 150], [WIDTH, 180]]
    focal = {camera["size"][0]: camera["parameters"]["f"] for camera in summary["cameras"]}
    assert focal[WIDTH] == pytest.approx(FOCAL * WIDTH, rel=0.01)
    assert focal[200] == pytest.approx(FOCAL * 200, rel=0.01)


def test_similar_images_are_found_with_a_vocabulary_of_the_capture(own, tmp_path):
    for i in (0, 1, 2, 3):
        (own / f"{i:03}.exr").unlink()
    assert prepare(own, tmp_path / "out", "--matching", "vocabulary") == 0
    assert len(load_capture(tmp_path / "out").views) == VIEWS - 4


def test_raw_files_are_developed_and_saturated_pixels_are_marked(tmp_path, monkeypatch):
    folder = tmp_path / "photos"
    folder.mkdir()
    for i in range(5):
        with (folder / f"{i:03}.dng").open("wb") as file:
            np.save(file, photograph(pose(i, 5, arc=40), (WIDTH, 180)))

    def develop(path: Path) -> Developed:
        pixels = np.load(path)
        valid = np.ones(pixels.shape[:2], bool)
        valid[50:60, 70:80] = False
        return Developed(pixels, valid, (1.0, 1.0, 1.0))

    monkeypatch.setattr(photo_files, "develop", develop)
    assert prepare(folder, tmp_path / "out") == 0
    capture = load_capture(tmp_path / "out")
    assert capture.hdr
    assert len(capture.views) == 5
    for view in capture.views:
        assert view.image.suffix == ".exr"
        invalid = read_image(view.valid).pixels[..., 0] < 0.5
        assert 80 <= invalid.sum() <= 120
        assert invalid[54:56, 74:76].all()


def test_a_capture_with_poses_keeps_them(tmp_path):
    source = load_capture(make_capture(tmp_path / "sphere", masks=True))
    assert prepare(tmp_path / "sphere", tmp_path / "out") == 0
    capture = load_capture(tmp_path / "out")
    assert capture.format == "neilfpp"
    assert capture.normalization == source.normalization
    assert capture.test == source.test
    for view, old in zip(capture.views, source.views, strict=True):
        assert view.name == old.name
        np.testing.assert_array_equal(view.camera.w2c, old.camera.w2c)
        assert view.mask.is_file()
        assert (read_image(view.image).pixels == read_image(old.image).pixels).all()


def test_poses_without_points_get_a_dense_cloud_and_a_box_from_it(prepared, tmp_path, capsys):
    root = tmp_path / "posed"
    shutil.copytree(prepared / "nerfstudio", root)
    content = json.loads((root / "transforms.json").read_text())
    for entry in ("scene", "ply_file_path"):
        content.pop(entry)
    (root / "transforms.json").write_text(json.dumps(content))
    (root / content["frames"][3]["file_path"]).unlink()
    assert load_capture(root).scene_from == "cameras"
    assert prepare(root, tmp_path / "out", "--cloud", "dense") == 0
    capture = load_capture(tmp_path / "out")
    points = read_oriented_ply(capture.point_cloud).position
    assert capture.scene_from in ("points", "focus")
    assert capture.normalization == find_box(capture.views, points).normalization
    assert f"1 of {VIEWS} listed images are missing and left out" in capsys.readouterr().out


def test_a_test_view_that_auto_leaves_out_is_no_test_view_of_the_capture(tmp_path):
    source = load_capture(make_capture(tmp_path / "sphere", masks=True))
    black = source.test_views[0]
    write_exr(black.image, {"RGB": np.zeros_like(read_image(black.image).pixels)})
    assert prepare(tmp_path / "sphere", tmp_path / "out", "--auto") == 0
    capture = load_capture(tmp_path / "out")
    assert {view.name for view in capture.views} == {view.name for view in source.views} - {black.name}
    assert capture.test == source.test - {black.name}


def test_auto_says_if_it_leaves_out_no_view_because_too_few_would_remain(tmp_path, capsys):
    source = load_capture(make_capture(tmp_path / "sphere", masks=True))
    for view in source.views[1:5]:
        write_exr(view.image, {"RGB": np.zeros_like(read_image(view.image).pixels)})
    assert prepare(tmp_path / "sphere", tmp_path / "out", "--auto") == 0
    assert len(load_capture(tmp_path / "out").views) == len(source.views)
    assert (
        "no view is left out: fewer than 3 would remain without 001, 002, 003, 004" in capsys.readouterr().out
    )


def test_a_colmap_project_keeps_its_poses_and_points(prepared, tmp_path):
    project = tmp_path / "project"
    shutil.copytree(prepared / "work" / "model" / "largest", project / "sparse" / "0")
    shutil.copytree(prepared / "work" / "copies", project / "images")
    assert prepare(project, tmp_path / "out", "--test-every", "0") == 0
    capture, source = load_capture(tmp_path / "out"), load_capture(prepared)
    assert not capture.hdr
    assert not capture.test
    for view, old in zip(capture.views, source.views, strict=True):
        np.testing.assert_allclose(view.camera.w2c, old.camera.w2c, atol=1e-9)
        assert view.camera.fx == pytest.approx(old.camera.fx)
    assert len(read_oriented_ply(capture.point_cloud).position) > 500


# -------------------------------------------------------------------------------------------------- bad input


def refused(capfd, images: Path, out: Path, *options: str, says: str) -> str:
    """Check that the command ends with one line and leaves no capture behind."""
    assert prepare(images, out, *options) == 2
    (line,) = capfd.readouterr().err.strip().splitlines()
    assert line.startswith("error: ")
    assert says in line
    assert not (out / "capture.json").exists()
    return line


def test_a_corrupt_image_is_named_and_can_be_left_out(own, tmp_path, capfd):
    (own / "003.exr").write_bytes((own / "003.exr").read_bytes()[:5000])
    line = refused(capfd, own, tmp_path / "out", says="003.exr")
    assert "--allow-partial" in line
    assert prepare(own, tmp_path / "out", "--allow-partial") == 0
    assert "003" not in {view.name for view in load_capture(tmp_path / "out").views}
    assert "left out: " in capfd.readouterr().out


@pytest.mark.parametrize(("kept", "says"), [(0, "no images"), (1, "1 image"), (2, "2 images")])
def test_too_few_images(own, tmp_path, capfd, kept, says):
    for path in sorted(own.iterdir())[kept:]:
        path.unlink()
    refused(capfd, own, tmp_path / "out", says=says)
    assert not (tmp_path / "out").exists()


def test_photographs_without_features_are_refused(tmp_path, capfd):
    for i in range(4):
        write_exr(tmp_path / "photos" / f"{i}.exr", {"RGB": np.full((120, 160, 3), 0.5, np.float32)})
    refused(capfd, tmp_path / "photos", tmp_path / "out", says="have features")


def test_images_without_common_features(tmp_path, capfd):
    for i in range(4):
        rng = np.random.default_rng(i)
        pixels = np.kron(rng.random((30, 40, 1)), np.ones((4, 4, 3)))
        write_exr(tmp_path / "photos" / f"{i}.exr", {"RGB": pixels.astype(np.float32)})
    refused(capfd, tmp_path / "photos", tmp_path / "out", says="placed")


def test_less_than_sixty_per_cent_placed(own, tmp_path, capfd):
    for i in range(3):
        (own / f"{i:03}.exr").unlink()
    for i in range(5):
        rng = np.random.default_rng(i)
        write_exr(
            own / f"other{i}.exr",
            {"RGB": np.kron(rng.random((45, 60, 1)), np.ones((4, 4, 3))).astype(np.float32)},
        )
    line = refused(capfd, own, tmp_path / "out", says="only 6 of 11 images")
    assert "other0" in line
    assert "--allow-partial" in line
    assert prepare(own, tmp_path / "out", "--allow-partial") == 0
    assert len(load_capture(tmp_path / "out").views) == 6
    assert "left out because they could not be placed: other0" in capfd.readouterr().out


def test_images_of_two_sizes_cannot_share_a_camera(own, tmp_path, capfd):
    write_exr(own / "009.exr", {"RGB": photograph(pose(1, VIEWS), (200, 150))})
    refused(capfd, own, tmp_path / "out", "--cameras", "shared", says="009.exr: 200×150 pixels")


def test_two_kinds_of_images(own, tmp_path, capfd):
    write_png(own / "009.png", np.zeros((180, WIDTH, 3), np.uint8))
    refused(capfd, own, tmp_path / "out", says="is linear and")


def test_two_images_with_the_same_name(own, tmp_path, capfd):
    write_png(own / "003.png", np.zeros((180, WIDTH, 3), np.uint8))
    line = refused(capfd, own, tmp_path / "out", "--response", "linear", says="named '003'")
    assert "003.exr" in line
    assert "003.png" in line


@pytest.mark.parametrize("every", ["1", "-3"])
def test_an_impossible_split(photos, tmp_path, capfd, every):
    refused(capfd, photos, tmp_path / "out", f"--test-every={every}", says="cannot be held out")


def test_no_such_folder(tmp_path, capfd):
    refused(capfd, tmp_path / "nowhere", tmp_path / "out", says="no such folder")
    (tmp_path / "photo.jpg").write_bytes(b"")
    refused(capfd, tmp_path / "photo.jpg", tmp_path / "out", says="is a file, not a folder")


def test_an_output_folder_that_cannot_be_written(photos, tmp_path, capfd):
    (tmp_path / "file").write_text("in the way")
    refused(capfd, photos, tmp_path / "file" / "out", says="cannot be written")
    refused(capfd, photos, tmp_path / "file", says="not a folder")


def test_an_output_folder_with_other_files(photos, tmp_path, capfd):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "letter.txt").write_text("dear")
    refused(capfd, photos, tmp_path / "out", says="not empty")
    assert (tmp_path / "out" / "letter.txt").read_text() == "dear"


def test_images_and_capture_inside_one_another(own, tmp_path, capfd):
    refused(capfd, own, own / "out", says="inside the other")
    refused(capfd, own, tmp_path, says="inside the other")


# ----------------------------------------------------------------------------------------- a rendered capture


@pytest.mark.slow
def test_the_ring_is_placed_exactly(tmp_path):
    ring = DATA / "ring_capture"
    if not ring.is_dir():
        pytest.skip(f"the capture {ring} is not at hand; NEILFPP_DATA names the folder of the captures")
    assert prepare(ring / "images", tmp_path / "ring") == 0
    capture = load_capture(tmp_path / "ring")
    truth = json.loads((ring / "true_cameras.json").read_text())
    assert {view.name for view in capture.views} == set(truth)
    poses = {name: np.array(camera["w2c"]) for name, camera in truth.items()}
    scale, _, _, centers, rotations = to_truth(capture, poses)
    assert len(capture.views) == 36
    assert centers < 0.005 * scale * capture.normalization.scale
    assert rotations < 0.2
    assert (
        main(
            [
                "train",
                "--data",
                str(tmp_path / "ring"),
                "--out",
                str(tmp_path / "run"),
                "--device",
                "cpu",
                *FIVE_STEPS,
            ]
        )
        == 0
    )


FIVE_STEPS = (
    "--config.train.sdf-steps",
    "3",
    "--config.train.material-steps",
    "1",
    "--config.train.joint-steps",
    "1",
)
