"""A scene of the path tracer, rendered by Mitsuba 3 (Jakob et al. 2022), an independent implementation.

Mitsuba has no plugin for the BRDF of METHOD §1, so the BRDF is implemented here in Mitsuba's own language,
with its local frames, its conventions (`si.wi` is the viewer, `wo` the light), and its samplers. Meshes,
camera, map and path integrator are Mitsuba's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.errors import UserError

__all__ = ["Lamp", "LitScene", "Part", "PathSampling", "load_mitsuba", "render"]

BSDF = "neilfpp"


@dataclass(frozen=True)
class Part:
    """A mesh of one material, with flat normals. A surface without a roughness is Lambertian."""

    mesh: trimesh.Trimesh
    base_color: tuple[float, float, float]
    roughness: float | None
    metallic: float


@dataclass(frozen=True)
class Lamp:
    """A ball whose whole surface emits the same radiance, and that cameras do not see."""

    position: tuple[float, float, float]
    radius: float
    radiance: tuple[float, float, float]


@dataclass(frozen=True)
class LitScene:
    """Surfaces, a map in this package's layout whose first and last rows are at the poles, and lamps."""

    parts: Sequence[Part]
    radiance: Float[np.ndarray, "H W 3"]
    lamps: Sequence[Lamp] = ()


@dataclass(frozen=True)
class PathSampling:
    """Samples per pixel, largest number of surfaces on a path, and seed."""

    samples: int
    bounces: int
    seed: int


def load_mitsuba(variant: str):
    """Load Mitsuba in a variant, and register the BRDF of METHOD §1.

    Raises:
        UserError: it is not installed, or the variant does not run on this machine.
    """
    try:
        import mitsuba as mi

        mi.set_variant(variant)
    except ImportError as error:
        raise UserError(
            f"Mitsuba does not run here in the variant {variant} ({error})", "pip install mitsuba"
        ) from error
    _register(mi)
    return mi


def render(
    mi, scene: LitScene, camera: Camera, sampling: PathSampling, folder: Path
) -> Float[np.ndarray, "h w 3"]:
    """Linear radiance of a scene, 0 where no surface is.

    Args:
        mi: Mitsuba, as `load_mitsuba` returns it.
        scene: the surfaces and the light.
        camera: a pinhole camera with its principal point in the middle of the image.
        sampling: number, length and seed of the paths.
        folder: folder for the files of the meshes.
    """
    bounces = sampling.bounces
    described = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": bounces + 1, "rr_depth": bounces, "hide_emitters": True},
        "sensor": _sensor(mi, camera, sampling.samples),
        # Its maps are about +y, with the azimuth from −z to +x; ours about +z, from +y to +x.
        "light": {
            "type": "envmap",
            "bitmap": mi.Bitmap(np.ascontiguousarray(scene.radiance, np.float32)),
            "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 90),
        },
    }
    for k, part in enumerate(scene.parts):
        path = folder / f"part_{k}.ply"
        path.write_bytes(part.mesh.export(file_type="ply", vertex_normal=False))
        described[f"part_{k}"] = {
            "type": "ply",
            "filename": str(path),
            "face_normals": True,
            "bsdf": _material(part),
        }
    for k, lamp in enumerate(scene.lamps):
        described[f"lamp_{k}"] = {
            "type": "sphere",
            "center": list(lamp.position),
            "radius": lamp.radius,
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": list(lamp.radiance)}},
        }
    return np.array(mi.render(mi.load_dict(described), seed=sampling.seed))[..., :3]


def _sensor(mi, camera: Camera, samples: int) -> dict[str, object]:
    pose = np.eye(4)
    pose[:3] = camera.c2w
    return {
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(camera.width / (2 * camera.fx)))),
        "fov_axis": "x",
        "to_world": mi.ScalarTransform4f(pose @ np.diag([-1.0, -1.0, 1.0, 1.0])),  # its x is left, its y up
        "film": {
            "type": "hdrfilm",
            "width": camera.width,
            "height": camera.height,
            "pixel_format": "rgb",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
        "sampler": {"type": "independent", "sample_count": samples},
    }


