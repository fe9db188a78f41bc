"""Mutation testing of the safety core with mutmut.

    python tests/mutation/mutate.py [PART...] [--without PART...] [--third {1,2,3}]

or `make mutation`. PART is a part of the safety core, such as limiter. The default is the whole safety core.

mutmut makes small changes (mutants) in the source code. A mutant is killed if a test fails, otherwise it survives. The file
SURVIVORS.md lists the accepted survivors with reasons. Each part is tested by its own tests only, in a copy of the project in
.mutation/. A killed mutant is not tested again until its function changes. A surviving mutant is tested in every run. Delete
.mutation/ to test all mutants. With --third, a third of the mutants is tested, also those that were killed before.

The exit code is 1 if fewer than 95 % of the tested mutants are killed, if a survivor is not listed, or if a listed mutant is
killed. The last condition is checked only without --third.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import chdir
from pathlib import Path

from core import CORE
from mutmut.mutation.diff_apply import get_diff_for_mutant
from survivors import Mutant, listed, mutant

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
WORK = ROOT / ".mutation"
REQUIRED = 0.95
#: Number of parts that are tested at the same time. The preparation of a part uses only one core.
PARALLEL = 2
#: Last digits of the numbers of the mutants in each third.
THIRDS = {1: "0369", 2: "147", 3: "258"}

PACKAGES = ("atalante_hal", "dbc/atalante_dbc", "control/atalante_control", "emulator/atalante_emulator")
#: Exit codes of mutmut for a survivor: 0 if all tests passed, 33 if no test reaches the mutant.
SURVIVED = (0, 33)
#: Exit codes of mutmut for a mutant that was not tested.
NOT_TESTED = (None, 2, 37)

#: Options of pytest. Each mutant runs pytest once, so unnecessary plugins would take most of the time.
PLUGINS = (
    "-p mutant_time_limit -p interpret_core -p _hypothesis_pytestplugin "
    "-p no:cacheprovider -p no:unraisableexception -p no:threadexception"
)
PYPROJECT = """
[tool.pytest.ini_options]
testpaths = ["tests"]
pythonpath = ["tests/fuzz", "tests/witness", "tests/hal/safety/plausibility"]
addopts = "-q --strict-markers --import-mode=importlib --hypothesis-profile=mutation -m 'not exhaustive' {plugins}"
markers = ["exhaustive", "long", "sample(n)"]

