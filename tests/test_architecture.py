"""Data flows in one direction: the imports in the sources follow the order of the layers."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = "neilfpp_method"
ROOT = Path(__file__).parent.parent / PACKAGE
PAGE = ROOT.parent / "docs" / "architecture.md"
SOURCES = {
    ".".join((PACKAGE, *path.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__"): path
    for path in sorted(ROOT.rglob("*.py"))
}

# A package may import packages to its left and itself; packages of one layer do not import each other. Lower
# is right.
LAYERS: tuple[tuple[str, ...], ...] = (
    ("drawing", "errors", "stratified", "structures", "timing"),
    ("settings",),
    ("kernels",),
    ("shading", "schedule"),
    ("volume",),
    ("fields", "data", "losses", "settings.facts"),
    ("hosts.base", "lighting", "inspection"),
    ("hosts", "incident"),
    ("model",),
    ("health", "effects", "budget"),
    ("attach", "train"),
    ("export",),
    ("evaluate",),
    ("relight",),
    ("report", "view"),
    ("compare",),
    ("demo", "plugin", "prepare", "tradeoff"),
    ("commands",),
    ("cli",),
    ("__main__",),
)
# Packages that are stricter than their layer. Data is read and prepared without networks,
# settings included.
ONLY = {
    "data": {"errors", "structures", "shading.color"},
    "prepare": {"drawing", "errors", "structures", "shading.color", "data", "inspection"},
    "inspection": {"drawing", "errors", "structures", "shading.color", "data"},
    "structures": set(),
    "errors": set(),
}
MAX_LINES = 400
MAX_IMPORTS_OF_MODEL = 15
MAX_AT_THE_TOP = 8


def room(module: str) -> str:
    """The longest name in `LAYERS` that a module belongs to; empty if there is none."""
    name = module.removeprefix(f"{PACKAGE}.")
    rooms = [r for layer in LAYERS for r in layer if f"{name}.".startswith(f"{r}.")]
    return max(rooms, key=len, default="")


def layer(name: str) -> int:
    return next(i for i, rooms in enumerate(LAYERS) if name in rooms)


def imports(tree: ast.AST, module: str = "") -> Iterator[str]:
    """Every module that a source imports, at any place in it; from the package only modules, not the names in
    them.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: a relative import hides where it leads"
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                yield full if full in SOURCES else node.module or ""


def backward(module: str, imported: str) -> bool:
    """Whether an import contradicts the order."""
    here, there = room(module), room(imported)
    if here == there:
        return False
    allowed = ONLY.get(here)
    name = f"{imported.removeprefix(f'{PACKAGE}.')}."
    if allowed is not None and not any(name.startswith(f"{other}.") for other in allowed):
        return True
    return layer(there) >= layer(here)


