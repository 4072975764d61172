"""The four fields G, R, B and L and the background, with their encodings and networks (METHOD §5)."""

from neilfpp_method.fields.brdf import BrdfField
from neilfpp_method.fields.exposure import PhotographGains, at_mean_exposure
from neilfpp_method.fields.light import LightModel, make_light
from neilfpp_method.fields.normal_tilts import NormalTilts, tilted
from neilfpp_method.fields.poses import PoseCorrections

__all__ = [
    "BrdfField",
    "LightModel",
    "NormalTilts",
    "PhotographGains",
    "PoseCorrections",
    "at_mean_exposure",
    "make_light",
    "tilted",
]
