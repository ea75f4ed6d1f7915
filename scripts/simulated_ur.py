"""`tofssm simulated-ur`: a simulated robot controller, for tests."""

from typing import Annotated

import typer

from tofssm_drake.arms.cell_plant import make_cell_plant
from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.arms.ur_arm import UrArm
from tofssm_drake.diagrams.drivers import Rtde, find_real_cell
from tofssm_drake.diagrams.scenario import Scenario, load_scenario
from tofssm_drake.diagrams.tasks import make_task_path
from tofssm_drake.errors import UserError, require
from tofssm_drake.rtde.rtde_server import Faults, RtdeServer
from tofssm_drake.rtde.simulated_ur import SimulatedUr, SimulatedUrConfig
import tofssm_drake.scripts.options as options
from tofssm_drake.scripts.simulate import catch_stop, interrupt_on_stop
from tofssm_drake.tasks.program import PickAndPlace

# Option by setting.
_OPTIONS = {
    "robot.series": "--series",
    "robot.start": "--start",
    "robot.ramp": "--ramp",
    "robot.watchdog_timeout": "--watchdog",
    "robot.watchdog_action": "--watchdog-action",
}


def simulated_ur(
    host: Annotated[
        str, typer.Option(help="Address to listen on.")
    ] = "127.0.0.1",
    port: Annotated[
        int, typer.Option(help="RTDE's TCP port; 0: a free one.")
    ] = 30004,
    dashboard_port: Annotated[
        int,
        typer.Option(help="The dashboard's TCP port; 0: a free one, -1: none."),
    ] = 29999,
    scenario_file: options.ScenarioFile = None,
    scenario_name: options.ScenarioName = "Default",
    scenario_text: options.ScenarioText = "",
    model: Annotated[
        str | None,
        typer.Option(help="Of the robot; default: the scenario's, e.g. ur5e."),
    ] = None,
    series: Annotated[
        str | None,
        typer.Option(
            help="CB3 or e-Series; default: that of the model.",
            metavar="cb3|e",
        ),
    ] = None,
    products: Annotated[
        int | None,
        typer.Option(help="How many products are picked and placed."),
    ] = None,
    loop: Annotated[
        bool, typer.Option(help="Start again when the program is done.")
    ] = False,
    start: Annotated[
        str,
        typer.Option(
            help="When the program starts: at once, with the first heartbeat "
            "or with the dashboard's play.",
            metavar="now|heartbeat|dashboard",
        ),
    ] = "now",
    ramp: Annotated[
        float,
        typer.Option(help="Time to follow the slider over its full range, s."),
    ] = 0.2,
    watchdog: Annotated[
        float,
        typer.Option(
            help="The watchdog acts if the heartbeat stalls for this long, s; "
            "0: no watchdog."
        ),
    ] = 0.0,
    watchdog_action: Annotated[
        str, typer.Option(help="What the watchdog does.", metavar="stop|pause")
    ] = "stop",
    slider_resets_on_pause: Annotated[
        bool, typer.Option(help="A pause sets the slider to 100 %.")
    ] = False,
    protective_stop_after_zero: Annotated[
        bool,
        typer.Option(help="Protective stop when the slider leaves 0."),
    ] = False,
    text_messages: Annotated[
        bool, typer.Option(help="Send text messages before replies and data.")
    ] = False,
    skip_every: Annotated[
        int, typer.Option(help="Leave out every n-th data package; 0: none.")
    ] = 0,
    fragment: Annotated[
        int, typer.Option(help="Send at most this many bytes at once; 0: all.")
    ] = 0,
) -> int:
    """Simulate a UR's controller: RTDE, dashboard and a running program.

    Robot and program are those of the scenario.

    It serves until Ctrl-C or SIGTERM. When it is ready it prints a line with
    its address.
    """
    scenario = _find_scenario(
        load_scenario(
            filename=scenario_file, name=scenario_name, text=scenario_text
        ),
        model,
        products,
    )
    driver = find_real_cell(scenario.driver)
    if not isinstance(driver, Rtde):
        raise UserError(
            f"driver: !{type(driver).__name__} is another brand's; only !Rtde "
            "has a controller that can be simulated"
        )
    config = SimulatedUrConfig(
        heartbeat_register=driver.robot.heartbeat_register,
        products_register=driver.robot.products_register,
        gripper_output=driver.gripper_output,
        series=series or find_series(scenario.robot),
        loop=loop,
        start=start,
        ramp=ramp,
        watchdog_timeout=watchdog,
        watchdog_action=watchdog_action,
        slider_resets_on_pause=slider_resets_on_pause,
        protective_stop_after_zero=protective_stop_after_zero,
    )
    with options.blame(_OPTIONS):
        config.check("robot")
    for name, number in (
        ("--port", port),
        ("--dashboard-port", dashboard_port),
    ):
        require(
            -1 <= number <= 65535 and (number >= 0 or name != "--port"),
            f"{name}: must be a TCP port from 0 to 65535, got {number}",
        )
    require(
        skip_every >= 0 and skip_every != 1,
        f"--skip-every: must be 0 or at least 2, got {skip_every}",
    )
    require(fragment >= 0, f"--fragment: must be 0 or more, got {fragment}")
    with catch_stop() as stopped:
        with interrupt_on_stop(stopped, "interrupted before the start"):
            robot = make_robot(config, scenario)
        server = RtdeServer(
            robot=robot,
            host=host,
            port=port,
            dashboard_port=None if dashboard_port < 0 else dashboard_port,
            faults=Faults(
                text_messages=text_messages,
                skip_every=skip_every,
                fragment=fragment,
            ),
        )
        print(describe(server, scenario.robot.model), flush=True)
        server.run(lambda: bool(stopped))
    return 0


