"""The parts of a capture: its views, and the transformation from the world frame to the scene frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.data.cameras.camera import Camera

__all__ = ["CaptureFiles", "Normalization", "SceneSource", "View"]


@dataclass(frozen=True)
class View:
    """One image with its camera in the world frame.

    Linear radiance = pixel / (`exposure` · `white_balance`), so that all images of a capture have one scale.

    Attributes:
        name: unique in the capture and a valid file name, in most layouts the stem of the image.
        index: number of the view in the layout's own list, which also counts views that are left out.
        camera: the camera, in the world frame.
        image: the image.
        mask: mask of the object, white on it; None if there is none.
        valid: validity mask, black where a pixel is saturated or has no meaning; None if all pixels are
            valid.
        exposure: exposure relative to other views.
        white_balance: factors of red, green and blue.
        file_size: width and height of the files if the camera has another size (`scaling`), to which pixels
            are scaled when they are read; else None.
    """

    name: str
    index: int
    camera: Camera
    image: Path
    mask: Path | None = None
    valid: Path | None = None
    exposure: float = 1.0
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    file_size: tuple[int, int] | None = None


@dataclass(frozen=True)
class Normalization:
    """scene = (world − centre) / scale: without rotation, directions are the same in both frames."""

    scale: float
    center: tuple[float, float, float]

    def to_scene(self, points: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
        """Transform positions from the world frame to the scene frame."""
        return (points - points.new_tensor(self.center)) / self.scale

    def to_world(self, points: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
        """Transform positions from the scene frame to the world frame."""
        return points * self.scale + points.new_tensor(self.center)

    def camera(self, camera: Camera) -> Camera:
        """Return the camera in the scene frame: with the same image, and depths divided by `scale`."""
        w2c = camera.w2c.copy()
        w2c[:3, 3] = (w2c[:3, :3] @ np.array(self.center) + w2c[:3, 3]) / self.scale
        return replace(camera, w2c=w2c)


SceneSource = Literal["box", "points", "focus", "masks", "cameras"]
"""Source of the scene box: the capture states it ("box"); points; the point that the cameras look at, because
the points extend far beyond it ("focus"); the visual hull of the masks; or only the cameras."""


@dataclass(frozen=True)
class CaptureFiles:
    """The content of a capture folder, as a reader returns it.

    Attributes:
        inputs: folder to which listed paths are relative, with masks, depth maps and other files.
        views: the views, in order.
        normalization: the transformation from the world frame to the scene frame.
        point_cloud: oriented point cloud; None if there is none.
        test: names of the test views; None if the capture states no split.
        hdr: whether pixels are linear radiance; None if the capture does not state it.
        scene_from: source of the normalisation.
        missing: images that the description lists and that do not exist; they have no view.
    """

    inputs: Path
    views: tuple[View, ...]
    normalization: Normalization
    point_cloud: Path | None = None
    test: frozenset[str] | None = None
    hdr: bool | None = None
    scene_from: SceneSource = "box"
    missing: tuple[str, ...] = ()
