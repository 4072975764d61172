"""The page in the browser, by viser: inputs become wishes, and pictures the page's background.

Every browser has a session of its own: camera, layer, light, lamps. Sessions take turns at the model.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import math
import threading
from collections.abc import Mapping

import numpy as np
import rich
import torch
import viser

from neilfpp_method.data.scaling import file_size, scaled_view
from neilfpp_method.data.view_pixels import read_colors
from neilfpp_method.data.views import View
from neilfpp_method.evaluate.pictures import display_color
from neilfpp_method.relight.cameras import turntable
from neilfpp_method.relight.sky import Sky
from neilfpp_method.shading.color import luminance
from neilfpp_method.view.cameras import Pose, pinhole, pose_of
from neilfpp_method.view.incident_map import Point, light_at, light_picture, point_under
from neilfpp_method.view.pace import Pace
from neilfpp_method.view.painter import Painter
from neilfpp_method.view.pictures import Frame, Wish, frames
from neilfpp_method.view.subject import LAYERS, Lighting, Subject, own_light

__all__ = ["Page", "open_page"]

OWN = "the run's own"
PHOTOGRAPH = 320
"""Longest side of the photograph beside a camera that was jumped to, pixels."""
MAP_SCALE = 3
"""Pixels of the page for each pixel of the map of incident light, along an edge."""
STOPS = 8.0
BRAND = (43, 108, 130)
CAMERA, HELD_OUT, PICKED = (70, 110, 130), (200, 130, 60), (220, 60, 60)
NOTHING = np.full((8, 16, 3), 238, np.uint8)
KEYS = {title: name for name, title in LAYERS.items()}


class _Local(viser.ViserServer):
    """Without viser's tunnel: any page in the browser could request one, and captures are private."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


class Page:
    """What all browsers see: a subject, and environment maps by name.

    Args:
        server: of viser, running.
        subject: the run; none: not there yet.
        skies: the maps that can be chosen beside the run's own light.
    """

    def __init__(self, server: viser.ViserServer, subject: Subject | None, skies: Mapping[str, Sky]) -> None:
        self.server, self.subject, self.skies = server, subject, skies
        self.pace, self.turn = Pace(), threading.Lock()
        self._sessions: dict[int, _Session] = {}
        server.on_client_connect(self._connect)
        server.on_client_disconnect(self._disconnect)

    def show(self, subject: Subject) -> None:
        """Another subject, such as a later checkpoint; cameras stay where they are."""
        self.subject = subject
        for client in self.server.get_clients().values():
            self._connect(client)

    def stop(self) -> None:
        """Close all pages and the port."""
        for session in list(self._sessions.values()):
            session.painter.stop()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def _connect(self, client: viser.ClientHandle) -> None:
        old = self._sessions.pop(client.client_id, None)
        if old is not None:
            old.close()
        if self.subject is None:
            client.gui.reset()
            client.gui.add_markdown("Waiting for the first checkpoint.")
            return
        self._sessions[client.client_id] = _Session(self, self.subject, client, old)

    def _disconnect(self, client: viser.ClientHandle) -> None:
        session = self._sessions.pop(client.client_id, None)
        if session is not None:
            session.painter.stop()


