"""Imports go one way: to a lower layer, or within the same package. The table below is the architecture."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

LAYERS = [
    # ground floor, lowest first
    ["pmutools", "pmutools.errors", "pmutools.flow", "pmutools.timebase", "pmutools.draws", "pmutools.loglinear"],
    ["pmutools.linux", "pmutools.parsers"],
    ["pmutools.clock", "pmutools.linux_columns", "pmutools.log_thread", "pmutools.realtime", "pmutools.settings"],
    ["pmutools.host", "pmutools.linux_receive", "pmutools.pacing"],
    # the codec, sans-I/O
    ["pmutools.c37118"],
    ["pmutools.c37118_scapy", "pmutools.schema", "pmutools.impair", "pmutools.net", "pmutools.modal"],
    ["pmutools.grid", "pmutools.formats", "pmutools.measure", "pmutools.sites"],
    ["pmutools.clocksources"],
    ["pmutools.report"],
    ["pmutools.tools"],
    ["pmutools.cli", "pmutools.stream"],
    # the controller
    ["dcon", "dcon.limiter"],
    ["dcon.core", "dcon.places"],
    ["dcon.link"],
    ["dcon.watchdog"],
    ["dcon.sections", "dcon.frontend", "dcon.safeguards"],
    ["dcon.settings"],
    ["dcon.effective", "dcon.engine"],
    ["dcon.session"],
    ["dcon.columns", "dcon.export", "dcon.replay"],
    ["dcon.drivers"],
    ["dcon.sim"],
    # one package a process: they meet in dcon.link only, but for a controller that is alone and receives by itself
    ["dcon.front", "dcon.aides", "dcon.output", "dcon.household"],
    ["dcon.control"],
    ["dcon.analysis", "dcon.server"],
    ["dcon.demo"],
    ["dcon.cli"],
]
ALONE = ["dcon.limiter", "dcon.watchdog"]
"""Share no code with the controller: they import nothing of ours."""
CODEC = [
    "constants",
    "checksum",
    "prefix",
    "config_names",
    "config",
    "config_kinds",
    "layout",
    "frames",
    "batch",
    "framer",
    "demux",
    "session",
]
"""Inside the codec, lowest first."""
NO_CLOCK = [
    "pmutools.c37118",
    "pmutools.impair",
    "pmutools.grid",
    "pmutools.modal",
    "pmutools.measure",
    "dcon.core",
    "dcon.limiter",
    *(f"dcon.watchdog.{name}" for name in ("codec", "core", "limits", "memory", "rules")),
]
EDGES = {"time", "socket", "select", "selectors", "threading", "subprocess", "asyncio"}


def test_packages_offer_what_they_have() -> None:
    for name in (
        "pmutools.c37118",
        "pmutools.formats",
        "pmutools.impair",
        "pmutools.schema",
        "pmutools.net",
        "pmutools.measure",
    ):
        package = import_module(name)
        missing = [offered for offered in getattr(package, "__all__", ()) if not hasattr(package, offered)]
        assert not missing, f"{name} offers {missing}"


def modules() -> Iterator[tuple[str, Path]]:
    for package in ("pmutools", "dcon"):
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            yield ".".join(parts[:-1] if parts[-1] == "__init__" else parts), path


def imports(path: Path) -> Iterator[tuple[str, int]]:
    """Every module imported anywhere in the file, inside functions too, but for type checking."""
    tree = ast.parse(path.read_text())
    guarded = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        for inner in ast.walk(node)
    }
    for node in ast.walk(tree):
        if id(node) in guarded:
            continue
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{path}:{node.lineno}: relative import"
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                yield (
                    (name if (ROOT / Path(*name.split("."))).with_suffix(".py").exists() else node.module),
                    node.lineno,
                )


def layer_of(module: str) -> tuple[int, str]:
    """Number and longest matching name of the layer that a module belongs to."""
    best = max(
        ((name, number) for number, names in enumerate(LAYERS) for name in names if within(module, name)),
        key=lambda entry: len(entry[0]),
    )
    return best[1], best[0]


def within(module: str, package: str) -> bool:
    return module == package or module.startswith(package + ".")


MODULES = list(modules())


@pytest.mark.parametrize(("module", "path"), MODULES, ids=[name for name, _ in MODULES])
def test_imports_go_down(module: str, path: Path) -> None:
    number, package = layer_of(module)
    assert package not in ("pmutools", "dcon") or module in ("pmutools", "dcon"), f"{module} is in no layer: add it"
    for target, line in imports(path):
        if target.split(".")[0] not in ("pmutools", "dcon"):
            continue
        where = f"{path.relative_to(ROOT)}:{line} imports {target}"
        assert not (within(module, "pmutools") and within(target, "dcon")), where
        assert not any(within(module, name) and not within(target, name) for name in ALONE), where
        below, other = layer_of(target)
        assert below < number or other == package, where


@pytest.mark.parametrize(("module", "path"), [m for m in MODULES if any(within(m[0], n) for n in ALONE)])
def test_those_alone_need_the_standard_library_only(module: str, path: Path) -> None:
    for target, line in imports(path):
        known = target.split(".")[0] in sys.stdlib_module_names or any(within(target, name) for name in ALONE)
        assert known, f"{path.relative_to(ROOT)}:{line} imports {target}"


def test_the_codec_is_a_chain() -> None:
    for name in CODEC:
        path = ROOT / "pmutools" / "c37118" / f"{name}.py"
        for target, line in imports(path):
            if within(target, "pmutools.c37118"):
                lower = target.split(".")[2]
                assert CODEC.index(lower) < CODEC.index(name), f"{path.name}:{line} imports {target}"


@pytest.mark.parametrize(("module", "path"), [m for m in MODULES if any(within(m[0], n) for n in NO_CLOCK)])
def test_the_core_has_no_clock_and_no_socket(module: str, path: Path) -> None:
    for target, line in imports(path):
        assert target.split(".")[0] not in EDGES, f"{path.relative_to(ROOT)}:{line} imports {target}"
