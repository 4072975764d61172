"""Resolve constraints.txt and start the package on every supported Python that is on this machine.

    python scripts/check_pythons.py      needs an index for pip; writes build/pythons

Resolving reads metadata alone (a build of torch can have gigabytes). To start the command takes three
imports; the whole package is compiled to byte code, which finds syntax that an older Python does not know.
`make package PYTHON=python3.10` installs everything on one Python.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
WORK = ROOT / "build" / "pythons"
MINOR_VERSIONS = range(10, 15)
"""3.10 is `requires-python`; the last is the newest that has wheels of all dependencies."""
NEW_PIP = "pip>=24"
"""Older ones download whole packages to resolve them."""
IMPORTS_OF_HELP = ("tyro", "rich", "PyYAML")


def main() -> int:
    """The number of Pythons on which something fails."""
    failed = 0
    for minor in MINOR_VERSIONS:
        python = find(minor)
        if python is None:
            print(f"Python 3.{minor}: not on this machine, skipped")
            continue
        try:
            print(f"Python 3.{minor}: {check(python)}")
        except subprocess.CalledProcessError as error:
            failed += 1
            print(f"Python 3.{minor}: FAILED: {' '.join(map(str, error.cmd))}\n{error.stderr}")
    return failed


def find(minor: int) -> Path | None:
    """A Python of this version that starts: on the path, or among pyenv's."""
    versions = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    found = [shutil.which(f"python3.{minor}"), *sorted(versions.glob(f"3.{minor}.*/bin/python3.{minor}"))]
    for candidate in filter(None, found):
        if subprocess.run([candidate, "-c", ""], capture_output=True, check=False).returncode == 0:
            return Path(candidate)
    return None


def check(python: Path) -> str:
    """What was resolved and what the command says; `CalledProcessError` where one fails."""
    folder = WORK / python.name
    shutil.rmtree(folder, ignore_errors=True)
    run(python, "-m", "venv", folder)
    own = folder / "bin" / "python"
    install = (own, "-m", "pip", "install", "--quiet", "--disable-pip-version-check")
    pins = ("--constraint", ROOT / "constraints.txt")
    run(*install, "--upgrade", NEW_PIP)
    run(*install, "--dry-run", *pins, f"{ROOT}[dev]")
    run(*install, *pins, *IMPORTS_OF_HELP)
    run(*install, "--no-deps", ROOT)
    run(own, "-m", "compileall", "-q", next(folder.glob("lib/*/site-packages/neilfpp_method")))
    help_text = run(folder / "bin" / "neilfpp", "--help")
    assert "neilfpp train" in help_text
    return f"all pins resolve; {run(folder / 'bin' / 'neilfpp', '--version').strip()} starts"


def run(*command: object) -> str:
    """What a command prints, away from the sources."""
    WORK.mkdir(parents=True, exist_ok=True)
    words = [str(word) for word in command]
    return subprocess.run(words, cwd=WORK, check=True, capture_output=True, text=True).stdout


if __name__ == "__main__":
    sys.exit(main())