class _Session:
    """What one browser looks at."""

    def __init__(
        self, page: Page, subject: Subject, client: viser.ClientHandle, before: _Session | None
    ) -> None:
        self.page, self.subject, self.client = page, subject, client
        self.own = own_light(subject.run)
        self.lights = self._lights()
        self.moved: dict[int, np.ndarray] = {}
        self.point: Point | None = None
        self.painter = Painter(lambda wish: frames(wish, page.pace), self._show, self._failed, page.turn)
        self._build(before)
        self._add_lamps()
        self._add_cameras()
        if before is None:
            self._stand(pose_of(turntable(subject.run.capture, 2, None, 400)[0].camera))
        client.camera.on_update(lambda _: self._ask())
        client.scene.on_click()(self._click)
        self._ask()

    def close(self) -> None:
        """Make room for another session of the same browser."""
        self.painter.stop()
        self.client.scene.reset()
        self.client.gui.reset()
        self.client.camera._state.camera_cb.clear()

    # ------------------------------------------------------------------------------------------- the controls

    def _build(self, before: _Session | None) -> None:
        gui, run = self.client.gui, self.subject.run
        gui.add_markdown(f"**{run.path.absolute().name}** · step {run.step}")
        if self.subject.note:
            gui.add_markdown(f"*{self.subject.note}*")
        titles = [LAYERS[name] for name in self.subject.layers]
        kept = before.layer.value if before is not None and before.layer.value in titles else titles[0]
        self.layer = gui.add_dropdown("Layer", titles, initial_value=kept)
        self.exposure = gui.add_slider("Exposure", -STOPS, STOPS, 0.25, 0.0, hint="Stops, for PBR and R")
        self.layer.on_update(lambda _: self._ask())
        self.exposure.on_update(lambda _: self._ask())
        with gui.add_folder("Light", visible="pbr" in self.subject.layers):
            self.environment = gui.add_dropdown(
                "Environment", list(self.lights), initial_value=next(iter(self.lights))
            )
            has_sky = self.own.sky is not None
            self.turned = gui.add_slider(
                "Turn", -180, 180, 5, 0, hint="Degrees, about the vertical", visible=has_sky
            )
            self.behind = gui.add_checkbox("Show the environment", False, visible=has_sky)
            lamps = self.own.lamps is not None
            self.lamps_on = gui.add_checkbox("Lamps", True, visible=lamps)
            self.back = gui.add_button("Put lamps back", visible=lamps)
        self.environment.on_update(lambda _: self._change_environment())
        self.turned.on_update(lambda _: self._change_light())
        self.behind.on_update(lambda _: self._ask())
        self.lamps_on.on_update(lambda _: self._change_light())
        self.back.on_click(lambda _: self._put_back())
        with gui.add_folder(
            "Light at a point", visible=self.subject.surface is not None and "pbr" in self.subject.layers
        ):
            self.told = gui.add_markdown("Click the surface.")
            self.map = gui.add_image(
                NOTHING, label="What arrives there; up is on top, grey is below the surface"
            )
        with gui.add_folder("Cameras"):
            names = [view.name for view in run.capture.views]
            self.shown = gui.add_checkbox("Show", False)
            self.view = gui.add_dropdown("Go to", ["–", *names])
            self.photograph = gui.add_image(NOTHING, label="The photograph", visible=False)
        self.shown.on_update(lambda _: self._show_cameras())
        self.view.on_update(lambda _: self._go_to(self.view.value))
        self.state = gui.add_markdown("")

    def _lights(self) -> dict[str, Lighting]:
        lights = {OWN: self.own}
        if self.own.sky is not None:
            lights |= {
                name: Lighting(sky, self.own.lamps, own=False) for name, sky in self.page.skies.items()
            }
        return lights

    # ------------------------------------------------------------------------------------------------- wishes

    @property
    def light(self) -> Lighting:
        """What the controls say."""
        light = self.lights[self.environment.value].turned(float(self.turned.value))
        lamps = self.own.lamps
        if lamps is None:
            return light
        if not self.lamps_on.value:
            return light.with_lamps(None)
        if not self.moved:
            return light
        position = lamps.position.clone()
        for k, place in self.moved.items():
            position[k] = torch.from_numpy(place).to(position)
        return light.with_lamps(dataclasses.replace(lamps, position=position))

    def _ask(self) -> None:
        camera = self.client.camera
        pose = Pose(camera.position, camera.wxyz, camera.fov, camera.aspect)
        window = pinhole(pose, camera.image_width, camera.image_height)
        wish = Wish(
            self.subject,
            window,
            KEYS[self.layer.value],
            self.light,
            float(self.exposure.value),
            self.behind.value,
        )
        self.painter.ask(wish)

    def _show(self, frame: Frame) -> None:
        self.client.scene.set_background_image(frame.image, format="jpeg", jpeg_quality=90, depth=frame.depth)
        sharp = "" if frame.share == 1 else f" · 1/{round(1 / frame.share)} of its size"
        noise = (
            f" · {frame.samples} samples a pixel"
            if KEYS[self.layer.value] == "pbr" and frame.share == 1
            else ""
        )
        self.state.content = f"{frame.image.shape[1]}×{frame.image.shape[0]}{sharp}{noise}"

    def _failed(self, error: Exception) -> None:
        self.state.content = f"This picture failed: {error}"

    # -------------------------------------------------------------------------------------------------- light

    def _change_environment(self) -> None:
        """A map of another unit would be black or white: exposure goes with its brightness."""
        own, sky = self.own.sky, self.lights[self.environment.value].sky
        if own is not None and sky is not None:
            stops = math.log2(_brightness(own) / _brightness(sky))
            self.exposure.value = float(np.clip(round(4 * stops) / 4, -STOPS, STOPS))
        if sky is not own:
            self.lamps_on.value = False
        self._change_light()

    def _change_light(self) -> None:
        self._ask()
        self._draw_light()

    def _put_back(self) -> None:
        self.moved.clear()
        for k, gizmo in enumerate(self.gizmos):
            gizmo.position = self.own.lamps.position[k].cpu().numpy()
        self._change_light()

    def _add_lamps(self) -> None:
        self.gizmos, lamps = [], self.own.lamps
        if lamps is None or "pbr" not in self.subject.layers:
            return
        for k, place in enumerate(lamps.position.cpu().numpy()):
            gizmo = self.client.scene.add_transform_controls(
                f"/lamps/{k}", scale=0.25, disable_rotations=True, depth_test=False, position=place
            )
            colour = lamps.radiance[k] / lamps.radiance[k].max().clamp_min(1e-9)
            shown = display_color(colour.cpu().numpy()[None, None])[0, 0]
            self.client.scene.add_icosphere(
                f"/lamps/{k}/bulb", radius=lamps.radius, color=tuple(int(c) for c in shown)
            )
            gizmo.on_update(lambda event, k=k: self._drag(k, event.target.position))
            self.gizmos.append(gizmo)

    def _drag(self, k: int, place: np.ndarray) -> None:
        self.moved[k] = np.array(place, np.float32)
        self.lamps_on.value = True
        self._change_light()

    def _click(self, event: viser.SceneClickEvent) -> None:
        with self.page.turn:
            self.point = point_under(self.subject, event.ray_origin, event.ray_direction)
        self._draw_light()

    def _draw_light(self) -> None:
        point = self.point
        if point is None or point.material is None:
            return
        with self.page.turn:
            radiance = light_at(self.subject, self.light, point)
        normal = point.normal.cpu().numpy()
        picture = light_picture(radiance, normal)
        self.map.image = picture.repeat(MAP_SCALE, axis=0).repeat(MAP_SCALE, axis=1)
        material = point.material
        colour = ", ".join(f"{value:.2f}" for value in material.base_color[0].tolist())
        roughness, metallic = material.roughness.item(), material.metallic.item()
        self.told.content = f"base colour {colour} · roughness {roughness:.2f} · metallic {metallic:.2f}"
        place = point.position.cpu().numpy()
        segment = np.stack((place, place + 0.15 * normal))[None]
        self.client.scene.add_line_segments(
            "/picked/normal", segment, PICKED, thickness=3, thickness_units="screen"
        )
        self.client.scene.add_icosphere("/picked/point", radius=0.012, color=PICKED, position=place)

    # ------------------------------------------------------------------------------------------------ cameras

    def _add_cameras(self) -> None:
        capture, self.frustums = self.subject.run.capture, []
        for view in capture.views:
            pose = pose_of(capture.normalisation.camera(view.camera))
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
            frustum.visible = self.shown.value

    def _go_to(self, name: str) -> None:
        capture = self.subject.run.capture
        view = next((view for view in capture.views if view.name == name), None)
        if view is None:
            return
        self._stand(pose_of(capture.normalisation.camera(view.camera)))
        try:
            self.photograph.image, self.photograph.visible = _photograph(view, capture.hdr), True
        except Exception as error:  # Files may have gone since the run was loaded; the camera is still there.
            self.state.content = f"The photograph cannot be shown: {error}"

    def _stand(self, pose: Pose) -> None:
        camera = self.client.camera
        with self.client.atomic():
            camera.up_direction = (0.0, 0.0, 1.0)
            camera.position = pose.position
            # Orbits go about what is looked at: the middle of the scene, as far as the camera looks there.
            camera.look_at = pose.position + max(0.1, float(-pose.position @ _forward(pose))) * _forward(pose)
            camera.fov = pose.fov


