"""Parquet files whose pages have checksums, which are verified on reading."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from tofssm_drake.errors import UserError


def write_table(table: pa.Table, where: Any, **options) -> None:
    """Writes a table.

    Args:
        table: The table.
        where: Path, or a stream.
        options: Of `pyarrow.parquet.write_table`.
    """
    pq.write_table(table, where, write_page_checksum=True, **options)


def read_table(path: Path, columns: Sequence[str] | None = None) -> pa.Table:
    """Reads a table.

    Args:
        path: The file.
        columns: Reads these only, those that there are; None: all.

    Raises:
        UserError: It cannot be read, or is damaged.
    """
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            if columns is None:
                return file.read()
            names = file.schema_arrow.names
            return file.read([name for name in names if name in columns])
    except (OSError, ValueError, pa.ArrowException) as error:
        raise _make_error(path, error) from None


def read_schema(path: Path) -> tuple[pa.Schema, int]:
    """Returns a table's schema and its number of rows.

    Raises:
        UserError: It cannot be read.
    """
    try:
        with pq.ParquetFile(path) as file:
            return file.schema_arrow, file.metadata.num_rows
    except (OSError, ValueError, pa.ArrowException) as error:
        raise _make_error(path, error) from None


def _make_error(path, error):
    reason = str(error).splitlines()[0] if str(error) else repr(error)
    return UserError(f"{path}: cannot be read: {reason}")
