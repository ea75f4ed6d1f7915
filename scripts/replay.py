"""`tofssm replay`: runs the monitor again on a recorded run."""

from pathlib import Path
from typing import Annotated

import typer

from tofssm_drake.diagrams.hardware_replay import replay_record
from tofssm_drake.recording.run_record import RunReader
import tofssm_drake.scripts.options as options


def replay(
    file: Annotated[
        Path,
        typer.Argument(
            parser=options.parse_path,
            help="File written by `tofssm hardware --record`.",
        ),
    ],
) -> int:
    """Run the monitor on a record again and compare its results.

    The exit code is 1 if a result differs or if the record is damaged. A
    record that ends early, for example because the process was killed, is
    replayed as far as it goes.
    """
    reader = RunReader(file)
    result = replay_record(reader)
    line = f"{result.ticks} ticks, {result.end_time:.2f} s, "
    if not result.differences:
        print(f"{line}all states as recorded")
    else:
        print(f"{line}{result.differences} differ; {result.first}")
    if reader.problem:
        how = "damaged" if reader.is_damaged else "incomplete"
        print(f"the record is {how}: {reader.problem}")
    return int(bool(result.differences) or reader.is_damaged)
