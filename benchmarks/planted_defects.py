"""The share of planted defects of a host that `check_host` finds: one defect at a time in a correct host.

    python -m benchmarks.planted_defects              print the table of docs/hosts.md
    python -m benchmarks.planted_defects --missed     print only the defects that are not found

The host is a ball with a learned radius and learned colours above a disc, viewed from all sides of the upper
half space.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from types import SimpleNamespace

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from neilfpp_method.hosts.testing import ContractBroken, check_host
from neilfpp_method.structures import RayBatch, SurfaceHits

__all__ = ["DEFECTS", "Outcome", "Scene", "outcomes", "rays_from_above"]

Outputs = dict[str, Tensor]
FLOOR, DISC = -0.4, 0.9
"""Height and radius of the disc."""


def rays_from_above(count: int = 300, seed: int = 0) -> RayBatch:
    """Rays from a half sphere of radius 2.5 to points on the scene and near it."""
    generator = torch.Generator().manual_seed(seed)
    origins = normalize(torch.randn(count, 3, generator=generator), dim=-1) * torch.tensor([1.0, 1.0, 0.5])
    origins = 2.5 * normalize(torch.cat((origins[:, :2], origins[:, 2:].abs() + 0.3), -1), dim=-1)
    aims = (2 * torch.rand(count, 3, generator=generator) - 1) * torch.tensor([0.8, 0.8, 0.4])
    return RayBatch(origins, normalize(aims - origins, dim=-1))


class Scene(nn.Module):
    """The correct host; `defect` changes what it renders."""

    def __init__(self, defect: Callable[[Scene, RayBatch], Outputs] | None = None) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.radius = nn.Parameter(torch.tensor(0.45))
        self.paint = nn.Sequential(nn.Linear(3, 16), nn.Softplus(), nn.Linear(16, 3), nn.Softplus())
        self.defect = defect
        self.calls = 0

    def clean(self, rays: RayBatch, near: float = 0.0, far: float = torch.inf) -> Outputs:
        """The correct result; surfaces nearer than `near` or beyond `far` are ignored."""
        o, d = rays.origins, rays.directions
        middle = -(o * d).sum(-1)
        square = middle.square() - o.square().sum(-1) + self.radius**2
        ball = middle - square.clamp_min(1e-6).sqrt()
        ball = torch.where((square > 1e-6) & (ball > near) & (ball < far), ball, torch.inf)
        floor = (FLOOR - o[:, 2]) / torch.where(d[:, 2].abs() < 1e-6, 1e-6, d[:, 2])
        on_disc = (o + floor[:, None] * d)[:, :2].norm(dim=-1) < DISC
        floor = torch.where((floor > max(near, 1e-4)) & (floor < far) & on_disc, floor, torch.inf)
        distance = torch.minimum(ball, floor)
        hit = distance.isfinite()
        position = o + torch.where(hit, distance, 0.0)[:, None] * d
        normal = torch.where(
            (ball < floor)[:, None], position / position.norm(dim=-1, keepdim=True), torch.eye(3)[2].to(o)
        )
        normal = torch.where((normal * d).sum(-1, keepdim=True) > 0, -normal, normal) * hit[:, None]
        color = self.paint(position) * hit[:, None]
        share = hit.to(o.dtype)
        return {
            "color": color,
            "position": position,
            "normal": normal,
            "opacity": share,
            "concentration": share,
        }

    def render(self, rays: RayBatch) -> SurfaceHits | SimpleNamespace:
        """The result of the host contract, changed by the defect."""
        self.calls += 1
        outputs = self.clean(rays) if self.defect is None else self.defect(self, rays)
        try:
            return SurfaceHits(**outputs)
        except TypeError:  # where tests look at shapes as structures are made; users' loops do not
            return SimpleNamespace(**outputs)


# ------------------------------------------------------------------------------------------------ the defects

Change = Callable[[RayBatch, Outputs], Mapping[str, object]]


def after(change: Change) -> Callable[[Scene, RayBatch], Outputs]:
    """A defect that changes the returned outputs."""

    def defect(host: Scene, rays: RayBatch) -> Outputs:
        outputs = host.clean(rays)
        return outputs | dict(change(rays, outputs))

    return defect


def along(rays: RayBatch, outputs: Outputs, factor: Tensor | float) -> Mapping[str, Tensor]:
    """Positions at `factor` times their distance."""
    return {"position": rays.origins + factor * (outputs["position"] - rays.origins)}


def z_depth(rays: RayBatch, outputs: Outputs) -> Mapping[str, Tensor]:
    """Positions from the z-depth of cameras that look at the scene's centre."""
    axis = normalize(-rays.origins, dim=-1)
    return along(rays, outputs, (axis * rays.directions).sum(-1, keepdim=True))


