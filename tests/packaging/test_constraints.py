"""Pinned versions: a file for each Python that is tested."""

from pathlib import Path
import re
import tomllib

import pytest

_ROOT = Path(__file__).parents[2]
# The last Drake for Python 3.11, and the newest one.
_DRAKE = {"3.11": "1.51.1", "3.12": "1.58.0", "3.13": "1.58.0"}


def read_pins(python):
    text = (_ROOT / f"constraints-{python}.txt").read_text("utf-8")
    return dict(
        line.lower().replace("_", "-").split("==")
        for line in text.splitlines()
        if not line.startswith("#")
    )


def read_requirements():
    project = tomllib.loads((_ROOT / "pyproject.toml").read_text("utf-8"))
    project = project["project"]
    extras = project["optional-dependencies"]
    return project["dependencies"] + [
        *(*extras["meshes"], *extras["test"], *extras["examples"]),
    ]


@pytest.mark.parametrize("python", _DRAKE)
def test_each_requirement_is_pinned(python):
    pins = read_pins(python)
    names = [re.match(r"[\w-]+", r).group() for r in read_requirements()]
    assert [name for name in names if name.lower() not in pins] == []
    assert pins["drake"] == _DRAKE[python]


def test_drake_has_no_upper_bound():
    assert "drake>=1.51.1" in read_requirements()
