"""Finds errors in a scenario's YAML before Drake's loader reads it.

Drake's typed loader rejects a bad document but does not say where. This check
compares the document with the schema and reports the line, the path of the key
and what would be right.
"""

import collections.abc
import dataclasses as dc
import difflib
import math
import re
import types
import typing
from typing import Any, NoReturn

import numpy as np
import yaml

from tofssm_drake.errors import UserError, require

_SCALARS = {
    bool: ("bool",),
    int: ("int",),
    # YAML 1.1 reads 1e-3 as text, but Drake's loader does not.
    float: ("float", "int", "str"),
    str: ("str",),
}
_WORDS = {
    bool: "true or false",
    int: "a whole number",
    float: "a finite number",
    str: "text",
}

# YAML 1.1 reads 010 as 8, 1:30 as 90 and 0x10 as 16.
_DECIMAL = re.compile(r"[-+]?(0|[1-9][0-9]*|[0-9]*\.[0-9]*|[0-9.]+[eE].*)")

_MERGE = "tag:yaml.org,2002:merge"
_MAP = "tag:yaml.org,2002:map"

# The C library's parser where PyYAML has it: ten times faster.
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

# More than any scenario needs, and read within a second.
_DEEPEST = 50
_MOST_VALUES = 20_000
MOST_CHARACTERS = 1_000_000
"""Longest text."""


def parse_yaml(text: str, source: str) -> yaml.MappingNode:
    """Parses a document into nodes that know their lines.

    A key `kind: Name` means the tag `!Name`.

    Args:
        text: the document; empty means no settings.
        source: its name in an error: a file name or an option.

    Raises:
        UserError: it is not YAML, or not a mapping, or a key is not a word or
            occurs twice, or it is too large.
    """
    try:
        _check_size(text, source)
        node = yaml.compose(text, Loader=_LOADER)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        # The end of the text may be named as a line more.
        last = max(len(text.splitlines()), 1)
        line = f":{min(mark.line + 1, last)}" if mark else ""
        problem = error.problem or error.context or ""
        if "expected whitespace" in problem or "expected ' '" in problem:
            # What the two parsers say of {driver: !Rtde}.
            problem = "a kind needs its settings: !Kind {}"
        raise UserError(f"{source}{line}: not YAML: {problem}") from None
    except yaml.YAMLError as error:
        problem = str(error).splitlines()[0]
        raise UserError(f"{source}: not YAML: {problem}") from None
    if node is None:
        return yaml.MappingNode("tag:yaml.org,2002:map", [])
    if not isinstance(node, yaml.MappingNode):
        raise UserError(
            f"{source}:{node.start_mark.line + 1}: must be a mapping of keys "
            f"to values"
        )
    _check_keys(node, source, "", [], {})
    _tag_kinds(node, set())
    return node


def _check_size(text, source):
    """Raises UserError if a text is too long, or nested too deep."""
    require(
        len(text) <= MOST_CHARACTERS,
        f"{source}: is longer than {MOST_CHARACTERS} characters",
    )
    depth = values = 0
    for event in yaml.parse(text, Loader=_LOADER):
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        values += isinstance(event, yaml.NodeEvent)
        if depth > _DEEPEST or values > _MOST_VALUES:
            mark = event.start_mark
            line = mark.line + 1 if mark else 1
            raise UserError(
                f"{source}:{line}: nested deeper than {_DEEPEST} levels"
                if depth > _DEEPEST
                else f"{source}:{line}: more than {_MOST_VALUES} values"
            )


def _check_keys(node, source, where, above, done):
    """Raises UserError unless every key is a word and occurs once.

    Nor may aliases and merges stand for more values than a text may have.

    Args:
        node: Checked with everything below it.
        source: Name of the document.
        where: Path of keys to the node.
        above: The nodes around it; an alias may lead back to one of them.
        done: How many values each correct node stands for, by identity; each
            is checked once, however many aliases lead to it. Changed.

    Returns:
        How many values the node stands for.
    """

    def fail(place, problem, key=""):
        line = place.start_mark.line + 1
        path = ".".join(filter(None, (where, key)))
        raise UserError(
            f"{source}:{line}: {path + ': ' if path else ''}{problem}"
        )

    if isinstance(node, yaml.ScalarNode):
        return 1
    if id(node) in done:
        return done[id(node)]
    if any(node is other for other in above):
        fail(node, "must not contain itself")
    above = [*above, node]
    if isinstance(node, yaml.MappingNode):
        _check_mapping_keys(node, fail)
    count = 1 + sum(
        _check_keys(child, source, path, above, done)
        for path, child in _find_paths(node, where)
    )
    if count > _MOST_VALUES:
        fail(node, f"stands for more than {_MOST_VALUES} values")
    done[id(node)] = count
    return count


