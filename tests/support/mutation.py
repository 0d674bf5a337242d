"""Mutants of a function: every operator flipped and every constant changed, one at a time."""

from __future__ import annotations

import ast
import copy
import inspect
import textwrap
from collections.abc import Callable, Iterator
from types import CodeType, FunctionType, ModuleType
from typing import Any

FLIPS: dict[type[ast.AST], tuple[type[ast.AST], ...]] = {
    ast.Lt: (ast.LtE, ast.Gt),
    ast.LtE: (ast.Lt, ast.GtE),
    ast.Gt: (ast.GtE, ast.Lt),
    ast.GtE: (ast.Gt, ast.LtE),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
    ast.Add: (ast.Sub,),
    ast.Sub: (ast.Add,),
    ast.Mult: (ast.Div,),
    ast.Div: (ast.Mult,),
    ast.FloorDiv: (ast.Mult,),
    ast.LShift: (ast.RShift,),
    ast.RShift: (ast.LShift,),
    ast.BitAnd: (ast.BitOr,),
    ast.BitOr: (ast.BitAnd,),
    ast.BitXor: (ast.BitOr,),
    ast.And: (ast.Or,),
    ast.Or: (ast.And,),
}


def places(tree: ast.AST) -> Iterator[tuple[str, Callable[[], None]]]:
    """(what is changed, how to change it) of every mutation of a tree; each is for a tree of its own."""
    for node in ast.walk(tree):
        where = f"line {getattr(node, 'lineno', 0)}"
        if isinstance(node, ast.Compare):
            for at, op in enumerate(node.ops):
                for other in FLIPS.get(type(op), ()):
                    yield f"{where}: {type(op).__name__} -> {other.__name__} #{at}", setter(node.ops, at, other())
        elif isinstance(node, ast.BinOp | ast.AugAssign | ast.BoolOp):
            for other in FLIPS.get(type(node.op), ()):
                yield f"{where}: {type(node.op).__name__} -> {other.__name__}", attribute(node, "op", other())
        elif isinstance(node, ast.UnaryOp):
            if isinstance(node.op, ast.Not):
                yield f"{where}: not", negated(node)
            elif isinstance(node.op, ast.USub):
                yield f"{where}: -", attribute(node, "op", ast.UAdd())
        elif isinstance(node, ast.Constant):
            if isinstance(node.value, bool):
                yield f"{where}: {node.value}", attribute(node, "value", not node.value)
            elif isinstance(node.value, int | float):
                yield f"{where}: {node.value} + 1", attribute(node, "value", node.value + 1)


def setter(target: list[Any], at: int, value: object) -> Callable[[], None]:
    def change() -> None:
        target[at] = value

    return change


def attribute(node: ast.AST, name: str, value: object) -> Callable[[], None]:
    return lambda: setattr(node, name, value)


def negated(node: ast.UnaryOp) -> Callable[[], None]:
    """``not x`` becomes ``bool(x)``, as ``not not x``."""

    def change() -> None:
        node.operand = ast.UnaryOp(ast.Not(), node.operand)

    return change


def written(function: FunctionType) -> ast.Module:
    """A function alone, without docstring, defaults and annotations; a method is one that is written further in."""
    source = ast.parse(textwrap.dedent(inspect.getsource(function)))
    body = source.body[0]
    assert isinstance(body, ast.FunctionDef)
    if ast.get_docstring(body) is not None:
        body.body = body.body[1:]
    body.args.defaults, body.args.kw_defaults = [], [None] * len(body.args.kwonlyargs)
    body.returns, body.decorator_list = None, []
    for node in ast.walk(source):
        if isinstance(node, ast.arg):
            node.annotation = None
        elif isinstance(node, ast.AnnAssign):  # nothing looks at what a local is said to be
            node.annotation = ast.Name("object", ast.Load())
    return source


def compiled(tree: ast.Module, name: str) -> CodeType:
    """The code of the function that a tree holds."""
    scope: dict[str, Any] = {}
    exec(compile(ast.fix_missing_locations(tree), f"mutant of {name}", "exec"), scope)
    code = scope[name].__code__
    assert isinstance(code, CodeType)
    return code


def mutants(function: FunctionType) -> Iterator[tuple[str, CodeType]]:
    """(what is changed, code) of every mutant."""
    source = written(function)
    for number in range(len(list(places(source)))):
        tree = copy.deepcopy(source)
        what, change = list(places(tree))[number]
        change()
        yield f"{function.__qualname__} {what}", compiled(tree, function.__name__)


def functions_of(module: ModuleType) -> Iterator[FunctionType]:
    """The functions that a module writes, and the methods of its classes."""
    for value in vars(module).values():
        if getattr(value, "__module__", None) == module.__name__:
            for member in vars(value).values() if inspect.isclass(value) else (value,):
                function = member.fget if isinstance(member, property) else getattr(member, "__func__", member)
                if isinstance(function, FunctionType) and function.__code__.co_filename == module.__file__:
                    yield function


def survivors(function: FunctionType, holds: Callable[[], bool]) -> list[str]:
    """Mutants that ``holds`` does not tell from ``function``; each is in its place while that is asked."""
    original, left = function.__code__, []
    same, others = compiled(written(function), function.__name__), list(mutants(function))
    try:
        function.__code__ = same
        assert holds(), "what is not changed is told from itself: all mutants would be"
        for what, code in others:
            function.__code__ = code
            if holds():
                left.append(what)
    finally:
        function.__code__ = original
    return left
