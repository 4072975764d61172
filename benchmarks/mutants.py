"""Faults planted one at a time in a copy of the package, and which quick test notices each.

    python -m benchmarks.mutants            plant all of them, and print the table
    python -m benchmarks.mutants --write    and write it into docs/stability.md
    python -m benchmarks.mutants --only V   those whose place has this word

Exit status 1 where a fault is not noticed, or a test fails without one. A fault is a change of one line;
the tests named beside it are run in a process that sees the changed copy alone, and stop at the first
failure.
"""

from __future__ import annotations

import importlib
import os
import re
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import tyro

__all__ = ["MUTANTS", "Mutant", "Verdict", "planted", "table", "try_all"]

ROOT = Path(__file__).parent.parent
DOCUMENT = ROOT / "docs" / "stability.md"
MARKED = re.compile(r"(<!-- mutants -->\n).*?(<!-- end -->)", re.DOTALL)
LOADED_BEFORE = (
    "pytest",
    "numpy",
    "scipy.spatial",
    "torch",
    "cv2",
    "pycolmap",
    "trimesh",
    "skimage",
    "OpenEXR",
    "lightning_fabric",
    "hypothesis",
)
"""What tests use of others, loaded once and shared by all processes."""
LONGEST = 300.0
"""Seconds of computing that the tests of one fault may take."""
LONGEST_BY_CLOCK = 3000
"""Seconds by the clock that they may take, if they wait without computing."""


@dataclass(frozen=True)
class Mutant:
    """A fault: in a module of the package `old`, which stands there once, becomes `new`.

    Attributes:
        what: the fault in a few words.
        module: path below the package.
        tests: path below `tests` of what should notice it.
    """

    what: str
    module: str
    old: str
    new: str
    tests: str