def _material(part: Part) -> dict[str, object]:
    if part.roughness is None:
        return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(part.base_color)}}
    red, green, blue = part.base_color
    return {
        "type": BSDF,
        "red": red,
        "green": green,
        "blue": blue,
        "roughness": part.roughness,
        "metallic": part.metallic,
    }


def _register(mi) -> None:
    """Register METHOD §1 with the paper's lobe as a BSDF; half of the directions are sampled by cosine, half
    by the lobe.
    """
    import drjit as dr

    class Neilf(mi.BSDF):
        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            base = mi.Color3f(props["red"], props["green"], props["blue"])
            metallic = props["metallic"]
            self.diffuse = base * (1 - metallic) / dr.pi
            self.facing = 0.04 * (1 - metallic) + base * metallic
            self.alpha = props["roughness"] ** 2
            self.m_flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
            self.m_components = [self.m_flags]

        def distribution(self, cosine):
            return dr.exp(2 / self.alpha**2 * (cosine - 1)) / (dr.pi * self.alpha**2)

        def masking(self, cosine):
            return 1 / ((2 - self.alpha) * cosine + self.alpha)

        def sample(self, ctx, si, sample1, sample2, active=True):
            cosine = mi.Frame3f.cos_theta(si.wi)
            width = self.alpha**2 / 2
            height = dr.maximum(1 + width * dr.log(1 + sample2.x * (dr.exp(-1 / width) - 1)), 0)
            sine, turn = dr.sqrt(dr.maximum(1 - height**2, 0)), 2 * dr.pi * sample2.y
            h = mi.Vector3f(sine * dr.cos(turn), sine * dr.sin(turn), height)
            wo = dr.select(sample1 < 0.5, mi.warp.square_to_cosine_hemisphere(sample2), mi.reflect(si.wi, h))
            found = mi.BSDFSample3f()
            found.wo, found.eta = wo, 1.0
            found.pdf = self.pdf(ctx, si, wo, active)
            found.sampled_type, found.sampled_component = +mi.BSDFFlags.GlossyReflection, 0
            good = active & (cosine > 0) & (mi.Frame3f.cos_theta(wo) > 0) & (found.pdf > 0)
            value = self.eval(ctx, si, wo, active) / dr.select(good, found.pdf, 1.0)
            return found, dr.select(good, value, mi.Color3f(0.0))

        def eval(self, ctx, si, wo, active=True):
            i, o = mi.Frame3f.cos_theta(wo), mi.Frame3f.cos_theta(si.wi)
            above = active & (i > 0) & (o > 0)
            h = dr.normalize(wo + si.wi)
            fresnel = self.facing + (1 - self.facing) * (1 - dr.dot(h, wo)) ** 5
            specular = (
                self.distribution(mi.Frame3f.cos_theta(h)) * fresnel * self.masking(i) * self.masking(o)
            )
            return dr.select(above, (self.diffuse + specular) * i, mi.Color3f(0.0))

        def pdf(self, ctx, si, wo, active=True):
            i, o = mi.Frame3f.cos_theta(wo), mi.Frame3f.cos_theta(si.wi)
            h = dr.normalize(wo + si.wi)
            by_lobe = self.distribution(dr.abs(mi.Frame3f.cos_theta(h))) / (1 - dr.exp(-2 / self.alpha**2))
            pdf = 0.5 * dr.maximum(i, 0) / dr.pi + 0.5 * by_lobe / (
                4 * dr.maximum(dr.abs(dr.dot(h, wo)), 1e-6)
            )
            return dr.select(active & (i > 0) & (o > 0), pdf, 0.0)

        def eval_pdf(self, ctx, si, wo, active=True):
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def to_string(self):
            return "Neilf[]"

    mi.register_bsdf(BSDF, Neilf)
