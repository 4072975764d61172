"""`neilfpp-data`: every capture that `neilfpp train` reads, HDR included, for nerfstudio's data managers.

Nerfstudio's frame is then the scene frame: the object lies in the unit sphere. No data manager is imported here; they
import this.
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

from neilfpp_method.data.capture import Capture, load_capture
from neilfpp_method.data.images import image_header
from neilfpp_method.data.views import Camera, Normalisation, View, check_camera
from neilfpp_method.errors import UserError

__all__ = ["CaptureParser", "CaptureParserConfig", "capture_of", "neilfpp_data"]

CAPTURE = "neilfpp_capture"
# OpenCV's camera (x right, y down, z forward) and OpenGL's (x right, y up, z back).
FLIP = np.array([1.0, -1.0, -1.0, 1.0])


@dataclass
class CaptureParserConfig(DataParserConfig):
    """Captures of posed images: the published NeILF layout and all others that `neilfpp train` reads."""

    _target: type = field(default_factory=lambda: CaptureParser)
    data: Path = Path()
    """Folder of the capture."""
    test_every: Optional[int] = None  # noqa: UP045  (tyro reads it at run time on every Python)
    """Hold out every k-th view; none: as the capture's split.json says, else every 8th."""
    response: Literal["auto", "linear", "srgb"] = "auto"
    """Whether pixels are linear radiance or display values; auto: floating-point files are linear."""


@dataclass
class CaptureParser(DataParser):
    """Reads a capture; the test views serve as nerfstudio's `val` and `test`."""

    config: CaptureParserConfig

    def _generate_dataparser_outputs(self, split: str = "train", **_) -> DataparserOutputs:
        capture = load_capture(self.config.data, test_every=self.config.test_every, response=self.config.response)
        # Nerfstudio cannot do without a view to evaluate; where none is held out it gets one from the training set.
        views = capture.train_views if split == "train" else capture.test_views or capture.train_views[:1]
        frame = capture.normalisation
        transform = torch.eye(4)[:3]
        transform[:, 3] = -torch.tensor(frame.centre)
        return DataparserOutputs(
            image_filenames=[view.image for view in views],
            cameras=_cameras([frame.camera(view.camera) for view in views]),
            scene_box=SceneBox(aabb=torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])),
            metadata={CAPTURE: capture},
            dataparser_transform=transform,
            dataparser_scale=1.0 / frame.scale,
        )


def _cameras(pinholes: Sequence[Camera]) -> Cameras:
    def column(name: str) -> torch.Tensor:
        return torch.tensor([[getattr(pinhole, name)] for pinhole in pinholes])

    poses = np.stack([pinhole.c2w * FLIP for pinhole in pinholes])
    intrinsics = {name: column(name).float() for name in ("fx", "fy", "cx", "cy")}
    sizes = {name: column(name) for name in ("width", "height")}
    return Cameras(torch.from_numpy(poses).float(), **intrinsics, **sizes, camera_type=CameraType.PERSPECTIVE)


def capture_of(outputs: DataparserOutputs) -> Capture:
    """The capture behind a dataparser's outputs: that of `neilfpp-data`, or one made of what another dataparser found.

    Raises:
        UserError: the cameras are no pinholes.
    """
    if CAPTURE in outputs.metadata:
        return outputs.metadata[CAPTURE]
    masks = outputs.mask_filenames or [None] * len(outputs.image_filenames)
    views = tuple(
        View(f"{i:05d}", i, _pinhole(outputs.cameras, i), Path(image), mask and Path(mask))
        for i, (image, mask) in enumerate(zip(outputs.image_filenames, masks, strict=True))
    )
    kinds = {image_header(view.image).hdr for view in views}
    if len(kinds) > 1:
        raise UserError(f"{views[0].image.parent}: HDR and LDR images together", "use images of one kind")
    folder = views[0].image.parent
    return Capture(folder, "nerfstudio", folder, views, Normalisation(1.0, (0.0, 0.0, 0.0)), kinds.pop(), frozenset())


def _pinhole(cameras: Cameras, i: int) -> Camera:
    bent = cameras.distortion_params is not None and bool(cameras.distortion_params[i].any())
    if bent or int(cameras.camera_type[i]) != CameraType.PERSPECTIVE.value:
        raise UserError(f"camera {i} is not a pinhole", "undistort the images")
    c2w = np.eye(4)
    c2w[:3] = cameras.camera_to_worlds[i].double().numpy() * FLIP
    intrinsics = (float(getattr(cameras, name)[i]) for name in ("fx", "fy", "cx", "cy"))
    pinhole = Camera(*intrinsics, int(cameras.width[i]), int(cameras.height[i]), np.linalg.inv(c2w))
    check_camera(pinhole, f"camera {i}")
    return pinhole


neilfpp_data = DataParserSpecification(CaptureParserConfig(), "Captures that `neilfpp train` reads, HDR included.")
