"""A campaign of one trial: every cell once, on all cores."""

import subprocess
import sys
import time

import psutil
import pyarrow.parquet as pq


def run_campaign(out):
    """Runs it; returns the most memory its processes had at a time, MB."""
    command = [
        *(sys.executable, "-m", "tofssm_drake.scripts.main", "experiments"),
        *("--trials", "1", "--out", out),
    ]
    most = 0
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        parent = psutil.Process(process.pid)
        while process.poll() is None:
            most = max(most, measure_memory(parent))
            time.sleep(0.5)
    assert process.returncode == 0
    return most / 2**20


def measure_memory(parent):
    """Returns what a process and its children hold, bytes.

    Pages that several of them share are counted once.
    """
    total = 0
    for process in [parent, *parent.children(recursive=True)]:
        try:
            total += process.memory_full_info().pss
        except psutil.NoSuchProcess:
            continue
    return total


def test_campaign(benchmark, tmp_path):
    """From a cold start to the report, start of the processes included."""
    memory = benchmark.pedantic(
        run_campaign, args=(tmp_path,), rounds=1, iterations=1
    )
    rows = pq.read_table(tmp_path / "results.parquet").to_pylist()
    assert len(rows) == 13
    simulated = sum(row["simulated_s"] for row in rows)
    taken = benchmark.stats.stats.max
    benchmark.extra_info["simulated_s"] = simulated
    benchmark.extra_info["simulated_s_per_s"] = simulated / taken
    benchmark.extra_info["peak_memory_MB"] = memory
