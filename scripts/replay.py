"""`tofssm replay`: runs the monitor once more on what was recorded."""

from pathlib import Path
from typing import Annotated

import typer

from tofssm_drake.diagrams.hardware_replay import replay_record
from tofssm_drake.hardware.run_record import RunReader
import tofssm_drake.scripts.options as options


def replay(
    file: Annotated[
        Path,
        typer.Argument(
            parser=options.parse_path,
            help="What `tofssm hardware --record` wrote.",
        ),
    ],
) -> int:
    """Run the monitor on a record, and compare all that it says.

    The exit code is 1 if it says something else than it did then.
    """
    result = replay_record(RunReader(file))
    line = f"{result.ticks} ticks, {result.end_time:.2f} s, "
    if not result.differences:
        print(f"{line}all states as recorded")
        return 0
    print(f"{line}{result.differences} differ; {result.first}")
    return 1
