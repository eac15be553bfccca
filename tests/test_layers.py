"""Imports point down only, the late ones too; computed from the code. And what must not be in the source."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import sc3d

ROOT = Path(sc3d.__file__).parent
TOOLS = ROOT.parent / "tools"
PLAN = ROOT.parent / "data" / "manual" / "architecture.md"  # has the picture of the floors, highest first


@cache
def floors() -> list[set[str]]:
    """The parts of the package by floor, lowest first, as the manual draws them: a bar separates two floors."""
    picture = re.search(r"^```\n(.*?)^```", PLAN.read_text(encoding="utf-8"), re.M | re.S)
    assert picture
    parts = [re.findall(r"^  (\w+)", floor, re.M) for floor in re.split(r"^ +\|$", picture[1], flags=re.M)]
    return [set(names) - {"tools"} for names in reversed(parts) if names != ["tools"]]


@cache
def modules() -> dict[str, set[str]]:
    """Every module of the package, and the modules of the package that it imports, also inside functions."""
    names = {_name(file) for file in ROOT.rglob("*.py")}
    return {
        _name(file): {name for name in _imports(file) if name in names} - {_name(file)}
        for file in ROOT.rglob("*.py")
    }


def _name(file: Path) -> str:
    return ".".join(file.relative_to(ROOT.parent).with_suffix("").parts).removesuffix(".__init__")


def _imports(file: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0 and node.module, f"{file}: relative import"
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


def _part(module: str) -> str:
    """The folder or module directly below sc3d/ that a module belongs to; "" for the package itself."""
    return module.split(".")[1] if "." in module else ""


def circle(graph: dict[str, Iterable[str]]) -> list[str]:
    """Some names that import one another in a loop; [] if there is none."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def test_modules_import_one_another_in_no_circle():
    graph = {module: names - {"sc3d"} for module, names in modules().items()}
    assert not circle(graph)


def test_parts_import_one_another_in_no_circle():
    parts: dict[str, set[str]] = {}
    for module, names in modules().items():
        parts.setdefault(_part(module), set()).update(_part(name) for name in names if name != "sc3d")
    assert not circle({part: names - {part} for part, names in parts.items() if part})


def test_imports_point_down_from_floor_to_floor():
    height = {part: row for row, parts in enumerate(floors()) for part in parts}
    upward = [
        f"{module} imports {name}"
        for module, names in modules().items()
        for name in names
        if _part(module) and _part(name) and height[_part(name)] > height[_part(module)]
    ]
    assert not upward


def test_every_part_has_its_floor_in_the_manual():
    parts = {_part(module) for module in modules()} - {""}
    assert parts == set().union(*floors()) and sum(map(len, floors())) == len(parts)


def test_a_loop_is_found():
    assert set(circle({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}})) == {"a", "b", "c"}
    assert not circle({"a": {"b"}, "b": {"c"}})


def test_the_root_has_at_most_eight_files():
    assert len([file for file in ROOT.iterdir() if file.is_file()]) <= 8


def test_stages_do_not_know_one_another():
    stages = {module: names for module, names in modules().items() if _part(module) == "stages"}
    crossing = [
        f"{module} imports {name}" for module, names in stages.items() for name in names if name in stages
    ]
    assert not [entry for entry in crossing if not entry.endswith(" sc3d.stages")]


def test_torch_lives_in_splatting_and_segmentation_only():
    heavy = {"torch", "transformers"}
    users = {
        _part(_name(file))
        for file in ROOT.rglob("*.py")
        if heavy & {name.split(".")[0] for name in _imports(file)}
    }
    assert users == {"splatting", "segmentation"}


def test_the_package_does_not_know_the_tools_or_the_tests():
    for file in ROOT.rglob("*.py"):
        assert not {name.split(".")[0] for name in _imports(file)} & {"tools", "tests"}, file


def test_no_pickle_and_no_print_in_the_package():
    for file in ROOT.rglob("*.py"):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        calls = [
            node.func.id
            for node in ast.walk(tree)
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
        ]
        assert "print" not in calls, file
        assert not _imports(file) & {"pickle", "dill", "joblib"}, file


def _lines(*folders: Path) -> list[str]:
    return [
        line
        for folder in folders
        for file in folder.rglob("*.py")
        for line in file.read_text("utf-8").splitlines()
    ]


def _functions(folder: Path) -> list[tuple[int, str]]:
    """Lines and place of every function; decorators do not count."""
    found = []
    for file in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                found.append(
                    ((node.end_lineno or 0) - node.lineno + 1, f"{file.relative_to(folder)}:{node.name}")
                )
    return sorted(found, reverse=True)


def test_lines_and_functions_stay_short():
    lines, functions = _lines(ROOT, TOOLS), _functions(ROOT)
    assert sum(len(line) > 110 for line in lines) <= 0.01 * len(lines)
    assert max(functions + _functions(TOOLS))[0] <= 60, functions[:10]
    assert functions[len(functions) // 2][0] < 10


def test_the_torch_module_is_small():
    files = [*(ROOT / "splatting").glob("*.py")]
    assert sum(len(file.read_text("utf-8").splitlines()) for file in files) <= 2000
