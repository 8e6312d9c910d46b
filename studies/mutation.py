"""Puts one mutant at a time into a package and checks whether its tests detect it.

mutmut makes the mistakes of the code (an operator turned, a number one higher, an argument left out); a constant is one
higher, a table has a row less. The tests are collected once, and each mistake is judged in a process forked from there,
by the tests that call the changed function, until one fails. A mistake replaces the code of a function or the value of
a name wherever it was imported, so that no module need be loaded again.
"""

from __future__ import annotations

import dis
import inspect
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum
from importlib import import_module
from pathlib import Path
from textwrap import indent
from types import CodeType, FunctionType
from typing import Any

import libcst as cst
from libcst.metadata import CodeRange, MetadataWrapper, PositionProvider
from mutmut.mutation.file_mutation import MutationVisitor
from mutmut.mutation.mutators import mutation_operators
from mutmut.mutation.pragma_handling import IgnoredCode


@dataclass(frozen=True)
class Mutant:
    """One mistake: where it is made, and what stood there before and stands there now.

    ``text`` is the changed function's, ``value`` that of the changed name where ``text`` is empty. Of ``lines`` (file,
    number) a test must take one to notice it; ``around`` are those of the whole function.
    """

    module: str
    place: str
    was: str
    now: str
    text: str = ""
    value: Any = None
    lines: tuple[tuple[str, int], ...] = ()
    around: tuple[tuple[str, int], ...] = ()

    @property
    def key(self) -> str:
        """Its place, in full."""
        return f"{self.module}.{self.place}"

    @property
    def home(self) -> str:
        """The module's own name."""
        return self.module.rpartition(".")[2]

    @property
    def kind(self) -> str:
        """Whether it is made in the code or in a value."""
        return "code" if self.text else "values"

    @property
    def name(self) -> str:
        """How a list of results names it."""
        return f"{self.home}.{self.place}: {self.was} -> {self.now}"


class _Visitor(MutationVisitor):
    """mutmut's, which leaves decorated functions alone; here a property is as good as any."""

    def _skip_node_and_children(self, node: cst.CSTNode) -> bool:
        if isinstance(node, cst.FunctionDef) and len(node.decorators) == 1:
            decorator = node.decorators[0].decorator
            if isinstance(decorator, cst.Name) and decorator.value == "property":
                return False
        return super()._skip_node_and_children(node)


def mutate_code(name: str) -> Iterator[Mutant]:
    """Return all mutants of the functions of a module, including those in its tables."""
    file = str(Path(str(import_module(name).__file__)).resolve())
    wrapper = MetadataWrapper(cst.parse_module(Path(file).read_text("utf-8")), unsafe_skip_copy=True)
    visitor = _Visitor(mutation_operators, IgnoredCode(set(), set(), set()))
    tree, spans = wrapper.visit(visitor), wrapper.resolve(PositionProvider)
    inside = {id(node): place for place, function, _ in _list_functions(tree) for node in _below(function)}
    functions = {
        place: (function, tree.code_for_node(function), spans[whole])
        for place, function, whole in _list_functions(tree)
    }
    for mutation in visitor.mutations:
        if id(mutation.original_node) not in inside:
            continue
        place = inside[id(mutation.original_node)]
        function, before, whole = functions[place]
        after = tree.code_for_node(function.deep_replace(mutation.original_node, mutation.mutated_node))
        was, now = _diff_lines(before, after)
        if was != now:
            lines = _lines(file, spans[mutation.original_node])
            yield Mutant(name, place, was, now, after, None, lines, _lines(file, whole))


def _lines(file: str, span: CodeRange) -> tuple[tuple[str, int], ...]:
    return tuple((file, line) for line in range(span.start.line, span.end.line + 1))


def _list_functions(tree: cst.Module) -> Iterator[tuple[str, Any, cst.CSTNode]]:
    """Return the functions and methods of a module, and the lambdas of tables whose rows are (name, lambda).

    Each comes with its node in the module; of a function that is itself with its decorators.
    """
    for node in tree.body:
        if isinstance(node, cst.FunctionDef):
            yield node.name.value, _bare(node), node
        elif isinstance(node, cst.ClassDef):
            for inner in node.body.body:
                if isinstance(inner, cst.FunctionDef):
                    yield f"{node.name.value}.{inner.name.value}", _bare(inner), inner
        elif isinstance(node, cst.SimpleStatementLine) and isinstance(node.body[0], cst.AnnAssign):
            table = node.body[0]
            rows = table.value.elements if isinstance(table.value, cst.Tuple) else ()
            for row in [row.value.elements for row in rows if isinstance(row.value, cst.Tuple)]:
                if isinstance(row[-1].value, cst.Lambda):
                    place = f"{table.target.value}[{row[0].value.evaluated_value}]"  # type: ignore[attr-defined]
                    yield place, row[-1].value, row[-1].value


def _bare(function: cst.FunctionDef) -> cst.FunctionDef:
    return function.with_changes(decorators=(), leading_lines=(), lines_after_decorators=())


