"""What is compiled is kept on disk, and is compiled anew when any of its sources has changed."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from reconstruction import compilation

SOURCES = sorted(path for path in Path(compilation.__file__).parent.glob("*.py") if "\n@compiled\n" in path.read_text())


def _compiled_in(source: Path) -> set[str]:
    """The modules of the package from which what is compiled in a file takes functions and numbers."""
    tree = ast.parse(source.read_text())
    functions = [
        node
        for node in tree.body
        if isinstance(node, ast.FunctionDef) and any(ast.unparse(each) == "compiled" for each in node.decorator_list)
    ]
    used = {
        name.id
        for function in functions
        for statement in function.body
        for name in ast.walk(statement)
        if isinstance(name, ast.Name)
    }
    return {
        node.module.removeprefix("reconstruction.")
        for node in tree.body
        if isinstance(node, ast.ImportFrom) and node.module is not None and node.module.startswith("reconstruction.")
        if used & {alias.asname or alias.name for alias in node.names}
    }


@pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.stem)
def test_every_source_of_what_is_compiled_is_looked_at_for_changes(source: Path) -> None:
    assert {source.stem, *_compiled_in(source)} <= set(compilation._COMPILED_FILES)


def test_there_is_something_to_look_at() -> None:
    assert len(SOURCES) >= 9
    assert _compiled_in(SOURCES[0].with_name("lenslet_weights.py")) == {"whitening"}