def noisy(normal: Tensor, position: Tensor, degrees: float) -> Tensor:
    """Normals rotated by so many degrees, in directions that depend on the position."""
    wave = torch.sin(
        91.7 * position @ torch.tensor([[1.0, 2.3, -1.7], [0.7, -1.9, 2.9], [2.1, 1.1, 1.3]]).to(position)
    )
    aside = normalize(torch.linalg.cross(normal, wave), dim=-1)
    return normalize(normal + torch.tan(torch.deg2rad(torch.tensor(degrees))) * aside, dim=-1)


def hit_of(outputs: Outputs) -> Tensor:
    return outputs["opacity"][:, None] > 0


def with_call(work: Callable[[Scene], object]) -> Callable[[Scene, RayBatch], Outputs]:
    """A defect with a side effect."""

    def defect(host: Scene, rays: RayBatch) -> Outputs:
        work(host)
        return host.clean(rays)

    return defect


def squeezed(host: Scene, rays: RayBatch) -> Outputs:
    return {name: value.squeeze(0) for name, value in host.clean(rays).items()}


def one_buffer(host: Scene, rays: RayBatch) -> Outputs:
    outputs = host.clean(rays)
    if torch.is_grad_enabled():
        return outputs
    kept = getattr(host, "kept", None)
    host.kept = torch.empty_like(outputs["color"]) if kept is None or len(kept) != len(rays) else kept
    return outputs | {"color": host.kept.copy_(outputs["color"])}


def views_its_input(host: Scene, rays: RayBatch) -> Outputs:
    outputs = host.clean(rays)
    rays.origins.view(-1)  # what a kernel asks that takes raw memory
    return outputs


def shifts_its_input(host: Scene, rays: RayBatch) -> Outputs:
    outputs = host.clean(rays)
    rays.origins.mul_(1.01)
    return outputs


def counted(host: Scene, rays: RayBatch) -> Outputs:
    outputs = host.clean(rays)
    return outputs | {"color": outputs["color"] * (1 + 0.1 * host.calls)}


def recomputed(rays: RayBatch, outputs: Outputs) -> Mapping[str, Tensor]:
    with torch.enable_grad():
        return {"normal": outputs["normal"] * torch.ones((), requires_grad=True)}


def scaled(host: Scene, rays: RayBatch, factor: float, shift: float) -> Outputs:
    """The scene in another frame, with rays in that frame."""
    by = torch.tensor([shift, 0.0, 0.0])
    outputs = host.clean(RayBatch((rays.origins - by) / factor, rays.directions))
    return outputs | {"position": outputs["position"] * factor + by}


def coarse(host: Scene, rays: RayBatch) -> Outputs:
    """A darker image if gradients are disabled."""
    outputs = host.clean(rays)
    return outputs if torch.is_grad_enabled() else outputs | {"color": 0.9 * outputs["color"]}


def inside_out(host: Scene, rays: RayBatch) -> Outputs:
    """The far side of the ball."""
    far = host.clean(RayBatch(rays.origins + 6.0 * rays.directions, -rays.directions))
    return far | {"position": far["position"], "normal": -far["normal"]}


