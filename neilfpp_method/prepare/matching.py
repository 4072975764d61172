"""Features and matches: SIFT on the CPU, pairs compared and verified, all kept in COLMAP's database.

The database grows image by image and pair by pair, and COLMAP passes over what it holds, so an interrupted
step goes on where it stopped. It is read by COLMAP's own SQLite only: beside a second copy of SQLite in the
process, such as Python's, neither sees the other's locks, and the process dies.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Literal

import numpy as np

from neilfpp_method.data.colmap_library import pycolmap
from neilfpp_method.data.images import image_header
from neilfpp_method.errors import UserError
from neilfpp_method.prepare.background import in_background
from neilfpp_method.prepare.photos import Photo

__all__ = ["Pairing", "choose_pairing", "extract_features", "feature_counts", "match_features"]

Pairing = Literal["exhaustive", "sequential", "vocabulary"]
EXHAUSTIVE_UP_TO = 200
NEIGHBOURS = 20
LOOK_ALIKES = 30
WORDS = 4096
WORD_SAMPLES = 200_000
FOCAL_GUESS = 1.2
"""Focal length in units of the longer side where nothing tells it: a field of view of 45°, to be refined."""


def choose_pairing(matching: str, count: int) -> Pairing:
    """The pairing for a number of images."""
    if matching == "auto":
        return "exhaustive" if count <= EXHAUSTIVE_UP_TO else "vocabulary"
    return matching  # type: ignore[return-value]


def extract_features(
    database: Path,
    copies: Path,
    photos: Sequence[Photo],
    cameras: Literal["auto", "shared", "folder", "image"],
    model: str,
    progress: Callable[[int, int], None],
) -> None:
    """Find the features of all copies, each image attached to the camera of its group.

    Args:
        database: COLMAP's database; made where there is none.
        copies: the folder of the 8-bit copies, NAME.png.
        photos: the photographs whose copies are used.
        cameras: which photographs share a camera.
        model: COLMAP's camera model.
        progress: called with the images done, and all.

    Raises:
        UserError: photographs of different sizes are to share a camera.
        KeyboardInterrupt: asked to stop.
    """
    groups = _groups(copies, photos, cameras)
    with closing(pycolmap.Database.open(database)) as opened:
        known = sorted(opened.read_all_cameras(), key=lambda camera: camera.camera_id)
        ids = [camera.camera_id for camera in known]
        for members in list(groups.values())[len(ids) :]:
            ids.append(opened.write_camera(_first_guess(copies, members[0], model)))

    def extract(token: pycolmap.CancellationToken) -> None:
        for camera_id, members in zip(ids, groups.values(), strict=True):
            options = pycolmap.ImageReaderOptions()
            options.existing_camera_id = camera_id
            names = [f"{photo.name}.png" for photo in members]
            if not token.is_cancelled:
                pycolmap.extract_features(
                    database,
                    copies,
                    names,
                    pycolmap.CameraMode.SINGLE,
                    options,
                    device=pycolmap.Device.cpu,
                    cancellation_token=token,
                )

    with closing(pycolmap.Database.open(database)) as watched:
        in_background(extract, lambda: progress(sum(map(bool, _features(watched).values())), len(photos)))


def match_features(
    database: Path, pairing: Pairing, work: Path, progress: Callable[[int, int], None]
) -> None:
    """Compare pairs of images and verify them by their epipolar geometry.

    Args:
        database: with the features of all images.
        pairing: which pairs are compared.
        work: where the vocabulary is kept.
        progress: called with the pairs done, and about how many there are.

    Raises:
        UserError: there are too few features to compare.
        KeyboardInterrupt: asked to stop.
    """
    counts = feature_counts(database)
    images = len(counts)
    if sum(count > 0 for count in counts.values()) < 2:
        raise UserError(
            "no features in the images",
            "structure from motion needs texture: put printed paper around the object, or check that images "
            "are not black",
        )
    pairs = images * (images - 1) // 2
    expected = min(
        {"exhaustive": pairs, "sequential": images * NEIGHBOURS, "vocabulary": images * LOOK_ALIKES}[pairing],
        pairs,
    )

    def match(token: pycolmap.CancellationToken) -> None:
        known = {"device": pycolmap.Device.cpu, "cancellation_token": token}
        if pairing == "exhaustive":
            pycolmap.match_exhaustive(database, **known)
        elif pairing == "sequential":
            pycolmap.match_sequential(database, pairing_options=_sequential(), **known)
        else:
            pycolmap.match_vocabtree(
                database, pairing_options=_vocabulary(database, work / "vocabulary.bin"), **known
            )

    with closing(pycolmap.Database.open(database)) as watched:
        in_background(match, lambda: progress(min(watched.num_matched_image_pairs(), expected), expected))


def feature_counts(database: Path) -> dict[str, int]:
    """The number of features of each image, by the name of its view."""
    with closing(pycolmap.Database.open(database)) as opened:
        return _features(opened)


def _features(database: pycolmap.Database) -> dict[str, int]:
    return {
        image.name.removesuffix(".png"): database.num_keypoints_for_image(image.image_id)
        for image in database.read_all_images()
    }


def _groups(copies: Path, photos: Sequence[Photo], cameras: str) -> dict[Hashable, list[Photo]]:
    """The photographs that share a camera, in an order that does not change between runs."""
    sizes = {photo.name: _size(copies, photo) for photo in photos}
    keys: dict[str, Callable[[Photo], Hashable]] = {
        "auto": lambda photo: (sizes[photo.name], photo.device),
        "shared": lambda photo: 0,
        "folder": lambda photo: photo.folder,
        "image": lambda photo: photo.name,
    }
    groups: dict[Hashable, list[Photo]] = {}
    for photo in photos:
        group = groups.setdefault(keys[cameras](photo), [])
        if group and sizes[photo.name] != sizes[group[0].name]:
            (w, h), (w0, h0) = sizes[photo.name], sizes[group[0].name]
            raise UserError(
                f"{photo.path}: {w}×{h} pixels where {group[0].path.name}, of the same camera, has {w0}×{h0}",
                "leave out --cameras, which tells cameras apart by size and EXIF",
            )
        group.append(photo)
    return groups


def _size(copies: Path, photo: Photo) -> tuple[int, int]:
    header = image_header(copies / f"{photo.name}.png")
    return header.width, header.height


def _first_guess(copies: Path, photo: Photo, model: str) -> pycolmap.Camera:
    width, height = _size(copies, photo)
    focal = (photo.focal or FOCAL_GUESS) * max(width, height)
    camera = pycolmap.Camera.create_from_model_name(0, model, focal, width, height)
    camera.has_prior_focal_length = photo.focal is not None
    return camera


def _sequential() -> pycolmap.SequentialPairingOptions:
    options = pycolmap.SequentialPairingOptions()
    options.overlap = NEIGHBOURS
    return options


def _vocabulary(database: Path, path: Path) -> pycolmap.VocabTreePairingOptions:
    """Words learnt from the capture's own features: none have to be fetched."""
    if not path.is_file():
        with closing(pycolmap.Database.open(database)) as opened:
            tables = [opened.read_descriptors(image.image_id) for image in opened.read_all_images()]
        share = max(1, WORD_SAMPLES // len(tables))
        samples = tables[0]
        samples.data = np.concatenate([_some(table.data, share) for table in tables])
        options = pycolmap.VisualIndex.BuildOptions()
        options.num_visual_words = min(WORDS, max(1, len(samples.data) // 8))
        index = pycolmap.VisualIndex.create(samples.data.shape[1], 64)
        index.build(options, samples.to_float())
        index.write(path)
    options = pycolmap.VocabTreePairingOptions()
    options.num_images = LOOK_ALIKES
    options.vocab_tree_path = path
    return options


def _some(rows: np.ndarray, count: int) -> np.ndarray:
    return rows[:: max(1, -(-len(rows) // count))]
