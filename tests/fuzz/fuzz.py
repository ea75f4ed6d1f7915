"""Coverage-guided fuzzing of every parser: `make fuzz`.

    python tests/fuzz/fuzz.py [--runs N] [PARSER ...]

Each parser runs in a process of its own. One that raises an error that it does
not name, takes more than a second of the processor or 500 MB, hangs, or ends
the process, fails; the input that does it is written to `build/fuzz`.
"""

import argparse
import os
from pathlib import Path
import subprocess
import sys
import time

_ROOT = Path(__file__).parents[2]
_CRASHES = _ROOT / "build" / "fuzz"
_INSTRUMENTED = [
    "tofssm_drake.diagrams.scenario",
    "tofssm_drake.diagrams.yaml_check",
    "tofssm_drake.people.bvh_file",
    "tofssm_drake.raycast.gltf_file",
    "tofssm_drake.raycast.obj_file",
    "tofssm_drake.raycast.vtk_file",
    "tofssm_drake.recording.run_record",
    "tofssm_drake.ringlink.ring_frame",
    "tofssm_drake.rtde.rtde_protocol",
]
# Of the processor, s: another program may delay any input.
_SLOWEST = 1.0
# Of the clock, s.
_HANGS = 60
_MEMORY = 500


def main() -> int:
    """Fuzzes; returns 1 if a parser fails."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--runs", type=int, default=100_000)
    options.add_argument("--in-process", action="store_true")
    options.add_argument("parser", nargs="*")
    given = options.parse_args()
    sys.path[:0] = [str(_ROOT / "tests" / "fuzz"), str(_ROOT / "tests/people")]
    if given.in_process:
        fuzz(given.parser[0], given.runs)
        return 0
    from parsers import PARSERS

    failed = [
        name
        for name in given.parser or PARSERS
        if not fuzz_in_process(name, given.runs)
    ]
    print(f"failed: {', '.join(failed)}" if failed else "all parsers held")
    return int(bool(failed))


def fuzz_in_process(name: str, runs: int) -> bool:
    """Returns whether a parser held; prints what libFuzzer says of it."""
    print(f"{name}: {runs} inputs", flush=True)
    command = [sys.executable, __file__, "--in-process", "--runs", str(runs)]
    done = subprocess.run(
        [*command, name],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        # Numba does not know instrumented code; kernels run as plain Python.
        env=os.environ | {"NUMBA_DISABLE_JIT": "1"},
    )
    lines = done.stdout.decode(errors="replace").splitlines()
    print("\n".join(lines[-3 if done.returncode == 0 else -40 :]), flush=True)
    return done.returncode == 0


def fuzz(name: str, runs: int) -> None:
    """Fuzzes one parser; ends the process."""
    import atheris

    with atheris.instrument_imports(include=_INSTRUMENTED):
        from parsers import PARSERS, SEEDS

    def parse(data):
        start = time.process_time()
        PARSERS[name](data)
        taken = time.process_time() - start
        assert taken < _SLOWEST, f"it took {taken:.1f} s"

    corpus = _CRASHES / f"{name}-seeds"
    corpus.mkdir(parents=True, exist_ok=True)
    for i, seed in enumerate(SEEDS[name]):
        (corpus / f"{i}").write_bytes(seed)
    longest = max(map(len, SEEDS[name]))
    atheris.Setup(
        [
            *(name, f"-runs={runs}", f"-timeout={_HANGS}", "-seed=1"),
            *(f"-rss_limit_mb={_MEMORY}", f"-max_len={2 * longest}"),
            f"-artifact_prefix={_CRASHES}/{name}-",
            str(corpus),
        ],
        parse,
    )
    atheris.Fuzz()


if __name__ == "__main__":
    sys.exit(main())
