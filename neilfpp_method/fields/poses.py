"""Corrections of the camera poses of the training views.

A correction is a rotation about the camera's centre and a shift of the centre, both in the scene frame. A
motion that all cameras share cannot be separated from a motion of the scene, so the corrections contain none.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from neilfpp_method.structures import Indexable, PixelBatch

__all__ = ["PoseCorrections", "PoseMotion", "rotation_matrices"]


@dataclass(frozen=True)
class PoseMotion(Indexable):
    """Motions of V cameras.

    Attributes:
        rotation: rotation vectors in radians, along the axis of the rotation; scene frame.
        shift: shifts of the camera centres, scene units.
    """

    rotation: Float[Tensor, "V 3"]
    shift: Float[Tensor, "V 3"]

    @staticmethod
    def none(views: int) -> PoseMotion:
        """No motion of any camera."""
        return PoseMotion(torch.zeros(views, 3), torch.zeros(views, 3))

    def of(self, batch: PixelBatch) -> PixelBatch:
        """The same pixels with their rays after the motion of their cameras."""
        turn = rotation_matrices(self.rotation).to(batch.directions)[batch.view]
        directions = (turn @ batch.directions[..., None])[..., 0]
        return replace(batch, origins=batch.origins + self.shift[batch.view], directions=directions)

    def without_common_motion(self, centers: Float[Tensor, "V 3"]) -> PoseMotion:
        """Subtract the rigid motion and the change of scale that are closest to the motions of all cameras.

        Args:
            centers: the camera centres before the motion.
        """
        count = len(centers)
        design = centers.new_zeros(count, 2, 3, 7)
        design[:, 0, :, :3] = torch.eye(3)  # a common rotation ω turns every camera by ω
        design[:, 1, :, :3] = -_cross_matrices(centers)  # and moves its centre c by ω × c
        design[:, 1, :, 3:6] = torch.eye(3)
        design[:, 1, :, 6] = centers
        motions = torch.stack((self.rotation, self.shift), 1).reshape(-1, 1)
        flat = design.reshape(-1, 7).double()
        common = flat @ torch.linalg.pinv(flat) @ motions.double()
        own = (motions.double() - common).to(self.shift).view(count, 2, 3)
        return PoseMotion(own[:, 0], own[:, 1])


class PoseCorrections(nn.Module):
    """The corrections of the training views as buffers, so that checkpoints contain them."""

    def __init__(self, views: int) -> None:
        super().__init__()
        self.register_buffer("rotation", torch.zeros(views, 3))
        self.register_buffer("shift", torch.zeros(views, 3))

    @property
    def motion(self) -> PoseMotion:
        """The motion from the given to the corrected cameras."""
        return PoseMotion(self.rotation, self.shift)

    def set(self, motion: PoseMotion) -> None:
        """Replace the corrections."""
        self.rotation.copy_(motion.rotation)
        self.shift.copy_(motion.shift)


def rotation_matrices(rotation: Float[Tensor, "V 3"]) -> Float[Tensor, "V 3 3"]:
    """Rotation matrices of rotation vectors, in double precision."""
    return torch.linalg.matrix_exp(_cross_matrices(rotation.double()))


def _cross_matrices(vector: Float[Tensor, "V 3"]) -> Float[Tensor, "V 3 3"]:
    """The matrices [v]× with [v]× u = v × u."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1).view(-1, 3, 3)
