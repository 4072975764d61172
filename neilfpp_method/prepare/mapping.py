"""Incremental structure from motion by COLMAP: from feature matches to poses and points."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

from neilfpp_method.data.cameras.colmap_library import pycolmap
from neilfpp_method.errors import UserError
from neilfpp_method.prepare.background import in_background
from neilfpp_method.prepare.photos import Photo
from neilfpp_method.prepare.upright import turn_upright

__all__ = ["MIN_SHARE", "map_scene", "refuse_partial"]

MIN_SHARE = 0.6
"""Smallest share of the images that the largest model must contain; with fewer, a side is usually missing."""

SEED = 7
"""Seed of COLMAP's random numbers (RANSAC), so that a repeated command gives the same poses."""

MAX_REPEATABLE = 200
"""Largest number of images that are placed by one thread, so that a repeated command gives the same poses,
bit for bit. With more images, whose common adjustment takes long, all processors are used.
"""

SHOOTING_ADVICE = (
    "take more photographs between the existing ones, at most 15° apart, with textured surfaces in view"
)
"""Remedy of errors about images that cannot be placed."""


def map_scene(
    database: Path, copies: Path, work: Path, photos: Sequence[Photo], progress: Callable[[int, int], None]
) -> list[int]:
    """Estimate poses and points; the largest model is written to `work`/largest, with +z up.

    Args:
        database: COLMAP's database with verified matches.
        copies: folder of the 8-bit copies of the images, from which points get their colours.
        work: folder of the models.
        photos: the images.
        progress: called with the number of placed images and the number of all images.

    Returns:
        The number of images of each model, largest first. Images that share no matches end up in different
        models.

    Raises:
        UserError: no two images could be placed.
        KeyboardInterrupt: Ctrl-C was pressed.
    """
    models, count = work / "models", len(photos)
    shutil.rmtree(models, ignore_errors=True)
    models.mkdir(parents=True)
    placed = 0

    def add(images: int) -> None:
        nonlocal placed
        placed += images

    pycolmap.set_random_seed(SEED)
    mapped = in_background(
        lambda token: pycolmap.incremental_mapping(
            database,
            copies,
            models,
            _options(count),
            initial_image_pair_callback=lambda: add(2),
            next_image_callback=lambda: add(1),
            cancellation_token=token,
        ),
        lambda: progress(min(placed, count), count),
    )
    if not mapped:
        raise UserError(
            f"no two of the {count} images could be placed relative to each other", SHOOTING_ADVICE
        )
    ranked = sorted(mapped.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))
    turn_upright(ranked[0], {f"{photo.name}.png": photo.orientation for photo in photos})
    largest = work / "largest"
    shutil.rmtree(largest, ignore_errors=True)
    largest.mkdir()
    ranked[0].write(largest)
    return [model.num_reg_images() for model in ranked]


def refuse_partial(missing: Sequence[str], sizes: Sequence[int]) -> None:
    """Raise an error if the largest model contains less than `MIN_SHARE` of the images.

    Args:
        missing: names of the images that are not in the largest model.
        sizes: number of images of each model, largest first.

    Raises:
        UserError: too few images; the message names the sizes of all models and three missing images.
    """
    placed, count = sizes[0], sizes[0] + len(missing)
    if placed >= MIN_SHARE * count:
        return
    others = f", others in models of {', '.join(map(str, sizes[1:]))}" if len(sizes) > 1 else ""
    examples = ", ".join(missing[:3]) + (", …" if len(missing) > 3 else "")
    raise UserError(
        f"only {placed} of {count} images could be placed in one model{others}; not placed: {examples}",
        f"{SHOOTING_ADVICE}, try --matching exhaustive, or accept the model with --allow-partial",
    )


def _options(count: int) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    # Sums of several threads depend on their number and order, and the poses on the sums.
    options.num_threads = 1 if count <= MAX_REPEATABLE else -1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = SEED
    options.min_model_size = min(options.min_model_size, max(3, count // 3))
    return options
