"""Line and branch coverage of the safety core by its own tests alone: it ends with 1 when less than all of it is covered.

    python tests/mutation/cover.py      or `make coverage`

What a property test draws a hundred times is drawn a few times here: once is enough to come through a line.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from core import CORE

ROOT = Path(__file__).resolve().parents[2]
#: Where the files of the core are, under the roots of their packages.
ROOTS = (".", "control", "emulator")


def main() -> int:
    """Run the tests of the core, report."""
    files = [
        path for files, _ in CORE.values() for file in files for root in ROOTS if (path := ROOT / root / file).exists()
    ]
    tests = sorted({f"tests/{test}" for _, tests in CORE.values() for test in tests})
    include = ",".join(map(str, files))
    coverage = [sys.executable, "-m", "coverage"]
    with tempfile.TemporaryDirectory() as folder:
        # Machine code has no lines.
        environment = {**os.environ, "COVERAGE_FILE": str(Path(folder) / "coverage"), "NUMBA_DISABLE_JIT": "1"}
        run = [
            "run",
            "--branch",
            f"--include={include}",
            "-m",
            "pytest",
            "--hypothesis-profile=coverage",
            "-m",
            "not exhaustive",
            *tests,
        ]
        subprocess.run([*coverage, *run], cwd=ROOT, env=environment, check=True)
        report = ["report", "--show-missing", "--skip-covered", "--fail-under=100"]
        return subprocess.run([*coverage, *report], cwd=ROOT, env=environment, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
