"""Conditions of the findings, and the verdict that follows from them."""

from __future__ import annotations

import pytest

from neilfpp_method.health.cases import (
    MAX_AT_BOUND,
    MIN_PARKED,
    Health,
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


@pytest.mark.parametrize(("width", "found"), [(None, "fog"), (0.01, "fog"), (0.06, "beta_stuck")])
def test_fog_is_reported_once_and_blames_a_width_with_which_no_surface_is_sharp(width, found):
    assert cases(surface_findings(SurfaceMeasurement(100, 1.0, 0.1, None, width=width), 7)) == [found]
    assert cases(surface_findings(SurfaceMeasurement(100, 1.0, 0.9, None, width=width), 7)) == []


@pytest.mark.parametrize(
    ("share", "severe"),
    [(None, []), (0.1, []), (MAX_AT_BOUND + 0.01, [False]), (MIN_PARKED - 0.01, [False]), (0.97, [True])],
)
def test_a_base_color_at_its_bounds_is_a_finding(share, severe):
    findings = material_findings(SurfaceMeasurement(100, 1.0, 1.0, share), 7)
    assert cases(findings) == ["material_at_bounds"] * len(severe)
    assert [finding.severe for finding in findings] == severe


@pytest.mark.parametrize(
    ("parked", "found"),
    [
        ({"roughness 0": 0.9, "roughness 1": 0.05, "metallic 1": 0.9}, []),
        ({"roughness 0": 0.97, "roughness 1": 0.0}, ["roughness_at_bound"]),
        ({"roughness 1": 0.97, "metallic 1": 0.96}, ["roughness_at_bound", "metallic_at_bound"]),
    ],
)
def test_a_parameter_that_is_at_a_bound_nearly_everywhere_is_a_finding(parked, found):
    findings = material_findings(SurfaceMeasurement(100, 1.0, 1.0, 0.0, parked=parked), 7)
    assert cases(findings) == found
    assert verdict_of(findings) == ("doubtful" if found else "sound")


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
    assert Health.of(doubt).failure is None
    assert Health.of(doubt + fog).failure == fog[0]
