"""The import rules of docs/developer/architecture.md: data walks one way, and nothing walks back."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[1]
LEVELS = (
    "errors placements rotations skeleton imu pose utils",
    "formats orientation calibration inference place",
    "sources sinks sip analysis diagnostics viewer convert record config",
    "pipeline",
    "benchmarks",
    "cli",
    "__main__",
)
LEVEL = {room: level for level, rooms in enumerate(LEVELS) for room in rooms.split()}
STATIONS = {"sources", "orientation", "calibration", "inference", "place", "sinks"}


def modules(package: Path) -> Iterator[tuple[str, ast.Module]]:
    for path in sorted(package.rglob("*.py")):
        yield (
            ".".join(path.relative_to(package.parent).with_suffix("").parts),
            ast.parse(path.read_text(encoding="utf-8")),
        )


def imports(tree: ast.Module) -> Iterator[str]:
    """Modules that are imported anywhere: lazily and for types alone, too."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def imported_at_once(node: ast.AST) -> Iterator[str]:
    """Modules and names that are imported while the module itself is."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Import | ast.ImportFrom):
            yield from imports(child)
        elif not isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef) and not is_for_types(child):
            yield from imported_at_once(child)


def is_for_types(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)


def room(module: str) -> str:
    return module.split(".")[1]


def test_rooms_import_only_what_stands_below_them():
    wrong = []
    for name, tree in modules(ROOT / "edgepose"):
        if name == "edgepose.__init__":  # its names are the public API
            continue
        for target in imports(tree):
            if target.startswith("edgepose.") and room(target) in LEVEL and room(target) != room(name):
                up = LEVEL[room(target)] > LEVEL[room(name)]
                across = {room(target), room(name)} <= STATIONS
                if up or across:
                    wrong.append(f"{name} imports {target}")
    assert not wrong


def test_every_room_has_a_level():
    rooms = {path.stem for path in (ROOT / "edgepose").iterdir() if path.suffix == ".py" or path.is_dir()}
    assert rooms - {"__init__", "__pycache__"} <= set(LEVEL)


def test_protocols_import_nothing_of_ours():
    for name, tree in modules(ROOT / "firmware_protocols"):
        assert not [
            target for target in imports(tree) if target.split(".")[0] in ("edgepose", "edgepose_export")
        ], name


def test_nothing_below_the_command_line_imports_click_or_prints():
    for name, tree in modules(ROOT / "edgepose"):
        if room(name) in ("cli", "__main__"):
            continue
        assert not [target for target in imports(tree) if target.split(".")[0] == "click"], name
        calls = [node.func for node in ast.walk(tree) if isinstance(node, ast.Call)]
        assert not [call for call in calls if isinstance(call, ast.Name) and call.id == "print"], name


def test_torch_is_imported_only_where_models_are():
    for name, tree in modules(ROOT / "edgepose"):
        if room(name) not in ("inference", "benchmarks"):
            typed = {id(node) for block in ast.walk(tree) if is_for_types(block) for node in ast.walk(block)}
            for node in ast.walk(tree):
                if isinstance(node, ast.Import) and id(node) not in typed:
                    assert not [alias for alias in node.names if alias.name.split(".")[0] == "torch"], name


def test_modules_can_be_imported_in_any_order():
    packages = (ROOT / "edgepose", ROOT / "firmware_protocols", ROOT / "export" / "edgepose_export")
    trees = {name.removesuffix(".__init__"): tree for package in packages for name, tree in modules(package)}
    needs = {
        name: {target if target in trees else target.rpartition(".")[0] for target in imported_at_once(tree)}
        & (trees.keys() - {name})
        for name, tree in trees.items()
    }
    assert any(needs.values())
    TopologicalSorter(needs).prepare()  # raises CycleError


def test_the_top_of_the_package_is_small():
    entries = [path for path in (ROOT / "edgepose").iterdir() if path.name != "__pycache__"]
    assert len(entries) <= 28
    assert sum(path.is_dir() for path in entries) <= 15
