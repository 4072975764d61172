"""The comparison of runs with effects by evidence, with all, and with none."""

from __future__ import annotations

import json

from benchmarks import effects_compared
from neilfpp_method.demo.command import demo_scene


def test_a_capture_is_trained_once_with_each_request_on_its_mesh(tmp_path, monkeypatch):
    trained = []

    def train(capture, run, config, device, effects, start_from=None):
        trained.append((run.name, config.host.kind, str(effects)))
        run.mkdir(parents=True)
        (run / "timing.json").write_text(json.dumps({"sdf_init": 2.0, "material_init": 3.5}))

    monkeypatch.setattr(effects_compared, "train", train)
    monkeypatch.setattr(
        effects_compared, "measure", lambda run, config: {"material_init": {"pbr_psnr": 20.0}}
    )
    rows = effects_compared.rows_of(demo_scene(), tmp_path, "cpu")
    assert trained == [
        ("scene-auto", "mesh", "auto"),
        ("scene-all", "mesh", "all"),
        ("scene-none", "mesh", "none"),
    ]
    assert [row.name for row in rows] == ["`auto`", "`all`", "`none`"]
    assert rows[0].figures == {"pbr_psnr": 20.0, "seconds": 5.5}
