"""A complete checkpoint of another version, and one without one of its parts, are refused."""

from __future__ import annotations

import pytest
import torch

from neilfpp_method.train.checkpoint import last_checkpoint, load_checkpoint, save_checkpoint
from tests.train.test_checkpoint import learner, refused


def test_another_version(tmp_path):
    path = last_checkpoint(tmp_path)
    save_checkpoint(path, *learner(), 7)
    contents = load_checkpoint(path)
    torch.save({**contents, "format": contents["format"] + 1}, path)
    refused(path, "a checkpoint of another version")


@pytest.mark.parametrize("key", ["format", "step", "model", "light_solver", "optimizer"])
def test_a_part_is_missing(tmp_path, key):
    path = last_checkpoint(tmp_path)
    save_checkpoint(path, *learner(), 7)
    contents = load_checkpoint(path)
    torch.save({name: part for name, part in contents.items() if name != key}, path)
    refused(path, "a checkpoint of another version")