def calls(tree: ast.AST) -> Iterator[tuple[str, ast.Call]]:
    """Every call by its dotted name."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func), node


@pytest.fixture(params=SOURCES)
def source(request) -> tuple[str, ast.AST]:
    return request.param, ast.parse(SOURCES[request.param].read_text())


def test_every_module_belongs_to_a_layer(source):
    module, _ = source
    assert module == PACKAGE or room(module), f"{module} stands in no layer"


def test_no_import_contradicts_the_order(source):
    module, tree = source
    if module == PACKAGE:
        assert not [
            name for name in imports(tree) if name.startswith(PACKAGE)
        ]  # its names load when asked for
        return
    wrong = [
        name for name in imports(tree, module) if name.startswith(f"{PACKAGE}.") and backward(module, name)
    ]
    assert not wrong, f"{module} may not import {wrong}"


def test_there_are_no_import_cycles():
    graph = {
        module: {name for name in imports(ast.parse(path.read_text())) if name in SOURCES and name != module}
        for module, path in SOURCES.items()
    }
    # A room's own __init__ may gather the room, and what imports a module has its __init__ run first anyway.
    for module in graph:
        graph[module] -= {f"{PACKAGE}.{room(module)}", PACKAGE}
    TopologicalSorter(graph).prepare()  # raises CycleError


def test_only_the_plugin_imports_nerfstudio(source):
    module, tree = source
    if not module.startswith((f"{PACKAGE}.plugin", f"{PACKAGE}.hosts.nerfstudio")):
        assert not [name for name in imports(tree) if name.split(".")[0] == "nerfstudio"]


def test_devices_follow_the_inputs(source):
    _, tree = source
    assert not [name for name, _ in calls(tree) if name.endswith(".cuda")]


def test_no_untrusted_file_is_unpickled(source):
    _, tree = source
    for name, call in calls(tree):
        assert name not in ("pickle.load", "pickle.loads")
        if name in ("torch.load", "load") or name.endswith("torch.load"):
            safe = {keyword.arg: ast.unparse(keyword.value) for keyword in call.keywords}.get("weights_only")
            assert safe == "True", "torch.load runs what a file says unless weights_only=True"


def test_trees_are_made_in_one_place(source):
    module, tree = source
    if module != f"{PACKAGE}.data.kd_tree":
        made = [name for name, _ in calls(tree) if name.split(".")[-1] in ("KDTree", "cKDTree")]
        assert not made, "use data.kd_tree: a tree of SciPy's defaults may overflow the stack in commands"


def test_the_top_level_has_few_modules():
    top = {path.name for path in ROOT.glob("*.py")} - {"__init__.py"}
    assert len(top) <= MAX_AT_THE_TOP, sorted(top)


def test_the_model_needs_few_modules():
    imported = {name for name in imports(ast.parse((ROOT / "model.py").read_text())) if name in SOURCES}
    assert len(imported) <= MAX_IMPORTS_OF_MODEL, sorted(imported)


def test_modules_are_short(source):
    module, _ = source
    assert len(SOURCES[module].read_text().splitlines()) <= MAX_LINES


def page_layers(text: str) -> tuple[tuple[str, ...], ...]:
    """The rooms of each layer in the numbered list of docs/architecture.md."""
    section = text.split("\n## Which module may import which\n")[1].split("\n## ")[0]
    lines = re.findall(r"^\d+\. (.+)$", section, re.MULTILINE)
    return tuple(tuple(re.findall(r"`([^`]+)`", line)) for line in lines)


def test_the_page_names_the_same_layers():
    rooms = [sorted(layer) for layer in page_layers(PAGE.read_text(encoding="utf-8"))]
    assert rooms == [sorted(layer) for layer in LAYERS]


# ----------------------------------------------------------------------------------- the tests above can fail


@pytest.mark.parametrize(
    ("module", "imported", "wrong"),
    [
        ("shading.brdf", "fields.brdf", True),
        ("fields.brdf", "shading.brdf", False),
        ("shading.brdf", "shading.frame", False),
        ("shading.sampling", "volume.density", True),
        ("shading.sampling", "stratified.intervals", False),
        ("volume.samplers", "stratified.intervals", False),
        ("hosts.base", "schedule", False),
        ("hosts.base", "hosts.volsdf", True),
        ("fields.sdf", "data.mesh", True),
        ("hosts.volsdf", "hosts.base", False),
        ("losses", "hosts.base", True),
        ("incident", "hosts.volsdf", True),
        ("data.pixels.dataset", "shading.color", False),
        ("data.pixels.dataset", "shading.brdf", True),
        ("data.pixels.dataset", "settings.types", True),
        ("prepare.command", "data.capture", False),
        ("prepare.command", "evaluate.pictures", True),
        ("train.loop", "prepare.command", True),
        ("inspection.defects", "data.capture", False),
        ("inspection.picture", "evaluate.pictures", True),
        ("train.loop", "attach", True),
        ("export.mesh", "evaluate.metrics", True),
        ("evaluate.scene_metrics", "export.mesh", False),
        ("relight.command", "evaluate.metrics", False),
        ("export.mesh", "relight.surface", True),
        ("settings.presets", "settings.facts", True),
        ("structures", "errors", True),
        ("model", "cli", True),
    ],
)
def test_the_order_is_checked_in_both_directions(module, imported, wrong):
    assert backward(f"{PACKAGE}.{module}", f"{PACKAGE}.{imported}") == wrong


def test_a_layer_of_the_page_with_another_room_is_found():
    text = "\n## Which module may import which\n\n1. `errors`, `timing`\n2. `settings`\n\n## Next\n1. `no`\n"
    assert page_layers(text) == (("errors", "timing"), ("settings",))


def test_imports_are_found_at_any_place():
    text = "import a.b\nfrom neilfpp_method import losses\n"
    text += "def f():\n  from neilfpp_method.data.files.images import write_png"
    assert list(imports(ast.parse(text))) == ["a.b", f"{PACKAGE}.losses", f"{PACKAGE}.data.files.images"]