def _find_paths(node, where):
    """Yields the children of a mapping or list, each with its path of keys."""
    if isinstance(node, yaml.MappingNode):
        for key, child in node.value:
            yield f"{where}.{key.value}" if where else key.value, child
    else:
        for i, child in enumerate(node.value):
            yield f"{where}[{i}]", child


def _check_mapping_keys(node, fail):
    """Checks a mapping's own keys; calls `fail` with what is wrong."""
    first: dict[str, int] = {}
    for key, child in node.value:
        if not isinstance(key, yaml.ScalarNode):
            fail(key, "a key must be a word, not a mapping or list")
        if key.value in first:
            fail(
                key,
                f"appears twice, first in line {first[key.value]}; leave one",
                key.value,
            )
        first[key.value] = key.start_mark.line + 1
        if key.tag == _MERGE:
            parts = child.value if child.id == "sequence" else [child]
            if any(part.id != "mapping" for part in parts):
                fail(child, "must name mappings to merge", key.value)


def _tag_kinds(node, seen):
    """Turns a key `kind: Name`, which JSON can have as well, into `!Name`."""
    if id(node) in seen or isinstance(node, yaml.ScalarNode):
        return
    seen.add(id(node))
    if isinstance(node, yaml.SequenceNode):
        for child in node.value:
            _tag_kinds(child, seen)
        return
    pairs = []
    for key, child in node.value:
        if key.value == "kind" and isinstance(child, yaml.ScalarNode):
            node.tag = f"!{child.value}"
        else:
            pairs.append((key, child))
        _tag_kinds(child, seen)
    node.value = pairs


def get_children(node: yaml.MappingNode) -> dict[str, yaml.Node]:
    """Returns a mapping's values by key, with merges (`<<`) resolved."""
    own: dict[str, yaml.Node] = {}
    merged: dict[str, yaml.Node] = {}
    for key, value in node.value:
        if key.tag == _MERGE:
            parts = (
                value.value if isinstance(value, yaml.SequenceNode) else [value]
            )
            for part in parts:
                merged = get_children(part) | merged
        else:
            own[key.value] = value
    return merged | own


_EXAMPLES = {int: "[0, 1]", float: "[0.0, 1.0]", str: "[a, b]"}


def check_yaml(
    node: yaml.Node, schema: type, source: str, where: str = ""
) -> None:
    """Checks that a node fits a dataclass schema of Drake's typed loader.

    Args:
        node: the document's node.
        schema: what the node must be: a dataclass, a union of dataclasses or
            of scalar types, a scalar type, list[T], dict[str, T] or np.ndarray.
        source: the document's name in an error.
        where: path of keys to the node.

    Raises:
        UserError: unknown key (with the nearest known one) or wrong type.
    """
    origin = typing.get_origin(schema)
    kinds: tuple[Any, ...] = ()
    if origin in (types.UnionType, typing.Union):
        kinds = typing.get_args(schema)
        schema = _choose(node, kinds, source, where)
        if schema is None:
            return
        origin = typing.get_origin(schema)
    elif find_kind(node):
        _fail(node, source, where, f"takes no kind, but has {find_kind(node)}")
    if dc.is_dataclass(schema):
        _check_settings(node, schema, source, where, kinds)
    elif origin is list or schema is np.ndarray:
        _check_list(node, schema, source, where)
    elif origin in (dict, collections.abc.Mapping):
        if not isinstance(node, yaml.MappingNode):
            _fail(node, source, where, "must be a mapping of names to values")
        for key, child in get_children(node).items():
            item = typing.get_args(schema)[1]
            check_yaml(child, item, source, f"{where}.{key}")
    elif schema in _SCALARS:
        _check_scalar(node, schema, source, where)


def _fail(node, source, where, problem) -> NoReturn:
    """Raises UserError for a node."""
    line = node.start_mark.line + 1 if node.start_mark else 1
    raise UserError(f"{source}:{line}: {where or 'scenario'}: {problem}")


def find_kind(node: yaml.Node) -> str:
    """Returns a node's tag, e.g. !Ring; empty: it has none but YAML's own."""
    if node.tag.startswith("!"):
        return node.tag
    if isinstance(node, yaml.MappingNode) and node.tag != _MAP:
        return f"!!{node.tag.rpartition(':')[2]}"
    return ""


