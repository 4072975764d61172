"""Build a model for a capture: the facts that are measured in its images, and the configured host."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from neilfpp_method.data.cameras.projection import camera_rays
from neilfpp_method.data.capture import Capture
from neilfpp_method.data.files.environment_map import read_environment
from neilfpp_method.data.mesh import read_mesh
from neilfpp_method.data.pixels.backdrop import border_color, border_median
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.data.point_cloud import load_point_cloud
from neilfpp_method.data.truth import Truth
from neilfpp_method.effects.evidence.exposure import Exposures, measure_exposures
from neilfpp_method.effects.plan import Plan
from neilfpp_method.effects.review import record_exposures
from neilfpp_method.errors import UserError
from neilfpp_method.fields import PoseCorrections
from neilfpp_method.hosts.base import Host
from neilfpp_method.hosts.mesh import MeshHost
from neilfpp_method.hosts.volsdf import VolSdfHost
from neilfpp_method.model import NeilfModel
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.structures import OrientedPoints
from neilfpp_method.train.optimizer import Stream, seed_stream

__all__ = [
    "build_model",
    "cloud_summary",
    "exposures_at_cloud",
    "initial_model",
    "measure_facts",
    "scene_facts",
    "show_known_light",
]

LDR_SCALE = 1.0
"""Largest radiance that R can represent for LDR input, as published: the scale of its sigmoid."""
LDR_ROOM = 2.0
"""Largest radiance of R for LDR input if losses are measured in units of the image. Clipped pixels are only
lower bounds of radiance, and an underexposed photograph shows radiance above the clipping level of the
others.
"""
HDR_MEDIANS = 20.0
"""Largest radiance of R for HDR input, in units of the median of the images, because radiance has no absolute
unit. The paper's value of 3 is about twenty times the median of a well exposed image.
"""
BRIGHT_QUANTILE = 0.999
"""R also reaches this quantile of the radiance of HDR images. The brightest pixels are excluded because a
single lamp in view should not set the scale of R.
"""
MAX_MEDIAN_DISTANCE = 2.0
"""Median distance of a mesh from the centre above which it is too large rather than inside out, scene
units."""
VISIBILITY_STRIDE = 67
"""One in this many pixels of every view is traced to check that the cameras see the outside of a mesh."""


def scene_facts(
    capture: Capture, pixels: PixelDataset, config: NeilfConfig, log_gains: Tensor | None = None
) -> SceneFacts:
    """Measure in the training images what the model must know before training; see `SceneFacts`.

    Args:
        capture: the capture.
        pixels: its training pixels.
        config: the settings.
        log_gains: logarithms of the gains of the training views, (V, 3); None if all views have the same
            exposure.
    """
    response = "linear" if capture.hdr else "srgb"
    median = pixels.median_radiance()
    hdr = max(HDR_MEDIANS * median, pixels.radiance_quantile(BRIGHT_QUANTILE))
    ldr = LDR_SCALE if config.loss.unit == "activation" else LDR_ROOM
    scale = ldr if response == "srgb" else hdr
    kind, color = config.background.kind, config.background.color
    if kind == "auto":
        kind = "inverted_sphere" if color is None and border_color(pixels) is None else "constant"
    if color is None and kind != "none":
        color = tuple(border_median(pixels).tolist())
    return SceneFacts(
        response=response,
        median_radiance=median,
        radiance_scale=scale,
        background=kind,
        background_color=color or (0.0, 0.0, 0.0),
        far_points=capture.scene_from == "focus",
        log_gains=() if log_gains is None else tuple(log_gains.flatten().tolist()),
    )


def measure_facts(plan: Plan, capture: Capture, pixels: PixelDataset) -> SceneFacts:
    """`scene_facts` with the settings of a plan, after the decision whether photographs have gains."""
    return scene_facts(capture, pixels, plan.config, _log_gains(plan, capture, pixels))


def _log_gains(plan: Plan, capture: Capture, pixels: PixelDataset) -> Tensor | None:
    """Initial log gains of the photographs, after the decision whether photographs have gains.

    Returns None if they have none, and zeros if they are requested but cannot be measured.
    """
    if not plan.is_on("exposure"):
        return None
    exposures = exposures_at_cloud(capture, pixels)
    record_exposures(plan, exposures)
    if not plan.is_on("exposure"):
        return None
    return torch.zeros(len(pixels.views), 3) if exposures is None else exposures.log_gain


def exposures_at_cloud(capture: Capture, pixels: PixelDataset) -> Exposures | None:
    """Measure the relative exposures of the training photographs at the points of the capture's point cloud.

    Returns:
        The exposures; None if the capture has no point cloud.
    """
    if capture.point_cloud is None:
        return None
    return measure_exposures(pixels, load_point_cloud(capture.point_cloud, capture.normalization))


def build_model(capture: Capture, facts: SceneFacts, config: NeilfConfig) -> NeilfModel:
    """Build an untrained model for a capture.

    Raises:
        UserError: if the settings name a mesh that the capture does not have, or if no point of its point
            cloud lies in the scene.
    """
    model = NeilfModel(HOSTS[config.host.kind](capture, facts, config), config, facts)
    if config.train.pose_fits:
        model.poses = PoseCorrections(len(capture.train_views))
    return model


def initial_model(capture: Capture, facts: SceneFacts, config: NeilfConfig) -> NeilfModel:
    """Build the model with which a training starts: random weights of the seed, and the known light if any.

    Raises:
        UserError: see `build_model` and `show_known_light`.
    """
    seed_stream(config.train.seed, Stream.WEIGHTS)
    model = build_model(capture, facts, config)
    show_known_light(model)
    return model


def show_known_light(model: NeilfModel) -> None:
    """Load the known environment map into a new model if the settings name one.

    The map is part of the checkpoints, so the file is not needed again once a checkpoint is written.

    Raises:
        UserError: if the file is missing or is not a usable map.
    """
    if model.config.known_map is not None:
        model.light.show(read_environment(Path(model.config.known_map)))


def _volsdf(capture: Capture, facts: SceneFacts, config: NeilfConfig) -> VolSdfHost:
    poses = [capture.scene_camera(view).c2w for view in capture.train_views]
    cameras = torch.from_numpy(np.stack(poses)[:, :, 3]).float()
    return VolSdfHost(config, facts, _cloud_points(capture, config), cameras)


def _mesh(capture: Capture, facts: SceneFacts, config: NeilfConfig) -> MeshHost:
    path = config.host.path
    mesh = Truth(capture).mesh() if path is None else read_mesh(Path(path), capture.normalization)
    if mesh is None:
        raise UserError(
            f"{capture.root}: no inputs/model/mesh.ply for the mesh host", "name a mesh with --mesh PATH"
        )
    host = MeshHost(mesh, config, facts)
    _check_visible(host, capture, path or "inputs/model/mesh.ply")
    return host


HOSTS: Mapping[str, Callable[[Capture, SceneFacts, NeilfConfig], Host]] = {"volsdf": _volsdf, "mesh": _mesh}


def cloud_summary(capture: Capture, config: NeilfConfig) -> str | None:
    """One line for the console on whether a point cloud supervises geometry.

    Returns None if the settings use no point cloud.
    """
    losses = config.geometry_loss
    if losses is None or losses.point_cloud == 0.0:
        return None
    if capture.point_cloud is None:
        return (
            "point cloud: the capture has none with normals, so geometry is found from the images alone; "
            f"neilfpp prepare {shlex.quote(str(capture.root))} --out CAPTURE computes one and keeps the poses"
        )
    used = f"point cloud: {capture.point_cloud.name} supervises the geometry"
    return f"{used}; --config.host.loss.point-cloud 0 switches this off"


def _check_visible(host: MeshHost, capture: Capture, path: str) -> None:
    """Raise a `UserError` unless the cameras see the outside of the mesh."""
    cameras = [capture.scene_camera(view) for view in capture.train_views]
    met = [host.intersect(camera_rays(camera)[::VISIBILITY_STRIDE]) for camera in cameras]
    outside = torch.cat([hits.outside for hits in met])
    if not len(outside):
        raise UserError(f"{path}: no camera sees this mesh", "give it in the world frame of the capture")
    if outside.float().mean() < 0.5:
        reach = torch.cat([hits.position for hits in met]).norm(dim=-1).median().item()
        if reach > MAX_MEDIAN_DISTANCE:
            raise UserError(
                f"{path}: the cameras are inside of this mesh, half of which is {reach:.3g} or more scene "
                "units from the centre",
                "give it in the world frame and the unit of length of the capture",
            )
        raise UserError(
            f"{path}: the cameras see the inside of this mesh", "reverse the orientation of its faces"
        )


def _cloud_points(capture: Capture, config: NeilfConfig) -> OrientedPoints | None:
    if config.host.loss.point_cloud == 0.0 or capture.point_cloud is None:
        return None
    points = load_point_cloud(capture.point_cloud, capture.normalization)
    # G is defined within the scene sphere only.
    within = points[points.position.norm(dim=-1) < config.background.radius]
    if not len(within):
        raise UserError(
            f"{capture.point_cloud}: no point lies in the scene",
            "check the scene box, or make the points again",
        )
    return within
