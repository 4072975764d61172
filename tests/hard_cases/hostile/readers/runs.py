"""Settings, and the files of a run folder."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
import trimesh
import yaml

from neilfpp_method.errors import UserError
from neilfpp_method.export.surface_cache import ExtractedSurface, read_surface, write_surface
from neilfpp_method.settings.files import read_settings
from neilfpp_method.settings.plain import changed, to_dict
from neilfpp_method.settings.presets import preset
from neilfpp_method.train.checkpoint import FORMAT, load_checkpoint, load_weights, save_checkpoint
from neilfpp_method.train.effects_record import read_plan
from neilfpp_method.train.health_record import read_findings
from neilfpp_method.train.light_record import read_fits
from neilfpp_method.train.run import read_description
from neilfpp_method.train.work_record import read_work
from tests.hard_cases.hostile.readers.reader import Reader

__all__ = ["RUNS"]


def _yaml(folder: Path) -> list[Path]:
    (folder / "all.yaml").write_text(yaml.safe_dump(to_dict(preset("fast"))))
    (folder / "some.yaml").write_text("train: {rays: 512, sdf_steps: 100}\nloss.volume: 1.0 # a comment\n")
    (folder / "tags.yaml").write_text(
        'train: {rays: !!int "512"}\nhost.loss: {mask: &a !!float 5e-4, hessian: *a}\n'
    )
    (folder / "all.json").write_text(json.dumps({"format": FORMAT, "config": to_dict(preset("paper-ngp"))}))
    return sorted(folder.iterdir())


def _read_yaml(folder: Path, damaged: Path) -> None:
    changed(preset("fast"), read_settings(damaged), str(damaged))


class _Small(torch.nn.Linear):
    def __init__(self) -> None:
        super().__init__(3, 4)
        self.register_buffer("mask", torch.ones(4, dtype=torch.bool))


def _checkpoint(folder: Path) -> list[Path]:
    torch.manual_seed(0)
    model, solver = _Small(), _Small()
    optimizer = torch.optim.Adam(model.parameters())
    model(torch.ones(2, 3)).sum().backward()
    optimizer.step()
    save_checkpoint(folder / "last.pt", model, solver, optimizer, 7)
    return [folder / "last.pt"]


def _read_checkpoint(folder: Path, damaged: Path) -> None:
    saved = load_checkpoint(damaged)
    whole = _Small()
    load_weights(whole, saved["model"], folder)
    load_weights(_Small(), saved["light_solver"], folder)
    assert isinstance(saved["step"], int)


RUN_FILES = (
    "config.json",
    "capture.json",
    "scene.json",
    "effects.json",
    "light.json",
    "health.json",
    "work.json",
)


def _run(folder: Path) -> list[Path]:
    contents = {
        "config.json": {"format": FORMAT, "config": to_dict(preset("fast"))},
        "capture.json": {
            "root": "captures/a",
            "test_every": 8,
            "response": "auto",
            "format": None,
            "scale": 1.0,
        },
        "scene.json": {
            "response": "linear",
            "median_radiance": 0.2,
            "radiance_scale": 3.0,
            "background": "constant",
            "background_color": [0.0, 0.1, 0.2],
        },
        "effects.json": {
            "format": 1,
            "request": "auto,-lamps",
            "effects": [],
            "decisions": [
                {
                    "step": 4,
                    "effect": "inter-reflection",
                    "on": True,
                    "by": "evidence",
                    "reason": "why",
                    "evidence": {
                        "what": "hits",
                        "value": 0.1,
                        "deviation": 0.01,
                        "threshold": 0.05,
                        "samples": 100,
                    },
                }
            ],
        },
        "light.json": {
            "format": 1,
            "fits": [{"step": 3, "gain": 0.1, "deviation": 0.01, "points": 99, "lamps": 1}],
        },
        "health.json": {
            "format": 1,
            "verdict": "doubtful",
            "findings": [
                {
                    "case": "fog",
                    "step": 4,
                    "what": "w",
                    "cause": "c",
                    "remedy": "r",
                    "severe": False,
                }
            ],
        },
        "work.json": {"format": 1, "seconds": {"joint": {"rendering": 1.5, "data": 0.2}}},
    }
    for name, content in contents.items():
        (folder / name).write_text(json.dumps(content))
    return [folder / name for name in RUN_FILES]


def _read_run(folder: Path, damaged: Path) -> None:
    config = read_description(folder).config
    read_plan(folder, config)
    fits = read_fits(folder, before=10)
    assert all(dataclasses.is_dataclass(fit) for fit in fits)
    read_findings(folder)
    read_work(folder)


def _surface(folder: Path) -> list[Path]:
    ball = trimesh.creation.icosphere(subdivisions=1)
    vertices, faces = ball.vertices.astype(np.float32), ball.faces.astype(np.int32)
    for name, normals in (("plain", None), ("shaded", vertices)):
        write_surface(folder / f"{name}.npz", ExtractedSurface(vertices, faces, normals), "weights")
    return sorted(folder.iterdir())


def _read_surface(folder: Path, damaged: Path) -> None:
    said: list[str] = []
    surface = read_surface(damaged, "weights", said.append)
    if surface is None:
        raise UserError(*said, "extract it again")
    assert np.isfinite(surface.vertices).all()
    assert surface.faces.min() >= 0
    assert surface.faces.max() < len(surface.vertices)


RUNS: Mapping[str, Reader] = {
    "settings (YAML, JSON)": Reader(_yaml, _read_yaml),
    "checkpoint": Reader(_checkpoint, _read_checkpoint),
    "run folder (JSON)": Reader(_run, _read_run),
    "surface in a run folder (NPZ)": Reader(_surface, _read_surface),
}
