"""The plan of a campaign, and the files in its folder.

The paper compares sensings and configurations of the safety law in *cells*,
each with several *trials*. Trials are paired: trial n is the same person on
the same way in every cell, so that cells are compared person by person.

In the folder of a campaign:

- `campaign.json`: the plan. A folder takes one plan only.
- `runs/<cell>-<trial>/`: `samples.parquet`, `scans.parquet` and, written
  last, `row.parquet`: the metrics of the samples in one row. A run that has
  one is finished and never repeated.
- `results.parquet`: all rows, in the order of the plan, with the numbers that
  need several runs.
"""

import dataclasses as dc
import io
import json
import os
from pathlib import Path
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tofssm_drake.errors import UserError, require
from tofssm_drake.laws.config import CONFIGURATIONS
from tofssm_drake.recording.samples import PARTS, write_atomically

SENSINGS = ("tof", "ideal", "lidar", "tof16")
"""What a campaign compares: the rings of 8 sensors, the ideal distance, the
lidar at the base, and the rings of 16 that the paper announces."""


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


def _make_lidar_variant(key, rule, label, question):
    """Returns a variant with another rule for the lidar's distance."""
    return Variant(
        key=key,
        label=label,
        question=question,
        sensings=("lidar",),
        configurations=CONFIGURATIONS,
        changes="{sensors: {lidar: {separation: "
        f"{{distance_rule: {rule}}}}}}}}}",
    )


VARIANTS = {
    variant.key: variant
    for variant in (
        Variant(
            key="literal",
            label="literal law",
            question="What do the corrections of the printed law change?",
            sensings=("tof",),
            configurations=CONFIGURATIONS,
            changes="{law: {literal: true}, separation: {literal: true}}",
        ),
        Variant(
            key="kmax",
            label="k_max 3.3 m/s",
            question="The paper's text gives Vr a k_max of 1.7 m/s, its table "
            "one of 3.3 m/s. Does it matter?",
            sensings=("tof", "ideal"),
            configurations=("vr",),
            changes="{law: {k_lmax: 3.3}}",
        ),
        Variant(
            key="exact",
            label="no sensor errors",
            question="How much of the rings' error is the sensors' own, and "
            "how much is that eight beams see little?",
            sensings=("tof",),
            configurations=("vo",),
            changes="{sensors: {base: {sensor: {ideal: true}}, "
            "elbow: {sensor: {ideal: true}}, tool: {sensor: {ideal: true}}}}",
        ),
        Variant(
            key="late",
            label="0.1 s late",
            question="Does the Ideal distance react later than the rings if "
            "computing it takes 0.1 s?",
            sensings=("ideal",),
            configurations=CONFIGURATIONS,
            changes="{sensors: {motion_capture: {latency: 0.1}}, "
            "law: {deadline: 0.2}}",
        ),
        _make_lidar_variant(
            "subtracted",
            "subtracted",
            "r_o subtracted",
            "What if the workspace radius is subtracted from the lidar's "
            "distance instead of added to the law's?",
        ),
        _make_lidar_variant(
            "piecewise",
            "literal",
            "paper's piecewise rule",
            "What does the jump of the paper's Eq. 11 at the border of the "
            "workspace do?",
        ),
    )
}
"""Studies by key. None has the sign of the closing speed as the paper prints
it: with that sign an approaching person counts as one who leaves."""

_SENSING_LABEL = {
    "tof": "Real",
    "tof16": "Real-16",
    "ideal": "Ideal",
    "lidar": "Lidar",
}
_CONFIGURATION_LABEL = {"vo": "Vo", "vr": "Vr", "sm": "SM"}

_PLAN_FILE = "campaign.json"
_SCRATCH = ".scratch"

ALONE = "alone"
"""Key of the run without a person, which gives the undisturbed task time."""


@dc.dataclass(frozen=True, kw_only=True)
class Cell:
    """One way to sense with one configuration of the safety law."""

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
            f"{_SENSING_LABEL[self.sensing]} "
            f"{_CONFIGURATION_LABEL[self.configuration]}{suffix}"
        )


