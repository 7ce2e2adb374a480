# SPDX-License-Identifier: Apache-2.0
"""Options and method of a stored calibration in words.

A run states them as Python writes a call, such as `CalibrationOptions(hold_out=0.25, prior=None)`.
"""

from __future__ import annotations

import ast
import re

UNITS = {"limit_position": "m", "limit_angle": "rad"}
"""Units of options that are numbers [SI]."""

OBJECT = re.compile(r"(?<==)<([A-Za-z_]+)[^<>]*>")
"""What Python writes of an argument that is an object."""

UNSTATED = ("None", "()", "[]", "{}")
"""Values of options that nobody stated."""


def list_options(text: str) -> list[tuple[str, str]]:
    """Return name and value of each stated option; the text itself where it is no call."""
    call = _parse_call(text)
    if call is None:
        return [("options", text or "unknown")]
    return [(f"option: {name.replace('_', ' ')}", value) for name, value in _list_values(call)]


def describe_call(text: str) -> str:
    """Return a call in words, such as `Ridge (parameter 0.1)`; the text where it is no call."""
    call = _parse_call(text)
    return text if call is None else _describe(call)


def _parse_call(text: str) -> ast.Call | None:
    """Return the call that a text is; None for other text."""
    try:
        node = ast.parse(OBJECT.sub(r"\1()", text), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return None
    return node if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) else None


def _list_values(call: ast.Call) -> list[tuple[str, str]]:
    """Return name and value of each argument that was stated; those of options within options have
    names of their own.
    """
    values: list[tuple[str, str]] = []
    for keyword in call.keywords:
        name, node = keyword.arg or "", keyword.value
        if ast.unparse(node) in UNSTATED:
            continue
        if isinstance(node, ast.Call) and name == "fit":
            values += _list_values(node)
        else:
            values.append((name, " ".join([_describe(node), *UNITS.get(name, "").split()])))
    return values


def _describe(node: ast.expr) -> str:
    """Return a value in words."""
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        arguments = [f"{name.replace('_', ' ')} {value}" for name, value in _list_values(node)]
        arguments = [*(_describe(value) for value in node.args), *arguments]
        return f"{node.func.id} ({', '.join(arguments)})" if arguments else node.func.id
    if isinstance(node, ast.Tuple | ast.List):
        return ", ".join(_describe(item) for item in node.elts)
    if isinstance(node, ast.Constant):
        if isinstance(node.value, bool):
            return "yes" if node.value else "no"
        return str(node.value)
    return ast.unparse(node)
