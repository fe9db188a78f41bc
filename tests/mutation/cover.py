"""Measure line and branch coverage of the safety core by its own tests. The exit code is 1 if the coverage is below 100 %.

    python tests/mutation/cover.py      or `make coverage`

The long tests are left out, and property tests use only a few examples, because a single example is enough to cover a line.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from core import CORE

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
#: Root folders of the packages.
ROOTS = (".", "control", "emulator")


def main() -> int:
    """Run the tests of the safety core and print the coverage."""
    files = [
        path for files, _ in CORE.values() for file in files for root in ROOTS if (path := ROOT / root / file).exists()
    ]
    tests = sorted({f"tests/{test}" for _, tests in CORE.values() for test in tests})
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "coveragerc"
        config.write_text("[run]\nbranch = true\ninclude =\n" + "".join(f"    {file}\n" for file in files))
        environment = {**os.environ, "COVERAGE_FILE": str(Path(folder) / "coverage"), "PYTHONPATH": str(HERE)}
        command = [
            sys.executable,
            "-m",
            "pytest",
            "--numprocesses=logical",
            "--dist=worksteal",
            "-p",
            "interpret_core",
            "--cov",
            f"--cov-config={config}",
            "--cov-report=term-missing:skip-covered",
            "--cov-fail-under=100",
            "--hypothesis-profile=coverage",
            "-m",
            "not (long or exhaustive)",
            *tests,
        ]
        return subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
