"""SURVIVORS.md: each listed mutant changes code that exists, so `make mutation` cannot fail because of an outdated entry."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from core import CORE
from survivors import Mutant, listed, mutant, without_comment

ROOT = Path(__file__).parents[2]
PACKAGES = {"atalante_hal": ROOT, "atalante_control": ROOT / "control", "atalante_emulator": ROOT / "emulator"}
FILES = [file for files, _ in CORE.values() for file in files]


def source(function: str) -> list[str]:
    """Return the lines of a function of the safety core, without comments and indentation."""
    file = next(file for file in FILES if function.startswith(file.removesuffix(".py").replace("/", ".") + "."))
    text = (PACKAGES[file.partition("/")[0]] / file).read_text(encoding="utf-8")
    node: ast.AST = ast.parse(text)
    for name in function.removeprefix(file.removesuffix(".py").replace("/", ".") + ".").split("."):
        found = [child for child in ast.iter_child_nodes(node) if getattr(child, "name", None) in (name, f"_{name}")]
        assert found, f"SURVIVORS.md lists {function}, which does not exist"
        node = found[0]
    assert isinstance(node, ast.FunctionDef)
    return [without_comment(line) for line in text.splitlines()[node.lineno - 1 : node.end_lineno]]


@pytest.mark.parametrize("survivor", sorted(set(listed()), key=str), ids=lambda survivor: survivor.function)
def test_each_listed_mutant_changes_code_that_exists(survivor: Mutant):
    lines = source(survivor.function)
    for line in survivor.removed:
        assert lines.count(line) >= listed().count(survivor)


def test_comments_have_no_effect_on_the_identity_of_a_mutant():
    plain = mutant("module.function", ["-a = 1", "+a = 2", " b = 3"])
    assert mutant("module.function", ["--- a", "+++ b", "@@", '-a = 1  # "one"', "+a = 2  # one", " b = 3"]) == plain
    assert without_comment('  text = "# no comment"  # comment') == 'text = "# no comment"'
    assert without_comment("call(  # continues on the next line") == "call("
