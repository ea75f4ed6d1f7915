"""Settings of all tests."""

import importlib.util

from hypothesis import settings

# The first call of a kernel compiles it: no deadline on single examples.
settings.register_profile("tofssm", deadline=None)
settings.load_profile("tofssm")

# These compare with MuJoCo, which comes with the extra `peers`.
_OF_PEERS = "geometry/test_ray_peers.py"
collect_ignore = []
if importlib.util.find_spec("mujoco") is None:
    collect_ignore.append(_OF_PEERS)


def pytest_terminal_summary(terminalreporter):
    """Says at the end of a run what could not be compared."""
    if collect_ignore:
        terminalreporter.section("not compared with MuJoCo")
        terminalreporter.write_line(
            f"tests/{_OF_PEERS} was left out: install the extra 'peers'"
        )
