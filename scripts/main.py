"""The command `tofssm` and how it fails: one line, exit code 2."""

import sys

import typer
from typer.exceptions import TyperException

from tofssm_drake.errors import UserError


def make_app() -> typer.Typer:
    """Makes the command with its subcommands.

    They are imported here and not above: it takes a second, in which Ctrl-C
    has to work as well.
    """
    from tofssm_drake.scripts.experiments import experiments
    from tofssm_drake.scripts.hardware import hardware
    from tofssm_drake.scripts.hardware_demo import hardware_demo
    from tofssm_drake.scripts.replay import replay
    from tofssm_drake.scripts.simulate import simulate
    from tofssm_drake.scripts.simulated_rings import simulated_rings
    from tofssm_drake.scripts.simulated_ur import simulated_ur

    app = typer.Typer(
        name="tofssm",
        help="Speed and separation monitoring with on-robot "
        "Time-of-Flight rings.",
        add_completion=False,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
    )
    app.command()(simulate)
    app.command()(experiments)
    app.command()(hardware)
    app.command("hardware-demo")(hardware_demo)
    app.command()(replay)
    app.command("simulated-rings")(simulated_rings)
    app.command("simulated-ur")(simulated_ur)
    return app


def run(arguments: list[str] | None = None) -> int:
    """Runs the command line and returns its exit code.

    Args:
        arguments: without the program's name; None takes sys.argv.

    Returns:
        0: done. 2: a mistake of the user, told in one line on stderr.
        130: interrupted, what was recorded until then is written.
    """
    try:
        command = typer.main.get_command(make_app())
        result = command.main(
            args=arguments, prog_name="tofssm", standalone_mode=False
        )
    except (UserError, TyperException) as error:
        message = getattr(error, "format_message", error.__str__)()
        print(f"tofssm: {' '.join(message.split())}", file=sys.stderr)
        return 2
    except (KeyboardInterrupt, typer.Abort):
        print("tofssm: interrupted", file=sys.stderr)
        return 130
    return result or 0


def main() -> None:
    """Entry point of the `tofssm` command."""
    sys.exit(run())


if __name__ == "__main__":
    main()
