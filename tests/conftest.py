"""Settings of all tests."""

import importlib.util
import signal

from hypothesis import settings

# The first call of a kernel compiles it: no deadline on single examples.
settings.register_profile("tofssm", deadline=None)
settings.load_profile("tofssm")

# A shell starts what runs in its background with Ctrl-C ignored; the tests that
# interrupt a run need it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# These compare with others' software, which comes with the extra `peers`.
_OF_PEERS = {
    "mujoco": "raycast/test_ray_peers.py",
    "rtde_receive": "rtde/test_ur_rtde.py",
}
collect_ignore = [
    path
    for module, path in _OF_PEERS.items()
    if importlib.util.find_spec(module) is None
]


def pytest_terminal_summary(terminalreporter):
    """Says at the end of a run what could not be compared."""
    if collect_ignore:
        terminalreporter.section("not compared with others")
        for path in collect_ignore:
            terminalreporter.write_line(
                f"tests/{path} was left out: install the extra 'peers'"
            )
