"""Mutation testing of the safety core with mutmut: every surviving mutant is argued in SURVIVORS.md, or a test is missing.

    python tests/mutation/mutate.py [PART...] [--without PART...]

or `make mutation`; parts such as limiter, default: all of the core.

Each part is judged by its own tests alone, in a copy of the project under .mutation/ that is laid out as mutmut wants it. A
mutant that was killed stays so until its function changes; one that lived is judged again every time. Take .mutation/ away to
begin anew. It ends with 1 when fewer than 95 % of the mutants are killed, when a mutant survives that is not listed, or when a
listed one does not exist any more.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import chdir
from dataclasses import dataclass
from pathlib import Path

from core import CORE
from mutmut.mutation.diff_apply import get_diff_for_mutant

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
WORK = ROOT / ".mutation"
SURVIVORS = HERE / "SURVIVORS.md"
REQUIRED = 0.95

PACKAGES = ("atalante_hal", "dbc/atalante_dbc", "control/atalante_control", "emulator/atalante_emulator")
#: mutmut's exit codes of a mutant that lives: survived, and no test at all.
LIVES = (0, 33)
#: And of one that was never judged.
UNKNOWN = (None, 2, 37)

#: Each mutant is a pytest of its own, which spent most of its time on plugins and on collecting garbage.
PLUGINS = (
    "-p impatience -p _hypothesis_pytestplugin -p no:cacheprovider -p no:unraisableexception -p no:threadexception"
)
PYPROJECT = """
[tool.pytest.ini_options]
testpaths = ["tests"]
pythonpath = ["tests/fuzz", "tests/witness", "tests/hal/safety/plausibility"]
addopts = "-q --strict-markers --import-mode=importlib --hypothesis-profile=mutation -m 'not exhaustive' {plugins}"
markers = ["exhaustive"]

[tool.mutmut]
source_paths = {packages}
only_mutate = {files}
also_copy = ["dbc"]
pytest_add_cli_args_test_selection = {tests}
timeout_constant = 20.0
timeout_multiplier = 3.0
"""


@dataclass(frozen=True)
class Mutant:
    """A mutant as its file would show it; the number mutmut gives it changes with every edit, this does not."""

    function: str
    removed: tuple[str, ...]
    added: tuple[str, ...]

    def __str__(self) -> str:
        lines = [f"-{line}" for line in self.removed] + [f"+{line}" for line in self.added]
        return f"## `{self.function}`\n\n```diff\n" + "\n".join(lines) + "\n```\n"


class Trial:
    """The mutants of a part of the core and the tests that are to notice them, in a directory of their own."""

    def __init__(self, part: str) -> None:
        self._part, (self._files, self._tests) = part, CORE[part]
        self._work = WORK / part

    def lay_out(self) -> None:
        """Copy the project; files that are as they were keep their time, and the mutants in them their verdicts."""
        self._work.mkdir(parents=True, exist_ok=True)
        before = self._sources()
        # mutmut does not copy data again that it has copied once.
        mutants = self._work / "mutants"
        ours = (*self._files, "mutmut-stats.json")
        for old in mutants.rglob("*"):
            if old.is_file() and not str(old.relative_to(mutants)).startswith(ours):
                old.unlink()
        # The witness of the tests reads the DBC where it is in the project.
        for package in (*PACKAGES, "dbc", "tests"):
            target = self._work / Path(package).name
            if target.exists():
                shutil.rmtree(target)
            shutil.copytree(ROOT / package, target, ignore=shutil.ignore_patterns("__pycache__", ".*", "mutation"))
        if self._sources() != before:
            # Which tests reach a function was asked before it was there.
            (mutants / "mutmut-stats.json").unlink(missing_ok=True)
        text = PYPROJECT.format(
            packages=json.dumps([Path(package).name for package in PACKAGES]),
            files=json.dumps(self._files),
            plugins=PLUGINS,
            tests=json.dumps([f"tests/{name}" for name in self._tests]),
        )
        (self._work / "pyproject.toml").write_text(text)

    def _sources(self) -> dict[str, bytes]:
        """The files of the part and their tests, as they are laid out."""
        paths = [self._work / name for name in (*self._files, *(f"tests/{test}" for test in self._tests))]
        return {path.name: path.read_bytes() for path in paths if path.exists()}

    def judge(self, children: int) -> None:
        """Let mutmut judge every mutant that was not killed before; it shows its progress itself, at a terminal.

        Raises:
            SystemExit: it failed.
        """
        for file in self._files:
            meta = self._meta(file)
            if meta.exists():
                said = json.loads(meta.read_text())
                codes = said["exit_code_by_key"]
                said["exit_code_by_key"] = {name: None if code in LIVES else code for name, code in codes.items()}
                meta.write_text(json.dumps(said))
        environment = {
            **os.environ,
            "PYTHONPATH": str(HERE),
            "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
            "NUMBA_DISABLE_JIT": "1",  # machine code has no mutants
            "HYPOTHESIS_STORAGE_DIRECTORY": str(self._work / ".hypothesis"),
        }
        command = [sys.executable, "-m", "mutmut", "run", "--max-children", str(children)]
        output = None if sys.stdout.isatty() else subprocess.PIPE
        done = subprocess.run(
            command, cwd=self._work, env=environment, stdout=output, stderr=subprocess.STDOUT, text=True, check=False
        )
        if done.returncode:
            sys.exit(f"{done.stdout or ''}\nmutmut failed with the part {self._part} (exit code {done.returncode})")

    def verdicts(self) -> Iterator[tuple[str, int, list[Mutant]]]:
        """Each module's name, how many mutants it has, and those that live.

        Raises:
            SystemExit: a mutant was not judged.
        """
        for file in self._files:
            codes: dict[str, int | None] = json.loads(self._meta(file).read_text())["exit_code_by_key"]
            for name, code in codes.items():
                if code in UNKNOWN:
                    sys.exit(f"{name} was not judged (exit code {code}); run it again")
            alive = [self._mutant(file, name) for name, code in codes.items() if code in LIVES]
            yield _module(file), len(codes), alive

    def _meta(self, file: str) -> Path:
        return self._work / "mutants" / f"{file}.meta"

    def _mutant(self, file: str, name: str) -> Mutant:
        """The mutant of mutmut's name."""
        with chdir(self._work):
            shown = get_diff_for_mutant(name, path=file).splitlines()
        changed = [line for line in shown if line[:1] in "+-" and not line.startswith(("+++", "---"))]
        removed, added = (tuple(line[1:].strip() for line in changed if line[0] == sign) for sign in "-+")
        mangled = name.rsplit("__mutmut_", 1)[0].rpartition(".")[2]
        plain = mangled.removeprefix("x").replace("ǁ", ".").strip(".").removeprefix("_")
        return Mutant(f"{_module(file)}.{plain}", removed, added)


