"""The data that nerfstudio gets from a capture: the same rays and pixels as in the standalone loop."""

from __future__ import annotations

import copy
import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.process_data.colmap_utils import colmap_to_json

from neilfpp_method.data.cameras.lens import Lens
from neilfpp_method.data.cameras.projection import camera_rays, project
from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.capture_folder import write_capture
from neilfpp_method.data.files.images import write_png
from neilfpp_method.data.formats.write_transforms import write_transforms
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.errors import UserError
from neilfpp_method.plugin.datamanager import CaptureDataManagerConfig, CaptureDataset, to_pixel_batch
from neilfpp_method.plugin.dataparser import CaptureParserConfig, capture_of
from neilfpp_method.train.optimizer import seed_step
from tests.data.formats.scenes import POINTS, material
from tests.data.formats.test_colmap import colmap_camera, reconstruction
from tests.data.formats.test_colmap import write as write_model
from tests.data.make_capture import CENTER, SCALE, make_capture

VIEWS, WIDTH, HEIGHT = 6, 24, 18


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return make_capture(tmp_path_factory.mktemp("capture"), masks=True, background=0.3)


def parsed(root: Path, split: str = "train") -> DataparserOutputs:
    return CaptureParserConfig(data=root).setup().get_dataparser_outputs(split)


def as_another_dataparser(outputs: DataparserOutputs) -> DataparserOutputs:
    return dataclasses.replace(outputs, metadata={})


def test_rays_of_nerfstudio_are_the_rays_of_the_capture(root: Path) -> None:
    capture = load_capture(root)
    for split, views in (("train", capture.train_views), ("test", capture.test_views)):
        pixels, outputs = PixelDataset(capture, views), parsed(root, split)
        assert [path.stem for path in outputs.image_filenames] == [view.name for view in views]
        for i in range(len(views)):
            theirs, ours = outputs.cameras.generate_rays(camera_indices=i).flatten(), pixels.view(i)
            torch.testing.assert_close(theirs.origins, ours.origins, atol=1e-5, rtol=0)
            torch.testing.assert_close(theirs.directions, ours.directions, atol=1e-5, rtol=0)


def test_the_transform_maps_the_world_to_the_scene(root: Path) -> None:
    outputs = parsed(root)
    point = np.array([1.0, 2.0, 3.0])
    transform = outputs.dataparser_transform.double().numpy()
    moved = outputs.dataparser_scale * (transform[:, :3] @ point + transform[:, 3])
    np.testing.assert_allclose(moved, (point - CENTER) / SCALE, atol=1e-6)


def test_each_drawn_pixel_has_its_color_and_loss_inputs(root: Path) -> None:
    manager = CaptureDataManagerConfig(
        dataparser=CaptureParserConfig(data=root), train_num_rays_per_batch=400
    ).setup()
    rays, batch = manager.next_train(0)
    drawn = to_pixel_batch(rays.origins, rays.directions, batch)
    whole = PixelDataset(load_capture(root), load_capture(root).train_views)
    camera, row, column = batch["indices"].unbind(-1)
    index = row * WIDTH + column
    for i in range(VIEWS - 1):
        mine, view = drawn[camera == i], whole.view(i)[index[camera == i]]
        for name in ("color", "mask", "mask_known", "image_gradient", "view"):
            assert torch.equal(getattr(mine, name), getattr(view, name)), name
        torch.testing.assert_close(mine.directions, view.directions, atol=1e-5, rtol=0)
    assert drawn.color.max() > 1.0, "radiance above 1 is kept"
    assert 0.0 < drawn.mask.mean() < 1.0, "pixels off the object are drawn too"


def test_a_step_uses_the_pixels_of_the_same_step_of_the_standalone_loop(root: Path) -> None:
    manager = CaptureDataManagerConfig(
        dataparser=CaptureParserConfig(data=root), train_num_rays_per_batch=64
    ).setup()
    whole = PixelDataset(load_capture(root), load_capture(root).train_views)
    for step in (0, 1):
        seed_step(7, step)
        rays, batch = manager.next_train(step)
        seed_step(7, step)
        expected = whole.sample(64)
        drawn = to_pixel_batch(rays.origins, rays.directions, batch)
        assert torch.equal(drawn.color, expected.color)
        assert torch.equal(drawn.view, expected.view)
        assert torch.equal(drawn.origins, expected.origins)
        assert torch.equal(drawn.directions, expected.directions)


