"""The command `tofssm` and how it fails: one line, exit code 2."""

from collections.abc import Iterator
import contextlib
import functools
import os
import signal
import sys

from tofssm_drake.errors import UserError


@contextlib.contextmanager
def leave_at_once() -> Iterator[None]:
    """Lets Ctrl-C end the process with one line and code 130.

    For the imports: an exception raised during them comes out of a library
    as an ImportError.
    """

    def leave(number, frame):
        os.write(2, b"tofssm: interrupted\n")
        os._exit(130)

    previous = signal.signal(signal.SIGINT, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)


def abort_on_interrupt(command):
    """Returns a command whose KeyboardInterrupt keeps its message.

    Typer would turn it into an exit code and print nothing.
    """
    import typer

    @functools.wraps(command)
    def run_command(*args, **kwargs):
        try:
            return command(*args, **kwargs)
        except KeyboardInterrupt as interrupt:
            raise typer.Abort(*interrupt.args) from None

    return run_command


def make_app():
    """Makes the command with its subcommands, a `typer.Typer`.

    They are imported here and not above, because it takes seconds in which
    Ctrl-C has to work too.
    """
    import typer

    from tofssm_drake.scripts.describe import describe
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
    app.command()(abort_on_interrupt(simulate))
    app.command()(abort_on_interrupt(experiments))
    app.command()(abort_on_interrupt(hardware))
    app.command("hardware-demo")(abort_on_interrupt(hardware_demo))
    app.command()(abort_on_interrupt(describe))
    app.command()(abort_on_interrupt(replay))
    app.command("simulated-rings")(abort_on_interrupt(simulated_rings))
    app.command("simulated-ur")(abort_on_interrupt(simulated_ur))
    return app


def run(arguments: list[str] | None = None) -> int:
    """Runs the command line and returns its exit code.

    Args:
        arguments: without the program's name; None takes sys.argv.

    Returns:
        0: done. 2: a mistake of the user, told in one line on stderr.
        130: interrupted, what was recorded until then is written.
    """
    import typer
    from typer.exceptions import TyperException

    try:
        command = typer.main.get_command(make_app())
        result = command.main(
            args=arguments, prog_name="tofssm", standalone_mode=False
        )
    except (UserError, TyperException) as error:
        message = getattr(error, "format_message", error.__str__)()
        print(f"tofssm: {' '.join(message.split())}", file=sys.stderr)
        return 2
    except (KeyboardInterrupt, typer.Abort) as interrupt:
        print(f"tofssm: {str(interrupt) or 'interrupted'}", file=sys.stderr)
        return 130
    return result or 0


def main() -> None:
    """Entry point of the `tofssm` command."""
    with leave_at_once():
        make_app()
    code = run()
    # All is done: a signal now must not change how it ended.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    sys.exit(code)


if __name__ == "__main__":
    main()
