"""The interface of the installed package: its public names, its types, its licence."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import neilfpp_method
from neilfpp_method.train.run import Run

ROOT = Path(__file__).parent.parent


def test_dir_shows_the_public_names():
    """Before any of them is loaded, so in a separate process; and each name exists."""
    asks = "import sys, neilfpp_method as n; print(*dir(n)); sys.exit('torch' in sys.modules)"
    shown = subprocess.run(
        [sys.executable, "-c", asks], capture_output=True, text=True, timeout=60, check=True
    )
    assert shown.stdout.split() == sorted(neilfpp_method.__all__)
    assert all(getattr(neilfpp_method, name) is not None for name in neilfpp_method.__all__)


def test_the_docstring_of_a_run_lists_its_attributes():
    for name in Run.__dataclass_fields__:
        assert f"        {name}: " in (Run.__doc__ or "")


def test_type_checkers_may_read_the_annotations():
    assert (Path(neilfpp_method.__file__).parent / "py.typed").is_file()


def test_license_and_citation_name_the_same_version():
    assert (ROOT / "LICENSE").read_text().startswith("MIT License")
    assert f"version: {neilfpp_method.__version__}\n" in (ROOT / "CITATION.cff").read_text()
    assert f'version = "{neilfpp_method.__version__}"\n' in (ROOT / "pyproject.toml").read_text()


def test_hints_in_messages_are_commands_that_install_an_extra():
    """Quoted, because brackets are a pattern to some shells, with the name and extras of pyproject.toml."""
    project = (ROOT / "pyproject.toml").read_text()
    (name,) = re.findall(r'^name = "(.+)"$', project, re.MULTILINE)
    section = project.split("[project.optional-dependencies]")[1].split("\n[")[0]
    extras = re.findall(r"^(\w+) = \[", section, re.MULTILINE)
    hints = {
        f"{path.relative_to(ROOT)}: {hint}"
        for path in (ROOT / "neilfpp_method").rglob("*.py")
        for hint in re.findall(r"\S* ?\S* ?\S*neilfpp[-_.]method\[[^ ]*", path.read_text())
    }
    assert len(hints) > 4
    wanted = re.compile(rf".*pip install '{name}\[({'|'.join(extras)})\]'\W*")
    assert [hint for hint in sorted(hints) if not wanted.fullmatch(hint)] == []