@dc.dataclass(frozen=True, kw_only=True)
class Trial:
    """One person on one path, and the seed of the sensors' errors.

    The seed determines everything, see `make_trial`.
    """

    number: int
    """From 1."""
    seed: int
    """Also the seed of the sensors' errors."""
    speed: float
    """Walking speed, m/s."""
    stature: float
    """Standing height, m."""
    start: float
    """Where on the figure of eight the person starts, fraction of a round."""
    reverse: bool
    """Whether the person walks the other way round."""
    centre: tuple[float, float]
    """Where the lobes cross, m from where the scenario has it."""
    half_length: float
    """Of the figure of eight, as a factor to the scenario's."""
    half_width: float
    """Likewise."""


def make_trial(campaign_seed: int, number: int) -> Trial:
    """Draws a trial. *Assumed*: how much people differ.

    Speeds are from 1.0 to 1.4 m/s, statures from 1.60 to 1.90 m, the path is
    shifted by up to 0.1 m in x and y and up to 5 % longer and wider or
    shorter and narrower than the scenario's.

    Args:
        campaign_seed: Seed of the campaign.
        number: Which trial, from 1. The same whatever the number of trials.
    """
    seed = int(
        np.random.SeedSequence((campaign_seed, number)).generate_state(1)[0]
    )
    rng = np.random.default_rng(seed)
    return Trial(
        number=number,
        seed=seed,
        speed=float(rng.uniform(1.0, 1.4)),
        stature=float(rng.uniform(1.6, 1.9)),
        start=float(rng.uniform(0.0, 1.0)),
        reverse=bool(rng.integers(2)),
        centre=tuple(rng.uniform(-0.1, 0.1, 2).tolist()),
        half_length=float(rng.uniform(0.95, 1.05)),
        half_width=float(rng.uniform(0.95, 1.05)),
    )


@dc.dataclass(frozen=True, kw_only=True)
class PlannedRun:
    """One run; without a trial there is no person."""

    cell: Cell
    trial: Trial | None = None

    @property
    def key(self) -> str:
        """Name of the run's folder."""
        if self.trial is None:
            return ALONE
        return f"{self.cell.key}-{self.trial.number}"

    @property
    def label(self) -> str:
        """Name for a reader."""
        if self.trial is None:
            return "nobody there"
        return (
            f"{self.cell.label}, trial {self.trial.number} "
            f"(seed {self.trial.seed})"
        )


@dc.dataclass(frozen=True, kw_only=True)
class Plan:
    """Everything that determines the results of a campaign."""

    seed: int
    cells: tuple[Cell, ...]
    trials: tuple[Trial, ...]
    scenario: dict
    """What all runs have in common, as plain values."""
    motions: dict[str, str] = dc.field(default_factory=dict)
    """Recordings of persons by file name, with a digest of each; the trials
    take turns. Empty: generated walks."""
    versions: dict[str, str] = dc.field(default_factory=dict)
    """Of the packages that a result depends on."""

    def list_runs(self) -> list[PlannedRun]:
        """Returns the runs, trial by trial, the one without a person first."""
        return [
            PlannedRun(cell=dc.replace(self.cells[0], variant="")),
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
) -> Plan:
    """Makes a campaign's plan.

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
        ("--study", variants, tuple(VARIANTS)),
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
    require(
        1 <= trials <= 1000,
        f"--trials: {trials} must be from 1 to 1000",
    )
    require(0 <= seed < 2**32, f"--seed: {seed} must be from 0 to {2**32 - 1}")
    plain = [
        Cell(sensing=sensing, configuration=configuration)
        for sensing in sensings
        for configuration in configurations
    ]
    cells = plain + [
        cell for key in variants for cell in _list_studied(key, plain)
    ]
    return Plan(
        seed=seed,
        cells=tuple(cells),
        trials=tuple(make_trial(seed, i + 1) for i in range(trials)),
        scenario=scenario,
        motions=dict(motions or {}),
        versions=dict(versions or {}),
    )


def _list_studied(key, cells):
    """Returns the cells that a study adds to some cells, at least one."""
    variant = VARIANTS[key]
    studied = [
        dc.replace(cell, variant=key)
        for cell in cells
        if variant.covers(cell.sensing, cell.configuration)
    ]
    require(
        len(studied) > 0,
        f"--study: {key} needs one of the sensings "
        f"{', '.join(variant.sensings)} with one of the configurations "
        f"{', '.join(variant.configurations)}",
    )
    return studied


def list_studies(sensings: list[str], configurations: list[str]) -> list[str]:
    """Returns the keys of the studies that have a cell among these."""
    return [
        key
        for key, variant in VARIANTS.items()
        if any(variant.covers(s, c) for s in sensings for c in configurations)
    ]


def describe_plan(plan: Plan) -> dict:
    """Returns a plan as plain values (JSON)."""
    return json.loads(json.dumps(dc.asdict(plan)))


def find_difference(old, new, where: str = "") -> str | None:
    """Describes where two plain values first differ; None: nowhere."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in [*old, *(k for k in new if k not in old)]:
            at = f"{where}.{key}" if where else str(key)
            if key not in new:
                return f"{at} is no longer there"
            if key not in old:
                return f"{at} is new"
            found = find_difference(old[key], new[key], at)
            if found:
                return found
        return None
    if isinstance(old, list) and isinstance(new, list):
        if len(old) != len(new):
            return f"{where}: {len(old)} then, {len(new)} now"
        for i, (a, b) in enumerate(zip(old, new, strict=True)):
            found = find_difference(a, b, f"{where}[{i}]")
            if found:
                return found
        return None
    if old != new:
        return f"{where}: {old!r} then, {new!r} now"
    return None


