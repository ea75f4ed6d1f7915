"""`tofssm` with a system that raises once a file exists.

failing_runner.py FILE hardware ...
"""

from pathlib import Path
import sys

from tofssm_drake.laws import tri_ssm
from tofssm_drake.scripts.main import run


def main():
    """Runs it."""
    trigger, function = Path(sys.argv[1]), tri_ssm.calc_ring_states

    def fail(**arguments):
        if trigger.exists():
            raise RuntimeError("something is broken")
        return function(**arguments)

    tri_ssm.calc_ring_states = fail
    sys.exit(run(sys.argv[2:]))


if __name__ == "__main__":
    main()
