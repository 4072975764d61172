"""A folder of rendered images with records of their settings, so that interrupted work can be continued."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from neilfpp_method.data.files.images import read_image, write_exr, write_png
from neilfpp_method.data.files.json_entry import write_json
from neilfpp_method.errors import UserError
from neilfpp_method.relight.cameras import Shot
from neilfpp_method.relight.film import Picture
from neilfpp_method.shading.color import tone_map
from neilfpp_method.train.json_files import read_json

__all__ = ["PictureFolder", "StoredPicture"]

IN_WORDS = {"map_sha256": "another map of this name", "weights_sha256": "the weights of another training"}
"""What a message says in place of the values of a setting that differs: hashes tell the user nothing."""


@dataclass(frozen=True)
class StoredPicture:
    """Linear radiance, premultiplied by alpha, and alpha."""

    radiance: Float[np.ndarray, "H W 3"]
    alpha: Float[np.ndarray, "H W"]


@dataclass(frozen=True)
class PictureFolder:
    """A folder of images that are rendered with the same settings.

    Each image is an EXR, a PNG and a JSON record with its settings. The record is written last; an image
    without a record is unfinished.
    """

    path: Path
    settings: Mapping[str, Any]

    def has(self, shot: Shot) -> bool:
        """Whether a finished image exists.

        Raises:
            UserError: an image exists that was rendered with different settings.
        """
        record = self._file(shot, ".json")
        if not record.is_file():
            return False
        stored = read_json(record)
        for key, value in self._record(shot).items():
            if stored.get(key) != value:
                other = IN_WORDS.get(key, f"{key} {stored.get(key)}, not {value}")
                problem = f"{record}: the image was rendered with {other}"
                raise UserError(problem, "choose another --out, or render again with --force")
        return all(self._file(shot, suffix).is_file() for suffix in (".exr", ".png"))

    def write(self, shot: Shot, picture: Picture, seconds: float) -> None:
        """Write an image, replacing an existing one. `seconds` is the time it took, for the record.

        Raises:
            UserError: a file cannot be written.
        """
        record = self._file(shot, ".json")
        record.unlink(missing_ok=True)
        rgba = torch.cat((picture.radiance, picture.alpha), -1).cpu()
        write_exr(self._file(shot, ".exr"), {"RGBA": rgba.numpy()})
        write_png(self.png(shot), _displayed(rgba))
        write_json(record, {**self._record(shot), "samples": picture.samples, "took": round(seconds, 2)})

    def read(self, shot: Shot) -> StoredPicture:
        """Read an image from its EXR."""
        file = read_image(self._file(shot, ".exr"))
        opaque = np.ones(file.pixels.shape[:2], np.float32)
        return StoredPicture(file.pixels, opaque if file.alpha is None else file.alpha)

    def png(self, shot: Shot) -> Path:
        """Path of the PNG of an image."""
        return self._file(shot, ".png")

    def _file(self, shot: Shot, suffix: str) -> Path:
        return self.path / f"{shot.name}{suffix}"

    def _record(self, shot: Shot) -> dict[str, Any]:
        return {**self.settings, "width": shot.camera.width, "height": shot.camera.height}


def _displayed(rgba: Float[Tensor, "H W 4"]) -> UInt8[np.ndarray, "H W 4"]:
    """Convert to 8-bit sRGB with straight alpha, as PNG requires."""
    color, alpha = rgba.split([3, 1], dim=-1)
    straight = torch.where(alpha > 0, color / alpha.clamp_min(1e-6), 0.0)
    return (torch.cat((tone_map(straight), alpha), -1) * 255).round().byte().numpy()
