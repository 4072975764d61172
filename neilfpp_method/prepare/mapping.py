"""From matches to poses and points: COLMAP's incremental mapping."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

from neilfpp_method.data.colmap_library import pycolmap
from neilfpp_method.errors import UserError
from neilfpp_method.prepare.background import in_background
from neilfpp_method.prepare.photos import Photo
from neilfpp_method.prepare.upright import turn_upright

__all__ = ["MIN_SHARE", "map_scene", "refuse_partial"]

MIN_SHARE = 0.6
SEED = 7
SHOT_ADVICE = (
    "take more photographs between those that are there, so that neighbours differ by 15° at most, "
    "with texture in sight"
)


def map_scene(
    database: Path, copies: Path, work: Path, photos: Sequence[Photo], progress: Callable[[int, int], None]
) -> list[int]:
    """Place the cameras and the points; the largest model is left, upright, in `work`/largest.

    Returns how many images each of the models places, the largest first.

    Args:
        database: with verified matches.
        copies: the images' 8-bit copies; they colour the points.
        work: where models go.
        photos: the images.
        progress: called with the images placed, and all.

    Raises:
        UserError: no two images could be placed.
        KeyboardInterrupt: asked to stop.
    """
    models, count = work / "models", len(photos)
    shutil.rmtree(models, ignore_errors=True)
    models.mkdir(parents=True)
    placed = 0

    def grow(images: int) -> None:
        nonlocal placed
        placed += images

    pycolmap.set_random_seed(SEED)
    found = in_background(
        lambda token: pycolmap.incremental_mapping(
            database,
            copies,
            models,
            _options(count),
            initial_image_pair_callback=lambda: grow(2),
            next_image_callback=lambda: grow(1),
            cancellation_token=token,
        ),
        lambda: progress(min(placed, count), count),
    )
    if not found:
        raise UserError(f"no two of the {count} images could be placed in space", SHOT_ADVICE)
    ranked = sorted(found.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))
    turn_upright(ranked[0], {f"{photo.name}.png": photo.held for photo in photos})
    largest = work / "largest"
    shutil.rmtree(largest, ignore_errors=True)
    largest.mkdir()
    ranked[0].write(largest)
    return [model.num_reg_images() for model in ranked]


def refuse_partial(missing: Sequence[str], sizes: Sequence[int]) -> None:
    """Refuse a largest model with less than `MIN_SHARE` of the images.

    Args:
        missing: the images that it does not place.
        sizes: how many images each of the models places, the largest first.

    Raises:
        UserError: says how many are placed, in how many pieces, and some that are not.
    """
    placed, count = sizes[0], sizes[0] + len(missing)
    if placed >= MIN_SHARE * count:
        return
    pieces = f", others in models of {', '.join(map(str, sizes[1:]))}" if len(sizes) > 1 else ""
    named = ", ".join(missing[:3]) + (", …" if len(missing) > 3 else "")
    raise UserError(
        f"only {placed} of {count} images could be placed in one model{pieces}; not placed: {named}",
        f"{SHOT_ADVICE}, try --matching exhaustive, or go on with --allow-partial",
    )


def _options(count: int) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = SEED
    options.min_model_size = min(options.min_model_size, max(3, count // 3))
    return options
