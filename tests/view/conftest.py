"""Tiny runs to view: with a recovered surface, and with a given mesh."""

from __future__ import annotations

from pathlib import Path

import pytest

from neilfpp_method.cli import main
from neilfpp_method.settings.presets import PRESETS
from tests.data.make_capture import make_capture
from tests.train.small_runs import small_config, solved_light


@pytest.fixture(scope="package")
def capture(tmp_path_factory) -> Path:
    return make_capture(tmp_path_factory.mktemp("capture") / "sphere", masks=True)


@pytest.fixture(scope="package")
def found(tmp_path_factory, capture) -> Path:
    """A run with a recovered surface and an environment map."""
    return _trained(tmp_path_factory.mktemp("runs") / "found", capture, solved_light)


@pytest.fixture(scope="package")
def given(tmp_path_factory, capture) -> Path:
    """A run with the capture's mesh and a light that is free at every point."""
    return _trained(
        tmp_path_factory.mktemp("runs") / "given", capture, lambda config: config, "--host", "mesh"
    )


def _trained(folder: Path, capture: Path, change, *options: str) -> Path:
    steps = {"sdf_steps": 2, "material_steps": 3, "joint_steps": 1}
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PRESETS, "tiny", lambda: change(small_config(**steps)))
        words = ["train", "--data", str(capture), "--out", str(folder), "--device", "cpu", "--preset", "tiny"]
        assert main([*words, *options]) == 0
    return folder