def _module(file: str) -> str:
    return file.removesuffix(".py").replace("/", ".")


_ENTRY = re.compile(r"^## `([^`]+)`\n\n```diff\n(.*?)\n```\n\n(\S.*?)(?=\n## |\Z)", re.DOTALL | re.MULTILINE)


def listed(text: str) -> dict[Mutant, str]:
    """The survivors of SURVIVORS.md, each with its argument."""
    found = {}
    for function, diff, argument in _ENTRY.findall(text):
        lines = diff.splitlines()
        removed, added = (tuple(line[1:].strip() for line in lines if line[0] == sign) for sign in "-+")
        found[Mutant(function, removed, added)] = argument.strip()
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Mutate, judge, compare with the list."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", nargs="*", choices=[*CORE, []], metavar="PART", help=", ".join(CORE) + "; default: all")
    parser.add_argument("--without", nargs="+", choices=CORE, default=[], metavar="PART", help="parts to leave out")
    parser.add_argument("--children", type=int, default=os.cpu_count() or 1, help="mutants at a time")
    wanted = parser.parse_args(arguments)
    known = listed(SURVIVORS.read_text(encoding="utf-8"))
    modules: list[str] = []
    alive: list[Mutant] = []
    total = 0
    parts = [part for part in wanted.part or CORE if part not in wanted.without]
    if not parts:
        parser.error("no part is left")
    for part in parts:
        trial, start = Trial(part), time.monotonic()
        trial.lay_out()
        trial.judge(wanted.children)
        for module, count, living in trial.verdicts():
            modules.append(module)
            alive += living
            total += count
            print(f"{module}: {count - len(living)} of {count} mutants killed", flush=True)
        print(f"{part}: {time.monotonic() - start:.0f} s", flush=True)
    unlisted = [m for m in alive if m not in known]
    gone = [m for m in known if m not in alive and any(m.function.startswith(f"{module}.") for module in modules)]
    for survivor in unlisted:
        print(f"\nlives and is not in SURVIVORS.md; kill it with a test, or argue it there:\n\n{survivor}")
    for survivor in gone:
        print(f"\nis in SURVIVORS.md and does not live; take it out:\n\n{survivor}")
    for part in wanted.without:
        print(f"\n{part} was left out")
    score = 1.0 - len(alive) / total
    print(f"\n{score:.1%} of {total} mutants killed, {REQUIRED:.0%} are required")
    return int(score < REQUIRED or bool(unlisted) or bool(gone))


if __name__ == "__main__":
    sys.exit(main())
