"""What the method recovers on captures whose truth is known: the tables of docs/results.md.

    python -m benchmarks.results DATA/tabletop_env DATA/tabletop_mix --out runs/results
    python -m benchmarks.results DATA/tabletop_env DATA/tabletop_mix --out runs/results-mesh \
        --host mesh --compare ladder

For each capture the preset is trained, and the paper's free light field with and without L_ref (the paper's
Table 2); with `--compare ladder` also every light with every inter-reflection that it allows. Each is
measured after material init (the paper's "Sep.") and after the joint stage (Table 3), and compared with
baselines that need no method. The runs share SDF init, in which they do not differ; a step depends only on
its seed and number, so sharing changes no result. With `--host mesh` the geometry is given and there is no
joint stage. `--save NAME` writes the figures of docs/results.md.
"""

from __future__ import annotations

import dataclasses
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from rich.console import Console
from torch import Tensor

from benchmarks.command import run_benchmark
from benchmarks.measure import hardware, revision
from benchmarks.tables import COLUMNS, RESULTS, Result, Row, markdown, write_result
from neilfpp_method.data.files.json_entry import write_json
from neilfpp_method.effects.request import EffectRequest
from neilfpp_method.evaluate.protocols import evaluate
from neilfpp_method.report.write import REPORT, write_report
from neilfpp_method.schedule import Stage, stage_steps
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.presets import fixed_geometry, free_light, preset
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.train.build import build_model
from neilfpp_method.train.checkpoint import checkpoint_path, last_checkpoint, load_checkpoint, save_checkpoint
from neilfpp_method.train.command import run_training
from neilfpp_method.train.json_files import read_json
from neilfpp_method.train.optimizer import Stream, make_optimizer, seed_stream
from neilfpp_method.train.request import TrainingRequest
from neilfpp_method.train.run import create_run, load_run, read_description

STAGES = {"material_init": "material stage", "joint": "joint stage"}
TABLES = {"volsdf": "found-geometry", "mesh": "given-geometry"}
"""Table of docs/results.md for each host."""


@dataclass
class Options:
    """Train and measure on captures whose truth is known."""

    captures: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of captures."""
    out: Path = Path("runs/results")
    """Folder for the runs and results.json."""
    save: str | None = None
    """Name of the result file in benchmarks/results, for the tables of docs/results.md; default: the figures
    are only written to --out.
    """
    preset: str = "fast"
    """Preset of the settings."""
    host: Literal["volsdf", "mesh"] = "volsdf"
    """Geometry is recovered (volsdf), or given (mesh)."""
    compare: Literal["preset", "paper", "ladder"] = "paper"
    """preset: nothing else, with effects by evidence as in `neilfpp train`. paper: the free light field with
    and without L_ref. ladder: every light with every inter-reflection that goes with it.
    """
    material_steps: int | None = None
    """Number of steps of material init; default: that of the preset."""
    device: str = "auto"
    """Device to train on."""


def variants(config: NeilfConfig, which: str) -> dict[str, NeilfConfig]:
    """The compared settings by name; the first is the unchanged preset."""
    if which == "preset":
        return {"preset": config}
    free = free_light(config)
    compared = {
        "preset": config,
        "free light, with L_ref": free,
        "free light, without L_ref": changed(free, {"light.inter_reflection": "off"}),
    }
    if which == "ladder":
        compared["free light, hard"] = changed(free, {"light.inter_reflection": "hard"})
        for kind, name in (("distant", "map"), ("distant_near", "map and lamps")):
            compared |= {
                f"{name}, {mode}": changed(config, {"light": {"kind": kind, "inter_reflection": mode}})
                for mode in ("hard", "off")
            }
    return compared


def train(
    capture: Path,
    out: Path,
    config: NeilfConfig,
    device: str,
    effects: EffectRequest,
    start_from: Path | None = None,
) -> None:
    """Train a run from scratch or from the end of another run's SDF init; an existing run is continued."""
    if start_from is not None and not out.exists():
        branch(start_from, out, config)
    request = TrainingRequest(
        data=capture,
        out=out,
        config=config,
        resume=out.exists(),
        effects=None if out.exists() else effects,
        device=device,
    )
    run_training(request, Console())


