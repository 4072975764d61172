"""The surface points of a light fit, from which the transport of any light is computed."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor

from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.fields.lamps import LampPlaces
from neilfpp_method.lighting.lamp_transport import from_lamps, in_sight, lamp_kernel
from neilfpp_method.lighting.map_transport import from_texels
from neilfpp_method.lighting.objective import Target
from neilfpp_method.lighting.transport import Transport
from neilfpp_method.shading.brdf import Lobe
from neilfpp_method.structures import Material, Observed, SceneTracer

__all__ = ["FitPoints"]


@dataclass(frozen=True)
class FitPoints:
    """N surface points to whose pixels a light is fitted.

    Attributes:
        observed: the points, with unit normals and directions to the viewer.
        material: their material.
        lobe: the specular lobe; None for Lambertian surfaces.
        scene: traces rays from the points through the scene, which blocks light and emits its own radiance;
            None if inter-reflection is off.
        place: number of the place that each point shows; None if every point is a place of its own (see
            `Target`).
    """

    observed: Observed
    material: Material
    lobe: Lobe | None
    scene: SceneTracer | None
    place: Int[Tensor, " N"] | None = None

    @property
    def target(self) -> Target:
        """What a fit has to explain at these points."""
        return Target(self.observed.position, self.material, self.observed.pixel, self.place)

    def from_texels(self, environment: EnvironmentLight) -> Transport:
        """See `map_transport.from_texels`."""
        return from_texels(environment, self.observed, self.material.roughness, self.lobe, self.scene)

    def from_lamps(self, lamps: LampPlaces, radius: float) -> Transport:
        """See `lamp_transport.from_lamps`."""
        return from_lamps(lamps, radius, self.observed, self.material.roughness, self.lobe, self.scene)

    def in_sight(self, lamps: LampPlaces, radius: float) -> Bool[Tensor, "N M"]:
        """See `lamp_transport.in_sight`."""
        return in_sight(lamps, radius, self.observed.position, self.scene)

    def lamp_kernel(
        self, lamps: LampPlaces, radius: float, sight: Bool[Tensor, "N M"]
    ) -> Float[Tensor, "K N M"]:
        """See `lamp_transport.lamp_kernel`."""
        return lamp_kernel(lamps, radius, sight, self.observed, self.material.roughness, self.lobe)
