"""Relight the test views of a run under a map that training has not seen, and compare with true images."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.scaling import at_scale
from neilfpp_method.errors import UserError
from neilfpp_method.relight.command import relight
from neilfpp_method.relight.comparison import find_truth
from neilfpp_method.relight.maps import Layout, check_map
from neilfpp_method.relight.request import RelightRequest
from neilfpp_method.report.measured import is_outdated

__all__ = ["Relighting", "has_relit", "metrics_path", "plan_relighting", "relight_run"]


@dataclass(frozen=True)
class Relighting:
    """The light of the comparison.

    Attributes:
        env: file of the environment map.
        layout: its layout.
        truth: folder of the true images of the test views.
        key: hash of the contents of all these files. It names the folder of the relit images in a run, so
            that images of another map of the same name are not compared.
    """

    env: Path
    layout: Layout
    truth: Path
    key: str


def plan_relighting(
    env: Path | None, truth: Path | None, layout: Layout, capture: Capture
) -> Relighting | None:
    """Check the options of the comparison; None if it is not wanted.

    Raises:
        UserError: only one of both is given, the map is unusable, or a test view has no true image.
    """
    if env is None and truth is None:
        return None
    if env is None or truth is None:
        raise UserError(
            "--relight and --truth belong together: a map, and true images of the test views under it",
            "give both, or none",
        )
    if not capture.test_views:
        raise UserError(f"{capture.root}: no test views to relight", "leave --relight and --truth out")
    check_map(env)
    files = find_truth(truth, at_scale(capture, 1.0).test_views)
    contents = hashlib.sha256(layout.encode())
    for path in (env, *files.values()):
        contents.update(hashlib.sha256(path.read_bytes()).digest())
    return Relighting(env, layout, truth, contents.hexdigest()[:12])


def metrics_path(run: Path, light: Relighting) -> Path:
    """The file with the figures of a relit run."""
    return run / "relit" / f"tradeoff-{light.key}" / light.env.stem / "metrics.json"


def has_relit(run: Path, light: Relighting) -> bool:
    """Whether a run has figures under a light that are not older than its last checkpoint."""
    path = metrics_path(run, light)
    return path.is_file() and not is_outdated(path, run)


def relight_run(run: Path, light: Relighting, device: str, say: Callable[[str], None]) -> None:
    """Relight the test views of a run in full size and write the figures, as `neilfpp relight --env MAP
    --truth DIR` does. Images that exist are kept.

    Raises:
        UserError: for example if the run has no material or no surface.
    """
    request = RelightRequest(
        run=run,
        env=(light.env,),
        env_layout=light.layout,
        truth=(light.truth,),
        out=metrics_path(run, light).parent.parent,
        device=device,
    )
    relight(request, say)
