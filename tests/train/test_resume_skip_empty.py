"""Rays skip empty space by a grid of an earlier step: a continued run uses the same grid."""

from __future__ import annotations

import pytest

from neilfpp_method.errors import Stopped
from neilfpp_method.settings.plain import changed
from neilfpp_method.volume import empty_space
from tests.data.make_capture import make_capture
from tests.train.small_runs import differences, small_config
from tests.train.test_resume import interrupt_at, run, state


@pytest.mark.parametrize("asked", [1, 9])
def test_a_stop_does_not_change_the_result(tmp_path, monkeypatch, asked):
    monkeypatch.setattr(empty_space, "RESOLUTION", 16)
    config = changed(small_config(), {"host.volume.skip_empty": True})
    capture = make_capture(tmp_path / "sphere")
    run(capture, tmp_path / "whole", config)
    assert (state(tmp_path / "whole")["model"]["host.empty_space.slope"] > 1.0).all()
    with monkeypatch.context() as patch:
        interrupt_at(patch, asked)
        with pytest.raises(Stopped):
            run(capture, tmp_path / "stopped", config)
    run(None, tmp_path / "stopped", resume=True)
    assert differences(state(tmp_path / "stopped"), state(tmp_path / "whole")) == []
