"""From a capture to a model: what the images decide, and the host that the settings ask for."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.environment_map import read_environment
from neilfpp_method.data.mesh import read_mesh
from neilfpp_method.data.pixels import PixelDataset
from neilfpp_method.data.point_cloud import load_point_cloud
from neilfpp_method.data.truth import Truth
from neilfpp_method.data.views import camera_rays
from neilfpp_method.effects.exposure import Exposures, measure_exposures
from neilfpp_method.errors import UserError
from neilfpp_method.hosts.base import Host
from neilfpp_method.hosts.mesh import MeshHost
from neilfpp_method.hosts.volsdf import VolSdfHost
from neilfpp_method.model import NeilfModel
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.structures import OrientedPoints

__all__ = ["build_model", "cloud_in_words", "exposures_of", "scene_facts", "show_known_light"]

# The sigmoid of R reaches 1 for LDR input, as published. Where errors have a unit of their own it reaches
# twice that: clipped pixels are lower bounds, and dark photographs show more than others before they clip.
# Radiance has no unit: the paper's 3 for HDR is twenty times the median of a well exposed image. Where more
# is bright R needs more room; the few brightest pixels (a lamp in view) do not decide for all.
LDR_SCALE = 1.0
LDR_ROOM = 2.0
HDR_MEDIANS = 20.0
BRIGHT_QUANTILE = 0.999

# Of the pixels of every view, one in so many asks whether a mesh is where the cameras look.
SEEN_EVERY = 67


def scene_facts(
    capture: Capture, pixels: PixelDataset, config: NeilfConfig, log_gains: Tensor | None = None
) -> SceneFacts:
    """What the training images decide before training; see `SceneFacts`.

    `log_gains` are those of the training views, (V, 3); none: all are exposed alike.
    """
    response = "linear" if capture.hdr else "srgb"
    median = pixels.median_radiance()
    hdr = max(HDR_MEDIANS * median, pixels.radiance_quantile(BRIGHT_QUANTILE))
    ldr = LDR_SCALE if config.loss.unit == "activation" else LDR_ROOM
    scale = ldr if response == "srgb" else hdr
    kind, color = config.background.kind, config.background.color
    if kind == "auto":
        kind = "inverted_sphere" if color is None and pixels.border_color() is None else "constant"
    if color is None and kind != "none":
        color = tuple(pixels.border_median().tolist())
    return SceneFacts(
        response,
        median,
        scale,
        kind,
        color or (0.0, 0.0, 0.0),
        far_points=capture.scene_from == "focus",
        log_gains=() if log_gains is None else tuple(log_gains.flatten().tolist()),
    )


def exposures_of(capture: Capture, pixels: PixelDataset) -> Exposures | None:
    """What the training photographs say of their exposures; none where no cloud shows them the same
    places.
    """
    if capture.point_cloud is None:
        return None
    return measure_exposures(pixels, load_point_cloud(capture.point_cloud, capture.normalisation))


def build_model(capture: Capture, facts: SceneFacts, config: NeilfConfig) -> NeilfModel:
    """An untrained model for a capture.

    Raises:
        UserError: the settings ask for a mesh that the capture does not have, or its point cloud is of no
            use.
    """
    return NeilfModel(HOSTS[config.host.kind](capture, facts, config), config, facts)


def show_known_light(model: NeilfModel) -> None:
    """Read the environment map that is known into a new model, where the settings name one.

    It is part of the checkpoints, so a run needs the file no more once it has one.

    Raises:
        UserError: the map cannot be used.
    """
    if model.config.known_map is not None:
        model.light.show(read_environment(Path(model.config.known_map)))


def _volsdf(capture: Capture, facts: SceneFacts, config: NeilfConfig) -> VolSdfHost:
    scale, start, points = facts.radiance_scale, facts.median_radiance, _points(capture, config)
    poses = [capture.normalisation.camera(view.camera).c2w for view in capture.train_views]
    cameras = torch.from_numpy(np.stack(poses)[:, :, 3]).float()
    return VolSdfHost(config, scale, facts.background, facts.background_color, points, start, cameras)


def _mesh(capture: Capture, facts: SceneFacts, config: NeilfConfig) -> MeshHost:
    path = config.host.path
    mesh = Truth(capture).mesh() if path is None else read_mesh(Path(path), capture.normalisation)
    if mesh is None:
        raise UserError(
            f"{capture.root}: no inputs/model/mesh.ply for the mesh host", "name a mesh with --mesh PATH"
        )
    scale, start = facts.radiance_scale, facts.median_radiance
    host = MeshHost(mesh, config, scale, facts.background, facts.background_color, start)
    _check_seen(host, capture, path or "inputs/model/mesh.ply")
    return host


HOSTS: Mapping[str, Callable[[Capture, SceneFacts, NeilfConfig], Host]] = {"volsdf": _volsdf, "mesh": _mesh}


def cloud_in_words(capture: Capture, config: NeilfConfig) -> str | None:
    """What a point cloud that geometry could learn from comes to, for people; none where there is nothing to
    say.
    """
    if config.host.kind != "volsdf" or config.loss.point_cloud == 0.0:
        return None
    if capture.point_cloud is None:
        return "point cloud: the capture has none with normals, so geometry is found from the images alone"
    used = f"point cloud: geometry keeps to {capture.point_cloud.name}"
    return f"{used}; --config.loss.point-cloud 0 leaves it out"


def _check_seen(host: MeshHost, capture: Capture, path: str) -> None:
    """That the cameras see the outside of the mesh."""
    cameras = [capture.normalisation.camera(view.camera) for view in capture.train_views]
    met = [host.cross(camera_rays(camera)[::SEEN_EVERY]).outside for camera in cameras]
    outside = torch.cat(met)
    if not len(outside):
        raise UserError(f"{path}: no camera sees this mesh", "give it in the world frame of the capture")
    if outside.float().mean() < 0.5:
        raise UserError(
            f"{path}: the cameras see the inside of this mesh", "turn its faces: they are wound outwards"
        )


def _points(capture: Capture, config: NeilfConfig) -> OrientedPoints | None:
    if config.loss.point_cloud == 0.0 or capture.point_cloud is None:
        return None
    points = load_point_cloud(capture.point_cloud, capture.normalisation)
    # What lies beyond the scene sphere is no business of G.
    within = points[points.position.norm(dim=-1) < config.volume.radius]
    if not len(within):
        raise UserError(
            f"{capture.point_cloud}: no point lies in the scene",
            "check the scene box, or make the points again",
        )
    return within
