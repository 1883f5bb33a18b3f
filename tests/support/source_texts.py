"""Texts in the source of the product."""

from __future__ import annotations

import ast
from collections.abc import Mapping


def template(node: ast.AST, names: Mapping[str, str]) -> str:
    """Return the text of an expression, with 0 for values that are not known; `names` are variables with a text."""
    text = "0"
    match node:
        case ast.Constant(value=str(constant)):
            text = constant
        case ast.Name(id=name):
            text = names.get(name, "0")
        case ast.FormattedValue(value=part) | ast.IfExp(body=part):
            text = template(part, names)
        case ast.JoinedStr(values=parts):
            text = "".join(template(part, names) for part in parts)
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            text = template(left, names) + template(right, names)
    return text
