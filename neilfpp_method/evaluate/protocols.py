"""Evaluate a run on its test views: all figures by name, and a description of how they are measured.

An image metric is computed per view and averaged over the test views. A figure is present if its truth is
known and the run has an estimate of it. A figure with an alignment always has its own name, next to the
figure without it.

    volume_psnr, pbr_psnr, *_ssim     images from R, and from the rendering equation; clipped, sRGB-encoded
    *_psnr_linear                     the same on linear radiance, peak 1; HDR captures
    *_psnr_exposed                    after the median gain per view and channel; captures whose
                                      training views have gains
    base_color_psnr, _gamma, _scaled  as estimated; after one gamma; after a least-squares factor per channel
    roughness_psnr, metallic_psnr     as estimated
    *_frame                           the same over the whole frame, the background counted as free of error
    normal_mae_deg                    mean angle between normals over pixels that have both, degrees
    chamfer, _accuracy, _completeness scene units
    incident_light_log_mae            mean |ln L − ln L_true| over points and directions of the true field
      _occluded, _scaled              over directions that hit the scene; after a factor per channel
    confidence_*_ratio                mean error of the half of the pixels with the smaller expected error,
                                      divided by that of the other half; base colour scaled
    baseline_*                        a naive baseline, on the same pixels
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from neilfpp_method.data.files.json_entry import write_json
from neilfpp_method.data.truth import Truth
from neilfpp_method.evaluate import metrics
from neilfpp_method.evaluate.map_metrics import (
    baseline_metrics,
    confidence_metrics,
    image_metrics,
    material_metrics,
    normal_metrics,
)
from neilfpp_method.evaluate.scene_metrics import chamfer_metrics, light_metrics
from neilfpp_method.evaluate.size import measured_views
from neilfpp_method.evaluate.views import RenderedView, known_test_views, mask_source, render_test_views
from neilfpp_method.health.cases import verdict_of
from neilfpp_method.hosts.base import HasSdf
from neilfpp_method.train.health_record import read_findings
from neilfpp_method.train.run import Run

__all__ = ["evaluate", "protocol", "write_metrics"]

RENDERING_SHARE = 0.9
"""Fraction of the progress that rendering the test views takes."""


def evaluate(
    run: Run,
    on_progress: Callable[[float], None] = lambda share: None,
    rendered: Sequence[RenderedView] | None = None,
) -> dict[str, float]:
    """Compute all figures for which the capture has the truth.

    Args:
        run: the trained run.
        on_progress: called with the fraction of the work that is done.
        rendered: the test views of the run, in order; if None, they are rendered here.

    Returns:
        The figures by name (see the table of this module).

    Raises:
        UserError: no view is held out, a file of the truth is damaged, or the run has no surface to compare.

    Example::

        run = load_run(Path("runs/teapot"), "cpu")
        write_metrics(run.path / "metrics.json", run, evaluate(run))
    """
    rendered = rendered or render_test_views(run, lambda share: on_progress(RENDERING_SHARE * share))
    known = known_test_views(run, rendered)
    pairs = [(r, k) for r, k in zip(rendered, known.views, strict=True) if k.mask.any()]
    figures = image_metrics(run, pairs) | material_metrics(run, pairs) | normal_metrics(pairs)
    figures |= confidence_metrics(run, pairs) | baseline_metrics(run.capture, pairs)
    truth = Truth(run.capture)
    mesh, light = truth.mesh(), truth.light_field()
    if mesh is not None and isinstance(run.model.host, HasSdf):
        figures |= chamfer_metrics(run, mesh)
    if light is not None and run.has_material:
        figures |= light_metrics(run, light, mesh)
    on_progress(1.0)
    return figures


def protocol(run: Run) -> dict[str, str]:
    """Describe how the figures of a run are measured: the source of the masks, averages, peak, log floor."""
    return {
        "mask_source": mask_source(run.capture),
        "average": "per view over its masked pixels, then over the test views",
        "peak": "1",
        "light_log_floor": f"{metrics.LOG_FLOOR:g}",
    }


def write_metrics(path: Path, run: Run, figures: Mapping[str, float]) -> None:
    """Write the figures and the verdict on the run's health as a flat JSON object.

    `<stem>-protocol.json` beside it describes how the figures are measured, and on which views.
    """
    findings = read_findings(run.path)
    health = {} if findings is None else {"health": verdict_of(findings)}
    write_json(path, {**figures, **health})
    described = {**protocol(run), "measured": measured_views(run)}
    write_json(path.with_name(f"{path.stem}-protocol.json"), described)