OWN = torch.Generator()
"""A generator that is independent of the seed of the loop."""

DEFECTS: Mapping[str, Callable[[Scene, RayBatch], Outputs]] = {
    # shapes and types
    "colour with an alpha": after(lambda r, o: {"color": torch.cat((o["color"], o["opacity"][:, None]), -1)}),
    "opacity (N, 1)": after(lambda r, o: {"opacity": o["opacity"][:, None]}),
    "opacity as a mask of bools": after(lambda r, o: {"opacity": o["opacity"] > 0}),
    "no concentration": after(lambda r, o: {"concentration": None}),
    "normals in float64": after(lambda r, o: {"normal": o["normal"].double()}),
    "colours in bfloat16": after(lambda r, o: {"color": o["color"].bfloat16()}),
    "a batch of one is squeezed": squeezed,
    "cannot take rays that share an origin": views_its_input,
    # where things are
    "depth too long by a tenth": after(partial(along, factor=1.1)),
    "depth too short by a tenth": after(partial(along, factor=0.9)),
    "depth too long by a fiftieth": after(partial(along, factor=1.02)),
    "z-depth for the distance": after(z_depth),
    "inverse depth for depth": after(
        lambda r, o: along(r, o, 1 / (o["position"] - r.origins).norm(dim=-1, keepdim=True) ** 2)
    ),
    "positions beside their rays": after(
        lambda r, o: {"position": o["position"] + 0.1 * r.directions.roll(1, -1)}
    ),
    "positions without the origin": after(lambda r, o: {"position": o["position"] - r.origins}),
    "positions behind the camera": after(lambda r, o: along(r, o, -1.0)),
    "axes y and z exchanged in positions": after(lambda r, o: {"position": o["position"][:, [0, 2, 1]]}),
    "positions with noise of 0.03": after(lambda r, o: along(r, o, 1 + 0.012 * torch.randn(len(r), 1))),
    "positions with noise of their own": after(
        lambda r, o: along(r, o, 1 + 0.01 * torch.rand((), generator=OWN))
    ),
    "scene five times too large": partial(scaled, factor=5.0, shift=0.0),
    "scene 4 beside the origin": partial(scaled, factor=1.0, shift=4.0),
    "the far side of surfaces": inside_out,
    "a near plane at 0.1": lambda host, rays: host.clean(rays, near=0.1),
    "a far plane at 4": lambda host, rays: host.clean(rays, far=4.0),
    # normals
    "normals turned inwards": after(lambda r, o: {"normal": -o["normal"]}),
    "normals of length 2": after(lambda r, o: {"normal": 2.0 * o["normal"]}),
    "normals as colours": after(lambda r, o: {"normal": 0.5 * (o["normal"] + 1.0)}),
    "normals that face the viewer": after(lambda r, o: {"normal": -r.directions * hit_of(o)}),
    "normals 20° noisy": after(lambda r, o: {"normal": noisy(o["normal"], o["position"], 20.0) * hit_of(o)}),
    "normals in the camera's frame": after(lambda r, o: {"normal": in_camera(r, o["normal"])}),
    "normals of a neighbour": after(lambda r, o: {"normal": o["normal"].roll(1, 0)}),
    "a normal that is not finite": after(
        lambda r, o: {"normal": o["normal"] / o["normal"].norm(dim=-1, keepdim=True)}
    ),
    # colours
    "colours that stop at 1": after(lambda r, o: {"color": (o["color"] / 0.75).clamp_max(1.0)}),
    "colours below 0": after(lambda r, o: {"color": o["color"] - 0.8}),
    "colours that are not finite": after(
        lambda r, o: {"color": torch.where(hit_of(o), o["color"], torch.nan)}
    ),
    "colours in display values": after(lambda r, o: {"color": o["color"].clamp_min(1e-6) ** (1 / 2.2)}),
    "red and blue exchanged": after(lambda r, o: {"color": o["color"].flip(-1)}),
    # hits and misses
    "never a hit": after(lambda r, o: {"concentration": 0.5 * o["concentration"]}),
    "always a hit": after(lambda r, o: {"concentration": torch.ones_like(o["opacity"])}),
    "opacity above 1": after(lambda r, o: {"opacity": 1.5 * o["opacity"]}),
    "opacity 1 for misses": after(lambda r, o: {"opacity": torch.ones_like(o["opacity"])}),
    "no opacity at all": after(lambda r, o: {"opacity": torch.zeros_like(o["opacity"])}),
    "positions of misses not finite": after(
        lambda r, o: {"position": torch.where(hit_of(o), o["position"], torch.inf)}
    ),
    # batches
    "colours scaled by the batch": after(
        lambda r, o: {"color": o["color"] / o["color"].amax().clamp_min(0.1)}
    ),
    "depth scaled by the batch": after(
        lambda r, o: along(r, o, 1 + 0.01 * o["opacity"].mean() * (len(r) > 150))
    ),
    "answers in another order": after(lambda r, o: {"color": o["color"][o["position"][:, 0].argsort()]}),
    "a buffer that is used again": one_buffer,
    # conduct
    "calls eval()": with_call(lambda host: host.eval()),
    "calls manual_seed": with_call(lambda host: torch.manual_seed(0)),
    "switches gradients on for good": with_call(lambda host: torch.set_grad_enabled(True)),
    "counts its calls in the colour": counted,
    "changes its input": shifts_its_input,
    "another colour without gradients": coarse,
    # gradients
    "colours cut off": after(lambda r, o: {"color": o["color"].detach()}),
    "hits cut off": after(lambda r, o: {name: o[name].detach() for name in ("position", "normal")}),
    "a gradient that is not finite": after(
        lambda r, o: {"color": o["color"] + (o["color"] - o["color"].detach()).sqrt()}
    ),
    "a gradient under no_grad": after(recomputed),
    "freezes its parameters": with_call(
        lambda host: [p.requires_grad_(False) for p in host.paint.parameters()]
    ),
}


