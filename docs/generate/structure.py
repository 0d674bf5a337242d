"""The layers, as ``tests/test_layers.py`` enforces them."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

from generate.markdown import code, first_sentence, table

ROOT = Path(__file__).parents[2]


def constant(path: Path, name: str) -> Any:
    """The value of a literal assigned in a file that is not imported."""
    for statement in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(statement, ast.Assign) and getattr(statement.targets[0], "id", "") == name:
            return ast.literal_eval(statement.value)
    raise KeyError(f"{path} assigns no {name}")


def source_of(module: str) -> Path:
    """Where a module or package of ours would be."""
    path = ROOT / Path(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def layers() -> str:
    """One row a module that exists, lowest layer first."""
    rows = []
    for number, names in enumerate(constant(ROOT / "tests" / "test_layers.py", "LAYERS"), 1):
        for name in names:
            path = source_of(name)
            if path.exists():
                says = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))
                rows.append((number, code(name), first_sentence(says)))
    return table(("layer", "module", "what it is"), rows)


def codec_chain() -> str:
    """The modules inside the codec, lowest first."""
    rows = []
    for name in constant(ROOT / "tests" / "test_layers.py", "CODEC"):
        says = ast.get_docstring(ast.parse(source_of(f"pmutools.c37118.{name}").read_text(encoding="utf-8")))
        rows.append((code(name), first_sentence(says)))
    return table(("module of `pmutools.c37118`", "what it is"), rows)


def speed_table() -> str:
    """What ``make bench`` wrote, or that it has not been run."""
    path = ROOT / "docs" / "speed-table.md"
    if path.exists():
        return path.read_text(encoding="utf-8").strip()
    return '!!! warning "Not measured yet"\n\n    `make bench` writes the table that belongs here.'


GENERATORS = {"layers": layers, "codec-chain": codec_chain, "speed-table": speed_table}