def _below(node: cst.CSTNode) -> Iterator[cst.CSTNode]:
    yield node
    for child in node.children:
        yield from _below(child)


def _diff_lines(before: str, after: str) -> tuple[str, str]:
    """Return the changed lines as they were and as they are."""
    old, new = before.splitlines(), after.splitlines()
    while old and new and old[0] == new[0]:
        del old[0], new[0]
    while old and new and old[-1] == new[-1]:
        del old[-1], new[-1]
    was, now = (" ".join(line.strip() for line in lines) for lines in (old, new))
    return was, now


def mutate_values(name: str) -> Iterator[Mutant]:
    """Return the mistakes in a module's constants and tables: a number that is one higher, a row that is missing."""
    module = import_module(name)
    for place, value in list(vars(module).items()):
        if place.isupper() and _is_defining(name, place):
            lines = find_readers(name, place)  # what is read while modules are loaded cannot be changed any more
            for was, now, changed in _change_value(value) if lines else ():
                yield Mutant(name, place, was, now, "", changed, lines)


def _change_value(value: Any) -> Iterator[tuple[str, str, Any]]:
    """Return the old text, the new text, and the changed value."""
    if type(value) in (int, float):
        yield f"{value:g}", f"{value + 1:g}", value + 1
    elif isinstance(value, Mapping):
        for key, row in value.items():
            if isinstance(row, tuple) and isinstance(row[0], IntEnum):
                other = type(row[0])((row[0] + 1) % len(type(row[0])))
                yield f"{key}: {row[0].name}", other.name, {**value, key: (other, *row[1:])}
            else:
                yield _show_value(key), "no such row", {k: v for k, v in value.items() if k != key}
    elif isinstance(value, tuple | frozenset):
        for item in value:
            yield _show_value(item), "no such row", type(value)(other for other in value if other is not item)


def _is_defining(name: str, place: str) -> bool:
    """Return whether a module defines a name, rather than importing it."""
    text = Path(str(sys.modules[name].__file__)).read_text("utf-8")
    return f"\n{place} = " in text or f"\n{place}: " in text


def _show_value(item: object) -> str:
    parts = item if isinstance(item, tuple) else (item,)
    return ", ".join(str(getattr(part, "name", part)) for part in parts if not isinstance(part, FunctionType))


# --- a mistake in this process ---


def find_function(module: str, place: str) -> FunctionType:
    """Return the function at a place: of a property its getter, of a static method what is within."""
    table, _, row = place.partition("[")
    found: Any = import_module(module)
    for part in table.split("."):
        found = inspect.getattr_static(found, part)
    if row:
        found = dict(found)[row.rstrip("]")]
    found = found.fget if isinstance(found, property) else getattr(found, "__func__", found)
    assert isinstance(found, FunctionType), place
    return found


def apply_mutant(mutant: Mutant) -> None:
    """Apply the mutant to this process; SyntaxError if it is not valid code."""
    if not mutant.text:
        return _put_value(mutant)
    target = find_function(mutant.module, mutant.place)
    owner, _, name = mutant.place.rpartition(".")
    space = dict(vars(sys.modules[mutant.module]))
    if "[" in mutant.place:
        changed = eval(mutant.text, space)
    else:
        text = f"class {owner}:\n{indent(mutant.text, '    ')}" if owner else mutant.text
        exec(compile(f"from __future__ import annotations\n{text}", mutant.name, "exec"), space)
        changed = inspect.getattr_static(space[owner], name) if owner else space[name]
    target.__code__, target.__defaults__ = changed.__code__, changed.__defaults__
    target.__kwdefaults__ = changed.__kwdefaults__
    return None


def _put_value(mutant: Mutant) -> None:
    before = vars(sys.modules[mutant.module])[mutant.place]
    for name, module in list(sys.modules.items()):
        if name.startswith(("fdhil.", "tests.")) and vars(module).get(mutant.place) is before:
            setattr(module, mutant.place, mutant.value)


def find_readers(home: str, place: str) -> tuple[tuple[str, int], ...]:
    """Return the lines of the package's functions that read a name of a module."""
    value, found = vars(sys.modules[home])[place], []
    for name, module in list(sys.modules.items()):
        if name.startswith(home.rpartition(".")[0]) and vars(module).get(place) is value:
            for function in _defined(module):
                file = str(Path(function.__code__.co_filename).resolve())
                for code in _within(function.__code__):
                    read = [step for step in dis.get_instructions(code) if step.argval == place and step.positions]
                    found += [(file, step.positions.lineno or 0) for step in read if step.positions]
    return tuple(dict.fromkeys(found))


def _defined(module: Any) -> Iterator[FunctionType]:
    for value in vars(module).values():
        inner = list(vars(value).values()) if isinstance(value, type) else [value]
        for found in inner:
            found = found.fget if isinstance(found, property) else getattr(found, "__func__", found)
            if isinstance(found, FunctionType) and found.__module__ == module.__name__:
                yield found


def _within(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _within(constant)