def find_change(old: dict, new: dict) -> str | None:
    """Describes what makes a plan another campaign; None: nothing does.

    Added cells and trials do not: existing runs stay valid.

    Args:
        old: From `describe_plan`.
        new: Likewise.
    """
    lists = {part: old[part] for part in ("cells", "trials")}
    old_rest, new_rest = (
        {k: v for k, v in plan.items() if k not in lists} for plan in (old, new)
    )
    if difference := find_difference(old_rest, new_rest):
        return difference
    for part, items in lists.items():
        for item in items:
            if item not in new[part]:
                values = [item["number"]] if "number" in item else item.values()
                name = " ".join(str(value) for value in values if value)
                return f"without {part[:-1]} {name} now"
    return None


def check_folder(folder: Path, plan: Plan) -> None:
    """Raises UserError if a path for the results is taken."""
    folder = Path(folder)
    folders = [
        *(*reversed(folder.parents), folder),
        *(folder / "runs", folder / "figures", get_scratch(folder)),
        *(get_run_folder(folder, run) for run in plan.list_runs()),
    ]
    for path in folders:
        require(
            path.is_dir() or not os.path.lexists(path),
            f"--out: cannot write into {folder}: {path} is not a folder",
        )
    for name in (_PLAN_FILE, "results.parquet", "report.html"):
        require(
            not (folder / name).is_dir(),
            f"--out: cannot write into {folder}: {folder / name} is a folder",
        )


def get_scratch(folder: Path) -> Path:
    """Returns the folder for temporary files of the processes."""
    return Path(folder) / _SCRATCH


def enter_folder(folder: Path, plan: Plan) -> None:
    """Removes what a kill has left in the folder of this campaign.

    Raises:
        UserError: The folder holds another campaign, or something else.
    """
    check_folder(folder, plan)
    path = Path(folder) / _PLAN_FILE
    if not path.exists():
        require(
            not any(Path(folder).glob("runs/*/row.parquet")),
            f"--out: {folder} holds runs, but not their {_PLAN_FILE}: their "
            "campaign is unknown; give another folder",
        )
        return
    try:
        old = json.loads(path.read_text("utf-8"))
        difference = find_change(old, describe_plan(plan))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path}: is not a campaign's plan: {error}") from None
    require(
        difference is None,
        f"--out: {folder} holds another campaign ({difference}); give "
        "another folder, or the same options and perhaps more trials or cells",
    )
    # Parts of files that were being written at a kill.
    for half in Path(folder).rglob(PARTS):
        half.unlink(missing_ok=True)
    shutil.rmtree(get_scratch(folder), ignore_errors=True)


