"""Version of the gait solver: every source file that determines a gait changes it."""

from __future__ import annotations

import ast
from pathlib import Path

import atalante_control
from atalante_control.gait_optimization import solve

PACKAGE = Path(next(iter(atalante_control.__path__)))
#: Modules that only print progress.
NO_EFFECT = {"gait_optimization/progress.py"}


def imported(path: Path) -> set[Path]:
    """Return the files of `atalante_control` that a file imports."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("atalante_control"):
            base = PACKAGE.joinpath(*str(node.module).split(".")[1:])
            found |= {base.with_suffix(".py"), base / "__init__.py", *(base / f"{n.name}.py" for n in node.names)}
    return {file for file in found if file.exists()}


def test_all_modules_that_determine_a_gait_are_part_of_the_version() -> None:
    todo, seen = [PACKAGE / "gait_optimization" / f"{name}.py" for name in ("solve", "second_start", "verify")], set()
    while todo:
        path = todo.pop()
        if path not in seen:
            seen.add(path)
            todo += imported(path)
    hashed = {file for pattern in solve._SOURCES for file in PACKAGE.glob(pattern)}
    missing = {str(path.relative_to(PACKAGE)) for path in seen - hashed} - NO_EFFECT
    assert missing == set()
