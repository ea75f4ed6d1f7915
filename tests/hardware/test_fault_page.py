"""The fault table is complete, and its page shows all of it."""

import pathlib
import re

from fault_rows import ROWS

from tofssm_drake.ringlink.ring_fault_injection import FAULTS, SENSOR_FAULTS

_PAGE = pathlib.Path(__file__).parents[2] / "docs" / "faults.md"


def test_no_kind_of_fault_is_left_out():
    names = [row.name for row in ROWS]
    assert len(set(names)) == len(names) >= 90
    for kind in FAULTS:
        assert any(name.startswith(f"ring `{kind}`") for name in names)
    for kind in SENSOR_FAULTS:
        assert any(name.startswith(f"sensor `{kind}`") for name in names)


def test_the_page_shows_each_row_and_what_is_open():
    lines = re.findall(r"^\| (.+) \|$", _PAGE.read_text("utf-8"), re.M)
    cells = [re.split(r" \| |\| ", line) for line in lines]
    rows = [c for c in cells if len(c) == 5 and c[0] != "fault"]
    assert [c[0] for c in rows] == [row.name for row in ROWS]
    for c, row in zip(rows, ROWS, strict=True):
        assert c[1:4].count("**open**") == len(row.open), row.name


def test_what_may_go_on_has_a_reason():
    for row in ROWS:
        assert row.why or row.still < float("inf"), row.name
        assert bool(row.open) == bool(row.finder), row.name
