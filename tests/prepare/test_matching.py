"""The numbers of images in COLMAP's database, and the vocabulary for the choice of image pairs."""

from __future__ import annotations

import shutil
from contextlib import closing
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from neilfpp_method.prepare import matching
from neilfpp_method.prepare.background import silent
from neilfpp_method.prepare.matching import (
    extract_features,
    feature_counts,
    match_features,
    train_vocabulary,
)
from neilfpp_method.prepare.photos import survey
from tests.prepare.textured_corner import make_photos


class Killed(BaseException):
    """The end of the process in the middle of a file."""


def test_images_are_numbered_in_the_order_of_the_photographs(tmp_path: Path, monkeypatch) -> None:
    """COLMAP numbers them in the order in which its threads end. Here the second image is complete first."""
    names = ["000", "001", "002"]
    make_photos(tmp_path / "copies", len(names), (64, 48), hdr=False)
    photos = survey(tmp_path / "copies", "auto").items
    database, whole = tmp_path / "database.db", matching.pycolmap.extract_features

    def second_first(database, copies, names, *options, **more):
        for name in (names[1], names[0], *names[2:]):
            whole(database, copies, [name], *options, **more)

    monkeypatch.setattr(matching.pycolmap, "extract_features", second_first)
    extract_features(database, tmp_path / "copies", photos, "shared", "SIMPLE_RADIAL", lambda *_: None)
    with closing(matching.pycolmap.Database.open(database)) as opened:
        images = sorted(opened.read_all_images(), key=lambda image: image.image_id)
        assert [image.name for image in images] == [f"{name}.png" for name in names]
        assert [image.camera_id for image in images] == [1, 1, 1]
        assert opened.num_frames() == len(names)
    assert all(feature_counts(database).values())


def test_verified_pairs_do_not_depend_on_the_pairs_before_them(tmp_path: Path) -> None:
    """A command that continues verifies a pair as an uninterrupted one, although its threads start anew."""
    silent()
    copies, first = tmp_path / "copies", tmp_path / "first.db"
    make_photos(copies, 4, (200, 150), hdr=False)
    photos = survey(copies, "auto").items
    extract_features(first, copies, photos, "shared", "SIMPLE_RADIAL", lambda *_: None)
    found = []
    for name, pairs_before in {"whole": (), "continued": ("0 1", "2 3", "0 2")}.items():
        database = tmp_path / f"{name}.db"
        shutil.copy(first, database)
        for pair in pairs_before:
            one, other = pair.split()
            (tmp_path / "pairs.txt").write_text(f"00{one}.png 00{other}.png\n")
            options = matching.pycolmap.ImportedPairingOptions()
            options.match_list_path = tmp_path / "pairs.txt"
            matching.pycolmap.match_image_pairs(
                database, pairing_options=options, verification_options=matching._verification()
            )
        match_features(database, "exhaustive", tmp_path, lambda *_: None)
        found.append(verified(database))
    assert len(found[0]) == 6
    assert sum(len(pair.inliers) > 50 for pair in found[0].values()) >= 4
    assert found[0] == found[1]


@dataclass(frozen=True)
class Verified:
    """The matches of a pair that agree with a fundamental matrix, and the matrix."""

    inliers: bytes
    fundamental: bytes


def verified(database: Path) -> dict[tuple[int, int], Verified]:
    """The verified pairs of a database."""
    with closing(matching.pycolmap.Database.open(database)) as opened:
        ids = sorted(image.image_id for image in opened.read_all_images())
        pairs = {pair: opened.read_two_view_geometry(*pair) for pair in combinations(ids, 2)}
    return {
        pair: Verified(geometry.inlier_matches.tobytes(), np.array(geometry.F).tobytes())
        for pair, geometry in pairs.items()
    }


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