BRDF, SAMPLING = "shading/brdf.py", "shading/sampling.py"
MUTANTS: Sequence[Mutant] = (
    # Shading.
    Mutant(
        "diffuse part without 1/π",
        "shading/rendering_equation.py",
        " / math.pi * _integrate(",
        " * _integrate(",
        "shading/test_rendering_equation.py",
    ),
    Mutant(
        "light from below the horizon counts",
        "shading/rendering_equation.py",
        "dot(incident.wi, n).clamp_min(0) * incident.weight",
        "dot(incident.wi, n) * incident.weight",
        "shading/test_rendering_equation.py",
    ),
    Mutant("Fresnel's power is 4", BRDF, "(1 - cos.d).pow(5)", "(1 - cos.d).pow(4)", "shading/test_brdf.py"),
    Mutant(
        "Fresnel is not taken off the facing part",
        BRDF,
        "SpecularTerms(reflected - grazing, grazing)",
        "SpecularTerms(reflected, grazing)",
        "shading/test_brdf.py",
    ),
    Mutant(
        "metals keep their diffuse part",
        BRDF,
        "base_color * (1 - material.metallic) if specular",
        "base_color if specular",
        "shading/test_brdf.py",
    ),
    Mutant(
        "α is r, not r²",
        BRDF,
        "wide.clamp_min(roughness_floor(wide.dtype)).square()",
        "wide.clamp_min(roughness_floor(wide.dtype))",
        "shading/test_brdf.py",
    ),
    Mutant(
        "no floor of the roughness",
        BRDF,
        "wide.clamp_min(roughness_floor(wide.dtype)).square()",
        "wide.square()",
        "hard_cases/test_shading.py",
    ),
    Mutant(
        "GGX without correlation of masking",
        BRDF,
        "0.5 / (cos_o * masking(cos_i) + cos_i * masking(cos_o))",
        "0.5 / (cos_o * masking(cos_o) + cos_i * masking(cos_i))",
        "shading/test_brdf.py",
    ),
    Mutant(
        "half vector opposite to the light",
        BRDF,
        "((1 + dot(wi, wo)) / 2)",
        "((1 - dot(wi, wo)) / 2)",
        "shading/test_brdf.py",
    ),
    Mutant(
        "no half vector, no floor",
        BRDF,
        ".clamp(1e-8, 1).sqrt()",
        ".clamp(0, 1).sqrt()",
        "hard_cases/test_shading.py",
    ),
    Mutant(
        "sRGB's power is 1/2.2",
        "shading/color.py",
        ".pow(1 / 2.4) - 0.055",
        ".pow(1 / 2.2) - 0.055",
        "shading/test_color.py",
    ),
    Mutant(
        "left-handed frame",
        "shading/frame.py",
        "torch.stack((tangent, bitangent, n), -2)",
        "torch.stack((bitangent, tangent, n), -2)",
        "shading/test_frame.py",
    ),
    Mutant(
        "normals of no length divide by 0",
        "shading/frame.py",
        "torch.where(long_enough, squared, 1.0).sqrt()",
        "squared.sqrt()",
        "shading/test_frame.py",
    ),
    # Sampling.
    Mutant(
        "density of the lobe without the Jacobian of the half vector",
        SAMPLING,
        "/ (4 * cos.d)",
        "/ 4",
        "shading/test_sampling.py",
    ),
    Mutant(
        "density of the cosine sampler per 2π",
        SAMPLING,
        "dot(wi, n).clamp_min(0) / math.pi",
        "dot(wi, n).clamp_min(0) / (2 * math.pi)",
        "shading/test_sampling.py",
    ),
    Mutant(
        "cosine sampler draws evenly",
        SAMPLING,
        "_hemisphere(n, lambda u: (1 - u).sqrt(), pdf_cosine)",
        "_hemisphere(n, lambda u: 1 - u, pdf_cosine)",
        "shading/test_sampling.py",
    ),
    Mutant(
        "densities joined without their shares",
        SAMPLING,
        "technique.pdf(wi) * (count / wi.shape[1])",
        "technique.pdf(wi)",
        "shading/test_sampling.py",
    ),
    Mutant(
        "strata are not moved",
        SAMPLING,
        "(k + torch.rand_like(k)) / count",
        "(k + 0.5) / count",
        "shading/test_sampling.py",
    ),
    # Density and compositing.
    Mutant(
        "sign of the distance",
        "volume/density.py",
        "scaled = sdf / beta\n",
        "scaled = -sdf / beta\n",
        "volume/test_density.py",
    ),
    Mutant(
        "even cuts divide by 0",
        "volume/density.py",
        "torch.where(close, torch.ones_like(step), step)",
        "step",
        "volume/test_density.py",
    ),
    Mutant(
        "β has no floor",
        "volume/density.py",
        "self.above_floor.abs() + self.beta_floor",
        "self.above_floor.abs()",
        "volume/test_density.py",
    ),
    Mutant(
        "a sample hides itself",
        "volume/compositing.py",
        "torch.exp(-depth_before[:, :-1])",
        "torch.exp(-depth_before[:, 1:])",
        "volume/test_compositing.py",
    ),
    Mutant(
        "weights are optical depths",
        "volume/compositing.py",
        "* -torch.expm1(-depth)\n",
        "* depth\n",
        "volume/test_compositing.py",
    ),
    Mutant(
        "swapped samples emit",
        "volume/compositing.py",
        "dim=-1).diff(dim=-1).clamp_min(0.0)",
        "dim=-1).diff(dim=-1)",
        "volume/test_compositing.py",
    ),
    Mutant(
        "a distance of many β is NaN in half precision",
        "volume/density.py",
        "scaled.clamp_max(0.0)\n    return",
        "scaled - torch.relu(scaled)\n    return",
        "hard_cases/test_properties.py",
    ),
    # Losses.
    Mutant(
        "mask loss: object and background swapped",
        "losses.py",
        "(object_mask * (1 - opacity) + (1 - object_mask)",
        "((1 - object_mask) * (1 - opacity) + object_mask",
        "test_losses.py",
    ),
    Mutant(
        "L_Eik asks for no slope",
        "losses.py",
        "(_safe_norm(gradient) - 1.0).abs()",
        "_safe_norm(gradient).abs()",
        "test_losses.py",
    ),
    Mutant("slope of a length at 0", "losses.py", ".clamp_min(1e-12).sqrt()", ".sqrt()", "test_losses.py"),
    Mutant(
        "smoothing grows at edges",
        "losses.py",
        "torch.exp(-image_gradient)",
        "torch.exp(image_gradient)",
        "test_losses.py",
    ),
    Mutant(
        "L_pcd turns normals around",
        "losses.py",
        "distance.abs() + (1.0 - cosine)",
        "distance.abs() + (1.0 + cosine)",
        "test_losses.py",
    ),
    Mutant(
        "scaled gradients scale the value",
        "losses.py",
        "value.detach() * (1.0 - scale)",
        "value.detach() * scale",
        "test_losses.py",
    ),
    # Light.
    Mutant(
        "rows of the map counted from below",
        "fields/environment.py",
        "((torch.arange(height + 1) - 0.5)",
        "((height - torch.arange(height + 1) - 0.5)",
        "fields/test_environment.py",
    ),
    Mutant(
        "density of the map without solid angles",
        "fields/environment.py",
        "(self._texel_shares() / self._texel_solid_angles())[",
        "(self._texel_shares())[",
        "fields/test_environment.py",
    ),
    Mutant(
        "lamps fall off with the distance, not its square",
        "fields/lamps.py",
        "math.pi * radius**2 / distance.square(), _emission",
        "math.pi * radius**2 / distance, _emission",
        "fields/test_lamps.py",
    ),
    Mutant(
        "lamps shine backwards",
        "fields/lamps.py",
        "(-(wi * axis).sum(-1)).clamp_min(0)",
        "(wi * axis).sum(-1).abs()",
        "fields/test_lamps.py",
    ),
    Mutant(
        "walls hide no lamp",
        "incident/arriving.py",
        "radiance * visibility[..., None]",
        "radiance * 1.0",
        "incident/test_arriving.py",
    ),
    Mutant(
        "light shines through the scene",
        "incident/arriving.py",
        "torch.nonzero(~scene.hit, as_tuple=True)",
        "torch.nonzero(scene.hit | ~scene.hit, as_tuple=True)",
        "incident/test_arriving.py",
    ),
    # Readers.
    Mutant(
        "camera's centre without its sign",
        "data/views.py",
        "-rotation @ self.w2c[:3, 3:]",
        "rotation @ self.w2c[:3, 3:]",
        "data/test_capture.py",
    ),
    Mutant(
        "scene frame is not centred",
        "data/views.py",
        "(points - points.new_tensor(self.centre)) / self.scale",
        "points / self.scale",
        "data/test_capture.py",
    ),
    Mutant(
        "paths may leave the capture",
        "data/views.py",
        "if path.resolve().is_relative_to(root.resolve()):",
        "if True:",
        "hard_cases/test_captures.py",
    ),
    Mutant(
        "mirrored cameras are taken",
        "data/views.py",
        "< 1e-3 and np.linalg.det(rotation) > 0",
        "< 1e-3",
        "hard_cases/test_captures.py",
    ),
    Mutant(
        "cameras whose rays do not fit into float32 are taken",
        "data/views.py",
        "if min(camera.fx, camera.fy) < MIN_FOCAL or",
        "if False and",
        "hard_cases/test_captures.py",
    ),
    Mutant(
        "sizes in headers are believed",
        "data/images.py",
        "width * height <= MAX_PIXELS",
        "True",
        "data/test_images.py",
    ),
    Mutant(
        "red and blue swapped",
        "data/images.py",
        "return samples[..., [2, 1, 0, 3][: samples.shape[2]]]\n\n\ndef _tiff",
        "return samples\n\n\ndef _tiff",
        "data/test_images.py",
    ),
    Mutant(
        "points of no finite place are taken",
        "data/point_cloud.py",
        "~(np.isfinite(position) & np.isfinite(normal)).all(axis=1)",
        "~np.isfinite(position).any(axis=1)",
        "data/test_point_cloud.py",
    ),
    # Checkpoints.
    Mutant(
        "checkpoints may run code",
        "train/run.py",
        'map_location="cpu", weights_only=True)',
        'map_location="cpu", weights_only=False)',
        "train/test_checkpoint.py",
    ),
    Mutant(
        "checkpoints are written in place",
        "train/run.py",
        'with replacing(path) as temporary, temporary.open("wb") as file:',
        'with path.open("wb") as file:',
        "train/test_checkpoint.py",
    ),
    Mutant(
        "the optimiser starts anew on resume",
        "train/loop.py",
        '    optimizer.load_state_dict(saved["optimizer"])\n',
        "",
        "train/test_resume.py",
    ),
    Mutant(
        "steps share their random numbers",
        "train/optimizer.py",
        "(seed * 1_000_003 + step) * 4_099 + rank",
        "seed * 4_099 + rank",
        "train/test_resume.py",
    ),
    Mutant(
        "steps that are not finite are taken",
        "train/loop.py",
        "if all(math.isfinite(value) for value in (loss, *mean_norms)):",
        "if True:",
        "train/test_not_finite.py",
    ),
)


