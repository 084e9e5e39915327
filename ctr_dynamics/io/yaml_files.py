"""Reading YAML strictly: numbers as in YAML 1.2, every key once, every failure as one line."""

from __future__ import annotations

import re
from typing import Any

import yaml

from ctr_dynamics.errors import InputError

# A robot file has some hundred values. Aliases and merges multiply what a short text holds, so that the limit is on what they stand for.
MAX_NODES = 100_000


class _Loader(yaml.SafeLoader):
    """SafeLoader that reads 52e9 as a number, rejects a key given twice, and bounds what aliases and merges stand for."""

    def compose_document(self) -> yaml.Node | None:
        node = super().compose_document()
        if node is not None:
            _expanded_size(node, {})
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                raise yaml.constructor.ConstructorError(
                    None, None, "a key must be a word, not a list or a mapping", key_node.start_mark
                )
            key = key_node.value
            if key in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key '{key}' is given twice", key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep)


def _expanded_size(node: yaml.Node, known: dict[int, int]) -> int:
    """Nodes of a document in which every alias is written out.

    Args:
        known: sizes of the nodes met so far by their ``id``; 0 for those that are being counted.

    Raises:
        yaml.constructor.ConstructorError: over ``MAX_NODES``, or a node that holds itself.
    """
    if id(node) in known:
        if not known[id(node)]:
            raise yaml.constructor.ConstructorError(
                None, None, "a node holds itself by an alias", node.start_mark
            )
        return known[id(node)]
    known[id(node)] = 0
    parts: list[yaml.Node] = []
    if isinstance(node, yaml.SequenceNode):
        parts = node.value
    elif isinstance(node, yaml.MappingNode):
        parts = [part for pair in node.value for part in pair]
    size = 1 + sum(_expanded_size(part, known) for part in parts)
    if size > MAX_NODES:
        raise yaml.constructor.ConstructorError(
            None, None, f"aliases and merges stand for {size} values, limit {MAX_NODES}", node.start_mark
        )
    known[id(node)] = size
    return size


# YAML 1.1 takes 52e9 and 1e-3 for text; files of this package follow YAML 1.2.
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d+(\.\d*)?|\.\d+)([eE][-+]?\d+)$"),
    list("-+0123456789."),
)


def read_yaml(text: str, where: str) -> Any:
    """Contents of a YAML text: mappings, lists, text and numbers.

    Args:
        text: the file's contents.
        where: what error messages call the file.

    Raises:
        InputError: with `where` and the line.
    """
    try:
        return yaml.load(text, Loader=_Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f" in line {mark.line + 1}" if mark else ""
        what = getattr(error, "problem", None) or str(error)
        raise InputError(f"not valid YAML{line}: {what}", do="mend the file", where=where) from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"not valid YAML: {error}", do="mend the file", where=where) from None
