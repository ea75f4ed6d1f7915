"""Looks for known faults in the pinned versions: `make audit`.

pip-audit asks the database of the Python Package Index about each version in
the constraints files; nothing is installed. Exit codes: 0 there is none, 1
there are some, 2 the database was not reached.
"""

import argparse
import json
from pathlib import Path
import subprocess
import sys

_ROOT = Path(__file__).parents[2]


def make_command(path: Path) -> list[str]:
    """Returns the command that asks about the versions in a file."""
    return [
        *(sys.executable, "-m", "pip_audit", "--requirement", str(path)),
        # Every package is listed with its version.
        *("--no-deps", "--disable-pip"),
        *("--progress-spinner", "off", "--format", "json"),
    ]


def audit(path: Path) -> int:
    """Prints what is known of the versions in a file; returns an exit code."""
    done = subprocess.run(make_command(path), capture_output=True, text=True)
    try:
        packages = json.loads(done.stdout)["dependencies"]
    except ValueError:
        last = (done.stderr.strip() or "it said nothing").splitlines()[-1]
        print(f"{path.name}: not audited, pip-audit failed: {last}")
        return 2
    faults = [
        f"{path.name}: {package['name']} {package['version']}: {fault['id']}, "
        f"mended in {', '.join(fault['fix_versions']) or 'no version'}"
        for package in packages
        for fault in package.get("vulns", ())
    ]
    skipped = [p["name"] for p in packages if "skip_reason" in p]
    if skipped:
        print(f"{path.name}: unknown there: {', '.join(skipped)}")
    print("\n".join(faults) or f"{path.name}: no known fault")
    return int(bool(faults))


def main() -> int:
    """Audits every constraints file; returns the worst exit code."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    return max(map(audit, sorted(_ROOT.glob("constraints-*.txt"))))


if __name__ == "__main__":
    sys.exit(main())
