"""The record of the time of a run by stage and kind of work is complete."""

from __future__ import annotations

import time

import pytest
from rich.console import Console

from neilfpp_method.data.files.json_entry import write_json
from neilfpp_method.errors import Stopped, UserError
from neilfpp_method.timing.ledger import WORK
from neilfpp_method.train.command import run_training
from neilfpp_method.train.request import TrainingRequest
from neilfpp_method.train.work_record import FILE, read_work
from tests.data.make_capture import make_capture
from tests.train.small_runs import small_config, solved_light
from tests.train.test_resume import interrupt_at


def test_the_seconds_of_a_stopped_run_add_up_to_the_clock(tmp_path, monkeypatch):
    capture, out = make_capture(tmp_path / "sphere"), tmp_path / "run"
    config, console = solved_light(small_config()), Console(quiet=True)
    taken = 0.0
    with monkeypatch.context() as patch:
        interrupt_at(patch, 6)
        began = time.perf_counter()
        with pytest.raises(Stopped):
            run_training(TrainingRequest(capture, out, config, device="cpu"), console)
        taken += time.perf_counter() - began
    before = read_work(out)
    began = time.perf_counter()
    run_training(TrainingRequest(out=out, resume=True, device="cpu"), console)
    taken += time.perf_counter() - began

    work = read_work(out)
    assert list(work) == ["preparation", "sdf_init", "material_init", "joint"]
    assert sum(sum(parts.values()) for parts in work.values()) == pytest.approx(taken, rel=0.02)
    assert work["sdf_init"] == before["sdf_init"]  # finished before the stop
    assert work["material_init"]["shading"] > before["material_init"]["shading"]
    told = {kind for parts in work.values() for kind in parts}
    assert told == set(WORK)
    assert "tracing" not in work["sdf_init"]
    assert "light_fits" in work["material_init"]


@pytest.mark.parametrize(
    "damage",
    [
        {"format": 9},
        {"format": 1},
        {"format": 1, "seconds": {"joint": {"tea": 1.0}}},
        {"format": 1, "seconds": {"joint": {"rendering": 10**400}}},
    ],
    ids=["format", "none", "kind", "longer than a float"],
)
def test_a_damaged_record_is_named(tmp_path, damage):
    assert read_work(tmp_path) == {}
    write_json(tmp_path / FILE, damage)
    with pytest.raises(UserError, match=r"work\.json"):
        read_work(tmp_path)


def test_deeply_nested_json_is_refused(tmp_path):
    (tmp_path / FILE).write_text("[" * 100_000)
    with pytest.raises(UserError, match="not readable as JSON"):
        read_work(tmp_path)