def test_invalid_pixels_are_not_drawn(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path, background=0.3))
    valid = np.full((HEIGHT, WIDTH), 255, np.uint8)
    valid[:, :9] = 0
    write_png(tmp_path / "valid.png", valid)
    views = tuple(dataclasses.replace(view, valid=tmp_path / "valid.png") for view in capture.views)
    write_capture(tmp_path, dataclasses.replace(capture, views=views), response="linear", test=capture.test)
    manager = CaptureDataManagerConfig(
        dataparser=CaptureParserConfig(data=tmp_path), train_num_rays_per_batch=400
    ).setup()
    whole = PixelDataset(load_capture(tmp_path), load_capture(tmp_path).train_views)
    for step in (0, 1):
        seed_step(7, step)
        rays, batch = manager.next_train(step)
        seed_step(7, step)
        assert torch.equal(
            to_pixel_batch(rays.origins, rays.directions, batch).color, whole.sample(400).color
        )
        assert (batch["indices"][:, 2] >= 9).all()


def test_object_mask_and_validity_are_separate(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path, background=0.3))
    rows, columns = np.indices((HEIGHT, WIDTH))
    facts = {"mask": rows < 6, "valid": columns < 9}
    for name, values in facts.items():
        write_png(tmp_path / f"{name}.png", np.where(values, 255, 0).astype(np.uint8))
    paths = {name: tmp_path / f"{name}.png" for name in facts}
    # The last view has no mask, so its object is unknown.
    views = [dataclasses.replace(view, **paths) for view in capture.views]
    views[-1] = dataclasses.replace(views[-1], mask=None)
    write_capture(tmp_path, dataclasses.replace(capture, views=tuple(views)), response="linear", test=())
    dataset = CaptureDataset(
        CaptureParserConfig(data=tmp_path, test_every=0).setup().get_dataparser_outputs("train")
    )
    for i in (0, len(views) - 1):
        item, has_mask = dataset[i], i == 0
        assert np.array_equal(item["object_mask"][..., 0].numpy() > 0.5, facts["mask"] | (not has_mask))
        assert (item["mask_known"] == float(has_mask)).all()
        assert np.array_equal(item["valid"][..., 0].numpy(), facts["valid"])


def test_another_dataparser_works(root: Path) -> None:
    outputs = parsed(root)
    other = PixelDataset(capture := capture_of(as_another_dataparser(outputs)), capture.views)
    ours = PixelDataset(load_capture(root), load_capture(root).train_views)
    assert capture.hdr
    torch.testing.assert_close(other.view(2).directions, ours.view(2).directions, atol=1e-5, rtol=0)
    torch.testing.assert_close(other.view(2).origins, ours.view(2).origins, atol=1e-5, rtol=0)
    assert torch.equal(other.view(2).color, ours.view(2).color)


LENSES = {
    "RADIAL": (-0.12, 0.03),
    "OPENCV": (-0.12, 0.03, 0.002, -0.001),
    "FULL_OPENCV": (-0.12, 0.03, 0.002, -0.001, 0.01, 0.0, 0.0, 0.0),
    "OPENCV_FISHEYE": (0.03, -0.005, 0.002, -0.001),
}


@pytest.mark.parametrize("model", LENSES)
def test_lenses_give_the_same_rays(tmp_path: Path, model: str) -> None:
    plain = load_capture(make_capture(tmp_path))
    lens = Lens(model, LENSES[model])
    views = tuple(
        dataclasses.replace(v, camera=dataclasses.replace(v.camera, lens=lens)) for v in plain.views
    )
    write_capture(tmp_path, dataclasses.replace(plain, views=views), response="linear")
    capture, outputs = load_capture(tmp_path), parsed(tmp_path)
    pixels = PixelDataset(capture, capture.train_views)
    there = capture_of(as_another_dataparser(outputs))
    back = PixelDataset(there, there.views)
    for i in range(len(capture.train_views)):
        theirs, ours = outputs.cameras.generate_rays(camera_indices=i).flatten(), pixels.view(i)
        torch.testing.assert_close(theirs.directions, ours.directions, atol=1e-4, rtol=0)
        torch.testing.assert_close(back.view(i).directions, ours.directions, atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("model", "words"), [("FOV", "no lens FOV"), ("THIN_PRISM_FISHEYE", "no lens THIN_PRISM")]
)
def test_lenses_that_nerfstudio_lacks_are_refused(tmp_path: Path, model: str, words: str) -> None:
    plain = load_capture(make_capture(tmp_path))
    lens = Lens(model, (0.5,) if model == "FOV" else (0.01,) * 8)
    views = tuple(
        dataclasses.replace(v, camera=dataclasses.replace(v.camera, lens=lens)) for v in plain.views
    )
    write_capture(tmp_path, dataclasses.replace(plain, views=views), response="linear")
    with pytest.raises(UserError, match=words):
        parsed(tmp_path)


