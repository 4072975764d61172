"""Float images for nerfstudio's data manager, with the ray and the loss inputs of each pixel."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Int, Shaped
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManager, VanillaDataManagerConfig
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.data.pixel_samplers import PixelSampler, PixelSamplerConfig
from nerfstudio.model_components.ray_generators import RayGenerator
from torch import Tensor

from neilfpp_method.data.cameras.projection import CameraRays
from neilfpp_method.data.pixels import drawing
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.errors import UserError
from neilfpp_method.plugin.dataparser import capture_of
from neilfpp_method.structures import PixelBatch

__all__ = [
    "PIXELS",
    "VALID",
    "CaptureDataManager",
    "CaptureDataManagerConfig",
    "CaptureDataset",
    "to_pixel_batch",
]

PIXELS = "neilfpp_pixels"
"""Key of a dataset's metadata under which the model finds the `PixelDataset`."""

LOSS_INPUTS = {"object_mask": "mask", "mask_known": "mask_known", "image_gradient": "image_gradient"}
"""Keys of a nerfstudio batch and the attributes of `PixelBatch` that they hold. The mask is not called `mask`
because nerfstudio would then draw no pixels outside of it, which L_vol needs.
"""
VALID = "valid"
"""Key of a nerfstudio batch for whether a pixel is valid."""
NEAR = "near_object"
"""Key of a nerfstudio batch for whether a pixel is on the object or near it."""


class CaptureDataset(InputDataset):
    """Images as stored in the files: unbounded linear radiance, or display values in [0, 1].

    Raises:
        UserError: if the views differ in size, or nerfstudio is to scale them.
    """

    exclude_batch_keys_from_device: ClassVar = [
        *InputDataset.exclude_batch_keys_from_device,
        *LOSS_INPUTS,
        VALID,
        NEAR,
    ]

    def __init__(self, dataparser_outputs: DataparserOutputs, scale_factor: float = 1.0) -> None:
        super().__init__(dataparser_outputs, scale_factor)
        capture = capture_of(dataparser_outputs)
        if scale_factor != 1.0:
            raise UserError("camera_res_scale_factor is not 1", "scale the capture instead")
        if len({(int(w), int(h)) for w, h in zip(self.cameras.width, self.cameras.height, strict=True)}) > 1:
            raise UserError(
                f"{capture.root}: views of several sizes", "use `neilfpp train`, or bring them to one size"
            )
        views = {view.image: view for view in capture.views}
        self.pixels = PixelDataset(capture, [views[image] for image in dataparser_outputs.image_filenames])
        self.metadata[PIXELS] = self.pixels

    def get_image_float32(self, image_idx: int) -> Float[Tensor, "H W 3"]:
        """The colours of a view as stored in its file: linear radiance or display values."""
        return self._image(image_idx, self.pixels.view(image_idx, gradients=False).color)

    def get_metadata(self, data: dict[str, Any]) -> dict[str, Tensor]:
        """Loss inputs of each pixel, and which pixels can be drawn, (H, W, 1) each."""
        i = data["image_idx"]
        pixels = self.pixels.view(i)
        inputs = {key: self._image(i, getattr(pixels, name)) for key, name in LOSS_INPUTS.items()}
        return inputs | {
            VALID: self._image(i, self.pixels.valid(i)),
            NEAR: self._image(i, self.pixels.near(i)),
        }

    def _image(self, i: int, values: Tensor) -> Shaped[Tensor, "H W C"]:
        camera = self.pixels.views[i].camera
        return values.reshape(camera.height, camera.width, -1)


def to_pixel_batch(origins: Tensor, directions: Tensor, batch: dict[str, Any]) -> PixelBatch:
    """Convert nerfstudio's rays and pixels of a training step to a `PixelBatch`.

    Args:
        origins: (N, 3) in the scene frame.
        directions: (N, 3), unit.
        batch: values of the N pixels, as drawn by `CapturePixelSampler` from a `CaptureDataset`.
    """
    inputs = {name: batch[key].to(origins.device)[:, 0] for key, name in LOSS_INPUTS.items()}
    color, view = batch["image"].to(origins.device), batch["indices"][:, 0].to(origins.device)
    return PixelBatch(origins=origins, directions=directions, color=color, view=view, **inputs)


