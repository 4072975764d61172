"""Conditions of the findings, and the verdict that follows from them."""

from __future__ import annotations

import pytest

from neilfpp_method.health.cases import (
    few_light_points,
    material_findings,
    nothing_shaded,
    skipped_steps,
    surface_findings,
    verdict_of,
)
from neilfpp_method.health.measure import SurfaceMeasurement


def cases(findings) -> list[str]:
    return [finding.case for finding in findings]


@pytest.mark.parametrize(
    ("opaque", "sharp", "found"),
    [
        (0.9, 0.95, []),
        (0.9, 0.1, ["fog"]),
        (0.01, 0.0, ["no_surface"]),
        (0.01, 1.0, ["no_surface"]),
        (0.3, 0.6, []),
    ],
)
def test_a_missing_or_blurred_surface_is_a_finding(opaque, sharp, found):
    assert cases(surface_findings(SurfaceMeasurement(100, opaque, sharp, None), 7)) == found


@pytest.mark.parametrize(("off", "found"), [(None, []), (0.05, []), (0.5, ["off_point_cloud"])])
def test_a_surface_far_from_its_point_cloud_is_a_finding(off, found):
    assert cases(surface_findings(SurfaceMeasurement(100, 1.0, 1.0, None, off), 7)) == found


@pytest.mark.parametrize(("share", "found"), [(None, []), (0.1, []), (0.4, ["material_at_bounds"])])
def test_a_material_at_its_bounds_is_a_finding(share, found):
    assert cases(material_findings(SurfaceMeasurement(100, 1.0, 1.0, share), 7)) == found


@pytest.mark.parametrize(
    ("function", "good", "bad", "case"),
    [
        (nothing_shaded, 10, 60, "nothing_shaded"),
        (few_light_points, 1024, 40, "few_light_points"),
        (skipped_steps, 3, 20, "skipped_steps"),
    ],
)
def test_a_count_beyond_its_limit_is_a_finding(function, good, bad, case):
    assert function(good, 100) == []
    (finding,) = function(bad, 100)
    assert finding.case == case
    assert finding.line().startswith("step 100: ")
    assert finding.remedy


def test_the_verdict_is_the_worst_finding():
    fog = surface_findings(SurfaceMeasurement(100, 1.0, 0.0, None), 1)
    doubt = few_light_points(3, 1)
    assert verdict_of([]) == "sound"
    assert verdict_of(doubt) == "doubtful"
    assert verdict_of(doubt + fog) == "failed"
