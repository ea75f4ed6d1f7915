"""A study of one's own: named scenarios, compared trial by trial."""

from collections.abc import Mapping
import dataclasses as dc
import re
from typing import ClassVar

import numpy as np

from tofssm_drake.errors import require
from tofssm_drake.recording.columns import Column
from tofssm_drake.studies.campaign import Plan, make_trials
from tofssm_drake.studies.results import Results

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


@dc.dataclass(kw_only=True)
class CellSettings:
    """A scenario to be compared."""

    # Where it is: "FILE.yaml#Name". Without a name: Default. Without a file:
    # one of the shipped scenarios. The file is looked for beside the study's.
    scenario: str = ""

    # Settings to change, as YAML in quotes.
    text: str = ""

    # Further cells: this one with some more settings changed, as YAML in
    # quotes, by name. Each is compared with this one.
    variants: dict[str, str] = dc.field(default_factory=dict)

    def check(self, where: str) -> None:
        """Raises UserError where a name cannot be one."""
        for name in self.variants:
            _check_name(name, f"{where}.variants")


@dc.dataclass(kw_only=True)
class Study:
    """What a campaign of one's own compares."""

    # What the report is called.
    title: str = "A study"

    # What is compared, by name.
    cells: dict[str, CellSettings] = dc.field(default_factory=dict)

    # The cell that the others are compared with; "": the first.
    baseline: str = ""

    # Runs of each cell with people. Trial n is the same people, on the same
    # way, in each.
    trials: int = 5

    # Decides every trial.
    seed: int = 0

    # Settings to change in all cells, as YAML in quotes.
    text: str = ""

    def check(self, where: str = "study") -> None:
        """Raises UserError unless every setting is valid.

        Args:
            where: What the user calls this.
        """
        require(
            bool(self.cells), f"{where}: cells: there is none to be compared"
        )
        for name, cell in self.cells.items():
            _check_name(name, f"{where}: cells")
            cell.check(f"{where}: cells.{name}")
        require(
            not self.baseline or self.baseline in self.cells,
            f"{where}: baseline: {self.baseline!r} is no cell, use one of "
            f"{', '.join(self.cells)}",
        )
        make_trials(self.seed, self.trials, where=f"{where}: ")


def _check_name(name, where):
    """Raises UserError unless a name can be that of a folder."""
    # YAML may have read a number.
    name = str(name)
    require(
        _NAME.fullmatch(name) is not None,
        f"{where}: {name!r} must be a name of letters, digits and _",
    )


@dc.dataclass(frozen=True, kw_only=True)
class StudyCell:
    """A scenario of a study, with the name it has there."""

    COLUMNS: ClassVar[Mapping[str, Column]] = {
        "cell": Column(meaning="name of the scenario in the study"),
        "variant": Column(meaning="what was changed in it; empty: nothing"),
    }

    name: str
    variant: str = ""
    """Empty: as it is."""
    scenario: dict = dc.field(default_factory=dict, compare=False)
    """As plain values, with every setting."""
    recordings: dict[str, str] = dc.field(default_factory=dict, compare=False)
    """Digests of the recordings of people that it replays, by file name."""

    @property
    def key(self) -> str:
        """See `Cell`."""
        return f"{self.name}-{self.variant}" if self.variant else self.name

    @property
    def label(self) -> str:
        """See `Cell`."""
        return f"{self.name} ({self.variant})" if self.variant else self.name

    @property
    def reference(self) -> str:
        """See `Cell`: its own, as its task may be another."""
        return f"{self.key}-alone"

    @property
    def plain(self) -> "StudyCell":
        """The cell of which this is a variant, or itself."""
        return StudyCell(name=self.name)

    def describe(self) -> dict[str, str]:
        """See `Cell`."""
        return {"cell": self.name, "variant": self.variant}


def make_study_plan(
    cells: list[StudyCell],
    *,
    seed: int,
    trials: int,
    motions: dict[str, str] | None = None,
    versions: dict[str, str] | None = None,
) -> Plan[StudyCell]:
    """Makes the plan of a study.

    Args:
        cells: What is compared.
        seed: Decides every trial.
        trials: Trials per cell.
        motions: Digests of recordings by file name; the trials take turns.
        versions: Versions of packages.

    Raises:
        UserError: A number is out of range.
    """
    return Plan(
        seed=seed,
        cells=tuple(cells),
        trials=make_trials(seed, trials, where="--"),
        scenario={},
        motions=dict(motions or {}),
        versions=dict(versions or {}),
    )


def add_time_lost(rows: list[dict]) -> list[dict]:
    """Returns rows with `time_lost_share`, 1 less productivity.

    It is the part of the task's time that slowing down and standing cost.
    """
    return [
        row | {"time_lost_share": 1.0 - row.get("productivity", np.nan)}
        for row in rows
    ]


def make_study_results(rows: list[dict]) -> Results:
    """Returns the results of a study, by `StudyCell`."""
    return Results(
        rows,
        lambda row: StudyCell(name=row["cell"], variant=row["variant"]),
    )
