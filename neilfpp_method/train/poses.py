"""Corrections of the camera poses in a training: when they are fitted, and where they are applied.

A correction applies to the views of the capture, so all that reads a training camera later uses the corrected
one. `corrected` is the only place that applies it. Test views keep their poses: no step may look at them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.capture import Capture
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.fields.poses import PoseCorrections, PoseMotion, rotation_matrices
from neilfpp_method.schedule import Stage, StagePosition
from neilfpp_method.structures import PixelBatch

__all__ = ["GivenCameras", "camera_centers", "corrected", "is_fit_due"]

FIRST, LAST = 0.3, 0.9
"""Shares of SDF init at which poses are fitted for the first and the last time. Before, R is too blurred;
after, G and R adapt to the final poses.
"""


@dataclass(frozen=True)
class GivenCameras:
    """Training pixels with their rays through the cameras as given.

    Attributes:
        pixels: all pixels.
        held_back: pixels at which quality is measured.
        checked: pixels at which health is checked.
    """

    pixels: PixelDataset
    held_back: PixelBatch
    checked: PixelBatch | None


def is_fit_due(fits: int, position: StagePosition) -> bool:
    """Whether poses are to be fitted after so many steps of a stage.

    >>> [step for step in range(101) if is_fit_due(3, StagePosition(Stage.SDF_INIT, step, 100))]
    [30, 60, 90]
    """
    if position.stage is not Stage.SDF_INIT:
        return False
    shares = (FIRST + (LAST - FIRST) * i / max(fits - 1, 1) for i in range(fits))
    return position.step in {round(share * position.length) for share in shares}


def corrected(capture: Capture, poses: PoseCorrections | None) -> Capture:
    """The capture with corrected poses of its training views.

    Args:
        capture: the capture with poses as given.
        poses: the corrections, in the order of `capture.train_views`; if None, the capture is unchanged.
    """
    if poses is None:
        return capture
    motion = PoseMotion(poses.rotation.cpu(), poses.shift.cpu())
    turns, shifts = rotation_matrices(motion.rotation).numpy(), motion.shift.double().numpy()
    scale = capture.normalization.scale
    moved = {
        view.name: replace(view, camera=_moved(view.camera, turn, scale * shift))
        for view, turn, shift in zip(capture.train_views, turns, shifts, strict=True)
    }
    return replace(capture, views=tuple(moved.get(view.name, view) for view in capture.views))


def camera_centers(capture: Capture) -> Float[Tensor, "V 3"]:
    """Centres of the training cameras in the scene frame."""
    centers = [capture.scene_camera(view).c2w[:, 3] for view in capture.train_views]
    return torch.from_numpy(np.stack(centers)).float()


def _moved(camera: Camera, turn: np.ndarray, shift: np.ndarray) -> Camera:
    """The camera, turned about its centre and shifted."""
    if not (shift.any() or (turn != np.eye(3)).any()):
        return camera
    pose, w2c = camera.c2w, np.eye(4)
    w2c[:3, :3] = (turn @ pose[:, :3]).T
    w2c[:3, 3] = -w2c[:3, :3] @ (pose[:, 3] + shift)
    return replace(camera, w2c=w2c)
