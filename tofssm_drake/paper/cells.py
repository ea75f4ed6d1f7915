"""The paper's cells: sensings, configurations of its law, and variants."""

from collections.abc import Mapping
import dataclasses as dc
import importlib.resources
from typing import ClassVar

import yaml

from tofssm_drake.errors import require
from tofssm_drake.laws.config import CONFIGURATIONS
from tofssm_drake.recording.columns import Column
from tofssm_drake.studies.campaign import Plan, make_trials


@dc.dataclass(frozen=True, kw_only=True)
class Sensing:
    """What watches the person."""

    label: str
    """The paper's name."""
    name: str
    """The same for a legend."""
    sensors_of: str = ""
    """Shipped scenario whose sensors are taken; empty: those there are."""
    changes: str = ""
    """Changed settings of the scenario, as YAML."""


@dc.dataclass(frozen=True, kw_only=True)
class Variant:
    """Cells run again with one thing changed, to see its effect."""

    key: str
    label: str
    question: str
    """What the comparison answers."""
    sensings: tuple[str, ...]
    configurations: tuple[str, ...]
    changes: str
    """The changed settings of the scenario, as YAML."""

    def covers(self, sensing: str, configuration: str) -> bool:
        """Returns whether a cell is run again."""
        return sensing in self.sensings and configuration in self.configurations


def _load():
    """Returns sensings and variants by key, from cells.yaml."""
    file = importlib.resources.files(__package__).joinpath("cells.yaml")
    data = yaml.safe_load(file.read_text(encoding="utf-8"))
    sensings = {key: Sensing(**item) for key, item in data["sensings"].items()}
    variants = {
        key: Variant(
            key=key,
            **item
            | {k: tuple(item[k]) for k in ("sensings", "configurations")},
        )
        for key, item in data["variants"].items()
    }
    return sensings, variants


SENSINGS, VARIANTS = _load()
"""What the paper compares, and what is run again, by key."""

CONFIGURATION_LABEL = {"vo": "Vo", "vr": "Vr", "sm": "SM"}

ALONE = "alone"
"""Key of the run without a person, which gives the undisturbed task time."""


@dc.dataclass(frozen=True, kw_only=True)
class Cell:
    """One way to sense with one configuration of the safety law."""

    COLUMNS: ClassVar[Mapping[str, Column]] = {
        "sensing": Column(meaning="what watches the person"),
        "configuration": Column(meaning="configuration of the safety law"),
        "variant": Column(meaning="what was changed; empty: nothing"),
    }

    sensing: str = "tof"
    """One of SENSINGS."""
    configuration: str = "vo"
    """vo, vr or sm."""
    variant: str = ""
    """Key of VARIANTS; empty: as it is."""

    @property
    def key(self) -> str:
        """Short name, for files and columns."""
        suffix = f"-{self.variant}" if self.variant else ""
        return f"{self.sensing}-{self.configuration}{suffix}"

    @property
    def label(self) -> str:
        """The paper's name."""
        suffix = f" ({VARIANTS[self.variant].label})" if self.variant else ""
        return (
            f"{SENSINGS[self.sensing].label} "
            f"{CONFIGURATION_LABEL[self.configuration]}{suffix}"
        )

    @property
    def reference(self) -> str:
        """The same for all cells: the undisturbed task is the same."""
        return ALONE

    @property
    def changes(self) -> list[str]:
        """Settings of the scenario that make this cell, as YAML, in order."""
        return [
            SENSINGS[self.sensing].changes,
            f"{{law: {{configuration: {self.configuration}}}}}",
            VARIANTS[self.variant].changes if self.variant else "",
        ]

    def describe(self) -> dict[str, str]:
        """Returns the columns of a row that say which cell it is."""
        return dc.asdict(self)


def read_cell(row: dict) -> Cell:
    """Returns the cell of a row."""
    return Cell(
        sensing=row["sensing"],
        configuration=row["configuration"],
        variant=row["variant"],
    )


def make_plan(
    *,
    seed: int,
    trials: int,
    sensings: list[str],
    configurations: list[str],
    variants: list[str],
    scenario: dict,
    motions: dict[str, str] | None = None,
    versions: dict[str, str] | None = None,
) -> Plan[Cell]:
    """Makes the plan of the paper's experiment.

    Args:
        seed: Decides every trial.
        trials: Trials per cell.
        sensings: Some of SENSINGS, in order, each once.
        configurations: Some of vo, vr and sm, likewise.
        variants: Some of VARIANTS, likewise. Of each, the cells with these
            sensings and configurations are added: at least one.
        scenario: What all runs have in common, as plain values.
        motions: Digests of recordings by file name.
        versions: Versions of packages.

    Raises:
        UserError: A name is unknown, or there is nothing to run.
    """
    for option, values, known in (
        ("--sensing", sensings, SENSINGS),
        ("--ssm", configurations, CONFIGURATIONS),
        ("--variant", variants, VARIANTS),
    ):
        for value in values:
            require(
                value in known,
                f"{option}: {value!r} is unknown, use one of "
                f"{', '.join(known)}",
            )
        require(
            len(set(values)) == len(values),
            f"{option}: {', '.join(values)} names one of them twice",
        )
    plain = [
        Cell(sensing=sensing, configuration=configuration)
        for sensing in sensings
        for configuration in configurations
    ]
    cells = plain + [
        cell for key in variants for cell in _list_changed(key, plain)
    ]
    return Plan(
        seed=seed,
        cells=tuple(cells),
        trials=make_trials(seed, trials, where="--"),
        scenario=scenario,
        motions=dict(motions or {}),
        versions=dict(versions or {}),
    )


def _list_changed(key, cells):
    """Returns the cells that a variant adds to some cells, at least one."""
    variant = VARIANTS[key]
    changed = [
        dc.replace(cell, variant=key)
        for cell in cells
        if variant.covers(cell.sensing, cell.configuration)
    ]
    require(
        len(changed) > 0,
        f"--variant: {key} needs one of the sensings "
        f"{', '.join(variant.sensings)} with one of the configurations "
        f"{', '.join(variant.configurations)}",
    )
    return changed


def list_variants(sensings: list[str], configurations: list[str]) -> list[str]:
    """Returns the keys of the variants that have a cell among these."""
    return [
        key
        for key, variant in VARIANTS.items()
        if any(variant.covers(s, c) for s in sensings for c in configurations)
    ]
