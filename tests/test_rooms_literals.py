"""What belongs to one robot, cell or study stays in its room.

A ring's name, the UR10, the number of rings or joints, a configuration of the
law and a kind of sensing are settings. Elsewhere the sources take them from the
scenario, the plant or the records.
"""

import ast
from pathlib import Path
import re
import textwrap

import pytest

_ROOT = Path(__file__).parents[1]
_FOLDERS = ("tofssm_drake", "diagrams", "scripts")

_RING = re.compile(
    r"^(base|elbow|tool)$|scan_(base|elbow|tool)\b"
    r"|^(base|elbow|tool)_(\w*distance|dsi|scan|sequence|state)$"
)
_UR10 = re.compile(r"ur10(?!e)", re.IGNORECASE)
_VARIANT = re.compile(r"\b([Vv][or]|[Ss]m)\b")
_SENSING = re.compile(r"^(tof\d*|ideal|lidar)$")
# What makes an array or counts; a number in it is a size.
_MAKERS = {"empty", "full", "ones", "range", "zeros"}
_COUNTED = re.compile(r"ring|link|scan|joint")

# Where what is allowed, and why.
_ALLOWED = {
    "ring": {
        "tofssm_drake/arms": "names of Universal Robots' own frames",
        "tofssm_drake/people": "a person has elbows",
        "tofssm_drake/rtde": "names of the protocol's fields",
    },
    "ur10": {
        "tofssm_drake/arms": "it is one of the arms",
        "tofssm_drake/paper": "the paper's robot",
    },
    "three": {},
    "six": {
        "tofssm_drake/arms/tool_down.py": "a closed form for six joints",
        "tofssm_drake/raycast": "boxes and their six bounds",
    },
    "variant": {
        "scripts/paper_experiment.py": "prints the paper's parameters",
        "tofssm_drake/laws": "they are the law's",
        "tofssm_drake/paper": "the paper compares them",
    },
    "sensing": {
        "diagrams/scenario.py": "keys that are renamed",
        "scripts/paper_experiment.py": "runs the paper's cells",
        "tofssm_drake/paper": "the paper compares them",
        "tofssm_drake/perception": "their systems",
        "tofssm_drake/sensors": "their systems",
    },
}


def find_docstrings(tree):
    """Returns the nodes of docstrings, also of those behind an attribute."""
    return {
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    }


def get_name(node):
    """Returns the name of a variable, attribute, argument or definition."""
    for key in ("id", "attr", "arg", "name"):
        name = getattr(node, key, None)
        if isinstance(name, str):
            return name
    return ""


def find_in_text(node, is_docstring):
    """Yields the kinds that a string names."""
    text = node.value
    if _RING.search(text):
        yield "ring"
    if _UR10.search(text):
        yield "ur10"
    if not is_docstring:
        if _VARIANT.search(text):
            yield "variant"
        if _SENSING.search(text):
            yield "sensing"


def is_number(node, number):
    return (
        isinstance(node, ast.Constant)
        and type(node.value) is int
        and node.value == number
    )


def find_sizes(node):
    """Yields (node of a number, names beside it) of sizes and counts."""
    if isinstance(node, ast.Call) and get_name(node.func) in _MAKERS:
        yield from ((part, "") for part in node.args[:1])
    elif isinstance(node, ast.Tuple) and len(node.elts) == 1:
        yield node.elts[0], ""
    elif isinstance(node, ast.Slice):
        yield from ((part, "") for part in (node.lower, node.upper))
    elif isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Slice):
        yield node.slice.upper, ast.unparse(node.value)
    elif isinstance(node, ast.Compare):
        for part in node.comparators:
            yield part, ast.unparse(node.left)
    elif isinstance(node, ast.For | ast.comprehension):
        if isinstance(node.iter, ast.Call):
            for part in node.iter.args[:1]:
                yield part, ast.unparse(node.target)


def find_in_sizes(node):
    """Yields the kinds of which a number is the size.

    Six is nearly always the joints; three is nearly always x, y and z, so the
    names beside it must speak of rings.
    """
    for part, names in find_sizes(node):
        if is_number(part, 6):
            yield "six"
        if is_number(part, 3) and _COUNTED.search(names):
            yield "three"


def find_literals(source):
    """Yields (line, kind) of what should be a setting."""
    tree = ast.parse(source)
    docstrings = find_docstrings(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            kinds = find_in_text(node, node in docstrings)
        else:
            kinds = [*find_in_sizes(node)]
            if _UR10.search(get_name(node)):
                kinds.append("ur10")
            # "base" and "tool" are ordinary words for a variable.
            if get_name(node) == "elbow":
                kinds.append("ring")
        for kind in kinds:
            yield getattr(node, "lineno", 0), kind


def is_allowed(path, kind):
    return any(path.is_relative_to(room) for room in _ALLOWED[kind])


def list_sources():
    """Yields (path from the root, source)."""
    for folder in _FOLDERS:
        for path in sorted((_ROOT / folder).rglob("*.py")):
            yield path.relative_to(_ROOT), path.read_text("utf-8")


def test_settings_are_not_in_the_sources():
    found = [
        f"{path}:{line}: {kind}"
        for path, source in list_sources()
        for line, kind in find_literals(source)
        if not is_allowed(path, kind)
    ]
    assert not found, "\n".join(found)


def test_what_is_allowed_is_needed():
    used = {
        (kind, room)
        for path, source in list_sources()
        for _, kind in find_literals(source)
        for room in _ALLOWED[kind]
        if path.is_relative_to(room)
    }
    allowed = {
        (kind, room) for kind, rooms in _ALLOWED.items() for room in rooms
    }
    assert allowed - used == set()


@pytest.mark.parametrize(
    ("kind", "source"),
    [
        ("ring", "port = 'scan_base'"),
        ("ring", "names = ('elbow',)"),
        ("ring", "samples['tool_state']"),
        ("ring", "elbow = 1"),
        ("ring", "class A:\n    '''- masked_scan_tool'''"),
        ("ur10", "def calc_ur10_stop(): pass"),
        ("ur10", "text = 'a UR10 may'"),
        ("three", "for ring in range(3): pass"),
        ("three", "assert len(rings) == 3"),
        ("three", "links[:3]"),
        ("six", "q[:6]"),
        ("six", "np.zeros(6)"),
        ("six", "range(6)"),
        ("six", "q.shape == (6,)"),
        ("six", "len(q) != 6"),
        ("variant", "law = 'vo'"),
        ("variant", "text = 'vo|vr|sm'"),
        ("sensing", "sensing == 'tof'"),
    ],
)
def test_finds(kind, source):
    assert kind in {k for _, k in find_literals(textwrap.dedent(source))}


@pytest.mark.parametrize(
    "source",
    [
        "for k in range(3): p[k] = 0.0",
        "np.zeros(3)",
        "model = 'ur10e'",
        "X[:3, 3]",
        "'''The lidar and its base; small.'''",
        "HARDWARE = 6",
        "port = 'scan_<ring>'",
    ],
)
def test_lets_pass(source):
    assert list(find_literals(source)) == []
