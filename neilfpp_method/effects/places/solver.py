"""Effects, initial light and searches for materials in a training loop without a data set of images.

`gathering.gather_places` asks a data set for the pixels that show a place. A loop into which NeILF++ is
attached hands over only batches of pixels. If many batches are remembered, most surface points have
neighbours that other views showed, and neighbours together are a place.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import nn

from neilfpp_method.effects.first_light import seconds_of_pixel
from neilfpp_method.effects.following import Followers, follow, follow_fit, improve, start_light
from neilfpp_method.effects.places.gathering import MIN_COSINE, SAME_NORMAL, Places
from neilfpp_method.effects.places.search import comparison_due
from neilfpp_method.effects.plan import Plan
from neilfpp_method.effects.review import SURFACE_PIXELS, review_light_at, review_visibility
from neilfpp_method.lighting.fit import Evidence
from neilfpp_method.lighting.ring import Ring
from neilfpp_method.lighting.solver import LightSolver
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import StagePosition
from neilfpp_method.shading.color import CLIPPED, srgb_to_linear
from neilfpp_method.structures import Observed

__all__ = ["PlaceSolver"]

PIXELS = 12_000
"""Number of remembered points, ten per place."""
PLACES = 1200
"""Number of places, as many as `neilfpp train` uses."""
MIN_PIXELS = 4
"""Minimum number of points per place: fewer do not distinguish materials."""
FOLDS = 20
"""Number of groups of points that stand for views when some are held back."""
MAX_WAIT = 40
"""Steps after which the search for the initial light begins, even with fewer points."""


class PlaceSolver(nn.Module):
    """Remembers surface points of training steps, and fits light and material to the places they form.

    Args:
        plan: the effects; those that are open are decided here, by evidence at the places.
        response: response of the pixels, "linear" or "srgb".
        say: prints a line.
    """

    def __init__(self, plan: Plan, response: str, say: Callable[[str], object]) -> None:
        super().__init__()
        self.plan, self.response, self.say = plan, response, say
        self.points = Ring(PIXELS, Observed.WIDTH)
        self._steps, self._tried, self._searched = 0, False, -1

    def is_waiting(self, light_solver: LightSolver) -> bool:
        """Whether more points are needed before the first fit of the light."""
        return not self._tried and light_solver.seeks_start

    @torch.no_grad()
    def observe(self, surface: Observed) -> None:
        """Remember the surface points of a step that trains material, in place of the oldest."""
        usable = (surface.normal * surface.wo).sum(-1) > MIN_COSINE
        if self.response == "srgb":
            usable = usable & (surface.pixel.amax(-1) < CLIPPED)
            surface = replace(surface, pixel=srgb_to_linear(surface.pixel))
        self.points.keep(surface.rows()[usable])
        self._steps += 1

    def before_step(
        self, model: NeilfModel, light_solver: LightSolver, position: StagePosition, step: int
    ) -> None:
        """Start the light, or improve light and material, if this is due before a step with material.

        This changes parameters, which is not allowed between the losses of a step and their gradients.

        Args:
            model: the model that is trained.
            light_solver: solves for the light of this model.
            position: position of the step in its stage.
            step: index of the step in all stages.
        """
        followers = Followers(self.plan, model, light_solver, self.say)
        # The fits need full precision, even within the autocast of the caller's loop.
        with torch.autocast(self.points.rows.device.type, enabled=False):
            if self.is_waiting(light_solver) and (self.points.full or self._steps >= MAX_WAIT):
                self._tried = True
                self._start_light(followers, step)
            if self.is_waiting(light_solver):
                return  # there is no light yet under which anything could be compared
            comparison = comparison_due(model, position)
            if comparison is not None and position.step != self._searched:
                self._searched = position.step
                improve(followers, self.places(), comparison, step)

    def after_fit(
        self, model: NeilfModel, light_solver: LightSolver, evidence: Evidence | None, step: int
    ) -> None:
        """Record what a fit of the light has decided on lamps."""
        follow_fit(Followers(self.plan, model, light_solver, self.say), evidence, step)

    @torch.no_grad()
    def places(self) -> Places:
        """Group the points: each belongs to the nearest of `PLACES` points drawn at random.

        There are no places before the first point.
        """
        observed = Observed.of_rows(self.points.kept())
        count = len(observed)
        center = observed[torch.randperm(count, device=observed.position.device)[:PLACES]]
        distance = torch.cdist(observed.position, center.position)
        place = distance.argmin(1) if count else distance.new_zeros(0, dtype=torch.long)
        same = (observed.normal * center.normal[place]).sum(-1) > SAME_NORMAL
        fold = torch.arange(count, device=place.device) % FOLDS
        places = Places(len(center), place, fold, observed)
        return places.where(torch.nonzero(same)[:, 0]).with_at_least(MIN_PIXELS)

    def _start_light(self, followers: Followers, step: int) -> None:
        """Decide on effects, and set an initial light and material that explain the places.

        If there are too few places, no effect is decided, and the first fit starts from an even light.
        """
        plan, model = followers.plan, followers.model
        surface = Observed.of_rows(self.points.kept()[:SURFACE_PIXELS])
        follow(followers, review_visibility(plan, model, surface, step))
        places = self.places()
        rate = seconds_of_pixel(
            places.place.device, with_lobe=plan.is_open("long-tails"), with_metals=plan.is_open("metals")
        )
        self.say(f"the search for effects and an initial light takes about {rate * len(places.place):.0f} s")
        start_light(followers, review_light_at(places, plan, model, step), step)
