"""Counts alarms of the self-hit watch where nothing is wrong.

`make false-alarms` runs the default scenario with one seed after the other
until an hour is simulated, on all cores. Prints a line for each run and the
sum.
"""

import concurrent.futures
import itertools
import multiprocessing
import os
import sys

from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.simulation import Run
from tofssm_drake.diagrams.workcell import make_workcell
from tofssm_drake.perception.self_hit_watch import view_state

_HOURS = 1.0


def count_alarms(seed: int) -> tuple[float, list[str], float, float, float]:
    """Runs the default scenario once.

    Returns:
        The simulated time, s; the alarms; the highest sums of a sensor and of a
        misfit, and the longest travel of a riding hit, m.
    """
    scenario = load_scenario(text=f"random_seed: {seed}")
    workcell = make_workcell(scenario)
    run = Run(workcell=workcell, scenario=scenario)
    watch = workcell.diagram.GetSubsystemByName("monitor").GetSubsystemByName(
        "self_hit_watch"
    )
    context = watch.GetMyContextFromRoot(run.context)
    said = []
    highest = [0.0, 0.0, 0.0]
    progress = run.advance()
    while not progress.finished:
        state = view_state(
            watch.model, context.get_discrete_state().value().copy()
        )
        for i, values in enumerate(
            (state.sensor_sum, state.misfit_sum, state.ride_travel)
        ):
            highest[i] = max(highest[i], float(values.max()))
        health = watch.GetOutputPort("self_hit_health").Eval(context)
        said += [line for line in health.problem if line]
        progress = run.advance()
    return progress.time, said, *highest


def main() -> int:
    """Runs seeds for the given hours; returns 1 if there was an alarm."""
    hours, alarms = 0.0, 0
    print(
        f"simulates {_HOURS:g} h; each line takes a minute or two", flush=True
    )
    seeds = itertools.count()
    # Forked processes and compiled kernels do not go together.
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(
        os.cpu_count(), mp_context=context
    ) as pool:
        while hours < _HOURS:
            some = list(itertools.islice(seeds, 4))
            for seed, result in zip(
                some, pool.map(count_alarms, some), strict=True
            ):
                time, said, sensor, misfit, travel = result
                hours += time / 3600.0
                alarms += len(set(said))
                print(
                    f"seed {seed}: {time:.1f} s, highest sum of a sensor "
                    f"{sensor:.1f}, of a misfit {misfit:.1f}, longest riding "
                    f"hit {travel:.2f} m; alarms: {sorted(set(said))}",
                    flush=True,
                )
    print(f"{hours:.2f} h simulated, {alarms} alarms")
    return int(alarms > 0)


if __name__ == "__main__":
    sys.exit(main())
