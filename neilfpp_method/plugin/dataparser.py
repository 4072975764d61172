"""The dataparser `neilfpp-data`, which reads every capture that `neilfpp train` reads, including HDR images.

Nerfstudio's frame is then the scene frame, in which the object lies in the unit sphere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Optional

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.plugins.registry_dataparser import DataParserSpecification

from neilfpp_method.data.cameras.camera import Camera, check_camera
from neilfpp_method.data.capture import Capture, load_capture
from neilfpp_method.data.files.images import image_header
from neilfpp_method.data.formats.nerfstudio_lens import FISHEYE, lens_from_nerfstudio, nerfstudio_coefficients
from neilfpp_method.data.formats.transforms import FLIP
from neilfpp_method.data.views import Normalization, View
from neilfpp_method.errors import UserError
from neilfpp_method.plugin.exr import explain_exr_to_pillow

__all__ = ["CaptureParser", "CaptureParserConfig", "capture_of", "neilfpp_data"]

CAPTURE = "neilfpp_capture"
"""Key of the metadata of `neilfpp-data` under which the `Capture` is."""
ORDER = ("k1", "k2", "k3", "k4", "p1", "p2")
"""Distortion coefficients in nerfstudio's order."""
MODELS = {CameraType.PERSPECTIVE.value: "OPENCV", CameraType.FISHEYE.value: FISHEYE}
"""COLMAP's lens model for each of nerfstudio's types of camera that are supported."""


@dataclass
class CaptureParserConfig(DataParserConfig):
    """Captures of posed images: the published NeILF layout and all others that `neilfpp train` reads."""

    _target: type = field(default_factory=lambda: CaptureParser)
    data: Path = Path()
    """Folder of the capture."""
    format: Optional[str] = None  # noqa: UP045  (tyro reads it at run time on every Python)
    """Format of the capture (see docs/captures.md); default: recognised from the files."""
    test_every: Optional[int] = None  # noqa: UP045  (tyro reads it at run time on every Python)
    """Hold out every k-th view; default: the capture's split, or every 8th view."""
    response: Literal["auto", "linear", "srgb"] = "auto"
    """What the pixels hold: linear radiance or sRGB; auto: as the capture or the kind of files says."""


@dataclass
class CaptureParser(DataParser):
    """Reads a capture; the test views serve as nerfstudio's `val` and `test`."""

    config: CaptureParserConfig

    def _generate_dataparser_outputs(self, split: str = "train", **_) -> DataparserOutputs:
        chosen = self.config
        capture = load_capture(chosen.data, chosen.format, chosen.test_every, response=chosen.response)
        # Nerfstudio needs at least one evaluation view; if none is held out it gets a training view.
        views = capture.train_views if split == "train" else capture.test_views or capture.train_views[:1]
        frame = capture.normalization
        transform = torch.eye(4)[:3]
        transform[:, 3] = -torch.tensor(frame.center)
        return DataparserOutputs(
            image_filenames=[view.image for view in views],
            cameras=_cameras([frame.camera(view.camera) for view in views]),
            scene_box=SceneBox(aabb=torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])),
            metadata={CAPTURE: capture},
            dataparser_transform=transform,
            dataparser_scale=1.0 / frame.scale,
        )


def _cameras(cameras: Sequence[Camera]) -> Cameras:
    """Convert cameras, whose axes are OpenCV's, to nerfstudio's, whose axes are OpenGL's."""

    def column(name: str) -> torch.Tensor:
        return torch.tensor([[getattr(camera, name)] for camera in cameras])

    poses = np.stack([camera.c2w * FLIP for camera in cameras])
    intrinsics = {name: column(name).float() for name in ("fx", "fy", "cx", "cy")}
    sizes = {name: column(name) for name in ("width", "height")}
    is_distorted = any(camera.lens is not None for camera in cameras)
    kinds = [CameraType.FISHEYE if _is_fisheye(camera) else CameraType.PERSPECTIVE for camera in cameras]
    return Cameras(
        torch.from_numpy(poses).float(),
        **intrinsics,
        **sizes,
        distortion_params=torch.tensor([_distortion(camera) for camera in cameras]) if is_distorted else None,
        camera_type=torch.tensor([[kind.value] for kind in kinds]),
    )


def _is_fisheye(camera: Camera) -> bool:
    return camera.lens is not None and camera.lens.model == FISHEYE


def _distortion(camera: Camera) -> list[float]:
    """Distortion coefficients in nerfstudio's order k1, k2, k3, k4, p1, p2.

    Raises:
        UserError: if nerfstudio does not support the lens model.
    """
    coefficients = nerfstudio_coefficients(camera)
    if coefficients is None:
        raise UserError(
            f"nerfstudio has no lens {camera.lens.model}", "undistort the images, or use `neilfpp train`"
        )
    return [coefficients.get(name, 0.0) for name in ORDER]


def capture_of(outputs: DataparserOutputs) -> Capture:
    """Return the capture of a dataparser's outputs: that of `neilfpp-data`, or one made from other outputs.

    The scene frame of a capture made from other outputs is nerfstudio's frame.

    Raises:
        UserError: if a camera is neither perspective nor fisheye, or if HDR and LDR images are mixed.
    """
    if CAPTURE in outputs.metadata:
        return outputs.metadata[CAPTURE]
    masks = outputs.mask_filenames or [None] * len(outputs.image_filenames)
    views = tuple(
        View(f"{i:05d}", i, _camera(outputs.cameras, i), Path(image), mask and Path(mask))
        for i, (image, mask) in enumerate(zip(outputs.image_filenames, masks, strict=True))
    )
    kinds = {image_header(view.image).hdr for view in views}
    if len(kinds) > 1:
        raise UserError(f"{views[0].image.parent}: HDR and LDR images together", "use images of one kind")
    folder = views[0].image.parent
    identity = Normalization(scale=1.0, center=(0.0, 0.0, 0.0))
    return Capture(folder, "nerfstudio", folder, views, identity, kinds.pop(), frozenset())


def _camera(cameras: Cameras, i: int) -> Camera:
    """Convert the i-th of nerfstudio's cameras.

    Raises:
        UserError: if the camera or its lens is not supported.
    """
    kind = int(cameras.camera_type[i])
    if kind not in MODELS:
        raise UserError(f"camera {i} is neither perspective nor fisheye", "cut perspective images out of it")
    known = cameras.distortion_params
    coefficients = [0.0] * len(ORDER) if known is None else known[i].double().tolist()
    distortion = dict(zip(ORDER, coefficients, strict=True))
    c2w = np.eye(4)
    c2w[:3] = cameras.camera_to_worlds[i].double().numpy() * FLIP
    intrinsics = (float(getattr(cameras, name)[i]) for name in ("fx", "fy", "cx", "cy"))
    lens = lens_from_nerfstudio(MODELS[kind], distortion, f"camera {i}")
    camera = Camera(*intrinsics, int(cameras.width[i]), int(cameras.height[i]), np.linalg.inv(c2w), lens)
    check_camera(camera, f"camera {i}")
    return camera


explain_exr_to_pillow()
neilfpp_data = DataParserSpecification(
    CaptureParserConfig(), "Captures that `neilfpp train` reads, HDR included."
)