@dataclass(frozen=True)
class Verdict:
    """What the tests of a fault did: `noticed_by` is the first that failed; none: all passed."""

    mutant: Mutant
    noticed_by: str | None


def planted(mutant: Mutant, source: str) -> str:
    """The source of the module with the fault.

    Raises:
        ValueError: what is to be changed does not stand there once.
    """
    if source.count(mutant.old) != 1:
        raise ValueError(
            f"{mutant.what}: {source.count(mutant.old)} places in {mutant.module} read {mutant.old!r}"
        )
    return source.replace(mutant.old, mutant.new)


def try_all(
    mutants: Sequence[Mutant], on_verdict: Callable[[Verdict], None] = lambda _: None
) -> list[Verdict]:
    """Run the tests of each fault, before that once without any.

    Raises:
        RuntimeError: a test fails without a fault.
    """
    for name in LOADED_BEFORE:
        importlib.import_module(name)
    verdicts = []
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        ignored = shutil.ignore_patterns("__pycache__")
        for name in ("neilfpp_method", "tests", "benchmarks"):
            shutil.copytree(ROOT / name, copy / name, ignore=ignored)
        passing: set[str] = set()
        for mutant in mutants:
            if mutant.tests not in passing and (failed := _first_failure(copy, mutant.tests)):
                raise RuntimeError(f"without any fault: {failed}")
            passing.add(mutant.tests)
            path = copy / "neilfpp_method" / mutant.module
            whole = path.read_text()
            path.write_text(planted(mutant, whole))
            verdicts.append(Verdict(mutant, _first_failure(copy, mutant.tests)))
            path.write_text(whole)
            on_verdict(verdicts[-1])
    return verdicts


