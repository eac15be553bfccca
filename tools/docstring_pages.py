"""Markdown pages of modules from their source: signatures and docstrings of what is public.

Read from the text, not by import, so that a page does not depend on what is installed. Kernels (functions that
numba compiles) are left out: they are called by other kernels only.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

# "name: ..." or "one, two: ..." at the start of a line of a docstring
ENTRY = re.compile(r"[a-z_][A-Za-z0-9_]*(, [a-z_][A-Za-z0-9_]*)*: ")

Definition = ast.FunctionDef | ast.ClassDef


def module_page(file: Path, name: str, note: str) -> str:
    """Page of a module; note: first line."""
    source = file.read_text(encoding="utf-8")
    tree = ast.parse(source)
    found = public(tree.body)
    index = [f"- [`{node.name}`](#{node.name.lower()}): {summary(node)}" for node in found]
    sections = [part for node in found for part in _section(node, source)]
    return (
        "\n\n".join([note, f"# {name}", *markdown(_docstring(tree), set()), "\n".join(index), *sections])
        + "\n"
    )


def public(body: list[ast.stmt]) -> list[Definition]:
    """Functions and classes without leading underscore, in the order of the file, kernels left out."""
    return [
        node
        for node in body
        if isinstance(node, ast.FunctionDef | ast.ClassDef)
        and not node.name.startswith("_")
        and not any("njit" in ast.unparse(decorator) for decorator in node.decorator_list)
    ]


def summary(node: Definition | ast.Module) -> str:
    """First sentence of the docstring."""
    return re.split(r"(?<=\.) (?=[A-Z])", " ".join(_docstring(node).split("\n\n")[0].split()), maxsplit=1)[0]


def markdown(docstring: str, names: set[str]) -> Iterator[str]:
    """Paragraphs and lists of a docstring: a line "name: ..." is an entry, an indented line or one in small
    letters goes on with what is before it.

    names: arguments or fields, which begin an entry also after a semicolon
    """
    for paragraph in docstring.split("\n\n"):
        parts: list[str] = []
        for line in paragraph.splitlines():
            if ENTRY.match(line):
                parts.append(f"- {line}")
            elif not parts or (parts[-1].startswith("- ") and re.match(r"[A-Z]", line)):
                parts.append(line.strip())
            else:
                parts[-1] += " " + line.strip()
        yield from _joined([entry for part in parts for entry in _entries(part, names)])


def _entries(part: str, names: set[str]) -> Iterator[str]:
    """An entry "- one: ...; two: ..." as one line for each name; another part as it is."""
    if not part.startswith("- "):
        yield part
        return
    lines: list[str] = []
    for piece in part[2:].split("; "):
        entry = ENTRY.match(piece)
        known = entry is not None and names.issuperset(entry.group()[:-2].split(", "))
        if entry and (known or not lines):
            label = ", ".join(
                name if name in ("returns", "raises") else f"`{name}`"
                for name in entry.group()[:-2].split(", ")
            )
            lines.append(f"- {label}: {piece[entry.end() :]}")
        else:
            lines[-1] += "; " + piece
    yield from lines


def _joined(parts: list[str]) -> Iterator[str]:
    """Entries that follow one another become one list."""
    entries: list[str] = []
    for part in parts:
        if part.startswith("- "):
            entries.append(part)
            continue
        if entries:
            yield "\n".join(entries)
            entries = []
        yield part
    if entries:
        yield "\n".join(entries)


def _docstring(node: Definition | ast.Module) -> str:
    return ast.get_docstring(node) or ""


def _section(node: Definition, source: str) -> Iterator[str]:
    yield f"## {node.name}"
    if isinstance(node, ast.FunctionDef):
        yield _code(_signature(node, source, node.name))
        yield from markdown(_docstring(node), _names(node))
        return
    if not any(_segment(base, source) == "Protocol" for base in node.bases):
        yield _code(_constructor(node, source))
    yield from markdown(_docstring(node), _names(node))
    for method in public(node.body):
        decorators = {ast.unparse(decorator) for decorator in method.decorator_list}
        name = f"{node.name if 'classmethod' in decorators else ''}.{method.name}"
        if decorators & {"property", "cached_property"}:
            yield _code(f"{name} -> {_segment(method.returns, source)}")
        else:
            yield _code(_signature(method, source, name, bound=True))
        yield from markdown(_docstring(method), _names(method))


def _names(node: Definition) -> set[str]:
    """Arguments of a function; fields of a record, arguments of a class's `__init__`."""
    if isinstance(node, ast.FunctionDef):
        return {argument.arg for argument in node.args.args + node.args.kwonlyargs} | {"returns"}
    members = (_names(part) for part in node.body if getattr(part, "name", "") == "__init__")
    return {part.target.id for part in node.body if isinstance(part, ast.AnnAssign)}.union(*members)


def _constructor(node: ast.ClassDef, source: str) -> str:
    """How a class is made: its `__init__`, or the fields of a record."""
    for member in node.body:
        if isinstance(member, ast.FunctionDef) and member.name == "__init__":
            return _signature(member, source, node.name, bound=True).removesuffix(" -> None")
    fields = [
        _segment(member, source)
        for member in node.body
        if isinstance(member, ast.AnnAssign) and not _segment(member, source).startswith("_")
    ]
    return f"{node.name}({', '.join(fields)})"


def _signature(node: ast.FunctionDef, source: str, name: str, bound: bool = False) -> str:
    """bound: without self or cls."""
    arguments = node.args.posonlyargs + node.args.args
    defaults = [None] * (len(arguments) - len(node.args.defaults)) + list(node.args.defaults)
    texts = [_argument(*pair, source) for pair in zip(arguments, defaults, strict=True)]
    if node.args.vararg:
        texts.append("*" + _argument(node.args.vararg, None, source))
    elif node.args.kwonlyargs:
        texts.append("*")
    texts += [
        _argument(*pair, source) for pair in zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True)
    ]
    returns = f" -> {_segment(node.returns, source)}" if node.returns else ""
    static = any(ast.unparse(decorator) == "staticmethod" for decorator in node.decorator_list)
    return f"{name}({', '.join(texts[1:] if bound and not static else texts)}){returns}"


def _argument(argument: ast.arg, default: ast.expr | None, source: str) -> str:
    text = _segment(argument, source)
    return text if default is None else f"{text} = {_segment(default, source)}"


def _segment(node: ast.AST | None, source: str) -> str:
    """The node as it is written, on one line."""
    return " ".join((ast.get_source_segment(source, node) or "").split()) if node else ""


def _code(signature: str) -> str:
    """A signature of more than 100 columns gets a line per argument."""
    if len(signature) > 100:
        head, _, rest = signature.partition("(")
        depth, lines, line = 0, [], ""
        for position, letter in enumerate(rest):
            if letter == ")" and depth == 0:
                lines += [line.strip() + ","] if line.strip() else []
                signature = "\n".join([f"{head}(", *("    " + text for text in lines), rest[position:]])
                break
            depth += (letter in "([{") - (letter in ")]}")
            line += letter
            if letter == "," and depth == 0:
                lines, line = [*lines, line.strip()], ""
    return f"```python\n{signature}\n```"
