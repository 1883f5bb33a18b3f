"""Plain words: documents, help, and texts of the window and of errors use no private terms; help begins with a noun."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.paths import DOCS, PRODUCT, ROOT
from support.source_texts import template

# Metaphors that were terms here: say model or simulation, package, checked, entered or reported, stand-ins, target,
# saved, next to or compared with, bright, is, has, continues.
PRIVATE = re.compile(
    r"\b(worlds?|rooms?|judg(?:e[sd]?|ing)|told|tells|wires|hoped|kept|besides?|(?:un)?lit|stands|yields|go(?:es)? on)"
    r"\b(?!-)",
    re.IGNORECASE,
)
QUOTED = {"report --beside", "--beside", "-kept"}  # names of options and files
CODE = re.compile(r"^```.*?^```|^    .*?$|`[^`]*`|\]\([^)]*\)|<!--.*?-->", re.DOTALL | re.MULTILINE)
# Help that begins so cannot be read without its label.
PREPOSITIONS = {
    *("of", "at", "in", "with", "that", "to", "for", "from", "by", "before", "after", "between", "along", "across"),
    *("per", "as", "if", "such", "omitted", "only", "up", "needed", "modal", "gige", "without", "over"),
}


def private_words(text: str) -> list[str]:
    """Return the private words of a text, each with its neighbours."""
    for name in QUOTED:
        text = text.replace(name, "")
    return [text[max(found.start() - 40, 0) : found.end() + 30].replace("\n", " ") for found in PRIVATE.finditer(text)]


PAGES = [ROOT / "README.md", *DOCS.rglob("*.md"), *ROOT.glob("app/gui/*.html"), *ROOT.glob("app/bench/presets/*.toml")]


@pytest.mark.parametrize("page", sorted(PAGES), ids=lambda path: path.stem)
def test_documents_use_plain_words(page: Path) -> None:
    assert private_words(CODE.sub(" ", page.read_text("utf-8"))) == []


def seen_texts(source: Path) -> Iterator[str]:
    """Yield the texts of a file that a user may see: all but docstrings, and the docstring of a command."""
    tree = ast.parse(source.read_text("utf-8"))
    unseen = {
        id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in unseen:
            yield node.value if " " in node.value else ""
        if isinstance(node, ast.FunctionDef) and source.parent.name == "commands" and node.name == source.stem:
            yield ast.get_docstring(node) or ""


def test_texts_of_the_program_use_plain_words() -> None:
    found = [
        f"{path.relative_to(ROOT)}: {words}"
        for path in PRODUCT
        for text in seen_texts(path)
        for words in private_words(text)
    ]
    assert not found, "\n".join(found)


def helps(call: ast.Call) -> list[ast.expr]:
    """Return the help of an option in a call; none if it is made elsewhere."""
    return [each.value for each in call.keywords if each.arg == "help" and len(template(each.value, {})) > len("0.")]


def test_help_of_settings_and_options_begins_with_a_noun_or_verb() -> None:
    found = [
        f"{path.relative_to(ROOT)}:{node.lineno}: {text}"
        for path in PRODUCT
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.Call)
        for part in [*(node.args if getattr(node.func, "id", "") == "Doc" else ()), *helps(node)]
        for text in [template(part, {})]
        if not text[0].isupper() or re.split(r"\W", text)[0].lower() in PREPOSITIONS
    ]
    assert not found, "\n".join(found)
