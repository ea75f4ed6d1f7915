"""The files in the folder of a campaign.

- `campaign.json`: the plan. A folder takes one plan only.
- `runs/<cell>-<trial>/`: `samples.parquet`, `scans.parquet` and, written
  last, `row.parquet`: the metrics of the samples in one row. A run that has
  one is finished and never repeated.
- `results.parquet`: all rows, in the order of the plan, with the numbers that
  need several runs.
"""

from collections.abc import Iterator
import contextlib
import datetime
import fcntl
import hashlib
import io
import json
import os
from pathlib import Path
import shutil
import socket

import pyarrow as pa

from tofssm_drake.errors import UserError, require
from tofssm_drake.recording.columns import add_descriptions
from tofssm_drake.recording.samples import PARTS, write_atomically
from tofssm_drake.recording.tables import read_table, write_table
from tofssm_drake.studies.campaign import Plan, PlannedRun, describe_plan
from tofssm_drake.studies.results import COLUMNS, make_row
from tofssm_drake.user_files import MEGABYTE, decode_json, read_file

_PLAN_FILE = "campaign.json"
_SCRATCH = ".scratch"
_LOCK = ".lock"
# With thousands of cells it has a few megabytes.
_LARGEST_PLAN = 100 * MEGABYTE
_DIGEST = b"digest"


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
            name = f"{part[:-1]} {_name_item(item)}"
            same = [i for i in new[part] if _identify(i) == _identify(item)]
            if not same:
                return f"without {name} now"
            if difference := find_difference(item, same[0], name):
                return difference
    return None


def _identify(item):
    """Returns what makes a cell or trial itself: all but its settings."""
    return {k: v for k, v in item.items() if not isinstance(v, dict)}


def _name_item(item):
    """Returns the name of a cell or trial."""
    if "number" in item:
        return str(item["number"])
    return " ".join(str(value) for value in _identify(item).values() if value)


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


@contextlib.contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Keeps every other campaign out of a folder for the duration of a `with`.

    The system releases the lock of a process that was killed.

    Raises:
        UserError: Another process has it, or the folder cannot be made.
    """
    path = Path(folder) / _LOCK
    made = [p for p in path.parents if not p.exists()]
    with _open_lock(path) as file:
        _lock(file, folder)
        try:
            yield
        finally:
            if made and os.listdir(path.parent) == [_LOCK]:
                # Nothing came of it.
                path.unlink()
                for empty in made:
                    empty.rmdir()


def _open_lock(path):
    """Opens the file that is locked; makes its folder."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return path.open("a+", encoding="utf-8")
    except OSError as error:
        raise UserError(
            f"--out: cannot write into {path.parent}: {error.strerror}"
        ) from None


def _lock(file, folder):
    """Locks an open file and writes into it who has the lock."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.seek(0)
        raise UserError(
            f"--out: {folder} is used by another campaign, "
            f"{file.read().strip() or 'which has just started'}; wait for it, "
            "or give another folder"
        ) from None
    now = datetime.datetime.now().isoformat(" ", "seconds")
    file.truncate(0)
    file.write(f"process {os.getpid()} on {socket.gethostname()} since {now}\n")
    file.flush()


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
        old = decode_json(read_file(path, most=_LARGEST_PLAN))
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
    table = _make_table([row], run.cell)
    metadata = {**(table.schema.metadata or {}), _DIGEST: _digest(row)}
    table = table.replace_schema_metadata(metadata)
    write_atomically(where / "row.parquet", lambda p: write_table(table, p))


def read_rows(folder: Path, plan: Plan) -> dict[str, dict]:
    """Returns the rows of the finished runs by the runs' keys.

    Raises:
        UserError: A row cannot be read, or is another run's.
    """
    rows = {}
    for run in plan.list_runs():
        path = get_run_folder(folder, run) / "row.parquet"
        if path.exists():
            rows[run.key] = _read_row(path)
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


def _read_row(path):
    """Returns the row of a finished run.

    Raises:
        UserError: It cannot be read, or is not as it was written.
    """
    remedy = "remove it to have the run repeated"
    try:
        table = read_table(path)
        (row,) = table.to_pylist()
    except UserError as error:
        raise UserError(f"{error}; {remedy}") from None
    except ValueError:
        raise UserError(f"{path}: is not one row; {remedy}") from None
    digest = (table.schema.metadata or {}).get(_DIGEST, b"")
    require(
        digest == _digest(row),
        f"{path}: is not as it was written; {remedy}",
    )
    return row


def _digest(row):
    """Returns a digest of a row's values, which reveals a changed one."""
    text = json.dumps(row, sort_keys=True, default=repr)
    return hashlib.sha256(text.encode()).hexdigest().encode()


def _make_table(rows, cell):
    """Returns rows as a table whose columns say what they are."""
    # Rows of an older version may lack some columns.
    names = list(dict.fromkeys(name for row in rows for name in row))
    table = pa.Table.from_pydict(
        {name: [row.get(name) for row in rows] for name in names}
    )
    return add_descriptions(table, COLUMNS | dict(cell.COLUMNS))


def write_results(folder: Path, plan: Plan, results: list[dict]) -> Path:
    """Writes results.parquet, one row per run; returns its path."""
    path = Path(folder) / "results.parquet"
    table = _make_table(results, plan.cells[0])
    buffer = io.BytesIO()
    write_table(table, buffer)
    write_atomically(path, lambda p: p.write_bytes(buffer.getvalue()))
    return path