def _find_scenario(scenario, model, products):
    """Returns the scenario with the options of the command line."""
    require(
        isinstance(scenario.robot, UrArm),
        "robot: only a !UrArm has a controller that can be simulated",
    )
    changed = {}
    if model is not None:
        scenario.robot.model = model
        changed["robot.model"] = "--model"
    if products is not None:
        require(
            isinstance(scenario.task, PickAndPlace),
            "--products: is for the task !PickAndPlace",
        )
        scenario.task.products = products
        changed["task.products"] = "--products"
    with options.blame(changed):
        scenario.check()
    return scenario


def find_series(robot: UrArm) -> str:
    """Returns the series of an arm, as `SimulatedUrConfig` names it."""
    return "cb3" if robot.is_cb3 else "e"


def make_robot(config: SimulatedUrConfig, scenario: Scenario) -> SimulatedUr:
    """Returns a robot whose kernels are compiled.

    Args:
        config: Settings; checked.
        scenario: Of robot and program.
    """
    kinematics = ArmKinematics.from_plant(make_cell_plant(arm=scenario.robot))
    try:
        path = make_task_path(scenario.task, kinematics, scenario.robot)
    except UserError as error:
        raise UserError(
            f"{error}; the task must fit the arm: change it with "
            "--scenario-text, or take a scenario of such an arm, e.g. "
            "--scenario-file examples/my_arm.yaml --scenario-name UR5e"
        ) from None
    robot = SimulatedUr(
        config=config,
        path=path,
        kinematics=kinematics,
    )
    # Compiles what the first cycle needs, so that its timing is steady.
    robot.step()
    return robot


def describe(server: RtdeServer, model: str) -> str:
    """Returns the line that says where a simulated robot can be reached.

    Args:
        server: Of the robot.
        model: Of the robot.
    """
    host, port = server.address
    name = f"UR{model.removeprefix('ur')}"
    line = f"simulated {name}, {server.robot.rate} Hz, RTDE at {host}:{port}"
    if server.dashboard_address is None:
        return line
    host, port = server.dashboard_address
    return f"{line}, dashboard at {host}:{port}"
