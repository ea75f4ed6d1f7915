"""Paths and links in the documentation lead somewhere."""

from pathlib import Path
import re

import pytest

_ROOT = Path(__file__).parents[1]
_PAGES = [_ROOT / "README.md", *sorted((_ROOT / "docs").glob("*.md"))]
_FOLDERS = (
    *("benchmarks", "diagrams", "docs", "examples", "models", "scripts"),
    *("tests", "tofssm_drake"),
)
_PATH = re.compile(rf"`((?:{'|'.join(_FOLDERS)})/[\w./-]*)`")
_LINK = re.compile(r"\]\(([^)#\s]+)(#[^)\s]+)?\)")


def list_headings(page):
    """Returns the anchors that a page's headings have."""
    return {
        re.sub(r"[^\w\- ]", "", line.lstrip("# ").lower()).replace(" ", "-")
        for line in page.read_text("utf-8").splitlines()
        if line.startswith("#")
    }


@pytest.mark.parametrize("page", _PAGES, ids=lambda page: page.name)
def test_paths_and_links(page):
    text = page.read_text("utf-8")
    missing = [
        path for path in _PATH.findall(text) if not (_ROOT / path).exists()
    ]
    for target, anchor in _LINK.findall(text):
        if re.match(r"\w+:", target):
            continue
        path = page.parent / target
        if not path.exists():
            missing.append(target)
        elif anchor and anchor[1:] not in list_headings(path):
            missing.append(target + anchor)
    assert not missing
