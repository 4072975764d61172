"""Features and matches by COLMAP on the CPU: SIFT, matching of pairs, geometric verification.

Results are kept in COLMAP's database. COLMAP skips images and pairs that are already in it, so an interrupted
step continues where it stopped. The database is read through COLMAP's own SQLite only: two copies of SQLite
in one process, such as COLMAP's and Python's, do not see each other's locks, and the process crashes.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Literal

import numpy as np

from neilfpp_method.data.cameras.colmap_library import pycolmap
from neilfpp_method.data.files.atomic_file import replacing
from neilfpp_method.data.files.images import image_header
from neilfpp_method.errors import UserError
from neilfpp_method.prepare.background import in_background
from neilfpp_method.prepare.photos import Photo

__all__ = [
    "Pairing",
    "choose_pairing",
    "extract_features",
    "feature_counts",
    "match_features",
    "train_vocabulary",
]

Pairing = Literal["exhaustive", "sequential", "vocabulary"]
"""Which pairs of images are matched: all, neighbours in the order of the names, or similar images."""

SEED = 7
"""Seed of the random numbers that verify a pair (RANSAC)."""

MAX_EXHAUSTIVE = 200
"""Largest number of images of which all pairs are matched (19 900 pairs); the time grows with its square."""

SEQUENTIAL_OVERLAP = 20
"""Number of following images that each image is matched with in sequential matching."""

SIMILAR_IMAGES = 30
"""Number of most similar images that each image is matched with in vocabulary matching."""

MAX_WORDS = 4096
"""Largest number of visual words of the vocabulary: far fewer than in vocabularies for any scene, because it
is trained on a single scene."""

FEATURES_PER_WORD = 8
"""Smallest number of training features per visual word, for captures with few features."""

TRAINING_FEATURES = 200_000
"""Number of features, evenly drawn from all images, from which the vocabulary is trained."""

EMBEDDED_DIMENSIONS = 64
"""Number of bits of the Hamming embedding of a feature in the vocabulary; COLMAP's default."""

DEFAULT_FOCAL = 1.2
"""Initial focal length without EXIF, in units of the longer side of the image: a field of view of 45°. It is
COLMAP's default as well, and is refined."""


def choose_pairing(matching: str, count: int) -> Pairing:
    """Choose the pairing of `--matching`, by the number of images if it is "auto"."""
    if matching == "auto":
        return "exhaustive" if count <= MAX_EXHAUSTIVE else "vocabulary"
    return matching  # type: ignore[return-value]


def extract_features(
    database: Path,
    copies: Path,
    photos: Sequence[Photo],
    cameras: Literal["auto", "shared", "folder", "image"],
    model: str,
    progress: Callable[[int, int], None],
) -> None:
    """Extract the SIFT features of all copies and assign a camera to each image.

    Args:
        database: COLMAP's database; created if it does not exist.
        copies: folder of the 8-bit copies, NAME.png.
        photos: the photographs whose copies are used.
        cameras: which photographs share a camera, as in `--cameras`.
        model: name of COLMAP's camera model.
        progress: called with the number of finished images and the number of all images.

    Raises:
        UserError: photographs of different sizes would share a camera.
        KeyboardInterrupt: Ctrl-C was pressed.
    """
    groups = _groups(copies, photos, cameras)
    with closing(pycolmap.Database.open(database)) as opened, pycolmap.DatabaseTransaction(opened):
        for number, members in enumerate(groups.values(), start=1):
            _register(opened, number, _initial_camera(copies, members[0], model), members)

    def extract(token: pycolmap.CancellationToken) -> None:
        for number, members in enumerate(groups.values(), start=1):
            options = pycolmap.ImageReaderOptions()
            options.existing_camera_id = number
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
    """Match the features of pairs of images and verify the matches by epipolar geometry.

    Args:
        database: COLMAP's database with the features of all images.
        pairing: which pairs are matched.
        work: folder of the vocabulary.
        progress: called with the number of finished pairs and the expected number of pairs.

    Raises:
        UserError: fewer than two images have features.
        KeyboardInterrupt: Ctrl-C was pressed.
    """
    counts = feature_counts(database)
    images = len(counts)
    if sum(count > 0 for count in counts.values()) < 2:
        raise UserError(
            "fewer than two images have features",
            "structure from motion needs texture: put printed paper around the object, and check that the "
            "images are not black",
        )
    pairs = images * (images - 1) // 2
    partners = {"exhaustive": images, "sequential": SEQUENTIAL_OVERLAP, "vocabulary": SIMILAR_IMAGES}[pairing]
    expected = min(images * partners, pairs)

    def match(token: pycolmap.CancellationToken) -> None:
        common = {
            "verification_options": _verification(),
            "device": pycolmap.Device.cpu,
            "cancellation_token": token,
        }
        if pairing == "exhaustive":
            pycolmap.match_exhaustive(database, **common)
        elif pairing == "sequential":
            pycolmap.match_sequential(database, pairing_options=_sequential(), **common)
        else:
            options = _vocabulary(database, work / "vocabulary.bin")
            pycolmap.match_vocabtree(database, pairing_options=options, **common)

    with closing(pycolmap.Database.open(database)) as watched:
        in_background(match, lambda: progress(min(watched.num_matched_image_pairs(), expected), expected))


