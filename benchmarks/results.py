"""What the method recovers on captures whose truth is known: the tables of docs/results.md.

    python -m benchmarks.results DATA/tabletop_env DATA/tabletop_mix --out runs/results
    python -m benchmarks.results DATA/tabletop_env DATA/tabletop_mix --out runs/results-mesh --host mesh --compare ladder

For each capture: the preset trained from scratch, beside it the paper's free light field with and without L_ref (the paper's
Table 2), with `--compare ladder` every light with every inter-reflection that goes with it; each measured after the material
stage ("Sep.") and after the joint stage (Table 3), beside baselines that need no method. The runs share the stage SDF init,
which none of this enters; every step depends on seed and number alone, so sharing changes nothing. With the mesh host
geometry is given, and there is one stage.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from rich.console import Console
from torch import Tensor

from neilfpp_method.evaluate.protocols import evaluate
from neilfpp_method.evaluate.report import write_report
from neilfpp_method.schedule import Stage, stage_steps
from neilfpp_method.settings.presets import fixed_geometry, free_light, preset
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.train.build import build_model
from neilfpp_method.train.command import run_training
from neilfpp_method.train.loop import make_optimizer, seed_step
from neilfpp_method.train.run import (
    create_run,
    load_checkpoint,
    load_run,
    read_description,
    read_json,
    save_checkpoint,
    write_json,
)

COLUMNS = {
    "volume_psnr": "R",
    "pbr_psnr": "PBR",
    "base_color_psnr": "base colour",
    "base_color_psnr_gamma": "… one gamma",
    "base_color_psnr_scaled": "… scaled",
    "roughness_psnr": "roughness",
    "metallic_psnr": "metallic",
    "normal_mae_deg": "normals °",
    "chamfer": "Chamfer",
    "incident_light_log_mae": "light",
    "incident_light_log_mae_occluded": "… occluded",
}
STAGES = {"material_init": "Sep.", "joint": "joint"}


@dataclass
class Options:
    """Train and measure on captures whose truth is known."""

    captures: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of captures."""
    out: Path = Path("runs/results")
    """Where the runs and the tables go."""
    preset: str = "fast"
    """Which settings."""
    host: Literal["volsdf", "mesh"] = "volsdf"
    """Geometry to be found, or given as a mesh."""
    compare: Literal["preset", "paper", "ladder"] = "paper"
    """preset: nothing else. paper: the free light field with and without L_ref. ladder: every light with every
    inter-reflection that goes with it."""
    material_steps: int | None = None
    """Steps of the stage material init; none: the preset's."""
    device: str = "auto"
    """Where to train."""


def variants(config: NeilfConfig, which: str) -> dict[str, NeilfConfig]:
    """What is compared; the first is the preset as it is."""
    if which == "preset":
        return {"preset": config}
    free = free_light(config)
    compared = {
        "preset": config,
        "free light, with L_ref": free,
        "free light, without L_ref": changed(free, "inter_reflection", mode="off"),
    }
    if which == "ladder":
        compared["free light, hard"] = changed(free, "inter_reflection", mode="hard")
        for kind, name in (("distant", "map"), ("distant_near", "map and lamps")):
            light = changed(config, "light", kind=kind)
            compared |= {f"{name}, {mode}": changed(light, "inter_reflection", mode=mode) for mode in ("hard", "off")}
    return compared


def changed(config: NeilfConfig, room: str, **settings: object) -> NeilfConfig:
    """The same settings but for these of a room."""
    return dataclasses.replace(config, **{room: dataclasses.replace(getattr(config, room), **settings)})


def train(capture: Path, out: Path, config: NeilfConfig, device: str, start_from: Path | None = None) -> None:
    """A run from scratch, or from the end of another run's SDF init. A run that is there is continued."""
    if start_from is not None and not out.exists():
        branch(start_from, out, config)
    run_training(
        data=capture,
        out=out,
        config=config,
        resume=out.exists(),
        test_every=None,
        response="auto",
        device=device,
        devices=1,
        console=Console(),
    )


