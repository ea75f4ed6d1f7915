"""Whole runs of the default scenario without Meshcat, on one core.

Each round is a process of its own, so that memory and start-up are those of a
fresh one. What Numba compiles is compiled (and cached) in a round before.
"""

import json
import os
import statistics
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
        "steps_done": progress.steps_done,
        "peak_memory_MB":
            resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    },
    sys.stdout,
)
"""


# Arm, controller and program without anything that looks at them.
_ALONE = """
import json, sys, time
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.tasks.program import TaskProgram, make_program_path
from tofssm_drake.arms.sim_arm import make_sim_arm
from tofssm_drake.arms.cell_plant import make_cell_plant
scenario = load_scenario(name=sys.argv[1], text=sys.argv[2])
builder = DiagramBuilder()
program = builder.AddSystem(
    TaskProgram(
        path=make_program_path(
            scenario.task, ArmKinematics.from_plant(make_cell_plant())
        ),
        period=scenario.control_period,
    )
)
robot, _ = make_sim_arm(
    config=scenario.driver,
    arm=scenario.robot,
    initial_position=program.path.calc_motion(0.0)[0],
)
builder.AddSystem(robot)
speed = builder.AddSystem(ConstantVectorSource([1.0]))
builder.Connect(speed.get_output_port(), program.GetInputPort("speed_fraction"))
builder.Connect(
    program.GetOutputPort("motion_commanded"),
    robot.GetInputPort("motion_commanded"),
)
simulator = Simulator(builder.Build())
simulator.AdvanceTo(0.1)
busy = time.process_time()
simulator.AdvanceTo(program.path.duration)
busy = time.process_time() - busy
json.dump(
    {"simulated_s": program.path.duration - 0.1, "busy_s": busy}, sys.stdout
)
"""


def _use_one_core():
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


def run_process(name, text="", program=_RUN):
    done = subprocess.run(
        [sys.executable, "-c", program, name, text],
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
    assert best["steps_done"] == 10
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


def test_cost_over_the_arm_alone(benchmark):
    """CPU time of a simulated second, the whole loop over the arm alone.

    The two run in turns, so that what else the machine does hits both.
    """
    ratios = []
    run_process("Default", "{simulation_duration: 0.2}")

    def compare():
        alone = run_process("Default", program=_ALONE)
        whole = run_process("Default")
        ratios.append(
            (whole["busy_s"] / whole["simulated_s"])
            / (alone["busy_s"] / alone["simulated_s"])
        )

    benchmark.pedantic(compare, rounds=5, iterations=1)
    benchmark.extra_info["cost_over_arm_alone"] = statistics.median(ratios)
    benchmark.extra_info["least"] = min(ratios)
    benchmark.extra_info["most"] = max(ratios)


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
