"""The session of one browser: its controls, its camera, and the images that it shows.

When a control or the camera changes, a request is sent to the `Painter`, whose images become the background
of the browser's scene. Sessions share the model and take turns in using it.
"""

from __future__ import annotations

import dataclasses
import math
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
import viser
from jaxtyping import Float, UInt8

from neilfpp_method.data.pixels.view_pixels import read_colors
from neilfpp_method.data.scaling import file_size, scaled_view
from neilfpp_method.data.views import View
from neilfpp_method.evaluate.pictures import display_color
from neilfpp_method.relight.cameras import turntable
from neilfpp_method.relight.sky import Sky
from neilfpp_method.shading.color import luminance
from neilfpp_method.view.cameras import Pose, pinhole, pose_of
from neilfpp_method.view.incident_map import SurfacePoint, light_at, light_picture, point_under
from neilfpp_method.view.painter import Painter
from neilfpp_method.view.pictures import PictureRequest, ViewerFrame, frames
from neilfpp_method.view.speed import RenderSpeed
from neilfpp_method.view.subject import ERROR_LAYERS, LAYERS, Lighting, Subject, own_light

__all__ = ["Session", "Shared"]

MAP_SCALE = 3
"""Pixels of the page along an edge of each pixel of the map of incident light."""

OWN_LIGHT = "the run's own"
"""Name of the run's light in the list of environments."""
PHOTOGRAPH_SIDE = 320
"""Longest side of the photograph of a view, pixels."""
MAX_STOPS = 8.0
"""Largest exposure in both directions, stops."""
CAMERA, HELD_OUT, PICKED = (70, 110, 130), (200, 130, 60), (220, 60, 60)
"""Colours of training cameras, of held-out cameras, and of the selected point, sRGB bytes."""
EMPTY_IMAGE = np.full((8, 16, 3), 238, np.uint8)
"""A grey image, shown before there is another one."""
START_WIDTH = 400
"""Width of the camera from which a new session starts, pixels; only its pose is used."""
KEYS = {title: name for name, title in LAYERS.items()}
"""Names of layers by title."""


@dataclass
class Shared:
    """What all sessions share.

    Attributes:
        skies: environment maps by name.
        speed: measured rendering speed.
        lock: held while the model is used.
    """

    skies: Mapping[str, Sky]
    speed: RenderSpeed = field(default_factory=RenderSpeed)
    lock: threading.Lock = field(default_factory=threading.Lock)


