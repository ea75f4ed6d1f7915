"""Reads a run into pandas: its units, its stops, its least distances.

Run it with `python examples/read_a_run.py out/default` after `make run`. It
needs pandas: `pip install --editable '.[examples]'`.
"""

from pathlib import Path
import sys

import pandas as pd
import pyarrow.parquet as pq


def read_run(folder):
    """Returns the table of samples; `attrs["unit"]` has each column's unit."""
    # Its pages have checksums; a damaged one is an error.
    table = pq.read_table(
        Path(folder) / "samples.parquet", page_checksum_verification=True
    )
    samples = table.to_pandas()
    # pandas keeps no metadata of columns, so they are taken along.
    samples.attrs["unit"] = {
        field.name: field.metadata[b"unit"].decode() for field in table.schema
    }
    return samples


def count_stops(samples):
    """Returns how often the robot was told to stop, by reason."""
    is_stop = samples["robot_state"] == "stop"
    # It begins stopped, because nothing is known yet: that is not a stop.
    begins = is_stop & ~is_stop.shift(fill_value=True)
    reasons = samples.loc[begins, "reason"].astype(str)
    # The figures in a reason are different each time.
    return reasons.str.replace(r"\d+\.\d+", "#", regex=True).value_counts()


def find_least_distances(samples):
    """Returns the least distance of the person from each link's centre."""
    end = "_measured_distance"
    links = [name[: -len(end)] for name in samples if name.endswith(end)]
    kinds = ("measured_distance", "true_distance")
    return pd.DataFrame(
        {
            f"{kind} [{samples.attrs['unit'][f'{links[0]}_{kind}']}]": {
                link: samples[f"{link}_{kind}"].min() for link in links
            }
            for kind in kinds
        }
    )


if __name__ == "__main__":
    run = read_run(sys.argv[1] if len(sys.argv) > 1 else "out/default")
    print(
        "stops by reason:", count_stops(run).to_string(header=False), sep="\n"
    )
    print("\nleast distances:", find_least_distances(run).round(3), sep="\n")
