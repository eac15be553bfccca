"""What README, manual and changelog say of the code is true: lengths, links, options, names and the library's ten lines."""

import ast
import re
import shlex
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from sc3d.commands import COMMANDS, STAGES
from tests.builders import write_bare_scene
from tools.make_manual import options

ROOT = Path(__file__).parents[1]
MANUAL = ROOT / "data" / "manual"
README = ROOT / "README.md"
PAGES = [README, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted(MANUAL.rglob("*.md"))]
HAND_WRITTEN = [page for page in PAGES if page.parent.name not in ("commands", "geometry")]
ROOTS = ("sc3d", "tools", "tests", "data")


def page_name(page: Path) -> str:
    return str(page.relative_to(ROOT))


@cache
def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def test_readme_is_short_and_its_lines_too():
    lines = text_of(README).splitlines()
    assert len(lines) <= 120
    assert not [line for line in lines if len(line) > 200 and not line.startswith("|")]


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_every_local_link_leads_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", text_of(page)):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists() and file.is_relative_to(ROOT), target
        if anchor:
            assert anchor in anchors(text_of(file)), target


def anchors(text: str) -> set[str]:
    """Of the headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", text, re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", HAND_WRITTEN, ids=page_name)
def test_every_option_of_a_command_exists(page):
    """In the changelog: those that are said to hold now."""
    text = text_of(page)
    if page.name == "CHANGELOG.md":
        rows = re.findall(r"^\|.*\|(.*)\|$", text, re.M)
        text = "\n".join(rows)
    for command, flags in commands_in(text):
        for flag in flags:
            assert flag in flags_of(command), f"sc3d {command} {flag}"


def commands_in(text: str) -> list[tuple[str, list[str]]]:
    """Name and options of every `sc3d COMMAND ...` in code, one line or span each."""
    blocks = re.findall(r"^```\w*\n(.*?)^```", text, re.M | re.S)
    code = [line.split("  #")[0] for block in blocks for line in block.splitlines()]
    code += re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", text, flags=re.M | re.S))
    found = []
    for part in (part.strip() for line in code for part in line.split("&&")):
        words = shlex.split(part.replace("[", "").replace("]", "")) if part.startswith("sc3d ") else []
        if len(words) > 1 and re.fullmatch(r"[a-z]+", words[1]):
            flags = [word for word in words[2:] if word.startswith("--")]
            found.append((words[1], flags))
    return found


def flags_of(command: str) -> set[str]:
    """Every option of a command."""
    record = (STAGES | COMMANDS)[command]
    flags = {"--help", "--overwrite"}
    for option in options(record):
        parts = option.flag.split(", ")
        flags |= set(parts)
        if option.flag.endswith(".OPTION"):
            nested = option.flag[2:].removesuffix(".OPTION")
            flags |= {f"--{nested}.{flag[2:]}" for flag in flags_of(nested)}
    return flags


@pytest.mark.parametrize("page", HAND_WRITTEN, ids=page_name)
def test_every_module_function_and_file_that_is_named_exists(page):
    text = text_of(page)
    if page.name == "CHANGELOG.md":  # the old names are gone; what older entries tell is history
        text = "\n".join(re.findall(r"^\|.*\|(.*)\|$", text.split("## 0.1.0")[0], re.M))
    names = set(re.findall(r"\b((?:sc3d|tools)(?:\.\w+)+)", text))
    assert not [name for name in names if not exists(name)]
    paths = set(re.findall(r"(?<![\w./])((?:sc3d|tools|tests|data)/[\w./-]*\w)", text))
    assert not [path for path in paths if not list(ROOT.glob(path)) and "<" not in path]


def exists(name: str) -> bool:
    """Whether a dotted name is a package, a module, or something that a module defines, found without import."""
    parts = name.split(".")
    folder = ROOT
    for position, part in enumerate(parts):
        if (folder / part).is_dir():
            folder = folder / part
            continue
        file = folder / f"{part}.py"
        rest = parts[position + 1 :] if file.exists() else parts[position:]
        source = file if file.exists() else folder / "__init__.py"
        return defines(ast.parse(text_of(source)).body, rest)
    return True


def defines(body: list[ast.stmt], path: list[str]) -> bool:
    if not path:
        return True
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == path[0]:
            return defines(getattr(node, "body", []), path[1:])
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if any(isinstance(target, ast.Name) and target.id == path[0] for target in targets):
            return len(path) == 1
    return False


def test_the_picture_of_the_floors_has_every_part_of_the_package():
    picture = re.findall(r"^```\n(.*?)^```", text_of(MANUAL / "architecture.md"), re.M | re.S)[0]
    names = re.findall(r"^  (\w+)", picture, re.M)
    parts = {
        path.stem
        for path in (ROOT / "sc3d").iterdir()
        if (path / "__init__.py").exists() or path.suffix == ".py"
    }
    assert sorted(names) == sorted(parts - {"__init__"} | {"tools"})


def test_the_checks_notice_what_is_wrong():
    assert exists("sc3d.metrics.Confusion.mean_iou") and exists("sc3d.geometry") and exists("sc3d.cli")
    assert (
        not exists("sc3d.metrics.Confusion.best") and not exists("sc3d.nothing") and not exists("sc3d.cli.x")
    )
    assert commands_in(
        "```\nsc3d label S --method paper && sc3d view S  # --no\n```\n`sc3d run --train.seed 1`"
    ) == [
        ("label", ["--method"]),
        ("view", []),
        ("run", ["--train.seed"]),
    ]
    assert {"--train.seed", "--label.method", "--no-color"} <= flags_of("run") | flags_of("propagate")
    assert anchors("# A: b_c (d)\n## Where is ...") == {"a-b_c-d", "where-is-"}


def test_the_librarys_ten_lines_run(tmp_path):
    (code,) = re.findall(r"^```python\n(.*?)^```", text_of(README), re.M | re.S)
    assert len(code.splitlines()) <= 10
    write_bare_scene(tmp_path / "SCENE")
    result = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(ROOT)!r})\n{code}"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert result.returncode == 0, result.stderr
    assert "mIoU" in result.stdout
