"""Run one command for each extra with the lowest versions that pyproject.toml allows.

    python tests/lowest/try_lowest.py

or `make lowest`, which first installs these versions. The exit code is 1 if the version of a direct dependency is not its lower
bound in pyproject.toml, if a command fails, or if a command skips a part of its work because a library is missing.
"""

from __future__ import annotations

import logging
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

from distributed import LocalCluster
from packaging.requirements import Requirement
from packaging.version import Version

ROOT = Path(__file__).resolve().parents[2]
ATALANTE = Path(sys.executable).with_name("atalante")
EXTRAS = ("emulator", "mujoco", "telemetry", "plot", "decode", "gaits", "campaign", "dask")
#: Texts in the output of a command that skips a part of its work because a library is missing.
WITHOUT = ("no figure", "nothing is published", "is missing", "not compared")


def requirements() -> Iterator[Requirement]:
    """Return the direct dependencies of the project and of the extras that its commands need."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    texts = {*project["dependencies"], *(text for extra in EXTRAS for text in project["optional-dependencies"][extra])}
    for requirement in map(Requirement, sorted(texts)):
        if requirement.name != project["name"]:
            yield requirement


def bound(requirement: Requirement) -> str:
    """Return the lower bound of a requirement."""
    return next(one.version for one in requirement.specifier if one.operator == ">=")


def run(*arguments: str | Path) -> None:
    """Run an `atalante` command. End the script if the command fails, or skips work because a library is missing."""
    line = " ".join(["atalante", *map(str, arguments)])
    print(line, flush=True)
    done = subprocess.run(
        [ATALANTE, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=900
    )
    missing = [words for words in WITHOUT if words in done.stdout]
    if done.returncode != 0 or missing:
        sys.exit(f"{done.stdout}\n{line}: exit code must be 0, got {done.returncode}; {', '.join(missing)}")


def main() -> None:
    """Compare the versions, then run the commands."""
    wrong = [
        f"{requirement}: the installed version must be the lower bound, got {version(requirement.name)}"
        for requirement in requirements()
        if Version(version(requirement.name)) != Version(bound(requirement))
    ]
    if wrong:
        sys.exit("\n".join(wrong))
    print(", ".join(f"{requirement.name} {version(requirement.name)}" for requirement in requirements()))
    with tempfile.TemporaryDirectory(prefix="atalante-lowest-") as name:
        out = Path(name)
        run("demo", "--steps", "2", "--shape", "constant", "--out", out / "demo", "--can-log", out / "demo.log")
        run("validate", out / "demo.log")
        run("demo", "--steps", "1", "--shape", "constant", "--engine", "mujoco", "--out", out / "mujoco")
        for suffix in ("mcap", "parquet"):
            run("decode", out / "demo.log", "-o", out / f"signals.{suffix}")
        patient = "--mass", "75", "--height", "175"
        run("model", *patient, "--show", out / "model.png")
        run("gait", "solve", *patient, "--plot", out / "gait.png", "--animate", out / "gait.gif")
        levels = (
            "--mass=60,70,85",
            "--height=1.65,1.75,1.85",
            "--step-length=0.12,0.15,0.18",
            "--step-duration=0.8,0.9,1",
            "--size=81",
        )
        run("gait", "library", "--out", out / "library", "--jobs", "2", *levels)
        run("gait", "fit", "--library", out / "library", "--out", out / "network.npz")
        run("demo", "--steps", "2", "--shape", "pinched", *patient, "--out", out / "patient")
        campaign = "faults", "campaign", "F28", "--no-pairs", "--no-endurance"
        run(*campaign, "--jobs", "2", "--out", out / "processes")
        with LocalCluster(
            n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address=None, silence_logs=logging.CRITICAL
        ) as cluster:
            run(*campaign, "--dask", cluster.scheduler_address, "--out", out / "cluster")


if __name__ == "__main__":
    main()
