"""The denoiser, if it is installed."""

from __future__ import annotations

import dataclasses

import pytest

from neilfpp_method.errors import UserError
from neilfpp_method.relight.denoise import check_denoiser, denoised
from neilfpp_method.relight.film import Budget, render_picture
from neilfpp_method.relight.path_tracer import Scene
from tests.relight.test_film import camera
from tests.relight.test_path_tracer import EVEN, ball, made_of


def test_noise_is_reduced_and_the_mean_is_kept():
    pytest.importorskip("pyoidn")
    close = dataclasses.replace(camera(64, 48), fx=200.0, fy=200.0)
    picture = render_picture(Scene(ball(), made_of(0.6), None, EVEN), close, Budget(2), bounces=1)
    covered = picture.alpha[..., 0] == 1
    assert covered.all()
    clean = denoised(picture)
    before, after = (p.radiance[covered] - 0.6 for p in (picture, clean))
    assert after.square().mean() < 0.2 * before.square().mean()
    assert after.mean().item() == pytest.approx(before.mean().item(), abs=0.02)
    assert (clean.alpha == picture.alpha).all()


def test_without_a_denoiser_the_error_names_the_package(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyoidn", None)
    with pytest.raises(UserError, match=r"neilfpp-method\[denoise\]"):
        check_denoiser()
