"""`tofssm describe`: lists the columns of a run's tables with their units."""

from pathlib import Path
from typing import Annotated

import pyarrow as pa
import typer

from tofssm_drake.errors import require
from tofssm_drake.recording.columns import read_description
from tofssm_drake.recording.tables import read_table
import tofssm_drake.scripts.options as options


def describe(
    run: Annotated[
        Path,
        typer.Argument(
            parser=options.parse_path,
            help="Folder of a run or of a campaign, or one of its tables.",
        ),
    ],
) -> int:
    """List the columns of the tables (*.parquet) with unit and meaning."""
    for path in find_tables(run):
        # All of it, so that damage is found.
        table = read_table(path)
        print(f"{path}: {table.num_rows} rows, {table.num_columns} columns")
        for line in list_columns(table.schema):
            print(line)
    return 0


def find_tables(run: Path) -> list[Path]:
    """Returns the tables of a run.

    Args:
        run: Folder, or a table.

    Raises:
        UserError: There is none.
    """
    paths = sorted(run.glob("*.parquet")) if run.is_dir() else [run]
    require(len(paths) > 0, f"RUN: there is no table (*.parquet) in {run}")
    return paths


def list_columns(schema: pa.Schema) -> list[str]:
    """Returns a line for each column: name, unit, meaning, names of codes.

    A `?` stands for what a table of an earlier version does not say.
    """
    columns = {field.name: read_description(field) for field in schema}
    width = max(map(len, columns), default=0)
    lines = []
    for name, column in columns.items():
        line = f"  {name:{width}}  {column.unit or '?':5}  "
        line += column.meaning or "?"
        if column.codes:
            line += f" ({', '.join(column.codes)})"
        lines.append(line)
    return lines
