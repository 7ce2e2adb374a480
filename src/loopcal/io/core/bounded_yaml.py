# SPDX-License-Identifier: Apache-2.0
"""A composer of YAML that refuses deep documents, those whose aliases stand for too much, and keys
that are lists or mappings.

A document of a kilobyte can stand for a terabyte: each line lists ten aliases of the line before.
The composer keeps an alias as a reference, but whoever reads the values meets all of them. So the
values that an alias stands for count each time that it is used.
"""

from __future__ import annotations

from typing import Any

from loopcal.io.core.limits import YAML_DEPTH, YAML_NODES, FileLimit


class LimitError(Exception):
    """A document beyond `limit`, at a line that is counted from 0."""

    def __init__(self, limit: FileLimit, line: int) -> None:
        super().__init__(limit.of)
        self.limit = limit
        self.line = line


class KeyTypeError(Exception):
    """A key that is a list or a mapping, at a line that is counted from 0."""

    def __init__(self, line: int) -> None:
        super().__init__("a key is a list or a mapping")
        self.line = line


def make_bounded_composer(loader: Any) -> Any:
    """Return a composer of ruamel.yaml that counts values and levels, and checks keys.

    Parameters
    ----------
    loader : of ruamel.yaml.

    Raises
    ------
    LimitError, KeyTypeError, MarkedYAMLError : while it composes, as soon as a limit is exceeded;
        a key that is no scalar, which ruamel.yaml cannot always store; or an alias that stands for
        a value that contains it.
    """
    from ruamel.yaml.composer import Composer
    from ruamel.yaml.error import MarkedYAMLError
    from ruamel.yaml.events import AliasEvent
    from ruamel.yaml.nodes import ScalarNode

    class BoundedComposer(Composer):
        """A composer that counts."""

        def __init__(self) -> None:
            super().__init__(loader)
            self._level = self._count = 0
            self._parser: Any = None
            self._sizes: dict[str, int] = {}

        @property
        def parser(self) -> Any:
            """The parser of the loader, kept because it is asked for a dozen times in a value."""
            if self._parser is None:
                self._parser = super().parser
            return self._parser

        def compose_node(self, parent: Any, index: Any) -> Any:
            """Return the next node; check that a key is a scalar."""
            event = self.parser.peek_event()
            line = event.start_mark.line
            node = self._compose_counted(parent, index, event)
            is_key = parent is not None and index is None
            if is_key and not isinstance(node, ScalarNode):
                raise KeyTypeError(line)
            return node

        def _compose_counted(self, parent: Any, index: Any, event: Any) -> Any:
            """Return the next node, whose event is the next one; count its values."""
            if isinstance(event, AliasEvent):
                if event.anchor in self.anchors and event.anchor not in self._sizes:
                    problem = f"alias {event.anchor!r} stands for a value that contains the alias"
                    raise MarkedYAMLError(problem=problem, problem_mark=event.start_mark)
                self._add(self._sizes.get(event.anchor, 1), event)
                return super().compose_node(parent, index)
            before = self._count
            self._add(1, event)
            self._level += 1
            if self._level > YAML_DEPTH.count:
                raise LimitError(YAML_DEPTH, event.start_mark.line)
            # YAML allows an anchor again, for another value; ruamel.yaml warns where it is known
            self.anchors.pop(event.anchor, None)
            self._sizes.pop(event.anchor, None)
            node = super().compose_node(parent, index)
            self._level -= 1
            if event.anchor is not None:
                self._sizes[event.anchor] = self._count - before
            return node

        def _add(self, values: int, event: Any) -> None:
            """Count values; raise LimitError where they are too many."""
            self._count += values
            if self._count > YAML_NODES.count:
                raise LimitError(YAML_NODES, event.start_mark.line)

    return BoundedComposer()
