"""What the method recovers on captures whose truth is known: the tables of docs/results.md.

    python -m benchmarks.results DATA/tabletop_env DATA/tabletop_mix --out runs/results

For each capture: the preset trained from scratch, with and without L_ref (the paper's Table 2), each measured after the
material stage ("Sep.") and after the joint stage (Table 3), beside baselines that need no method. The two runs share
the stage SDF init, which L_ref does not enter; every step depends on seed and number alone, so sharing changes nothing.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console

from neilfpp_method.config import NeilfConfig
from neilfpp_method.evaluate.protocols import evaluate
from neilfpp_method.evaluate.report import write_report
from neilfpp_method.presets import preset
from neilfpp_method.train.command import run_training
from neilfpp_method.train.run import load_run, read_json, write_json

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
    device: str = "auto"
    """Where to train."""


def without_inter_reflection(config: NeilfConfig) -> NeilfConfig:
    """The same settings with L_ref off."""
    off = dataclasses.replace(config.inter_reflection, mode="off")
    return dataclasses.replace(config, inter_reflection=off)


def train(capture: Path, out: Path, config: NeilfConfig, device: str, start_from: Path | None = None) -> None:
    """A run from scratch, or from the end of another run's SDF init. A run that is there is continued."""
    resume = out.exists()
    if start_from is not None and not resume:
        shutil.copytree(start_from, out, ignore=shutil.ignore_patterns("tensorboard", "*.html", "*.png", "*.ply"))
        checkpoints = out / "checkpoints"
        shutil.copyfile(checkpoints / "sdf_init.pt", checkpoints / "last.pt")
        for stage in STAGES:
            (checkpoints / f"{stage}.pt").unlink(missing_ok=True)
        stored = read_json(out / "config.json")
        write_json(out / "config.json", {**stored, "config": dataclasses.asdict(config)})
        write_json(out / "timing.json", {"sdf_init": read_json(out / "timing.json")["sdf_init"]})
        resume = True
    run_training(
        data=capture,
        out=out,
        config=config,
        resume=resume,
        test_every=None,
        response="auto",
        device=device,
        devices=1,
        console=Console(),
    )


def measure(out: Path) -> dict[str, dict[str, float]]:
    """The figures of a run after each of its stages with a material."""
    figures = {}
    for stage, name in STAGES.items():
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
    sections = []
    for capture in options.captures:
        base = options.out / capture.name
        bare = options.out / f"{capture.name}-without-ref"
        train(capture, base, config, options.device)
        train(capture, bare, without_inter_reflection(config), options.device, start_from=base)
        with_ref, without = measure(base), measure(bare)
        final = with_ref["joint"]
        baseline = {key: final[f"baseline_{key}"] for key in COLUMNS if f"baseline_{key}" in final}
        rows = {"naive baseline": baseline}
        rows |= {f"{name}, without L_ref": figures for name, figures in without.items()}
        rows |= {f"{name}, with L_ref": figures for name, figures in with_ref.items()}
        seconds = {name: read_json(path / "timing.json") for name, path in (("with", base), ("without", bare))}
        write_report(load_run(base), base, final, seconds["with"])
        times = "; ".join(
            f"{name} L_ref " + ", ".join(f"{stage} {value:.0f} s" for stage, value in stages.items())
            for name, stages in seconds.items()
        )
        hardware = read_json(base / "environment.json")
        machine = f"{hardware['processor']}, {hardware['threads']} threads; GPUs: {', '.join(hardware['gpus']) or 'none'}"
        sections.append(f"### {capture.name}\n\n{table(rows)}\n\nTraining time: {times}. {machine}.\n")
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "tables.md").write_text("\n".join(sections))
    Console().print("\n".join(sections), markup=False, highlight=False)
    Console().print(json.dumps({"tables": str(options.out / "tables.md")}), markup=False)


if __name__ == "__main__":
    main(tyro.cli(Options))