[tool.mutmut]
source_paths = {packages}
only_mutate = {files}
also_copy = ["dbc"]
pytest_add_cli_args_test_selection = {tests}
timeout_constant = 20.0
timeout_multiplier = 3.0
"""


class PartTest:
    """Mutation test of one part of the safety core. It works in its own directory.

    Args:
        part: name of the part.
        third: third of the mutants to test; None means all mutants.
    """

    def __init__(self, part: str, third: int | None) -> None:
        self.part, (self._files, self._tests) = part, CORE[part]
        self._digits = THIRDS[third] if third else None
        self._work = WORK / part

    def _prepare(self) -> None:
        """Copy the project. Results of mutants in unchanged functions are kept."""
        self._work.mkdir(parents=True, exist_ok=True)
        before = self._sources()
        # Delete old copies, because mutmut does not update files that it has copied before.
        mutants = self._work / "mutants"
        kept = (*self._files, "mutmut-stats.json")
        for old in mutants.rglob("*"):
            if old.is_file() and not str(old.relative_to(mutants)).startswith(kept):
                old.unlink()
        # Copy the folder `dbc`, too, because some tests read the DBC file there.
        for package in (*PACKAGES, "dbc", "tests"):
            target = self._work / Path(package).name
            if target.exists():
                shutil.rmtree(target)
            shutil.copytree(ROOT / package, target, ignore=shutil.ignore_patterns("__pycache__", ".*", "mutation"))
        if self._sources() != before:
            # The statistics list the tests that reach each function, so they are out of date after a change of these files.
            (mutants / "mutmut-stats.json").unlink(missing_ok=True)
        text = PYPROJECT.format(
            packages=json.dumps([Path(package).name for package in PACKAGES]),
            files=json.dumps(self._files),
            plugins=PLUGINS,
            tests=json.dumps([f"tests/{name}" for name in self._tests]),
        )
        (self._work / "pyproject.toml").write_text(text)

    def _sources(self) -> dict[str, bytes]:
        """Return the copied files of the part and of its tests: name -> content."""
        paths = [self._work / name for name in (*self._files, *(f"tests/{test}" for test in self._tests))]
        return {path.name: path.read_bytes() for path in paths if path.exists()}

    def run(self, children: int) -> float:
        """Test the mutants; without a third, only those that were not killed before.

        Returns:
            Duration [s].

        Raises:
            SystemExit: If mutmut fails.
        """
        start = time.monotonic()
        self._prepare()
        for file in self._files:
            meta = self._meta(file)
            if meta.exists():
                record = json.loads(meta.read_text())
                codes = record["exit_code_by_key"]
                record["exit_code_by_key"] = {name: None if code in SURVIVED else code for name, code in codes.items()}
                meta.write_text(json.dumps(record))
        environment = {
            **os.environ,
            "PYTHONPATH": str(HERE),
            "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
            "HYPOTHESIS_STORAGE_DIRECTORY": str(self._work / ".hypothesis"),
        }
        command = [sys.executable, "-m", "mutmut", "run", "--max-children", str(children)]
        if self._digits:
            command.append(f"*__mutmut_*[{self._digits}]")
        done = subprocess.run(
            command,
            cwd=self._work,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        if done.returncode:
            sys.exit(f"{done.stdout}\nmutmut failed in part {self.part} (exit code {done.returncode})")
        return time.monotonic() - start

    def results(self) -> Iterator[tuple[str, int, list[Mutant]]]:
        """Yield the name, the number of tested mutants and the survivors of each module.

        Raises:
            SystemExit: If a mutant was not tested.
        """
        for file in self._files:
            recorded: dict[str, int | None] = json.loads(self._meta(file).read_text())["exit_code_by_key"]
            codes = {name: code for name, code in recorded.items() if not self._digits or name[-1] in self._digits}
            for name, code in codes.items():
                if code in NOT_TESTED:
                    sys.exit(f"the mutant {name} was not tested (exit code {code}): run the command again")
            survivors = [self._mutant(file, name) for name, code in codes.items() if code in SURVIVED]
            yield _module(file), len(codes), survivors

    def _meta(self, file: str) -> Path:
        return self._work / "mutants" / f"{file}.meta"

    def _mutant(self, file: str, name: str) -> Mutant:
        """Return the mutant that has the given name in mutmut."""
        with chdir(self._work):
            shown = get_diff_for_mutant(name, path=file).splitlines()
        mangled = name.rsplit("__mutmut_", 1)[0].rpartition(".")[2]
        plain = mangled.removeprefix("x").replace("ǁ", ".").strip(".").removeprefix("_")
        return mutant(f"{_module(file)}.{plain}", shown)


def _module(file: str) -> str:
    return file.removesuffix(".py").replace("/", ".")


def main(arguments: Sequence[str] | None = None) -> int:
    """Test the mutants and compare the survivors with SURVIVORS.md."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts_help = f"parts to test: {', '.join(CORE)}; default: all"
    parser.add_argument("part", nargs="*", choices=[*CORE, []], metavar="PART", help=parts_help)
    parser.add_argument(
        "--without", nargs="+", choices=CORE, default=[], metavar="PART", help="parts that are not tested"
    )
    parser.add_argument(
        "--third", type=int, choices=THIRDS, help="test only this third of the mutants; default: all mutants"
    )
    parser.add_argument(
        "--children", type=int, default=os.cpu_count() or 1, help="mutants tested in parallel; default: number of cores"
    )
    options = parser.parse_args(arguments)
    known = listed()
    modules: list[str] = []
    survivors: list[Mutant] = []
    total = 0
    parts = [part for part in options.part or CORE if part not in options.without]
    if not parts:
        parser.error("--without must leave at least one part, got all parts")
    tests = [PartTest(part, options.third) for part in parts]
    with ThreadPoolExecutor(PARALLEL) as pool:
        try:
            for test, seconds in zip(tests, pool.map(lambda test: test.run(options.children), tests), strict=True):
                for module, count, alive in test.results():
                    modules.append(module)
                    survivors += alive
                    total += count
                    print(f"{module}: {count - len(alive)} of {count} mutants killed", flush=True)
                print(f"{test.part}: {seconds:.0f} s", flush=True)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    expected = Counter(m for m in known if any(m.function.startswith(f"{module}.") for module in modules))
    unlisted = Counter(survivors) - expected
    killed = Counter[Mutant]() if options.third else expected - Counter(survivors)
    for survivor in unlisted.elements():
        print(
            f"\nsurvived, but is not in SURVIVORS.md: add a test that kills it, or list it with a reason:\n\n{survivor}"
        )
    for entry in killed.elements():
        print(f"\nis in SURVIVORS.md, but did not survive: remove it from the list:\n\n{entry}")
    for part in options.without:
        print(f"\n{part} was not tested")
    score = 1.0 - len(survivors) / total
    if options.third:
        print(f"\nonly third {options.third} of the mutants was tested")
    print(f"\n{score:.1%} of {total} mutants killed, at least {REQUIRED:.0%} are required")
    return int(score < REQUIRED or bool(unlisted) or bool(killed))


if __name__ == "__main__":
    sys.exit(main())