def branch(trunk: Path, out: Path, config: NeilfConfig) -> None:
    """A run that stands at the end of SDF init, with the host of the trunk and a material and a light that have not moved."""
    described = read_description(trunk)
    saved = load_checkpoint(trunk / "checkpoints" / "sdf_init.pt")
    seed_step(config.train.seed, step=-1)
    model = build_model(described.source.load(), described.facts, config)
    own = model.state_dict()
    shared = {key: value for key, value in saved["model"].items() if key.startswith("host.") and is_like(value, own[key])}
    model.load_state_dict(own | shared)
    optimizer = make_optimizer(model, config.optimizer)
    # So far only the host has moved: its moments are all that the optimiser knows, and its parameters come first.
    optimizer.load_state_dict(optimizer.state_dict() | {"state": saved["optimizer"]["state"]})
    create_run(out, config, described.source, described.facts)
    save_checkpoint(out / "checkpoints" / "last.pt", model, model.light_solver(), optimizer, saved["step"])
    write_json(out / "timing.json", {"sdf_init": read_json(trunk / "timing.json")["sdf_init"]})


def is_like(value: object, other: object) -> bool:
    """Whether both are tensors of one shape."""
    return isinstance(value, Tensor) and isinstance(other, Tensor) and value.shape == other.shape


def measure(out: Path, config: NeilfConfig) -> dict[str, dict[str, float]]:
    """The figures of a run after each of its stages with a material."""
    figures = {}
    steps = stage_steps(config.train)
    for stage, name in STAGES.items():
        if not steps[Stage(stage)]:
            continue
        path = out / f"metrics-{stage}.json"
        if not path.exists():
            write_json(path, evaluate(load_run(out, checkpoint=stage)))
        figures[name] = read_json(path)
    return figures


def table(rows: dict[str, dict[str, float]]) -> str:
    """A Markdown table; a dash where a figure does not exist."""
    lines = ["| | " + " | ".join(COLUMNS.values()) + " |", "|---" * (len(COLUMNS) + 1) + "|"]
    for name, figures in rows.items():
        cells = [_cell(name, figures.get(key)) for key, name in COLUMNS.items()]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _cell(column: str, value: float | None) -> str:
    if value is None:
        return "–"
    return f"{value:.4f}" if column == "Chamfer" else f"{value:.2f}"


def main(options: Options) -> None:
    """Train, measure, and write `tables.md`."""
    config = preset(options.preset)
    config = fixed_geometry(config) if options.host == "mesh" else config
    if options.material_steps is not None:
        config = dataclasses.replace(config, train=dataclasses.replace(config.train, material_steps=options.material_steps))
    sections = []
    for capture in options.captures:
        rows: dict[str, dict[str, float]] = {}
        times = []
        base = options.out / capture.name
        for name, settings in variants(config, options.compare).items():
            run = base if settings is config else options.out / f"{capture.name}-{name.replace(', ', '-').replace(' ', '-')}"
            shares_trunk = run != base and config.train.sdf_steps > 0
            train(capture, run, settings, options.device, start_from=base if shares_trunk else None)
            figures = measure(run, config)
            final = list(figures.values())[-1]
            if not rows:
                rows["naive baseline"] = {k: final[f"baseline_{k}"] for k in COLUMNS if f"baseline_{k}" in final}
            rows |= {f"{stage}, {name}": values for stage, values in figures.items()}
            seconds = read_json(run / "timing.json")
            write_report(load_run(run), run, final, seconds)
            times.append(f"{name}: " + ", ".join(f"{stage} {value:.0f} s" for stage, value in seconds.items()))
        hardware = read_json(base / "environment.json")
        machine = f"{hardware['processor']}, {hardware['threads']} threads, GPU {', '.join(hardware['gpus']) or 'none'}"
        sections.append(f"### {capture.name}\n\n{table(rows)}\n\nTraining time: {'; '.join(times)}. {machine}.\n")
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "tables.md").write_text("\n".join(sections))
    Console().print("\n".join(sections), markup=False, highlight=False)
    Console().print(json.dumps({"tables": str(options.out / "tables.md")}), markup=False)


if __name__ == "__main__":
    main(tyro.cli(Options))
