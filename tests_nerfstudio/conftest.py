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

# Must be imported before torchvision.
import tests_nerfstudio.cpu_torchvision  # noqa: F401, I001
import torchmetrics.image.lpip
from nerfstudio.field_components.encodings import HashEncoding
from nerfstudio.fields import sdf_field


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
