"""The size at which views are rendered, and the announced time."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rich

from neilfpp_method.commands import command
from neilfpp_method.commands.command import duration, progress_bar
from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.scaling import PIXELS_OF_A_VIEW, at_scale
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate import metrics
from neilfpp_method.evaluate.size import at_size, describe_size
from neilfpp_method.evaluate.views import known_test_views, render_test_views
from neilfpp_method.train.run import Run
from tests.data.large_capture import make_large_capture
from tests.data.make_capture import make_capture
from tests.evaluate.test_protocols import make_run


def sizes(run: Run) -> set[tuple[int, int]]:
    return {(view.camera.width, view.camera.height) for view in run.capture.views}


def test_views_have_a_limited_size_unless_another_is_given(tmp_path: Path) -> None:
    run = make_run(load_capture(make_large_capture(tmp_path, views=3, size=(800, 600)), test_every=2))
    ((width, height),) = sizes(at_size(run))
    assert width * height == pytest.approx(PIXELS_OF_A_VIEW, rel=0.01)
    assert width / height == pytest.approx(4 / 3, abs=0.01)
    assert sizes(at_size(run, scale=1.0)) == {(800, 600)}
    assert sizes(at_size(run, width=100)) == {(100, 75)}
    told = describe_size(at_size(run, width=100))
    assert told == "views have 100×75 pixels, the files 800×600; --width or --scale changes the size"
    assert describe_size(run) is None
    with pytest.raises(UserError, match="both set the size"):
        at_size(run, scale=1.0, width=100)


def test_a_run_trained_at_a_small_size_keeps_that_size(tmp_path: Path) -> None:
    capture = at_scale(
        load_capture(make_large_capture(tmp_path, views=2, size=(800, 600)), test_every=2), 0.25
    )
    run = make_run(capture)
    assert sizes(at_size(run)) == {(200, 150)}
    assert sizes(at_size(run, scale=0.5)) == {(400, 300)}


def test_a_perfect_estimate_is_perfect_at_half_the_size(tmp_path: Path) -> None:
    """Maps of the sphere from which the images were made, compared with averaged images and masks."""
    root = make_capture(tmp_path, size=(160, 120), views=4, test=(0, 2), masks=True)
    run = at_size(make_run(load_capture(root)), scale=0.5)
    shares: list[float] = []
    rendered = render_test_views(run, shares.append)
    assert shares == sorted(shares)
    assert shares[0] == pytest.approx(1 / 6)  # two views of three parts each: 4800 rays by EVAL_RAYS
    assert shares[-1] == 1.0
    for view, known in zip(rendered, known_test_views(run, rendered).views, strict=True):
        assert view.maps["rgb"].shape == known.image.shape == (60, 80, 3)
        assert 0.2 < known.mask.mean() < 0.6
        assert metrics.psnr(view.maps["rgb"], known.image, known.mask) > 40
        assert np.abs(view.maps["depth"][..., 0] > 0)[known.mask].all()


def test_the_time_of_the_work_is_estimated_without_its_start(monkeypatch, capsys) -> None:
    # Loading takes until 150, and 1 % of the work takes 2 seconds from then on.
    times = iter([100.0, 150.0, 151.0, 152.0, 153.0])
    monkeypatch.setattr(
        command, "time", SimpleNamespace(monotonic=lambda: next(times))
    )  # rich's threads read the clock, too
    monkeypatch.setattr(rich, "_console", None)  # the console that others share may write elsewhere
    with progress_bar("evaluating") as advance:
        for done in (0.01, 0.015, 0.02, 0.025):
            advance(done)
    # 52 s have passed, and 98 % are left.
    assert capsys.readouterr().out.count(f"evaluating takes about {duration(52 + 0.98 * 200)}") == 1


def test_work_that_fails_leaves_no_bar_behind(monkeypatch, capsys) -> None:
    monkeypatch.setattr(rich, "_console", None)
    with pytest.raises(UserError), progress_bar("evaluating"):
        raise UserError("no such map", "check the path")
    assert capsys.readouterr().out == ""


def test_durations_are_rounded() -> None:
    assert [duration(s) for s in (42.4, 200.0, 9000.0)] == ["42 s", "3 min", "2.5 h"]
