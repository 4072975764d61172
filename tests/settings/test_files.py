"""Settings from files: words and numbers keep their types, and invalid files are refused in one line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from neilfpp_method.commands.train import COMMAND
from neilfpp_method.errors import UserError
from neilfpp_method.settings.files import read_settings
from neilfpp_method.settings.plain import changed, to_dict
from neilfpp_method.settings.presets import fixed_geometry, free_light, preset
from neilfpp_method.settings.types import NeilfConfig


def settings_of(*arguments: str) -> NeilfConfig:
    """The settings of `neilfpp train` before options for single settings are applied."""
    return COMMAND.default(arguments).config


def written(folder: Path, text: str, name: str = "settings.yaml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_words_and_numbers_of_yaml(tmp_path):
    """YAML 1.1 reads `off` as false, `5e-4` as a string and `1:30` as ninety."""
    text = "a: off\nb: no\nc: 5e-4\nd: 12\ne: true\nf: none\ng: -.5\nh: 1:30\ni: [1, 2.5]\nj: 'off'\n"
    text += "k: 1_000\nl: 2001-01-01\nm:\n"
    expected = {"a": "off", "b": "no", "c": 5e-4, "d": 12, "e": True, "f": None, "g": -0.5}
    expected |= {"h": "1:30", "i": [1, 2.5], "j": "off", "k": 1000, "l": "2001-01-01", "m": None}
    found = read_settings(written(tmp_path, text))
    assert found == expected
    assert {name: type(value) for name, value in found.items()} == {
        name: type(value) for name, value in expected.items()
    }


def test_a_file_changes_a_preset_and_options_override_it(tmp_path):
    path = written(
        tmp_path,
        "preset: paper-ngp\ntrain:\n  rays: 64\nlight.inter-reflection: off\nhost.loss.eikonal: 1e-2\n",
    )
    config = settings_of("--config", str(path))
    changes = {"train.rays": 64, "light.inter_reflection": "off", "host.loss.eikonal": 0.01}
    assert config == changed(preset("paper-ngp"), changes)
    assert (
        settings_of(f"--config={path}", "--preset", "fast").train.sdf_steps == preset("fast").train.sdf_steps
    )


def test_without_a_preset_a_file_changes_the_usual_one(tmp_path):
    assert settings_of("--config", str(written(tmp_path, ""))) == preset("fast")
    mesh = settings_of("--config", str(written(tmp_path, "host: {kind: mesh, path: a.ply}")))
    assert mesh == changed(fixed_geometry(preset("fast")), {"host.path": "a.ply"})
    free = settings_of("--config", str(written(tmp_path, "light: {kind: free, width: 32}")))
    assert free == changed(free_light(preset("fast")), {"light.width": 32})


ROUND_TRIPS = [NeilfConfig(), preset("paper-mlp"), fixed_geometry(preset("fast")), free_light(preset("fast"))]


@pytest.mark.parametrize("config", ROUND_TRIPS)
def test_the_file_of_a_run_folder_gives_its_settings(tmp_path, config):
    path = written(tmp_path, json.dumps({"format": 2, "config": to_dict(config)}), "config.json")
    assert settings_of("--config", str(path)) == config


@pytest.mark.parametrize(
    ("name", "text", "complaint"),
    [
        ("a.yaml", "train: [", "a.yaml:1: not YAML"),
        ("a.yaml", "train:\n  rays: 1\n  rays: 2\n", "a.yaml:3: not YAML ('rays' is set twice)"),
        ("a.yaml", "a: !!python/object/apply:os.getcwd []", "a.yaml:1: not YAML"),
        ("a.yaml", "- 1\n", "a.yaml: holds no settings"),
        ("a.yaml", "[" * 5000, "a.yaml"),
        ("a.json", "{", "a.json:1: not JSON"),
        ("a.json", "[1]", "a.json: holds no settings"),
        ("a.json", '{"format": 2, "config": 3}', "a.json: holds no settings"),
        ("a.toml", "", "a.toml: not a .yaml, .yml or .json file"),
        ("a.yaml", "train.ray: 3", "a.yaml.train: unknown setting 'ray'; did you mean 'rays'?"),
        ("a.yaml", "preset: quick", "unknown preset 'quick'"),
        ("a.yaml", "preset: 3", "a.yaml.preset: 3 is not a name"),
        ("a.yaml", "x" * (1 << 21), "a.yaml: too large"),
        ("a.yaml", "train.rays: " + "9" * 5000, "a.yaml: not a settings file"),
        ("a.json", '{"train.rays": ' + "9" * 5000 + "}", "a.json: not a settings file"),
        ("a.yaml", "train.rays: !!int many", "a.yaml: not a settings file"),
        ("a.yaml", "train.rays: !!bool many", "a.yaml: not a settings file"),
        ("a.yaml", "train.rays: !!timestamp 2001-13-45", "a.yaml: not a settings file"),
        ("a.yaml", 'host.path: "\\U99999999"', "a.yaml: not a settings file"),
        ("a.yaml", "[a]: 1", "a.yaml:1: not YAML"),
        ("a.yaml", "a: &a [1]\nb: *a\n", "a.yaml:2: not YAML ('*a' stands for several values"),
    ],
)
def test_invalid_settings_files_are_refused(tmp_path, name, text, complaint):
    with pytest.raises(UserError) as error:
        settings_of("--config", str(written(tmp_path, text, name)))
    assert complaint in str(error.value)
    assert "\n" not in str(error.value)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(UserError, match=r"none\.yaml: no such file"):
        settings_of("--config", str(tmp_path / "none.yaml"))


def test_a_folder_is_refused(tmp_path):
    (tmp_path / "a.yaml").mkdir()
    with pytest.raises(UserError, match=r"a\.yaml: cannot be read \(Is a directory\)"):
        read_settings(tmp_path / "a.yaml")


def test_aliases_of_aliases_are_not_expanded(tmp_path):
    """Ten lines describe 10¹⁰ values, which a message about them would spell out."""
    levels = [f"b{i}: &b{i} {{{', '.join(f'k{j}: *b{i - 1}' for j in range(10))}}}" for i in range(1, 11)]
    text = "train: {rays: {b0: &b0 {x: 1}, " + ", ".join(levels) + "}}\n"
    with pytest.raises(UserError, match=r"'\*b0' stands for several values"):
        settings_of("--config", str(written(tmp_path, text)))


def test_an_alias_may_stand_for_one_value(tmp_path):
    assert read_settings(written(tmp_path, "a: &a 5e-4\nb: *a\n")) == {"a": 5e-4, "b": 5e-4}


def test_a_binary_file_is_refused(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(UserError, match="not a text file"):
        settings_of("--config", str(path))


def test_a_host_that_contradicts_the_file_is_refused(tmp_path):
    path = written(tmp_path, "host.kind: volsdf\n")
    with pytest.raises(UserError, match="its host is volsdf, but --host is mesh"):
        settings_of("--config", str(path), "--host", "mesh")