def _check_settings(node, schema, source, where, kinds):
    """Checks a mapping that must fit a dataclass, one of these kinds."""
    if not isinstance(node, yaml.MappingNode):
        kind = find_kind(node)
        hint = f"; write {kind} {{}}" if kind else ""
        _fail(node, source, where, f"must be a mapping of keys to values{hint}")
    known: dict[str, Any] = {f.name: f.type for f in dc.fields(schema)}
    for key, child in get_children(node).items():
        path = f"{where}.{key}" if where else key
        if key not in known:
            now = getattr(schema, "RENAMED", {}).get(key)
            if now:
                _fail(child, source, path, f"is now {now}")
            _fail(
                child,
                source,
                path,
                f"unknown key; {_suggest(key, known, schema, kinds)}",
            )
        check_yaml(child, known[key], source, path)


def _suggest(key, known, schema, kinds):
    """Returns what would be right in place of an unknown key."""
    near = difflib.get_close_matches(key, known, n=1, cutoff=0.7)
    if near:
        return f"did you mean {near[0]!r}?"
    others = [
        f"!{kind.__name__}"
        for kind in kinds
        if isinstance(kind, type)
        and dc.is_dataclass(kind)
        and key in {f.name for f in dc.fields(kind)}
    ]
    if others:
        return f"it is one of {', '.join(others)}, not of !{schema.__name__}"
    return f"known keys: {', '.join(sorted(known))}"


def _check_list(node, schema, source, where):
    """Checks a list, or an array of one or more dimensions."""
    is_array = schema is np.ndarray
    item = float if is_array else typing.get_args(schema)[0]
    if not isinstance(node, yaml.SequenceNode):
        _fail(
            node,
            source,
            where,
            f"must be a list, e.g. {_EXAMPLES.get(item, '[...]')}",
        )
    for index, child in enumerate(node.value):
        is_row = is_array and isinstance(child, yaml.SequenceNode)
        check_yaml(
            child, schema if is_row else item, source, f"{where}[{index}]"
        )


def _check_scalar(node, schema, source, where):
    """Checks a word, a number, or true or false."""
    kind = node.tag.rpartition(":")[2]
    is_scalar = isinstance(node, yaml.ScalarNode)
    if (
        not is_scalar
        or kind not in _SCALARS[schema]
        or (schema is float and not _is_number(node, kind))
    ):
        value = repr(node.value) if is_scalar else "a mapping or list"
        quoted = "; write it in quotes" if schema is str and is_scalar else ""
        _fail(
            node,
            source,
            where,
            f"must be {_WORDS[schema]}, not {value}{quoted}",
        )
    if schema in (int, float) and not _DECIMAL.fullmatch(node.value):
        _fail(
            node,
            source,
            where,
            f"must be {_WORDS[schema]} in plain decimals, not "
            f"{node.value!r}, which YAML reads as "
            f"{yaml.safe_load(node.value)}",
        )


def _is_number(node, kind):
    """Returns whether a scalar node is a finite number."""
    try:
        value = node.value if kind == "str" else yaml.safe_load(node.value)
        return not node.style and math.isfinite(float(value))
    except (OverflowError, TypeError, ValueError):
        return False


def _choose(node, members, source, where):
    """Returns the union's member that a node is; None for null.

    Of dataclasses the node's tag names it.
    """
    kind = node.tag.rpartition(":")[2]
    if kind == "null" and type(None) in members:
        return None
    members = [m for m in members if m is not type(None)]
    if len(members) > 1 and set(members) <= set(_SCALARS):
        return _choose_scalar(node, members, source, where)
    if not find_kind(node):
        return members[0]
    for member in members:
        if member.__name__ == node.tag[1:]:
            return member
    names = ", ".join(f"!{m.__name__}" for m in members)
    _fail(
        node,
        source,
        where,
        f"unknown kind {find_kind(node)}; one of {names}",
    )


def _choose_scalar(node, members, source, where):
    """Returns which of several scalar types a node is."""
    kind = node.tag.rpartition(":")[2]
    if kind == "str" and _is_number(node, kind):
        kind = "float"
    for member in members:
        if isinstance(node, yaml.ScalarNode) and member.__name__ == kind:
            return member
    words = ", ".join(_WORDS[member] for member in members)
    _fail(node, source, where, f"must be one of: {words}")