class CapturePixelSampler(PixelSampler):
    """Draws the same pixels as `PixelDataset.sample` (`data.pixels.drawing`) with the same random numbers.

    A step thus trains on the same pixels as the corresponding step of the standalone loop.
    """

    _valid: Tensor | None = None
    _draws: drawing.PixelDraws

    def collate_image_dataset_batch(
        self, batch: dict[str, Any], num_rays_per_batch: int, keep_full_image: bool = False
    ) -> dict[str, Tensor]:
        """Pixels of a batch of images, and their `indices`: view, row, column."""
        # Training never reads whole images.
        del keep_full_image
        _, height, width, _ = batch["image"].shape
        # Nerfstudio shuffles the images when it loads them.
        order = batch["image_idx"].cpu().argsort()
        if self._valid is not batch[VALID]:
            bits = drawing.VALID * batch[VALID].cpu()[order] + drawing.NEAR * batch[NEAR].cpu()[order]
            padded = torch.nn.functional.pad(bits.flatten(), (0, -bits.numel() % drawing.BLOCK))
            self._valid = batch[VALID]
            self._draws = drawing.PixelDraws(padded.to(torch.uint8).numpy(), bits.numel())
        number = self._draws.draw(num_rays_per_batch)
        row, column = number // width % height, number % width
        place = order[number // (height * width)]
        drawn = {
            key: values[place, row, column]
            for key, values in batch.items()
            if key not in ("image_idx", VALID, NEAR)
        }
        return drawn | {"indices": torch.stack([batch["image_idx"].cpu()[place], row, column], dim=-1)}


class CaptureRayGenerator(RayGenerator):
    """Rays of the capture's cameras, bitwise equal to those of the standalone loop.

    Nerfstudio's own rays differ by rounding errors, and by slightly more with lens distortion. Training is
    chaotic: two runs that differ by a rounding error end about as far apart as two runs with different seeds.
    """

    def __init__(self, dataset: CaptureDataset, device: torch.device | str) -> None:
        super().__init__(dataset.cameras.to(device))
        capture, views = dataset.pixels.capture, dataset.pixels.views
        self._rays = CameraRays([capture.scene_camera(view) for view in views], device)

    def forward(self, ray_indices: Int[Tensor, "N 3"]) -> RayBundle:
        """Rays through pixels: view, row, column."""
        bundle = super().forward(ray_indices)
        view, row, column = ray_indices.to(bundle.origins.device).unbind(-1)
        rays = self._rays(view, row * self.image_coords.shape[1] + column)
        bundle.origins, bundle.directions = rays.origins, rays.directions
        return bundle


@dataclass
class CaptureDataManagerConfig(VanillaDataManagerConfig):
    """Nerfstudio's data manager with float images."""

    _target: type = field(default_factory=lambda: CaptureDataManager)
    pixel_sampler: PixelSamplerConfig = field(
        default_factory=lambda: PixelSamplerConfig(_target=CapturePixelSampler)
    )
    """The sampler of the pixels of a step."""


class CaptureDataManager(VanillaDataManager[CaptureDataset]):
    """Nerfstudio's data manager with float images.

    Raises:
        UserError: if the device is not there: the data manager is the first part of this package that
            `ns-train` builds, and its default device is CUDA.
    """

    def __init__(
        self, config: CaptureDataManagerConfig, device: torch.device | str = "cpu", **options: Any
    ) -> None:
        if torch.device(device).type == "cuda" and not torch.cuda.is_available():
            raise UserError("torch finds no CUDA device", "use one, or add --machine.device-type cpu")
        super().__init__(config, device, **options)

    def setup_train(self) -> None:
        """Set up as nerfstudio does, but with `CaptureRayGenerator`."""
        super().setup_train()
        self.train_ray_generator = CaptureRayGenerator(self.train_dataset, self.device)
