"""The vocabulary for the choice of image pairs."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from neilfpp_method.prepare import matching
from neilfpp_method.prepare.matching import train_vocabulary


class Killed(BaseException):
    """The end of the process in the middle of a file."""


def test_a_vocabulary_that_was_not_written_to_its_end_is_not_used_again(tmp_path: Path, monkeypatch) -> None:
    def write(path: Path) -> None:
        path.write_bytes(b"the first half")
        raise Killed

    features = SimpleNamespace(data=np.zeros((16, 128), np.uint8), to_float=lambda: None)
    database = SimpleNamespace(
        close=lambda: None,
        read_all_images=lambda: [SimpleNamespace(image_id=1)],
        read_descriptors=lambda image: features,
    )
    index = SimpleNamespace(build=lambda options, samples: None, write=write)
    colmap = SimpleNamespace(
        Database=SimpleNamespace(open=lambda path: database),
        VisualIndex=SimpleNamespace(BuildOptions=SimpleNamespace, create=lambda size, bits: index),
    )
    monkeypatch.setattr(matching, "pycolmap", colmap)
    with pytest.raises(Killed):
        train_vocabulary(tmp_path / "database.db", tmp_path / "vocabulary.bin")
    assert not (tmp_path / "vocabulary.bin").exists()