def open_folder(folder: Path, plan: Plan) -> None:
    """Makes the folder of a campaign, with its plan in it.

    Raises:
        UserError: It cannot be written.
    """
    text = json.dumps(describe_plan(plan), indent=2) + "\n"
    try:
        (Path(folder) / "runs").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(
            f"--out: cannot write into {folder}: {error.strerror}"
        ) from None
    write_atomically(
        Path(folder) / _PLAN_FILE, lambda p: p.write_text(text, "utf-8")
    )


def get_run_folder(folder: Path, run: PlannedRun) -> Path:
    """Returns the folder of a run."""
    return Path(folder) / "runs" / run.key


def store_run(
    folder: Path, run: PlannedRun, row: dict, files: dict[str, bytes]
) -> None:
    """Writes the results of a run, its row last.

    Args:
        folder: The campaign's.
        run: Which.
        row: Plain values by column: str, bool, int or float.
        files: Contents by file name.

    Raises:
        UserError: The folder cannot be written.
    """
    where = get_run_folder(folder, run)
    where.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        write_atomically(
            where / name, lambda p, content=content: p.write_bytes(content)
        )
    table = pa.Table.from_pylist([row])
    write_atomically(where / "row.parquet", lambda p: pq.write_table(table, p))


def read_rows(folder: Path, plan: Plan) -> dict[str, dict]:
    """Returns the rows of the finished runs by the runs' keys.

    Raises:
        UserError: A row cannot be read, or is another run's.
    """
    rows = {}
    for run in plan.list_runs():
        path = get_run_folder(folder, run) / "row.parquet"
        if path.exists():
            try:
                (rows[run.key],) = pq.read_table(path).to_pylist()
            except (OSError, ValueError, pa.ArrowException) as error:
                reason = str(error).splitlines()[0]
                raise UserError(
                    f"{path}: cannot be read ({reason}); remove it to have "
                    "the run repeated"
                ) from None
            wrong = [
                name
                for name, value in make_row(run, {}).items()
                # NaN is not equal to itself.
                if rows[run.key].get(name) != value and value == value
            ]
            require(
                not wrong,
                f"{path}: is of another run ({', '.join(wrong)}); remove it "
                "to have the run repeated",
            )
    return rows


def make_row(run: PlannedRun, metrics: dict) -> dict:
    """Returns the row of a run.

    Args:
        run: Which.
        metrics: Numbers that follow from its samples.
    """
    trial = run.trial
    about = {
        "run": run.key,
        "sensing": run.cell.sensing,
        "configuration": run.cell.configuration,
        "variant": run.cell.variant,
        "trial": trial.number if trial else 0,
        "seed": trial.seed if trial else 0,
        "speed": trial.speed if trial else np.nan,
        "stature": trial.stature if trial else np.nan,
    }
    return about | metrics


def make_results(plan: Plan, rows: dict[str, dict]) -> list[dict]:
    """Returns all rows in the order of the plan.

    Adds `productivity_measured`, t_NoHRI / t_HRI (the paper's Eq. 10a) with
    t_NoHRI from the run without a person; NaN for a run that was not
    finished when its time was up. It checks `productivity`, which takes
    t_NoHRI from the run's own samples.

    Args:
        plan: The campaign's.
        rows: By the runs' keys; runs that failed are missing.
    """
    alone = rows.get(ALONE, {}).get("task_time_s", np.nan)
    return [
        row | {"productivity_measured": alone / row["task_time_s"]}
        for row in (rows.get(run.key) for run in plan.list_runs())
        if row is not None
    ]


def write_results(folder: Path, results: list[dict]) -> Path:
    """Writes results.parquet, one row per run; returns its path."""
    path = Path(folder) / "results.parquet"
    # Rows of an older version may lack some columns.
    names = list(dict.fromkeys(name for row in results for name in row))
    table = pa.Table.from_pydict(
        {name: [row.get(name) for row in results] for name in names}
    )
    buffer = io.BytesIO()
    pq.write_table(table, buffer)
    write_atomically(path, lambda p: p.write_bytes(buffer.getvalue()))
    return path
