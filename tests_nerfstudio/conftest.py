"""Nerfstudio on a CPU without a network. None of this is needed if torchvision and tiny-cuda-nn run on a
GPU.
"""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

pytest.importorskip(
    "nerfstudio", reason="nerfstudio is not installed here: `make test-nerfstudio` has its own environment"
)

# torchvision's wheels are CUDA builds: with a CPU build of torch two operators have no schema, and its import
# fails.
OPERATORS = torch.library.Library("torchvision", "DEF")
OPERATORS.define("nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
OPERATORS.define("qnms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")

import torchmetrics.image.lpip  # noqa: E402
from nerfstudio.field_components.encodings import HashEncoding  # noqa: E402
from nerfstudio.fields import sdf_field  # noqa: E402


class TorchEncoding(HashEncoding):
    """The hash grid that nerfstudio's SDF field takes from tiny-cuda-nn, in plain torch."""

    def __init__(self, n_input_dims: int, encoding_config: dict) -> None:
        del n_input_dims
        levels, base = encoding_config["n_levels"], encoding_config["base_resolution"]
        super().__init__(
            num_levels=levels,
            min_res=base,
            max_res=int(base * encoding_config["per_level_scale"] ** (levels - 1)),
            log2_hashmap_size=encoding_config["log2_hashmap_size"],
            features_per_level=encoding_config["n_features_per_level"],
            implementation="torch",
        )
        self.n_output_dims = self.get_out_dim()


class NoLpips(torch.nn.Module):
    """Nerfstudio's models build LPIPS, which downloads AlexNet; no test uses its value."""

    def __init__(self, **_: object) -> None:
        super().__init__()


sdf_field.tcnn = SimpleNamespace(Encoding=TorchEncoding)
torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity = NoLpips
