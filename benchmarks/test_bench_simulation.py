"""Whole runs of the default scenario without Meshcat, on one core.

Each round is a process of its own, so that memory and start-up are those of a
fresh one. What Numba compiles is compiled (and cached) in a round before.
"""

import json
import os
import subprocess
import sys

import pytest

_RUN = """
import json, resource, sys, time
start = time.perf_counter()
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.simulation import Run
from tofssm_drake.diagrams.workcell import make_workcell
imported = time.perf_counter()
scenario = load_scenario(name=sys.argv[1], text=sys.argv[2])
run = Run(workcell=make_workcell(scenario), scenario=scenario)
ready = time.perf_counter()
busy = time.process_time()
first = progress = run.advance()
while not progress.finished:
    progress = run.advance()
busy = time.process_time() - busy
samples = run.make_samples()
json.dump(
    {
        "import_s": imported - start,
        "build_s": ready - imported,
        "first_step_s": first.wall_time,
        "simulated_s": progress.time,
        "run_s": progress.wall_time,
        "busy_s": busy,
        "products_placed": progress.products_placed,
        "peak_memory_MB":
            resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    },
    sys.stdout,
)
"""


def _use_one_core():
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


def run_process(name, text=""):
    done = subprocess.run(
        [sys.executable, "-c", _RUN, name, text],
        stdout=subprocess.PIPE,
        check=True,
        # Linear algebra libraries must not start threads either.
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        preexec_fn=_use_one_core,
    )
    return json.loads(done.stdout)


@pytest.mark.parametrize(
    ("name", "count"), [("Default", 5), ("NoHuman", 1), ("SixteenSensors", 1)]
)
def test_whole_run(benchmark, name, count):
    """Import, build and run; the figures give the run separately."""
    rounds = []
    run_process(name, "{simulation_duration: 0.2}")
    benchmark.pedantic(
        lambda: rounds.append(run_process(name)), rounds=count, iterations=1
    )
    best = min(rounds, key=lambda figures: figures["run_s"])
    assert best["products_placed"] == 10
    benchmark.extra_info["real_time_factor"] = (
        best["simulated_s"] / best["run_s"]
    )
    # The same without the time when other processes had the core.
    benchmark.extra_info["simulated_per_cpu_time"] = (
        best["simulated_s"] / best["busy_s"]
    )
    benchmark.extra_info["simulated_s"] = best["simulated_s"]
    benchmark.extra_info["peak_memory_MB"] = max(
        figures["peak_memory_MB"] for figures in rounds
    )


def test_startup(benchmark):
    """From a cold start to the first 0.2 s."""
    rounds = []
    text = "{simulation_duration: 0.2}"
    run_process("Default", text)
    benchmark.pedantic(
        lambda: rounds.append(run_process("Default", text)),
        rounds=3,
        iterations=1,
    )
    for name in ("import_s", "build_s", "first_step_s"):
        benchmark.extra_info[name] = min(r[name] for r in rounds)


def test_report(benchmark, tmp_path):
    """What `tofssm simulate` does for a very short run."""
    command = [
        *(sys.executable, "-m", "tofssm_drake.scripts.main", "simulate"),
        *("--duration", "0.2", "--no-recording", "--out", tmp_path),
    ]
    benchmark.pedantic(
        lambda: subprocess.run(
            command, check=True, capture_output=True, preexec_fn=_use_one_core
        ),
        rounds=3,
        iterations=1,
    )
