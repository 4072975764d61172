"""Incident light at surface points: its directions, radiance and sources.

`arriving` evaluates light, lamps and scene along sampled directions, `directions` chooses directions for
several viewers at once, `scene` traces rays through the host, and `traced` samples and traces the rays of
L_ref. Nothing here depends on `NeilfModel`.
"""

from neilfpp_method.incident.arriving import Sources, arriving, incident_radiance
from neilfpp_method.incident.directions import directions_for_viewers
from neilfpp_method.incident.scene import scene_tracer
from neilfpp_method.incident.traced import trace_light

__all__ = [
    "Sources",
    "arriving",
    "directions_for_viewers",
    "incident_radiance",
    "scene_tracer",
    "trace_light",
]
