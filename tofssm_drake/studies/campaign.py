"""The plan of a campaign: which runs there are.

A campaign compares *cells*, each with several *trials*. What a cell is, is the
campaign's choice: one's own study has named scenarios (`study.py`), the
paper's experiment has sensings and configurations of its law.
"""

from collections.abc import Mapping
import dataclasses as dc
import json
from typing import ClassVar, Generic, Protocol, TypeVar

from tofssm_drake.errors import require
from tofssm_drake.recording.columns import Column
from tofssm_drake.studies.trials import Trial, make_trial


class Cell(Protocol):
    """What is compared: a frozen dataclass of plain values."""

    @property
    def key(self) -> str:
        """Short name, for files and columns."""

    @property
    def label(self) -> str:
        """Name for a reader."""

    @property
    def reference(self) -> str:
        """Key of its run without people, for the undisturbed task time.

        Cells with the same key share that run.
        """

    COLUMNS: ClassVar[Mapping[str, Column]]
    """What the columns of `describe` are."""

    def describe(self) -> dict[str, str]:
        """Returns the columns of a row that say which cell it is."""


CellT = TypeVar("CellT", bound=Cell)
"""A campaign's kind of cell."""


@dc.dataclass(frozen=True, kw_only=True)
class PlannedRun(Generic[CellT]):
    """One run; without a trial there is no person."""

    cell: CellT
    trial: Trial | None = None

    @property
    def key(self) -> str:
        """Name of the run's folder."""
        if self.trial is None:
            return self.cell.reference
        return f"{self.cell.key}-{self.trial.number}"

    @property
    def label(self) -> str:
        """Name for a reader."""
        if self.trial is None:
            return f"{self.cell.label}, nobody there"
        return (
            f"{self.cell.label}, trial {self.trial.number} "
            f"(seed {self.trial.seed})"
        )


@dc.dataclass(frozen=True, kw_only=True)
class Plan(Generic[CellT]):
    """Everything that determines the results of a campaign."""

    seed: int
    cells: tuple[CellT, ...]
    trials: tuple[Trial, ...]
    scenario: dict
    """What all runs have in common, as plain values."""
    motions: dict[str, str] = dc.field(default_factory=dict)
    """Recordings of persons by file name, with a digest of each; the trials
    take turns. Empty: people move as the scenarios say."""
    versions: dict[str, str] = dc.field(default_factory=dict)
    """Of the packages that a result depends on."""

    def list_runs(self) -> list[PlannedRun[CellT]]:
        """Returns the runs, trial by trial, those without a person first."""
        first: dict[str, PlannedRun[CellT]] = {}
        for cell in self.cells:
            first.setdefault(cell.reference, PlannedRun(cell=cell))
        return [
            *first.values(),
            *(
                PlannedRun(cell=cell, trial=trial)
                for trial in self.trials
                for cell in self.cells
            ),
        ]

    def find_motion(self, run: PlannedRun) -> str | None:
        """Returns the file name of the recording that a run replays."""
        if not self.motions or run.trial is None:
            return None
        return list(self.motions)[(run.trial.number - 1) % len(self.motions)]


def make_trials(seed: int, trials: int, *, where: str) -> tuple[Trial, ...]:
    """Draws the trials of a campaign.

    Args:
        seed: Decides every trial.
        trials: How many.
        where: What stands before the names of these in the user's input.

    Raises:
        UserError: One of them is out of range.
    """
    require(
        1 <= trials <= 1000, f"{where}trials: {trials} must be from 1 to 1000"
    )
    require(
        0 <= seed < 2**32, f"{where}seed: {seed} must be from 0 to {2**32 - 1}"
    )
    return tuple(make_trial(seed, i + 1) for i in range(trials))


def describe_plan(plan: Plan) -> dict:
    """Returns a plan as plain values (JSON)."""
    return json.loads(json.dumps(dc.asdict(plan)))
