"""Beats a simulated robot's heartbeat until it is killed."""

import sys

from tofssm_drake.messages import SliderCommand
from tofssm_drake.rtde.rtde_client import RtdeClient
from tofssm_drake.rtde.rtde_config import RtdeConfig


def main():
    """Answers each report; says so after the tenth."""
    sequence = beat = -1
    with RtdeClient(
        RtdeConfig(host=sys.argv[1], port=int(sys.argv[2]))
    ) as client:
        while True:
            report = client.wait_for_report(after=sequence, timeout=1.0)
            sequence, beat = report.sequence, beat + 1
            client.send(
                SliderCommand(
                    sequence=sequence,
                    mask=int(beat == 0),
                    speed_fraction=1.0,
                    heartbeat=beat,
                )
            )
            if beat == 10:
                print("beating", flush=True)


if __name__ == "__main__":
    main()
