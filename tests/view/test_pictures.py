"""Images of layers compared with rays that trimesh casts, and light in constant surroundings."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from neilfpp_method.data import memory
from neilfpp_method.data.cameras.projection import camera_rays
from neilfpp_method.evaluate.pictures import lat_long_directions
from neilfpp_method.relight.cameras import turntable
from neilfpp_method.relight.film import Budget, render_picture
from neilfpp_method.relight.lamplight import Lamplight
from neilfpp_method.relight.sky import Sky
from neilfpp_method.train.run import load_run
from neilfpp_method.view.incident_map import light_at, light_picture, point_under
from neilfpp_method.view.pictures import BOUNCES, FAR_DEPTH, PictureRequest, ViewerFrame, frames
from neilfpp_method.view.speed import RenderSpeed
from neilfpp_method.view.subject import Lighting, own_light, scene_of, subject_of


@pytest.fixture(scope="module")
def subject(found):
    return subject_of(load_run(found), 32)


@pytest.fixture(scope="module")
def camera(subject):
    return turntable(subject.run.capture, 2, None, 40)[0].camera


def pictures(wish: PictureRequest, count: int = 99) -> list[ViewerFrame]:
    made = []
    for frame in frames(wish, RenderSpeed({wish.layer: 2_000.0})):
        if frame is not None:
            made.append(frame)
        if len(made) == count:
            break
    return made


def cast(subject, camera):
    """For each pixel, whether its ray first hits the outside of the surface, where, and which triangle, by
    trimesh.
    """
    rays = camera_rays(camera)
    corners = subject.surface.triangles.reshape(-1, 3).numpy()
    mesh = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)
    place, ray, _ = mesh.ray.intersects_location(
        rays.origins.numpy(), rays.directions.numpy(), multiple_hits=False
    )
    return rays, place, ray


def srgb(linear):
    return np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055
    )


def test_images_become_finer_up_to_the_size_of_the_window(subject, camera):
    made = pictures(PictureRequest(subject, camera, "normal", own_light(subject.run)))
    assert [frame.share for frame in made] == sorted(frame.share for frame in made)
    assert made[0].share < 1 == made[-1].share
    assert made[-1].image.shape == (camera.height, camera.width, 3)


@pytest.mark.parametrize("layer", ["base_color", "roughness", "metallic"])
def test_a_layer_shows_the_material_at_the_hit_of_each_pixel(subject, camera, layer):
    frame = pictures(PictureRequest(subject, camera, layer, own_light(subject.run)))[-1]
    _, place, ray = cast(subject, camera)
    assert len(ray) > 100
    with torch.no_grad():
        material = getattr(subject.run.model.materials(torch.from_numpy(place).float()), layer).numpy()
    true = 255 * (srgb(material) if layer == "base_color" else material)
    shown = frame.image.reshape(-1, 3)[ray]
    assert np.percentile(np.abs(shown - true), 98) <= 2  # a ray along the outline may meet another triangle
    nothing = np.setdiff1d(np.arange(camera.width * camera.height), ray)
    assert (frame.image.reshape(-1, 3)[nothing] == 237).all()


def test_depth_is_along_the_axis(subject, camera):
    frame = pictures(PictureRequest(subject, camera, "normal", own_light(subject.run)))[-1]
    _, place, ray = cast(subject, camera)
    depth = (place @ camera.w2c[2, :3]) + camera.w2c[2, 3]
    assert np.percentile(np.abs(frame.depth.reshape(-1)[ray] - depth), 98) < 1e-3
    assert frame.depth.max() == FAR_DEPTH


def test_pbr_converges_to_the_image_of_the_path_tracer(subject, camera):
    """Many samples of both, with different random numbers."""
    light = own_light(subject.run)
    made = [
        frame for frame in pictures(PictureRequest(subject, camera, "pbr", light), 40) if frame.share == 1
    ]
    assert [frame.samples for frame in made] == list(range(1, len(made) + 1))
    picture = render_picture(scene_of(subject, light), camera, Budget(64), BOUNCES, seed=7)
    inside = (picture.alpha[..., 0] > 0.999).numpy()
    true = 255 * srgb(picture.radiance.numpy()).clip(0, 1)
    error = [np.abs(frame.image.astype(float) - true)[inside].mean() for frame in (made[0], made[-1])]
    assert error[1] < error[0] / 2
    assert abs((made[-1].image.astype(float) - true)[inside].mean()) < 1.5


def test_twice_the_light_is_one_stop_brighter(subject, camera):
    light = own_light(subject.run)
    brighter = Lighting(replace(light.sky, radiance=2 * light.sky.radiance), None, own=False)
    last = [
        pictures(PictureRequest(subject, camera, "pbr", shone, exposure), 6)[-1].image
        for shone, exposure in ((brighter, 0.0), (light.with_lamps(None), 1.0))
    ]
    assert np.abs(last[0].astype(int) - last[1]).max() <= 1


def test_a_free_light_shows_pbr_too(given, camera):
    subject = subject_of(load_run(given), 32)
    assert own_light(subject.run).sky is None
    frame = pictures(PictureRequest(subject, camera, "pbr", own_light(subject.run)))[-1]
    assert frame.share == 1
    assert frame.image.std() > 5


def test_a_surface_too_large_for_the_memory_is_the_reason_in_the_note(found, monkeypatch):
    monkeypatch.setattr(memory, "available_memory", lambda: 1000)
    # The surface at a resolution of 32 is in the cache of the run.
    note = subject_of(load_run(found), 40).note
    assert note.startswith("Only R can be shown: the distances of a grid of 40³ points need about")
    assert note.endswith("; give a lower resolution, on the command line with --resolution.")


def test_a_run_without_a_surface_shows_r_with_a_note(found, camera):
    run = load_run(found)
    run.model.host.sdf = lambda x: x.norm(dim=-1) + 1.0
    # As above.
    empty = subject_of(run, 40)
    assert empty.layers == ("radiance",)
    assert empty.note.startswith("Only R can be shown: no surface within")
    assert pictures(PictureRequest(empty, camera, "radiance", own_light(run)))[-1].share == 1
    assert point_under(empty, (3.0, 0.0, 0.0), (-1.0, 0.0, 0.0)) is None


# ------------------------------------------------------------------------------------------- light at a point


def test_a_ray_picks_the_point_that_trimesh_finds(subject, camera):
    rays, place, ray = cast(subject, camera)
    k = len(ray) // 2
    point = point_under(
        subject, tuple(rays.origins[ray[k]].tolist()), tuple((3 * rays.directions[ray[k]]).tolist())
    )
    assert point.position.tolist() == pytest.approx(place[k].tolist(), abs=1e-4)
    assert point.normal.norm().item() == pytest.approx(1, abs=1e-5)


def test_even_light_arrives_evenly_and_not_from_below(subject, camera):
    rays, _, ray = cast(subject, camera)
    middle = ray[len(ray) // 2]
    point = point_under(
        subject, tuple(rays.origins[middle].tolist()), tuple(rays.directions[middle].tolist())
    )
    even = Lighting(Sky(torch.full((8, 16, 3), 0.7), True, 0.0), None, own=False)
    radiance = light_at(subject, even, point)
    normal = point.normal.numpy()
    theta, phi = (np.arange(48) + 0.5) * np.pi / 48, (np.arange(96) + 0.5) * np.pi / 48
    cosine = (
        np.sin(theta)[:, None] * (np.sin(phi) * normal[0] + np.cos(phi) * normal[1])
        + np.cos(theta)[:, None] * normal[2]
    )
    assert np.median(np.abs(radiance[cosine > 0.5] - 0.7)) < 1e-5  # it is not occluded
    assert radiance[cosine < -0.05].max() == 0
    picture = light_picture(np.ones_like(radiance), normal)
    assert (picture[cosine < -0.05] == 44).all()
    assert picture[cosine > 0.05].min() > 88


def test_a_lamp_of_changed_light_is_seen_in_front_of_the_sky(subject, camera):
    rays, _, ray = cast(subject, camera)
    middle = ray[len(ray) // 2]
    point = point_under(
        subject, tuple(rays.origins[middle].tolist()), tuple(rays.directions[middle].tolist())
    )
    radius, distance = 0.1, 0.5
    lamp = Lamplight(
        position=(point.position + distance * point.normal)[None],
        axis=torch.zeros(1, 3),
        radiance=torch.tensor([[5.0, 4.0, 3.0]]),
        radius=radius,
    )
    sky = Sky(torch.full((8, 16, 3), 0.7), True, 0.0)
    radiance = light_at(subject, Lighting(sky, lamp, own=False), point)
    cosine = lat_long_directions(len(radiance)) @ point.normal.numpy()
    edge = (1 - (radius / distance) ** 2) ** 0.5
    towards_lamp = radiance[cosine > edge + 5e-3]
    assert len(towards_lamp) > 5
    np.testing.assert_allclose(towards_lamp - 0.7, np.broadcast_to([5, 4, 3], towards_lamp.shape), rtol=1e-4)
    around = radiance[(cosine > 0.5) & (cosine < edge - 5e-3)]
    assert np.median(np.abs(around - 0.7)) < 1e-5


def test_the_own_light_agrees_with_the_model(subject, camera):
    rays, _, ray = cast(subject, camera)
    middle = ray[len(ray) // 2]
    point = point_under(
        subject, tuple(rays.origins[middle].tolist()), tuple(rays.directions[middle].tolist())
    )
    radiance = light_at(subject, own_light(subject.run), point)
    down, across = np.argwhere(radiance.any(-1))[77]
    theta, phi = np.pi * (down + 0.5) / 48, 2 * np.pi * (across + 0.5) / 96
    wi = torch.tensor(
        [np.sin(phi) * np.sin(theta), np.cos(phi) * np.sin(theta), np.cos(theta)], dtype=torch.float32
    )
    with torch.no_grad():
        true = subject.run.model.incident_light(point.position[None], wi[None, None])[0, 0]
    assert radiance[down, across].tolist() == pytest.approx(true.tolist(), rel=1e-3)