def _register(
    database: pycolmap.Database, number: int, camera: pycolmap.Camera, photos: Sequence[Photo]
) -> None:
    """Enter a camera and its images into the database, unless they are known.

    Images that COLMAP itself enters are numbered in the order in which its threads find their features, and
    the poses depend on the numbers: a repeated command would give other poses.

    Args:
        database: COLMAP's database.
        number: the number of the camera, from 1.
        camera: the camera.
        photos: its photographs.
    """
    if not database.exists_camera(number):
        camera.camera_id = number
        database.write_camera(camera, use_camera_id=True)
        rig = pycolmap.Rig()
        rig.rig_id = number
        rig.add_ref_sensor(camera.sensor_id)
        database.write_rig(rig, use_rig_id=True)
    for photo in photos:
        image = pycolmap.Image(name=f"{photo.name}.png", camera_id=number)
        if database.exists_image(image.name):
            continue
        image.image_id = database.write_image(image)
        frame = pycolmap.Frame()
        frame.rig_id = number
        frame.add_data_id(image.data_id)
        database.write_frame(frame)


def feature_counts(database: Path) -> dict[str, int]:
    """Return the number of features of each image, by the name of its view."""
    with closing(pycolmap.Database.open(database)) as opened:
        return _features(opened)


def _features(database: pycolmap.Database) -> dict[str, int]:
    return {
        image.name.removesuffix(".png"): database.num_keypoints_for_image(image.image_id)
        for image in database.read_all_images()
    }


def _groups(copies: Path, photos: Sequence[Photo], cameras: str) -> dict[Hashable, list[Photo]]:
    """Group the photographs that share a camera. The order of the groups is the same in every run."""
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
                f"{photo.path}: {w}×{h} pixels, but {group[0].path.name} of the same camera has {w0}×{h0}",
                "leave out --cameras: then images of different size or EXIF have different cameras",
            )
        group.append(photo)
    return groups


def _size(copies: Path, photo: Photo) -> tuple[int, int]:
    header = image_header(copies / f"{photo.name}.png")
    return header.width, header.height


def _initial_camera(copies: Path, photo: Photo, model: str) -> pycolmap.Camera:
    width, height = _size(copies, photo)
    focal = (photo.focal or DEFAULT_FOCAL) * max(width, height)
    camera = pycolmap.Camera.create_from_model_name(0, model, focal, width, height)
    camera.has_prior_focal_length = photo.focal is not None
    return camera


def _verification() -> pycolmap.TwoViewGeometryOptions:
    """Options that verify each pair with random numbers of its own.

    Otherwise each of COLMAP's threads draws one sequence for all of its pairs. The inliers of a pair then
    depend on which pairs its thread has verified before, and so on whether the command was interrupted.
    """
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = SEED
    return options


def _sequential() -> pycolmap.SequentialPairingOptions:
    options = pycolmap.SequentialPairingOptions()
    options.overlap = SEQUENTIAL_OVERLAP
    return options


def _vocabulary(database: Path, path: Path) -> pycolmap.VocabTreePairingOptions:
    """Options with a vocabulary of this capture, which is trained if the file does not exist."""
    if not path.is_file():
        train_vocabulary(database, path)
    options = pycolmap.VocabTreePairingOptions()
    options.num_images = SIMILAR_IMAGES
    options.vocab_tree_path = path
    return options


def train_vocabulary(database: Path, path: Path) -> None:
    """Train a vocabulary on the features of a capture, so that nothing is downloaded.

    Args:
        database: COLMAP's database with the features of all images.
        path: the file of the vocabulary; it is written when it is complete.

    Raises:
        UserError: the file cannot be written.
    """
    with closing(pycolmap.Database.open(database)) as opened:
        tables = [opened.read_descriptors(image.image_id) for image in opened.read_all_images()]
    per_image = max(1, TRAINING_FEATURES // len(tables))
    samples = tables[0]
    samples.data = np.concatenate([_evenly_spaced(table.data, per_image) for table in tables])
    options = pycolmap.VisualIndex.BuildOptions()
    options.num_visual_words = min(MAX_WORDS, max(1, len(samples.data) // FEATURES_PER_WORD))
    index = pycolmap.VisualIndex.create(samples.data.shape[1], EMBEDDED_DIMENSIONS)
    index.build(options, samples.to_float())
    with replacing(path) as temporary:
        index.write(temporary)


def _evenly_spaced(rows: np.ndarray, count: int) -> np.ndarray:
    """At most `count` rows, evenly spaced."""
    return rows[:: max(1, -(-len(rows) // count))]
