"""What nerfstudio is given of a capture: the same rays and the same pixels that the standalone loop learns from."""

from __future__ import annotations

import copy
import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs

from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.pixels import PixelDataset
from neilfpp_method.errors import UserError
from neilfpp_method.plugin.datamanager import CaptureDataManagerConfig, CaptureDataset, pixel_batch
from neilfpp_method.plugin.dataparser import CaptureParserConfig, capture_of
from neilfpp_method.train.loop import seed_step
from tests.data.make_capture import CENTRE, SCALE, make_capture

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


def test_the_transform_leads_from_the_world_to_the_scene(root: Path) -> None:
    outputs = parsed(root)
    point = np.array([1.0, 2.0, 3.0])
    transform = outputs.dataparser_transform.double().numpy()
    moved = outputs.dataparser_scale * (transform[:, :3] @ point + transform[:, 3])
    np.testing.assert_allclose(moved, (point - CENTRE) / SCALE, atol=1e-6)


def test_each_drawn_pixel_brings_its_color_and_its_facts(root: Path) -> None:
    manager = CaptureDataManagerConfig(dataparser=CaptureParserConfig(data=root), train_num_rays_per_batch=400).setup()
    rays, batch = manager.next_train(0)
    drawn = pixel_batch(rays.origins, rays.directions, batch)
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


def test_a_step_learns_from_the_pixels_of_the_same_step_of_the_standalone_loop(root: Path) -> None:
    manager = CaptureDataManagerConfig(dataparser=CaptureParserConfig(data=root), train_num_rays_per_batch=64).setup()
    whole = PixelDataset(load_capture(root), load_capture(root).train_views)
    for step in (0, 1):
        seed_step(7, step)
        rays, batch = manager.next_train(step)
        seed_step(7, step)
        expected = whole.sample(64)
        drawn = pixel_batch(rays.origins, rays.directions, batch)
        assert torch.equal(drawn.color, expected.color)
        assert torch.equal(drawn.view, expected.view)
        torch.testing.assert_close(drawn.directions, expected.directions, atol=1e-5, rtol=0)


def test_another_dataparser_serves_as_well(root: Path) -> None:
    outputs = parsed(root)
    other = PixelDataset(capture := capture_of(as_another_dataparser(outputs)), capture.views)
    ours = PixelDataset(load_capture(root), load_capture(root).train_views)
    assert capture.hdr
    torch.testing.assert_close(other.view(2).directions, ours.view(2).directions, atol=1e-5, rtol=0)
    torch.testing.assert_close(other.view(2).origins, ours.view(2).origins, atol=1e-5, rtol=0)
    assert torch.equal(other.view(2).color, ours.view(2).color)


def test_cameras_that_are_no_pinholes_are_refused(root: Path) -> None:
    outputs = as_another_dataparser(parsed(root))
    outputs.cameras = copy.deepcopy(outputs.cameras)
    outputs.cameras.distortion_params = torch.full((VIEWS - 1, 6), 0.1)
    with pytest.raises(UserError, match="undistort"):
        capture_of(outputs)


def test_views_are_not_rescaled_in_silence(root: Path) -> None:
    with pytest.raises(UserError, match="scale the capture"):
        CaptureDataset(parsed(root), scale_factor=0.5)


def test_without_test_views_nerfstudio_still_has_one_to_show(tmp_path: Path) -> None:
    outputs = CaptureParserConfig(data=make_capture(tmp_path, test=None), test_every=0).setup().get_dataparser_outputs("val")
    assert [path.stem for path in outputs.image_filenames] == ["000"]
