"""Build the source distribution and, from it, the wheel; run the wheel's command from an empty environment.

    python scripts/check_package.py      needs git, and an index for pip; writes dist/ and build/package

Build isolation would ask the index a second time, so the build's tools lie in an environment that is made
here.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tarfile
import zipfile
from email import message_from_bytes
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
WORK = ROOT / "build" / "package"
DIST = ROOT / "dist"
TOOLS = ("build", "setuptools>=77", "wheel")


def main() -> None:
    """Each step ends the script where it fails."""
    for folder in (WORK, DIST):
        shutil.rmtree(folder, ignore_errors=True)
    tools = environment("tools", *TOOLS)
    run(
        tools, "-m", "build", "--no-isolation", "--outdir", DIST, ROOT
    )  # the wheel from the source distribution
    (source,), (wheel,) = DIST.glob("*.tar.gz"), DIST.glob("*.whl")
    check_source(source)
    check_wheel(wheel)
    empty = environment("empty", "--constraint", ROOT / "constraints.txt", wheel)
    command = empty.with_name("neilfpp")
    print(run(command, "--version"), end="")
    assert "neilfpp train" in run(command, "--help")
    scene = run(empty, "-c", "import neilfpp_method as n; print(n.__path__[0] + '/demo/scene')").strip()
    assert str(WORK) in scene, f"the command runs {scene}, not the wheel"
    assert "views of" in run(command, "inspect", scene)
    print(f"{source.name} and {wheel.name} are complete; the command runs")


def environment(name: str, *packages: object) -> Path:
    """The Python of a new virtual environment that has these packages and no others."""
    run(sys.executable, "-m", "venv", WORK / name)
    python = WORK / name / "bin" / "python"
    run(python, "-m", "pip", "install", "--quiet", "--no-compile", "--disable-pip-version-check", *packages)
    return python


def run(*command: object) -> str:
    """What a command prints; from a folder in which the package itself cannot be imported."""
    WORK.mkdir(parents=True, exist_ok=True)
    return subprocess.run(
        [str(word) for word in command], cwd=WORK, check=True, stdout=subprocess.PIPE, text=True
    ).stdout


def check_source(source: Path) -> None:
    """Every file that git tracks is in the source distribution."""
    tracked = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True
    ).stdout
    with tarfile.open(source) as archive:
        held = {name.partition("/")[2] for name in archive.getnames()}
    missing = sorted(set(tracked.splitlines()) - held)
    assert not missing, f"{source.name} lacks {', '.join(missing)}; see MANIFEST.in"


def check_wheel(wheel: Path) -> None:
    """Typing marker, licence and the demo's scene are there; no link of the description is relative."""
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        metadata = message_from_bytes(
            archive.read(next(n for n in names if n.endswith(".dist-info/METADATA")))
        )
    for ending in (
        "neilfpp_method/py.typed",
        "demo/scene/split.json",
        "report/static/viewer.js",
        "licenses/LICENSE",
    ):
        assert any(name.endswith(ending) for name in names), f"{wheel.name} lacks {ending}"
    description = str(metadata.get_payload())
    relative = [
        end for end in description.split("](")[1:] if not end.startswith(("https://", "http://", "#"))
    ]
    assert not relative, f"a link of the description leads nowhere: {relative[0].partition(')')[0]}"


if __name__ == "__main__":
    main()