def in_camera(rays: RayBatch, normal: Tensor) -> Tensor:
    """Normals in a frame whose third axis points to the scene's centre."""
    z = normalize(-rays.origins, dim=-1)
    x = normalize(torch.linalg.cross(z, torch.tensor([0.0, 0.0, 1.0]).expand_as(z)), dim=-1)
    return torch.stack([(normal * axis).sum(-1) for axis in (x, torch.linalg.cross(z, x), z)], -1)


# -------------------------------------------------------------------------------------------------- the table


@dataclass(frozen=True)
class Outcome:
    """The result for a defect: the check that found it, or None, and its message."""

    defect: str
    check: str | None
    message: str


def outcomes() -> Iterator[Outcome]:
    """Plant the defects one after the other."""
    for name, defect in DEFECTS.items():
        host, rays = Scene(defect), rays_from_above()
        grad = torch.is_grad_enabled()
        try:
            check_host(host, rays)
            yield Outcome(name, None, "")
        except ContractBroken as broken:
            yield Outcome(name, broken.check, str(broken).removeprefix("Scene: "))
        except Exception as error:  # a host that dies is found as well
            yield Outcome(name, "crash", f"{type(error).__name__}: {error}")
        finally:
            torch.set_grad_enabled(grad)


def main() -> None:
    """Print the table."""
    check_host(Scene(), rays_from_above())
    found = list(outcomes())
    shown = [o for o in found if o.check is None] if "--missed" in sys.argv[1:] else found
    print("| defect | found by | message |\n|---|---|---|")
    for outcome in shown:
        said = outcome.message.partition("\n")[0]
        print(f"| {outcome.defect} | {outcome.check or '**nothing**'} | {said} |")
    print(
        f"\n{sum(o.check is not None for o in found)} of {len(found)} defects are found; the whole host "
        "passes."
    )


if __name__ == "__main__":
    main()
