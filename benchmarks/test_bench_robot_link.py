"""What the robot's link costs for each package, without the network.

At 500 Hz there are 2 ms for everything.
"""

from tofssm_drake.messages import RobotReport, SliderCommand
from tofssm_drake.rtde.rtde_fields import OUTPUT_TYPES
from tofssm_drake.rtde.rtde_protocol import PackageReader, Recipe
from tofssm_drake.rtde.rtde_report import ReportMaker, list_outputs
from tofssm_drake.rtde.slider import (
    SliderConfig,
    SliderState,
    step_slider,
)


def test_package_to_report(benchmark):
    names = list_outputs(24)
    types = [OUTPUT_TYPES[name] for name in names]
    recipe = Recipe(names, types, 1)
    package = recipe.encode(
        [(0.5,) * 6 if kind == "VECTOR6D" else 1 for kind in types]
    )
    make_report = ReportMaker(
        recipe, frequency=500, products_register=24, clock_jump=1.0
    )
    before = RobotReport()
    reader = PackageReader()

    def read():
        ((_, payload),) = reader.feed(package)
        return make_report(
            recipe.decode_flat(payload),
            before=before,
            time=0.0,
            last=0.998,
            session=0,
        )

    report = benchmark(read)
    assert report.timestamp == 1.0


def test_report_to_command(benchmark):
    config = SliderConfig()
    report = RobotReport(
        sequence=1,
        session=0,
        timestamp=1.0,
        robot_mode=7,
        safety_mode=1,
        runtime_state=2,
        target_speed_fraction=0.5,
    )
    state = SliderState(
        command=SliderCommand(sequence=0),
        session=0,
        timestamp=0.998,
        # Not the first report of its session.
        count=1,
        echo=0.5,
        fraction=0.5,
        confirmed=True,
        ceiling=1.0,
    )
    state = benchmark(step_slider, config, state, report, 0.5)
    assert state.command.mask == 0
