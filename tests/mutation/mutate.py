"""Mutation testing of the safety core with mutmut: every surviving mutant is argued in SURVIVORS.md, or a test is missing.

    python tests/mutation/mutate.py [MODULE...]      or `make mutation`; modules such as limiter, default: all of the core

Each module is judged by its own tests alone, in a copy of the project under .mutation/ that is laid out as mutmut wants it. A
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
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
WORK = ROOT / ".mutation"
SURVIVORS = HERE / "SURVIVORS.md"
REQUIRED = 0.95

PACKAGES = ("atalante_hal", "dbc/atalante_dbc", "control/atalante_control", "emulator/atalante_emulator")
#: The safety core, and the tests that have to notice a change of it.
CORE = {
    "atalante_hal/e2e.py": ("test_e2e.py", "test_image.py"),
    "atalante_hal/image.py": ("test_image.py",),
    "atalante_hal/judgement.py": ("test_judgement.py",),
    "atalante_hal/diagnostics.py": ("test_diagnostics.py",),
    "atalante_hal/fault_memory.py": ("test_fault_memory.py", "test_judgement.py"),
    "atalante_hal/plausibility/finding.py": ("test_plausibility.py",),
    "atalante_hal/plausibility/encoders.py": ("test_plausibility.py",),
    "atalante_hal/plausibility/imus.py": ("test_plausibility.py",),
    "atalante_hal/plausibility/feet.py": ("test_plausibility.py",),
    "atalante_hal/plausibility/stillness.py": ("test_plausibility.py",),
    "atalante_hal/plausibility/plausibility.py": ("test_plausibility.py",),
    "atalante_hal/heartbeats.py": ("test_heartbeats.py",),
    "atalante_hal/transceiver.py": ("test_transceiver.py",),
    "atalante_hal/pendant.py": ("test_hal_pendant.py",),
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
only_mutate = ["{module}"]
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
    """The mutants of one module and the tests that are to notice them, in a directory of their own."""

    def __init__(self, module: str) -> None:
        self.module = module
        self.name = module.removesuffix(".py").replace("/", ".")
        self._work = WORK / Path(module).stem
        self._meta = self._work / "mutants" / f"{module}.meta"

    def lay_out(self) -> None:
        """Copy the project; files that are as they were keep their time, and the mutants in them their verdicts."""
        self._work.mkdir(parents=True, exist_ok=True)
        for package in (*PACKAGES, "tests"):
            target = self._work / Path(package).name
            if target.exists():
                shutil.rmtree(target)
            shutil.copytree(ROOT / package, target, ignore=shutil.ignore_patterns("__pycache__", ".*", "mutation"))
        text = PYPROJECT.format(
            packages=json.dumps([Path(package).name for package in PACKAGES]),
            module=self.module,
            tests=json.dumps([f"tests/{name}" for name in CORE[self.module]]),
        )
        (self._work / "pyproject.toml").write_text(text)

    def judge(self, children: int) -> None:
        """Let mutmut judge every mutant that was not killed before; it shows its progress itself."""
        if self._meta.exists():
            meta = json.loads(self._meta.read_text())
            codes = meta["exit_code_by_key"]
            meta["exit_code_by_key"] = {name: None if code in LIVES else code for name, code in codes.items()}
            self._meta.write_text(json.dumps(meta))
        hypothesis = str(self._work / ".hypothesis")
        environment = {**os.environ, "PYTHONPATH": "", "HYPOTHESIS_STORAGE_DIRECTORY": hypothesis}
        self._mutmut("run", "--max-children", str(children), environment=environment)

    def verdicts(self) -> dict[str, bool]:
        """Every mutant by mutmut's name, and whether it lives.

        Raises:
            SystemExit: a mutant was not judged.
        """
        judged: dict[str, int | None] = json.loads(self._meta.read_text())["exit_code_by_key"]
        for name, code in judged.items():
            if code in UNKNOWN:
                sys.exit(f"{name} was not judged (exit code {code}); run mutmut again in {self._work}")
        return {name: code in LIVES for name, code in judged.items()}

    def mutant(self, name: str) -> Mutant:
        """The mutant of mutmut's name."""
        shown = self._mutmut("show", name, capture=True).splitlines()
        changed = [line for line in shown if line[:1] in "+-" and not line.startswith(("+++", "---"))]
        removed, added = (tuple(line[1:].strip() for line in changed if line[0] == sign) for sign in "-+")
        module, _, mangled = name.rsplit("__mutmut_", 1)[0].rpartition(".")
        plain = mangled.removeprefix("x").replace("ǁ", ".").strip(".").removeprefix("_")
        return Mutant(f"{module}.{plain}", removed, added)

    def _mutmut(self, *arguments: str, environment: dict[str, str] | None = None, capture: bool = False) -> str:
        command = [sys.executable, "-m", "mutmut", *arguments]
        ran = subprocess.run(command, cwd=self._work, env=environment, capture_output=capture, text=True, check=True)
        return ran.stdout or ""


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
    trials = [Trial(module) for module in CORE if not wanted.module or Path(module).stem in wanted.module]
    known = listed(SURVIVORS.read_text(encoding="utf-8"))
    alive: list[Mutant] = []
    told, total, killed = [], 0, 0
    for trial in trials:
        start = time.monotonic()
        trial.lay_out()
        trial.judge(wanted.children)
        verdicts = trial.verdicts()
        living = [trial.mutant(name) for name, lives in verdicts.items() if lives]
        alive += living
        total += len(verdicts)
        killed += len(verdicts) - len(living)
        seconds = time.monotonic() - start
        told.append(f"{trial.name}: {len(verdicts) - len(living)} of {len(verdicts)} mutants killed, {seconds:.0f} s")
    print("\n".join(told))
    unlisted = [m for m in alive if m not in known]
    gone = [m for m in known if m not in alive and any(m.function.startswith(f"{trial.name}.") for trial in trials)]
    for survivor in unlisted:
        print(f"\nlives and is not in SURVIVORS.md; kill it with a test, or argue it there:\n\n{survivor}")
    for survivor in gone:
        print(f"\nis in SURVIVORS.md and does not live; take it out:\n\n{survivor}")
    print(f"\n{killed / total:.1%} of {total} mutants killed, {REQUIRED:.0%} are required")
    return int(killed < REQUIRED * total or bool(unlisted) or bool(gone))


if __name__ == "__main__":
    sys.exit(main())
