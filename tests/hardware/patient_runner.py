"""`tofssm` on a computer so busy that reports may come seconds late.

patient_runner.py hardware ...
"""

import sys

from tofssm_drake.diagrams import hardware_run
from tofssm_drake.scripts.main import run

if __name__ == "__main__":
    hardware_run._LATEST = 10.0
    sys.exit(run(sys.argv[1:]))