def open_page(subject: Subject | None, skies: Mapping[str, Sky], host: str, port: int, label: str) -> Page:
    """Serve the page; the port must be free (`address.check_free`)."""
    rich.get_console().quiet = True  # viser's box names its own address, not ours
    server = _Local(host=host, port=port, label=label, verbose=False)
    server.gui.configure_theme(
        show_logo=False, show_share_button=False, brand_color=BRAND, control_width="medium"
    )
    return Page(server, subject, skies)


def _forward(pose: Pose) -> np.ndarray:
    return pinhole(pose, 1, 1).w2c[2, :3]


def _photograph(view: View, hdr: bool) -> np.ndarray:
    view = scaled_view(view, min(1.0, PHOTOGRAPH / max(file_size(view))))
    pixels = read_colors(view, hdr)
    return display_color(pixels) if hdr else np.rint(pixels.clip(0, 1) * 255).astype(np.uint8)


def _brightness(sky: Sky) -> float:
    """Mean luminance over the sphere, about."""
    theta = torch.linspace(0, math.pi, len(sky.radiance), device=sky.radiance.device)
    weight = theta.sin()[:, None].clamp_min(1e-3)
    return float((luminance(sky.radiance) * weight).sum() / (weight.sum() * sky.radiance.shape[1])) or 1e-6