class Session:
    """The page in one browser.

    Args:
        shared: what all sessions share.
        subject: the run.
        client: the browser.
        previous: the closed session of the same browser, whose layer and camera are kept, or None.

    Attributes:
        own: the run's own light.
        lights: the lights that can be selected, by name.
        moved: new positions of lamps that the user has moved, by the number of the lamp.
        point: the surface point that was clicked last; None before a click and after one beside the surface.
        painter: renders the requested images.
    """

    def __init__(
        self, shared: Shared, subject: Subject, client: viser.ClientHandle, previous: Session | None
    ) -> None:
        self.shared, self.subject, self.client = shared, subject, client
        self.own = own_light(subject.run)
        self.lights = self._lights()
        self.moved: dict[int, np.ndarray] = {}
        self.point: SurfacePoint | None = None
        self.painter = Painter(
            lambda request: frames(request, shared.speed), self._show, self._failed, shared.lock
        )
        self._add_header()
        self._add_picture_controls(previous)
        self._add_light_controls()
        self._add_camera_controls()
        self.status = client.gui.add_markdown("")
        self._add_lamps()
        self._add_cameras()
        if previous is None:
            self._move_camera(pose_of(turntable(subject.run.capture, 2, None, START_WIDTH)[0].camera))
        client.camera.on_update(lambda _: self._request())
        client.scene.on_click()(self._click)
        self._request()

    def close(self) -> None:
        """Remove the session from its browser, so that another one can use it."""
        self.painter.stop()
        self.client.scene.reset()
        self.client.gui.reset()
        # viser has no public way to remove the callbacks of a camera.
        self.client.camera._state.camera_cb.clear()

    # ----------------------------------------------------------------------------------------------- controls

    def _add_header(self) -> None:
        gui, run = self.client.gui, self.subject.run
        gui.add_markdown(f"**{run.path.absolute().name}** · step {run.step}")
        if self.subject.note:
            gui.add_markdown(f"*{self.subject.note}*")

    def _add_picture_controls(self, previous: Session | None) -> None:
        gui = self.client.gui
        titles = [LAYERS[name] for name in self.subject.layers]
        keeps_layer = previous is not None and previous.layer.value in titles
        self.layer = gui.add_dropdown(
            "Layer", titles, initial_value=previous.layer.value if keeps_layer else titles[0]
        )
        self.exposure = gui.add_slider(
            "Exposure", -MAX_STOPS, MAX_STOPS, 0.25, 0.0, hint="Stops, for PBR and R"
        )
        self.layer.on_update(lambda _: self._request())
        self.exposure.on_update(lambda _: self._request())

    def _add_light_controls(self) -> None:
        gui, has_pbr = self.client.gui, "pbr" in self.subject.layers
        with gui.add_folder("Light", visible=has_pbr):
            self.environment = gui.add_dropdown(
                "Environment", list(self.lights), initial_value=next(iter(self.lights))
            )
            has_sky = self.own.sky is not None
            self.rotation = gui.add_slider(
                "Rotation", -180, 180, 5, 0, hint="Degrees around the vertical axis", visible=has_sky
            )
            self.sky_behind = gui.add_checkbox("Show the environment", False, visible=has_sky)
            has_lamps = self.own.lamps is not None
            self.lamps_on = gui.add_checkbox("Lamps", True, visible=has_lamps)
            self.reset_lamps = gui.add_button("Reset lamps", visible=has_lamps)
        self.environment.on_update(lambda _: self._change_environment())
        self.rotation.on_update(lambda _: self._change_light())
        self.sky_behind.on_update(lambda _: self._request())
        self.lamps_on.on_update(lambda _: self._change_light())
        self.reset_lamps.on_click(lambda _: self._reset_lamps())
        with gui.add_folder("Light at a point", visible=self.subject.surface is not None and has_pbr):
            self.point_text = gui.add_markdown("Click the surface.")
            self.point_light = gui.add_image(
                EMPTY_IMAGE, label="Incident light; up is at the top, directions below the surface are grey"
            )

    def _add_camera_controls(self) -> None:
        gui = self.client.gui
        with gui.add_folder("Cameras"):
            names = [view.name for view in self.subject.run.capture.views]
            self.cameras_on = gui.add_checkbox("Show", False)
            self.view = gui.add_dropdown("Go to", ["–", *names])
            self.photograph = gui.add_image(EMPTY_IMAGE, label="The photograph", visible=False)
        self.cameras_on.on_update(lambda _: self._show_cameras())
        self.view.on_update(lambda _: self._go_to(self.view.value))

    def _lights(self) -> dict[str, Lighting]:
        """The lights that can be selected, by name. A free light cannot be replaced."""
        lights = {OWN_LIGHT: self.own}
        if self.own.sky is not None:
            for name, sky in self.shared.skies.items():
                lights[name] = Lighting(sky, self.own.lamps, own=False)
        return lights

    # ------------------------------------------------------------------------------------------------- images

    @property
    def light(self) -> Lighting:
        """The light that the controls select."""
        light = self.lights[self.environment.value].turned(float(self.rotation.value))
        lamps = self.own.lamps
        if lamps is None:
            return light
        if not self.lamps_on.value:
            return light.with_lamps(None)
        if not self.moved:
            return light
        position = lamps.position.clone()
        for k, moved in self.moved.items():
            position[k] = torch.from_numpy(moved).to(position)
        return light.with_lamps(dataclasses.replace(lamps, position=position))

    def _request(self) -> None:
        """Request images for the present camera and controls."""
        camera = self.client.camera
        pose = Pose(camera.position, camera.wxyz, camera.fov, camera.aspect)
        if KEYS[self.layer.value] in ERROR_LAYERS and not self.subject.has_expected_errors:
            self.status.content = "Computing the expected errors of the material; this takes some seconds."
        self.painter.request(
            PictureRequest(
                subject=self.subject,
                camera=pinhole(pose, camera.image_width, camera.image_height),
                layer=KEYS[self.layer.value],
                light=self.light,
                exposure=float(self.exposure.value),
                sky_behind=self.sky_behind.value,
            )
        )

    def _show(self, frame: ViewerFrame) -> None:
        self.client.scene.set_background_image(frame.image, format="jpeg", jpeg_quality=90, depth=frame.depth)
        parts = [f"{frame.image.shape[1]}×{frame.image.shape[0]}"]
        if frame.share < 1:
            parts.append(f"1/{round(1 / frame.share)} of the full size")
        elif KEYS[self.layer.value] == "pbr":
            parts.append(f"{frame.samples} samples per pixel")
        self.status.content = " · ".join(parts)

    def _failed(self, error: Exception) -> None:
        self.status.content = f"This image could not be rendered: {error}"

    # -------------------------------------------------------------------------------------------------- light

    def _change_environment(self) -> None:
        """Adjust the exposure to the brightness of the new environment, whose unit may be a different one."""
        own, sky = self.own.sky, self.lights[self.environment.value].sky
        if own is not None and sky is not None:
            stops = math.log2(_brightness(own) / _brightness(sky))
            self.exposure.value = float(np.clip(round(4 * stops) / 4, -MAX_STOPS, MAX_STOPS))
        if sky is not own:
            self.lamps_on.value = False
        self._change_light()

    def _change_light(self) -> None:
        self._request()
        self._draw_light()

    def _reset_lamps(self) -> None:
        self.moved.clear()
        for k, handle in enumerate(self.lamp_handles):
            handle.position = self.own.lamps.position[k].cpu().numpy()
        self._change_light()

    def _add_lamps(self) -> None:
        self.lamp_handles, lamps = [], self.own.lamps
        if lamps is None or "pbr" not in self.subject.layers:
            return
        for k, position in enumerate(lamps.position.cpu().numpy()):
            handle = self.client.scene.add_transform_controls(
                f"/lamps/{k}", scale=0.25, disable_rotations=True, depth_test=False, position=position
            )
            tint = lamps.radiance[k] / lamps.radiance[k].max().clamp_min(1e-9)
            color = display_color(tint.cpu().numpy()[None, None])[0, 0]
            self.client.scene.add_icosphere(
                f"/lamps/{k}/bulb", radius=lamps.radius, color=tuple(int(c) for c in color)
            )
            handle.on_update(lambda event, k=k: self._move_lamp(k, event.target.position))
            self.lamp_handles.append(handle)

    def _move_lamp(self, k: int, position: np.ndarray) -> None:
        self.moved[k] = np.array(position, np.float32)
        self.lamps_on.value = True
        self._change_light()

    def _click(self, event: viser.SceneClickEvent) -> None:
        with self.shared.lock:
            self.point = point_under(self.subject, event.ray_origin, event.ray_direction)
        self._draw_light()

    def _draw_light(self) -> None:
        """Show the material and the incident light at the selected point."""
        point = self.point
        if point is None or point.material is None:
            return
        with self.shared.lock:
            radiance = light_at(self.subject, self.light, point)
        position, normal = point.position.cpu().numpy(), point.normal.cpu().numpy()
        picture = light_picture(radiance, normal)
        self.point_light.image = picture.repeat(MAP_SCALE, axis=0).repeat(MAP_SCALE, axis=1)
        material = point.material
        color = ", ".join(f"{value:.2f}" for value in material.base_color[0].tolist())
        roughness, metallic = material.roughness.item(), material.metallic.item()
        self.point_text.content = f"base colour {color} · roughness {roughness:.2f} · metallic {metallic:.2f}"
        segment = np.stack((position, position + 0.15 * normal))[None]
        self.client.scene.add_line_segments(
            "/picked/normal", segment, PICKED, thickness=3, thickness_units="screen"
        )
        self.client.scene.add_icosphere("/picked/point", radius=0.012, color=PICKED, position=position)

    # ------------------------------------------------------------------------------------------------ cameras

    def _add_cameras(self) -> None:
        capture, self.frustums = self.subject.run.capture, []
        for view in capture.views:
            pose = pose_of(capture.scene_camera(view))
            frustum = self.client.scene.add_camera_frustum(
                f"/cameras/{view.name}",
                pose.fov,
                pose.aspect,
                scale=0.1,
                thickness=1.5,
                thickness_units="screen",
                color=HELD_OUT if view.name in capture.test else CAMERA,
                wxyz=pose.wxyz,
                position=pose.position,
                visible=False,
            )
            frustum.on_click(lambda _, name=view.name: setattr(self.view, "value", name))
            self.frustums.append(frustum)

    def _show_cameras(self) -> None:
        for frustum in self.frustums:
            frustum.visible = self.cameras_on.value

    def _go_to(self, name: str) -> None:
        """Move the camera to a view, and show its photograph."""
        capture = self.subject.run.capture
        view = next((view for view in capture.views if view.name == name), None)
        if view is None:
            return
        self._move_camera(pose_of(capture.scene_camera(view)))
        try:
            self.photograph.image, self.photograph.visible = _photograph(view, capture.hdr), True
        # The file may have been removed since the run was loaded; the camera still moves.
        except Exception as error:
            self.status.content = f"The photograph cannot be shown: {error}"

    def _move_camera(self, pose: Pose) -> None:
        camera, forward = self.client.camera, _forward(pose)
        # The user orbits around the point nearest to the centre of the scene on the camera's axis.
        distance = max(0.1, float(-pose.position @ forward))
        with self.client.atomic():
            camera.up_direction = (0.0, 0.0, 1.0)
            camera.position = pose.position
            camera.look_at = pose.position + distance * forward
            camera.fov = pose.fov


def _forward(pose: Pose) -> Float[np.ndarray, " 3"]:
    return pinhole(pose, 1, 1).w2c[2, :3]


def _photograph(view: View, hdr: bool) -> UInt8[np.ndarray, "H W 3"]:
    view = scaled_view(view, min(1.0, PHOTOGRAPH_SIDE / max(file_size(view))))
    pixels = read_colors(view, hdr)
    return display_color(pixels) if hdr else np.rint(pixels.clip(0, 1) * 255).astype(np.uint8)


def _brightness(sky: Sky) -> float:
    """Approximate mean luminance over the sphere."""
    theta = torch.linspace(0, math.pi, len(sky.radiance), device=sky.radiance.device)
    weight = theta.sin()[:, None].clamp_min(1e-3)
    return float((luminance(sky.radiance) * weight).sum() / (weight.sum() * sky.radiance.shape[1])) or 1e-6
