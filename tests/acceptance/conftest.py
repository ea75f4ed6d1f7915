"""Complete runs, made once for all tests that use them."""

import dataclasses as dc
import functools
import json

from fault_rows import Moment, make_cell
import numpy as np
from pydrake.math import RigidTransform
import pytest

from tofssm_drake.carried_objects import ON_TOOL
from tofssm_drake.diagrams.scenario import dump_scenario, load_scenario
from tofssm_drake.diagrams.simulation import Run
from tofssm_drake.diagrams.workcell import make_workcell
from tofssm_drake.metrics.metrics import calc_summary


@dc.dataclass(frozen=True, kw_only=True)
class Look:
    """A view of the cell."""

    carried: list[int]
    """Numbers of the products on the tool."""
    placed: int
    X_WG: RigidTransform
    """Pose of the gripper."""
    X_WP: list[RigidTransform]
    """Poses of the products."""
    reason: str
    """Why the robot is not in the normal state."""


class Looker:
    """Looks into the cell through the SceneGraph, as a camera would."""

    def __init__(self, workcell, products):
        self._station = workcell.station.diagram
        self._monitor = workcell.diagram.GetSubsystemByName("monitor")
        self._decision = self._monitor.GetOutputPort("decision")
        plant = workcell.station.plant
        (gripper,) = plant.GetBodyIndices(
            plant.GetModelInstanceByName("gripper")
        )
        self._frame_ids = [plant.GetBodyFrameIdOrThrow(gripper)]
        for i in range(products):
            instance = plant.GetModelInstanceByName(f"product_{i}")
            (body,) = plant.GetBodyIndices(instance)
            self._frame_ids.append(plant.GetBodyFrameIdOrThrow(body))

    def look(self, root_context):
        context = self._station.GetMyContextFromRoot(root_context)

        def read(name):
            return self._station.GetOutputPort(name).Eval(context)

        query = read("geometry_query")
        # Copies, since the returned values change with time.
        X_WF = [
            RigidTransform(query.GetPoseInWorld(f)) for f in self._frame_ids
        ]
        return Look(
            carried=np.flatnonzero(read("carried_objects") == ON_TOOL).tolist(),
            placed=int(read("products_placed")[0]),
            X_WG=X_WF[0],
            X_WP=X_WF[1:],
            reason=self._decision.Eval(
                self._monitor.GetMyContextFromRoot(root_context)
            ).reason,
        )


_FINISHED = {}


def finish_scenario(name="Default", text=""):
    """Runs to the end; returns scenario, samples and a Look per step.

    Equal scenarios with different names or texts run once.
    """
    scenario = load_scenario(name=name, text=text)
    key = json.dumps(dump_scenario(scenario))
    if key not in _FINISHED:
        workcell = make_workcell(scenario)
        looker = Looker(workcell, scenario.task.products)
        run = Run(workcell=workcell, scenario=scenario)
        looks = []
        finished = False
        while not finished:
            finished = run.advance().finished
            looks.append(looker.look(run.context))
        _FINISHED[key] = scenario, run.make_samples(), looks
    return _FINISHED[key]


@functools.cache
def run_scenario(name="Default", text=""):
    """Runs a scenario to its end; returns its samples and its summary."""
    _, samples, _ = finish_scenario(name, text)
    return samples, calc_summary(samples)


@pytest.fixture(scope="session")
def run():
    return run_scenario


@pytest.fixture(scope="session")
def looks():
    """Returns what was seen of a run, every 0.2 s."""
    return lambda name="Default", text="": finish_scenario(name, text)[2]


@pytest.fixture(scope="session")
def fault_cells():
    """Returns robots at full speed, and about to stop for somebody."""
    alone = make_cell(Moment.ALONE)
    return {
        Moment.ALONE: alone,
        Moment.HELD: make_cell(Moment.HELD),
        Moment.COMES: alone,
    }