def branch(trunk: Path, out: Path, config: NeilfConfig) -> None:
    """Create a run at the end of SDF init with the host of the trunk, and an untrained material and light."""
    described = read_description(trunk)
    saved = load_checkpoint(checkpoint_path(trunk, "sdf_init"))
    seed_stream(config.train.seed, Stream.WEIGHTS)
    model = build_model(described.source.load(), described.facts, config)
    own = model.state_dict()
    shared = {
        key: value
        for key, value in saved["model"].items()
        if key.startswith("host.") and is_like(value, own[key])
    }
    model.load_state_dict(own | shared)
    optimizer = make_optimizer(model, config.optimizer)
    # So far only the host is trained: the optimizer has only its moments, and its parameters come
    # first.
    optimizer.load_state_dict(optimizer.state_dict() | {"state": saved["optimizer"]["state"]})
    create_run(out, config, described.source, described.facts)
    save_checkpoint(last_checkpoint(out), model, model.light_solver(), optimizer, saved["step"])
    write_json(out / "timing.json", {"sdf_init": read_json(trunk / "timing.json")["sdf_init"]})


def is_like(value: object, other: object) -> bool:
    """Whether both are tensors of the same shape."""
    return isinstance(value, Tensor) and isinstance(other, Tensor) and value.shape == other.shape


def measure(out: Path, config: NeilfConfig) -> dict[str, dict[str, float]]:
    """The figures of a run after each of its stages with a material."""
    figures = {}
    steps = stage_steps(config.train)
    for stage in STAGES:
        if not steps[Stage(stage)]:
            continue
        path = out / f"metrics-{stage}.json"
        if not path.exists():
            write_json(path, evaluate(load_run(out, checkpoint=stage)))
        figures[stage] = read_json(path)
    return figures


def main(options: Options) -> None:
    """Train, measure, and write the result file."""
    # The point clouds of captures with known truth lie on the true surface, which must be recovered.
    config = changed(preset(options.preset), {"host.loss.point_cloud": 0.0})
    config = fixed_geometry(config) if options.host == "mesh" else config
    if options.material_steps is not None:
        config = dataclasses.replace(
            config, train=dataclasses.replace(config.train, material_steps=options.material_steps)
        )
    # Compared variants must simulate the same effects.
    effects = "auto" if options.compare == "preset" else "as-set"
    rows: list[Row] = []
    for capture in options.captures:
        base = options.out / capture.name
        compared = variants(config, options.compare)
        for name, settings in compared.items():
            run = (
                base
                if settings is config
                else options.out / f"{capture.name}-{name.replace(', ', '-').replace(' ', '-')}"
            )
            shares_trunk = run != base and config.train.sdf_steps > 0
            trunk = base if shares_trunk else None
            train(capture, run, settings, options.device, EffectRequest(effects), trunk)
            figures = measure(run, config)
            final = list(figures.values())[-1]
            if settings is config:
                baseline = {key: final[f"baseline_{key}"] for key in COLUMNS if f"baseline_{key}" in final}
                rows.append(Row("naive baseline", baseline, capture.name))
            seconds = read_json(run / "timing.json")
            rows += [
                Row(
                    f"{STAGES[stage]}, {name}",
                    {**values, "seconds": seconds_until(stage, seconds)},
                    capture.name,
                )
                for stage, values in figures.items()
            ]
            write_report(run, run / REPORT)
        # Written after every capture, so that figures are kept if a later capture fails.
        table = "light-ladder" if options.compare == "ladder" else TABLES[options.host]
        result = Result(
            table,
            revision(),
            f"python -m benchmarks.results {shlex.join(sys.argv[1:])}",
            hardware(),
            tuple(rows),
        )
        write_result(options.out / "results.json", result)
        if options.save is not None:
            write_result(RESULTS / f"{options.save}.json", result)
    Console().print(markdown([result]), markup=False, highlight=False, soft_wrap=True)


def seconds_until(stage: str, seconds: dict[str, float]) -> float:
    """Training time until the end of a stage, in seconds."""
    stages = list(seconds)
    return sum(seconds[name] for name in stages[: stages.index(stage) + 1])


if __name__ == "__main__":
    run_benchmark(lambda: main(tyro.cli(Options)))
