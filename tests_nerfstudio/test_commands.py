"""The plugin among nerfstudio's commands: it is listed, and if it is broken, the other methods still work."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import pytest
import tyro
from nerfstudio.configs.dataparser_configs import all_dataparsers
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion, all_methods, method_configs

import neilfpp_method.plugin

ARGUMENTS = ["neilfpp", "--data", "somewhere", "--pipeline.model.host", "neus"]


def test_the_methods_and_the_dataparser_are_found() -> None:
    assert "neilfpp" in all_methods
    assert "neilfpp-data" in all_dataparsers
    assert set(method_configs) <= set(all_methods), "nerfstudio's own methods are all there"


def test_every_entry_point_of_the_package_exists() -> None:
    for group, known in (
        ("nerfstudio.method_configs", all_methods),
        ("nerfstudio.dataparser_configs", all_dataparsers),
    ):
        for entry in entry_points(group=group):
            if entry.value.startswith("neilfpp_method"):
                assert entry.name in known


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("ns-train", ["neilfpp", "neilfpp-mesh", "nerfacto"]),
        ("ns-export", ["pointcloud", "marching-cubes"]),
        ("ns-render", ["dataset"]),
    ],
)
def test_the_commands_start_by_hand(command: str, words: list[str], tmp_path: Path) -> None:
    # In a folder and a process that know nothing of the tests.
    done = subprocess.run(
        [Path(sys.executable).parent / command, "--help"],
        capture_output=True,
        text=True,
        timeout=300,
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    assert all(word in done.stdout for word in words)


def test_the_command_line_reaches_the_settings() -> None:
    more = ["--pipeline.model.neilf.train.sdf-steps", "7", "neilfpp-data", "--test-every", "3"]
    config = tyro.cli(AnnotatedBaseConfigUnion, args=[*ARGUMENTS, *more])
    assert config.pipeline.model.host == "neus"
    assert config.pipeline.model.neilf.train.sdf_steps == 7
    assert config.pipeline.datamanager.dataparser.test_every == 3


@pytest.mark.parametrize("dependency", ["OpenEXR", "nerfstudio"])
def test_a_broken_dependency_raises_no_error(dependency: str) -> None:
    # A module that is None in sys.modules cannot be imported, as if it were missing.
    code = (
        f"import sys, tests_nerfstudio.conftest; sys.modules['{dependency}'] = None\n"
        "from importlib.metadata import entry_points\n"
        "found = [e for g in ('method', 'dataparser') for e in "
        "entry_points(group=f'nerfstudio.{g}_configs')]\n"
        "print([e.load() for e in found if e.value.startswith('neilfpp_method')][:1])"
    )
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip().endswith("[None]")
    assert dependency in done.stderr


def test_the_package_of_the_plugin_itself_imports_nothing() -> None:
    code = "import sys, neilfpp_method.plugin; large = {'torch', 'numpy', 'nerfstudio'}"
    code += "; print(sorted(large & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "[]"


def test_other_names_are_missing_as_usual() -> None:
    with pytest.raises(AttributeError):
        neilfpp_method.plugin.nonsense  # noqa: B018