def test_cameras_without_an_image_plane_are_refused(root: Path) -> None:
    outputs = as_another_dataparser(parsed(root))
    outputs.cameras = copy.deepcopy(outputs.cameras)
    outputs.cameras.distortion_params = torch.full((VIEWS - 1, 6), 0.1)
    with pytest.raises(UserError, match=r"k4 .* undistort"):
        capture_of(outputs)
    outputs.cameras.camera_type[:] = CameraType.EQUIRECTANGULAR.value
    with pytest.raises(UserError, match="neither perspective nor fisheye"):
        capture_of(outputs)


def test_other_layouts_are_read_and_a_format_can_be_forced(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path / "in", masks=True))
    root = write_transforms(capture, tmp_path / "out")
    outputs = CaptureParserConfig(data=root, format="transforms").setup().get_dataparser_outputs("train")
    torch.testing.assert_close(
        outputs.cameras.camera_to_worlds, parsed(tmp_path / "in").cameras.camera_to_worlds
    )
    with pytest.raises(UserError, match="not a capture of the format colmap"):
        CaptureParserConfig(data=root, format="colmap").setup().get_dataparser_outputs("train")


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV", "OPENCV_FISHEYE"])
def test_a_colmap_model_converted_by_nerfstudio_is_read(tmp_path: Path, model: str) -> None:
    write_model(material(tmp_path), reconstruction(colmap_camera(model)))
    colmap_to_json(tmp_path / "sparse" / "0", tmp_path)
    first, theirs = load_capture(tmp_path, "colmap"), load_capture(tmp_path, "transforms")
    applied = np.array(json.loads((tmp_path / "transforms.json").read_text())["applied_transform"])
    assert not np.allclose(applied, np.eye(4)[:3])  # the world is rotated
    points = torch.from_numpy(POINTS)
    turned = points @ torch.from_numpy(applied[:, :3]).T + torch.from_numpy(applied[:, 3])
    assert [view.name for view in theirs.views] == [view.name for view in first.views]
    for new, old in zip(theirs.views, first.views, strict=True):
        torch.testing.assert_close(
            project(new.camera, turned).pixel, project(old.camera, points).pixel, atol=1e-4, rtol=0
        )
    assert theirs.scene_from == "points"  # from sparse_pc.ply, in the rotated frame
    np.testing.assert_allclose(
        theirs.normalization.center, applied[:, :3] @ first.normalization.center, atol=0.1
    )


def test_nerfstudio_reads_the_exported_capture(tmp_path: Path) -> None:
    capture = load_capture(make_capture(tmp_path / "in", hdr=False, masks=True))
    config = NerfstudioDataParserConfig(
        data=write_transforms(capture, tmp_path / "out"),
        orientation_method="none",
        center_method="none",
        auto_scale_poses=False,
        downscale_factor=1,
        load_3D_points=False,
    )
    for split, views in (("train", capture.train_views), ("test", capture.test_views)):
        outputs = config.setup().get_dataparser_outputs(split)
        assert [path.stem for path in outputs.image_filenames] == [view.name for view in views]
        for i, view in enumerate(views):
            theirs, ours = outputs.cameras.generate_rays(camera_indices=i).flatten(), camera_rays(view.camera)
            torch.testing.assert_close(theirs.origins, ours.origins, atol=1e-5, rtol=0)
            torch.testing.assert_close(theirs.directions, ours.directions, atol=1e-5, rtol=0)


def test_exr_images_in_other_methods_and_dataparsers_are_refused(root: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"\.exr: this part of nerfstudio cannot read EXR .*neilfpp-data"):
        InputDataset(parsed(root))[0]
    config = NerfstudioDataParserConfig(data=write_transforms(load_capture(root), tmp_path))
    with pytest.raises(UserError, match=r"\.exr: this part of nerfstudio cannot read EXR"):
        config.setup().get_dataparser_outputs("train")


def test_a_device_that_is_not_there_is_refused(root: Path, monkeypatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    manager = CaptureDataManagerConfig(dataparser=CaptureParserConfig(data=root))
    for device in ("cuda", "cuda:0"):
        with pytest.raises(UserError, match=r"no CUDA device; .*--machine\.device-type cpu"):
            manager.setup(device=device)


def test_rescaled_views_are_refused(root: Path) -> None:
    with pytest.raises(UserError, match="scale the capture"):
        CaptureDataset(parsed(root), scale_factor=0.5)


def test_without_test_views_nerfstudio_gets_a_training_view(tmp_path: Path) -> None:
    outputs = (
        CaptureParserConfig(data=make_capture(tmp_path, test=None), test_every=0)
        .setup()
        .get_dataparser_outputs("val")
    )
    assert [path.stem for path in outputs.image_filenames] == ["000"]
