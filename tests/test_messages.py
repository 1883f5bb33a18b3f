"""Messages of the program: each has an entry in troubleshooting, which the terminal and the window name."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from support.paths import DOCS, PRODUCT, ROOT
from support.source_texts import template

from app.documentation import TROUBLES, anchor_of, entries, entry_of

SHOWN = {"warn", "alarm", "refuse", "emit", "inform", "Quality.of", "Disconnected.of"}  # calls that show their text
NO_MESSAGES = {"ContractBroken", "SystemExit", "Exit"}  # in the report of `devices --check`, and without text
INNER = {"app/acquisition/serialization.py", "app/acquisition/streams/ring.py"}  # between processes of one version


def said(node: ast.AST, *, is_quality: bool) -> list[ast.expr]:
    """Return what a statement or a call raises or shows."""
    match node:
        case ast.Raise(exc=ast.Call() as call) if not NO_MESSAGES & set(ast.unparse(call.func).split(".")):
            return list(call.args)
        case ast.Call() as call if {ast.unparse(call.func), ast.unparse(call.func).rpartition(".")[2]} & SHOWN:
            return list(call.args)
        case ast.Yield(value=ast.Tuple(elts=[*_, reason])) if is_quality:
            return [reason]
        case ast.Assign(targets=[ast.Subscript()], value=reason) if is_quality:
            return [reason]
    return []


def texts(source: Path) -> Iterator[tuple[int, str]]:
    """Yield line and text of each message that a file raises or shows."""
    nodes = list(ast.walk(ast.parse(source.read_text("utf-8"))))
    names: dict[str, str] = {}
    for node in nodes:
        if isinstance(node, ast.Assign) and isinstance(target := node.targets[0], ast.Name):
            names[target.id] = template(node.value, names)
    for node in nodes:
        for expression in said(node, is_quality="quality" in source.parts):
            text = template(expression, names)
            if len(words := re.findall(r"[a-z]+", text)) > 1 and len(" ".join(words)) > 8:
                yield expression.lineno, text


@cache
def messages() -> dict[str, str]:
    """Place of each message of the product."""
    sources = [path for path in PRODUCT if path.relative_to(ROOT).as_posix() not in INNER]
    return {text: f"{path.relative_to(ROOT)}:{line}" for path in sources for line, text in texts(path)}


def test_every_message_has_an_entry() -> None:
    missing = [f"{place}: {text}" for text, place in messages().items() if not entry_of(text)]
    assert len(messages()) > 400
    assert not missing, "\n".join(missing)


def test_every_entry_quotes_messages_of_the_product_and_says_what_to_do() -> None:
    nodes = (node for path in PRODUCT for node in ast.walk(ast.parse(path.read_text("utf-8"))))
    said_by_it = "\n".join(
        template(node, {}) for node in nodes if isinstance(node, ast.Constant | ast.JoinedStr)
    ).lower()
    assert len(entries()) >= 45
    stale: list[str] = []
    for anchor, text in entries().items():
        heading, quotes, *advice = text.strip().split("\n\n")
        assert anchor == anchor_of(heading)
        assert advice, anchor
        assert set(quotes.split("`")[::2]) <= {"", " ", "\n"}, anchor  # nothing but quotes
        parts = {quote: [part.strip().lower() for part in quote.split("...")] for quote in quotes.split("`")[1::2]}
        stale += [
            f"{anchor}: {quote}" for quote, those in parts.items() if not all(part in said_by_it for part in those)
        ]
    assert not stale, "\n".join(stale)


def test_headings_are_unique() -> None:
    headings = re.findall(r"^##+ (.*)$", (DOCS / TROUBLES).read_text("utf-8"), re.MULTILINE)
    assert len(set(map(anchor_of, headings))) == len(headings)
