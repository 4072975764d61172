"""EXR files that OpenEXR writes on a full disk without an error."""

from __future__ import annotations

import numpy as np
import pytest

from neilfpp_method.data.files.exr_chunks import has_all_chunks
from neilfpp_method.data.files.images import read_image, write_exr
from neilfpp_method.errors import UserError
from tests.hard_cases.faults.limits import largest_file


@pytest.mark.parametrize("shape", [(18, 24), (16, 24), (33, 8), (1, 1)])
@pytest.mark.parametrize("constant", [False, True])
def test_a_full_disk_is_reported_wherever_the_file_ends(tmp_path, shape, constant):
    pixels = np.random.default_rng(0).random((*shape, 4), np.float32)
    pixels = np.full_like(pixels, 0.5) if constant else pixels
    path = tmp_path / "image.exr"
    write_exr(path, {"RGBA": pixels})
    assert has_all_chunks(path)
    size = path.stat().st_size
    path.unlink()
    for limit in (1, 100, size // 2, size - 100, size - 1):
        with largest_file(limit), pytest.raises(UserError, match="cannot be written"):
            write_exr(path, {"RGBA": pixels})
        assert list(tmp_path.iterdir()) == []
    with largest_file(size):
        write_exr(path, {"RGBA": pixels})
    assert np.array_equal(read_image(path).pixels, pixels[..., :3])
