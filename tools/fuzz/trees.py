# SPDX-License-Identifier: Apache-2.0
"""Damage to what a YAML or JSON file contains, and the text of the damaged tree."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable, Iterator
from functools import cached_property
from random import Random
from typing import Any

from tools.fuzz.values import DEPTHS, Raw, change_number, draw_name, draw_value

Tree = Any
Place = tuple[Any, Any]
"""A mapping or a list, and the key or index in it."""


class Trees(list[Tree]):
    """Trees of files that do not change, with the keys of all their mappings."""

    @cached_property
    def keys(self) -> list[str]:
        """Every key of a mapping, as often as it occurs."""
        return [str(k) for tree in self for node, k in list_places(tree) if isinstance(node, dict)]


def list_places(tree: Tree) -> list[Place]:
    """Return every place of a value in a tree."""
    return list(_walk(tree))


def _walk(node: Tree) -> Iterator[Place]:
    pairs = (
        node.items()
        if isinstance(node, dict)
        else enumerate(node)
        if isinstance(node, list)
        else ()
    )
    for key, value in list(pairs):
        yield node, key
        yield from _walk(value)


def mutate_tree(tree: Tree, rng: Random, others: Trees) -> tuple[Tree, str]:
    """Return a damaged copy of a tree, and the name of the damage.

    Parameters
    ----------
    others : trees of other files, whose parts may be transplanted.
    """
    tree = copy.deepcopy(tree)
    places = list_places(tree)
    if not places:
        return draw_value(rng), "replace"
    node, key = rng.choice(places)
    name = rng.choice(list(MUTATIONS))
    MUTATIONS[name](node, key, rng, others)
    return tree, name


def _replace(node: Any, key: Any, rng: Random, _others: Trees) -> None:
    node[key] = draw_value(rng)


def _change(node: Any, key: Any, rng: Random, others: Trees) -> None:
    """Change a number, or a value below where there is one."""
    value = node[key]
    if isinstance(value, bool) or not isinstance(value, int | float):
        inner = [p for p in _walk(value) if isinstance(p[0][p[1]], int | float)]
        if not inner:
            _replace(node, key, rng, others)
            return
        node, key = rng.choice(inner)
    node[key] = change_number(node[key], rng)


def _delete(node: Any, key: Any, _rng: Random, _others: Trees) -> None:
    del node[key]


def _duplicate(node: Any, key: Any, rng: Random, _others: Trees) -> None:
    """Repeat an item of a list, or a value of a mapping under another key."""
    if isinstance(node, list):
        node.insert(rng.randrange(len(node) + 1), copy.deepcopy(node[key]))
    else:
        node[rng.choice([draw_name(rng), f"{key}2", *map(str, node)])] = copy.deepcopy(node[key])


def _rename(node: Any, key: Any, rng: Random, others: Trees) -> None:
    """Rename a key, keeping its place; an item of a list becomes a name."""
    if isinstance(node, list):
        node[key] = draw_name(rng)
        return
    new = rng.choice([draw_name(rng), *rng.sample(others.keys, min(2, len(others.keys)))])
    pairs = [(new if k == key else k, v) for k, v in node.items()]
    node.clear()
    node.update(pairs)


def _reorder(node: Any, _key: Any, rng: Random, _others: Trees) -> None:
    """Shuffle a mapping or a list."""
    if isinstance(node, list):
        rng.shuffle(node)
        return
    pairs = list(node.items())
    rng.shuffle(pairs)
    node.clear()
    node.update(pairs)


def _nest(node: Any, key: Any, rng: Random, _others: Trees) -> None:
    """Write a value into lists or mappings, perhaps many of them."""
    depth = rng.choices(DEPTHS, [6, 3, 2, 1, 1])[0]
    if depth > 40:
        node[key] = Raw("[" * depth + "1" + "]" * depth)
        return
    for _ in range(depth):
        node[key] = [node[key]] if rng.random() < 0.7 else {"x": node[key]}


def _transplant(node: Any, key: Any, rng: Random, others: Trees) -> None:
    """Write a part of another file here, under its own key where this is a mapping."""
    other = rng.choice([o for o in others if isinstance(o, dict | list) and o] or [{"x": 1}])
    source, name = rng.choice(list_places(other))
    part = copy.deepcopy(source[name])
    if isinstance(node, dict) and isinstance(name, str) and rng.random() < 0.7:
        node[name] = part
    else:
        node[key] = part


def _repeat(node: Any, key: Any, rng: Random, _others: Trees) -> None:
    """Make a list much longer, or repeat a text."""
    value = node[key]
    if isinstance(value, list) and value:
        node[key] = [copy.deepcopy(rng.choice(value)) for _ in range(rng.choice([2, 7, 60]))]
    else:
        node[key] = str(value) * rng.choice([2, 50])


Mutation = Callable[[Any, Any, Random, Trees], None]
MUTATIONS: dict[str, Mutation] = {
    "replace": _replace,
    "change": _change,
    "delete": _delete,
    "duplicate": _duplicate,
    "rename": _rename,
    "reorder": _reorder,
    "nest": _nest,
    "transplant": _transplant,
    "repeat": _repeat,
}


# --- text of a tree


def write_json(tree: Tree) -> str:
    """Return a tree as JSON, with NaN and Infinity where it has them."""
    if isinstance(tree, Raw):
        return tree.text
    if isinstance(tree, dict):
        return (
            "{" + ", ".join(f"{json.dumps(str(k))}: {write_json(v)}" for k, v in tree.items()) + "}"
        )
    if isinstance(tree, list | tuple):
        return "[" + ", ".join(map(write_json, tree)) + "]"
    return json.dumps(tree, default=str)


def write_yaml(tree: Tree, rng: Random) -> str:
    """Return a tree as YAML: in blocks, or in flow style; perhaps without its last line end."""
    if rng.random() < 0.15:
        text = _flow(tree) + "\n"
    else:
        text = "\n".join(_block(tree, rng.choice(["", "", "", "  "]))) + "\n"
    return text.rstrip("\n") if rng.random() < 0.05 else text


def _block(tree: Tree, indent: str) -> Iterator[str]:
    """Yield the lines of a tree; mappings in blocks, the items of lists in one line each."""
    if isinstance(tree, dict) and tree:
        for key, value in tree.items():
            if isinstance(value, dict) and value and len(_flow(value)) > 60:
                yield f"{indent}{_scalar(key)}:"
                yield from _block(value, indent + "  ")
            elif isinstance(value, list) and value and isinstance(value[0], dict):
                yield f"{indent}{_scalar(key)}:"
                yield from (f"{indent}  - {_flow(item)}" for item in value)
            else:
                yield f"{indent}{_scalar(key)}: {_flow(value)}"
    else:
        yield indent + _flow(tree)


def _flow(tree: Tree) -> str:
    if isinstance(tree, dict):
        return "{" + ", ".join(f"{_scalar(k)}: {_flow(v)}" for k, v in tree.items()) + "}"
    if isinstance(tree, list | tuple):
        return "[" + ", ".join(map(_flow, tree)) + "]"
    return _scalar(tree)


def _scalar(value: Any) -> str:
    """Return a value as YAML; text is written plain where that is safe."""
    if isinstance(value, Raw):
        return value.text
    if isinstance(value, float) and not math.isfinite(value):
        return ".nan" if math.isnan(value) else ".inf" if value > 0 else "-.inf"
    if isinstance(value, str):
        is_plain = (
            value.replace("_", "").replace("-", "").isalnum()
            and value.isascii()
            and value[0].isalpha()
        )
        is_word = value.lower() in {
            "null",
            "yes",
            "no",
            "true",
            "false",
            "on",
            "off",
            "nan",
            "inf",
            "y",
            "n",
        }
        return value if is_plain and not is_word else json.dumps(value)
    return json.dumps(value, default=str)
