"""The light that arrives at a surface point: from which direction, how much, and from which source.

`directions` chooses the incident directions, `arriving` asks the light, the lamps and the scene what comes
along them, `scene` traces rays through the host, and `traced` draws the rays that L_ref compares. Nothing
here knows the model.
"""

from neilfpp_method.incident.arriving import Sources, arriving, incident_radiance
from neilfpp_method.incident.directions import directions_for_viewers, draw_directions
from neilfpp_method.incident.scene import scene_tracer
from neilfpp_method.incident.traced import trace_light

__all__ = [
    "Sources",
    "arriving",
    "directions_for_viewers",
    "draw_directions",
    "incident_radiance",
    "scene_tracer",
    "trace_light",
]
