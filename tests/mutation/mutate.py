"""Mutation testing of the safety core with mutmut: every surviving mutant is argued in SURVIVORS.md, or a test is missing.

    python tests/mutation/mutate.py [MODULE...]      or `make mutation`; modules such as limiter, default: all of the core

mutmut wants every package beside the tests, so a copy of the project is laid out that way in .mutation/ and worked on there;
what was judged before and has not changed since is not judged again. It ends with 1 when fewer than 95 % of the mutants
are killed, when a mutant survives that is not listed, or when a listed one does not exist any more.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
WORK = ROOT / ".mutation"
SURVIVORS = HERE / "SURVIVORS.md"
REQUIRED = 0.95

PACKAGES = (
    "atalante_hal",
    "dbc/atalante_dbc",
    "control/atalante_control",
    "emulator/atalante_emulator",
    "tools/atalante_tools",
)
#: The safety core, and the tests that have to notice a change of it.
CORE = {
    "atalante_hal/e2e.py": ("test_e2e.py", "test_image.py"),
    "atalante_hal/image.py": ("test_image.py",),
    "atalante_hal/judgement.py": ("test_judgement.py",),
    "atalante_hal/diagnostics.py": ("test_diagnostics.py",),
    "atalante_hal/fault_memory.py": ("test_fault_memory.py", "test_judgement.py"),
    "atalante_hal/supervisor.py": ("test_supervisor.py",),
    "atalante_hal/cia402.py": ("test_cia402.py",),
    "atalante_hal/limiter.py": ("test_limiter.py",),
    "atalante_control/guide.py": ("test_guide.py",),
    "atalante_emulator/drive.py": ("test_drive.py",),
    "atalante_emulator/emergency.py": ("test_emergency.py",),
    "atalante_emulator/collision.py": ("test_collision.py",),
}
#: mutmut's exit codes of a mutant that lives: survived, and no test at all.
LIVES = (0, 33)
#: And of one that was never judged.
UNKNOWN = (None, 2, 37)

PYPROJECT = """
[tool.pytest.ini_options]
testpaths = ["tests"]
pythonpath = ["tests/fuzz", "tests/witness"]
addopts = "-q --strict-markers --import-mode=importlib -p no:cacheprovider --hypothesis-profile=mutation"

[tool.mutmut]
source_paths = {packages}
only_mutate = {files}
also_copy = ["atalante_dbc", "atalante_tools"]
pytest_add_cli_args_test_selection = {tests}
timeout_constant = 10.0
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


def lay_out(modules: Sequence[str]) -> None:
    """Copy the project into the layout mutmut wants; files that are as they were keep their time, and their verdicts."""
    WORK.mkdir(exist_ok=True)
    for package in (*PACKAGES, "tests"):
        source, target = ROOT / package, WORK / Path(package).name
        if target.exists():
            shutil.rmtree(target)
        shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__", "mutation"))
    tests = sorted({f"tests/{name}" for module in modules for name in CORE[module]})
    text = PYPROJECT.format(
        packages=json.dumps(sorted({module.split("/")[0] for module in CORE})),
        files=json.dumps(list(modules)),
        tests=json.dumps(tests),
    )
    (WORK / "pyproject.toml").write_text(text)


def run(children: int) -> None:
    """Let mutmut judge every mutant; it shows its progress itself."""
    environment = {**os.environ, "PYTHONPATH": "", "HYPOTHESIS_STORAGE_DIRECTORY": str(WORK / ".hypothesis")}
    command = [sys.executable, "-m", "mutmut", "run", "--max-children", str(children)]
    subprocess.run(command, cwd=WORK, env=environment, check=True)


def verdicts(modules: Sequence[str]) -> Iterator[tuple[str, bool]]:
    """Every mutant by mutmut's name, and whether it lives.

    Raises:
        SystemExit: a mutant was not judged.
    """
    for module in modules:
        judged = json.loads((WORK / "mutants" / f"{module}.meta").read_text())["exit_code_by_key"]
        for name, code in judged.items():
            if code in UNKNOWN:
                sys.exit(f"{name} was not judged (exit code {code}); run mutmut again in {WORK}")
            yield name, code in LIVES


def mutant(name: str) -> Mutant:
    """The mutant of mutmut's name."""
    command = [sys.executable, "-m", "mutmut", "show", name]
    shown = subprocess.run(command, cwd=WORK, capture_output=True, text=True, check=True).stdout.splitlines()
    changed = [line for line in shown if line[:1] in "+-" and not line.startswith(("+++", "---"))]
    removed, added = (tuple(line[1:].strip() for line in changed if line[0] == sign) for sign in "-+")
    function = name.rsplit("__mutmut_", 1)[0]
    module, _, mangled = function.rpartition(".")
    plain = mangled.removeprefix("x").replace("ǁ", ".").strip(".").removeprefix("_")
    return Mutant(f"{module}.{plain}", removed, added)


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
    parser.add_argument("module", nargs="*", metavar="MODULE", help="of the core, e.g. limiter; default: all")
    parser.add_argument("--children", type=int, default=os.cpu_count() or 1, help="mutants at a time")
    wanted = parser.parse_args(arguments)
    modules = [file for file in CORE if not wanted.module or Path(file).stem in wanted.module]
    lay_out(modules)
    run(wanted.children)
    known = listed(SURVIVORS.read_text(encoding="utf-8"))
    judged = list(verdicts(modules))
    alive = [mutant(name) for name, lives in judged if lives]
    score = 1.0 - len(alive) / len(judged)
    unlisted = [m for m in alive if m not in known]
    names = {file.removesuffix(".py").replace("/", ".") for file in modules}
    gone = [m for m in known if m not in alive and any(m.function.startswith(f"{name}.") for name in names)]
    for module in modules:
        name = module.removesuffix(".py").replace("/", ".")
        mine = [lives for key, lives in judged if key.startswith(f"{name}.")]
        print(f"{name}: {len(mine) - sum(mine)} of {len(mine)} mutants killed")
    for survivor in unlisted:
        print(f"\nlives and is not in SURVIVORS.md; kill it with a test, or argue it there:\n\n{survivor}")
    for survivor in gone:
        print(f"\nis in SURVIVORS.md and does not live; take it out:\n\n{survivor}")
    print(f"\n{score:.1%} of {len(judged)} mutants killed, {REQUIRED:.0%} are required")
    return int(score < REQUIRED or bool(unlisted) or bool(gone))


if __name__ == "__main__":
    sys.exit(main())