class _Failures:
    """A plugin of pytest that writes down the first failure."""

    def __init__(self, place: Path) -> None:
        self.place = place

    def pytest_runtest_logreport(self, report) -> None:
        if report.failed and not self.place.exists():
            self.place.write_text(report.nodeid)

    def pytest_collectreport(self, report) -> None:
        self.pytest_runtest_logreport(report)


def _first_failure(copy: Path, tests: str) -> str | None:
    """The first test of a file that fails, or how the process ended that ran them; none: all pass."""
    failed = copy / "failed"
    failed.unlink(missing_ok=True)
    child = os.fork()
    if not child:
        # Either signal ends the process.
        signal.setitimer(signal.ITIMER_PROF, LONGEST)
        signal.alarm(LONGEST_BY_CLOCK)
        os.chdir(copy)
        sys.dont_write_bytecode = True
        # An editable install finds the package by its name; here it is the copy.
        sys.path.insert(0, str(copy))
        for name in [
            name for name in sys.modules if name.split(".")[0] in ("neilfpp_method", "tests", "benchmarks")
        ]:
            del sys.modules[name]
        import pytest

        options = ["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-m", "not slow and not hard"]
        options += ["--rootdir", str(copy), "-c", os.devnull, "-W", "ignore", "--import-mode=append"]
        with open(copy / "output", "w") as output, redirect_stdout(output), redirect_stderr(output):
            status = pytest.main([*options, f"tests/{tests}"], plugins=[_Failures(failed)])
        os._exit(int(status))
    _, status = os.waitpid(child, 0)
    if failed.exists():
        return failed.read_text()
    return None if status == 0 else f"{tests}: ends with {status}: {(copy / 'output').read_text()[-1000:]}"


def table(verdicts: Sequence[Verdict]) -> str:
    """The verdicts in Markdown."""
    rows = ["| fault | in | noticed by |", "|---|---|---|"]
    for verdict in verdicts:
        by = "**nothing**" if verdict.noticed_by is None else f"`{verdict.noticed_by}`"
        rows.append(f"| {verdict.mutant.what} | `{verdict.mutant.module}` | {by} |")
    return "\n".join(rows) + "\n"


def read_table(text: str) -> list[Verdict]:
    """The verdicts that the document has on faults that are still planted."""
    by_name = {(mutant.what, mutant.module): mutant for mutant in MUTANTS}
    rows = re.findall(r"^\| (.+?) \| `(.+?)` \| (?:`(.+?)`|\*\*nothing\*\*) \|$", text, re.MULTILINE)
    return [Verdict(by_name[row[:2]], row[2] or None) for row in rows if row[:2] in by_name]


def main(write: bool = False, only: str = "") -> int:
    """Plant faults one at a time, and say which quick test notices each.

    Args:
        write: put the table into docs/stability.md; rows of faults that were not planted stay as they are.
        only: those whose module, or description, has this in it.
    """
    chosen = [mutant for mutant in MUTANTS if only in mutant.module or only in mutant.what]
    verdicts = try_all(
        chosen, lambda v: print(f"{v.mutant.what}: {v.noticed_by or 'NOT NOTICED'}", flush=True)
    )
    caught = sum(verdict.noticed_by is not None for verdict in verdicts)
    print(f"\n{table(verdicts)}\n{caught} of {len(verdicts)} faults are noticed")
    if write:
        text = DOCUMENT.read_text("utf-8")
        known = {(v.mutant.what, v.mutant.module): v for v in (*read_table(text), *verdicts)}
        rows = [known[m.what, m.module] for m in MUTANTS if (m.what, m.module) in known]
        noticed = sum(verdict.noticed_by is not None for verdict in rows)
        section = f"{table(rows)}\n{noticed} of {len(rows)} are noticed.\n"
        DOCUMENT.write_text(MARKED.sub(lambda m: f"{m[1]}\n{section}{m[2]}", text), "utf-8")
    return int(caught < len(verdicts))


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
