"""Check README and documentation: their commands run, their Python compiles, their links and paths exist."""

from __future__ import annotations

import json
import math
import os
import re
import shlex
import subprocess
import sys
import textwrap
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from atalante_control.airwalk.config import AirwalkConfig
from atalante_control.guide.disturbance import HandOver
from atalante_control.walking.config import WALK_GUIDE
from atalante_hal.bus.adapters import ADAPTERS
from atalante_hal.safety.diagnostics import Dtc
from atalante_tools.cli import COMMANDS, cli
from atalante_tools.faults.matrix import load_matrix

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = {str(page.relative_to(ROOT)): page.read_text() for page in (ROOT / "README.md", *sorted(DOCS.rglob("*.md")))}
MAKEFILE = (ROOT / "Makefile").read_text()
BLOCK = re.compile(r"^( *)```(\w*)[^\n]*\n(.*?)^\1```$", re.MULTILINE | re.DOTALL)
INCLUDE = re.compile(r"--8<-- \"([^\"]+)\"")
#: Pattern of command lines that are not run here -> reason. The first pattern that matches a line applies.
NOT_RUN = {
    r"-i socketcan|--can-interface": "needs a CAN interface",
    r"^make ": "builds, installs or runs the whole suite; continuous integration runs it",
    r"^\. ": "the tests run in this environment",
    r"^python examples/": "tests/project/test_examples.py runs the examples",
    r"^python -m pytest": "runs tests that are part of this suite",
    r"^atalante airwalk --steps 100": "runs until it is stopped; tests/project/test_examples.py runs it with the subscriber",
    r"faults\.reachability\.report$": "tests/faults/test_reachability.py runs the same searches and the report",
    r"^atalante gait (library|fit|check|verify)": "takes minutes, or needs the result of such a command",
    r"--network control/": "tests/control/gait_optimization/test_walk_verification.py solves it",
    r"^atalante faults campaign": "takes an hour",
    r"^atalante guide check --patients": "takes hours",
}


def blocks(page: str, language: str) -> list[str]:
    """Return the fenced blocks of a language in a page."""
    return [textwrap.dedent(text) for _, found, text in BLOCK.findall(PAGES[page]) if found == language]


def commands(page: str) -> list[str]:
    """Return the lines of the ```sh blocks of a page, without comments."""
    lines = [line for block in blocks(page, "sh") for line in block.splitlines()]
    return [line.split("  #")[0].strip() for line in lines if line.strip()]


def reason_not_to_run(line: str) -> str | None:
    """Return why a line is not run, or None if it is run."""
    return next((reason for pattern, reason in NOT_RUN.items() if re.search(pattern, line)), None)


def runnable(page: str) -> list[str]:
    """Return the lines of a page that are run, in their order. A command of README and another page runs for the other page."""
    shared = {line for other in PAGES if other != page for line in commands(other)} if page == "README.md" else set()
    return [line for line in commands(page) if line not in shared and reason_not_to_run(line) is None]


ALL = [(page, line) for page in PAGES for line in commands(page)]
MAKE = sorted(
    {match for page in PAGES.values() for match in re.findall(r"`?make ([a-z-]+)`?(?:$|`|  )", page, re.MULTILINE)}
)


def test_documentation_contains_commands_and_make_targets():
    assert sum(line.startswith("atalante ") for _, line in ALL) >= 20
    assert {"demo", "test", "docs"} <= set(MAKE)


def test_every_exclusion_pattern_matches_a_command():
    for pattern in NOT_RUN:
        assert any(re.search(pattern, line) for _, line in ALL), f"no command matches {pattern}"


@pytest.mark.parametrize("line", sorted({line for _, line in ALL if line.startswith("atalante ")}))
def test_documented_command_is_accepted_by_the_parser(line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Parse the line with the parser of the program, down to the subcommand, without running it."""
    (tmp_path / "runs").mkdir()  # folder and file that earlier commands of the page create
    (tmp_path / "runs" / "old.dbc").touch()
    (tmp_path / "dbc").symlink_to(ROOT / "dbc")
    monkeypatch.chdir(tmp_path)
    command: click.Command = cli
    arguments = shlex.split(line)[1:]
    context = click.Context(command)
    while isinstance(command, click.Group):
        name, arguments = arguments[0], arguments[1:]
        found = command.get_command(context, name)
        assert found is not None, f"no command {name}"
        context, command = click.Context(found, parent=context, info_name=name), found
    command.make_context(command.name, arguments, parent=context.parent)


@pytest.mark.parametrize("page", [page for page in PAGES if runnable(page)])
@pytest.mark.long
def test_commands_of_a_page_succeed_in_order(page: str, tmp_path: Path):
    """Run the commands in a temporary copy of the project root, to which they write their output."""
    for name in ("atalante_hal", "dbc", "examples", "tests"):
        (tmp_path / name).symlink_to(ROOT / name)
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    for line in runnable(page):
        done = subprocess.run(
            ["bash", "-c", line], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300
        )
        assert done.returncode == 0, f"{line}\n{done.stderr}"


@pytest.mark.parametrize("page", PAGES)
def test_python_blocks_compile_and_included_files_exist(page: str):
    for path in INCLUDE.findall(PAGES[page]):
        assert (ROOT / path).is_file(), path
    for block in blocks(page, "python"):
        text = INCLUDE.sub(lambda include: (ROOT / include[1]).read_text(), block)
        compile(text, page, "exec")


@pytest.mark.parametrize("target", MAKE)
def test_documented_make_target_exists(target: str):
    assert re.search(rf"^{target}:", MAKEFILE, re.MULTILINE)


def test_make_without_a_target_lists_every_target():
    done = subprocess.run(["make", "--no-print-directory"], cwd=ROOT, capture_output=True, text=True, check=True)
    (phony,) = re.findall(r"^\.PHONY: (.*)$", MAKEFILE, re.MULTILINE)
    assert [line.split()[0] for line in done.stdout.splitlines()] == phony.split()


@pytest.mark.parametrize("page", PAGES)
def test_paths_in_backticks_exist(page: str):
    paths = re.findall(r"`((?:[\w.-]+/)+[\w.-]*)`", PAGES[page])
    made = ("runs/", "site/", "failed/")  # written by commands
    missing = [path for path in paths if not path.startswith(made) and not (ROOT / path).exists()]
    assert missing == []


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_to_files(page: str):
    links = re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", PAGES[page])
    folder = (ROOT / page).parent
    assert [link for link in links if "://" not in link and not (folder / link).exists()] == []


def test_every_page_is_in_the_navigation_once():
    navigation = re.findall(r"^ +- [^:\n]+: (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    assert sorted(navigation) == sorted(str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md"))


def test_cli_page_lists_every_command():
    page = PAGES["docs/reference/cli.md"]
    assert re.findall(r"^\| `atalante (\w+)` \|", page, re.MULTILINE) == list(COMMANDS)


def test_adapter_page_agrees_with_the_adapter_table():
    page = PAGES["docs/howto/real-bus.md"]
    rows = re.findall(r"^\| `(\w+)` \| `([^`]+)` \| (.+) \|$", page, re.MULTILINE)
    usable = {name: adapter for name, adapter in ADAPTERS.items() if adapter.can_fd and not adapter.unusable}
    assert [(name, tried) for name, _, tried in rows] == [(name, adapter.tried) for name, adapter in usable.items()]
    for name, channel, _ in rows:
        assert channel in usable[name].channel
    rejected = page.split("Rejected, because")[1].split("## 2.")[0]
    assert set(ADAPTERS) - set(usable) <= set(re.findall(r"`(\w+)`", rejected))
    for name in ("pcan", "kvaser", "vector", "nixnet"):
        assert blocks("docs/howto/real-bus.md", "ini") == [ADAPTERS[name].configuration + "\n"]
    assert f"{ADAPTERS['socketcan'].setup}\n" in blocks("docs/howto/real-bus.md", "console")[0]


def test_guide_shapes_image_is_at_most_120_kb():
    assert (DOCS / "img" / "guide_shapes.png").stat().st_size <= 120_000


@pytest.mark.long
@pytest.mark.parametrize(("column", "options"), [(1, ["--literal"]), (2, [])], ids=["literal", "default"])
def test_ratios_of_the_demo_are_those_of_the_page_about_the_paper(column: int, options: list[str], tmp_path: Path):
    rows = re.findall(r"^\| (\w+) \| ([\d.]+) \| ([\d.]+) \|$", PAGES["docs/reference/paper.md"], re.MULTILINE)
    arguments = ["demo", *options, "--steps", "3", "--json", "--out", str(tmp_path / "demo")]
    lines = CliRunner().invoke(cli, arguments).stdout.splitlines()
    measured = {result["shape"]: result["max_ratio"] for result in map(json.loads, lines) if "shape" in result}
    assert {row[0]: float(row[column]) for row in rows} == pytest.approx(measured, abs=0.006, rel=0.002)


def test_hand_over_boxes_in_the_pages_are_those_of_the_controllers() -> None:
    def row(name: str, box: HandOver, added: str) -> str:
        jumps = f"{box.torque[0]:g}, {box.torque[1]:g} Nm"
        limits = f"{math.degrees(box.deviation):.1f} degrees | {box.rate:g} rad/s | {box.acceleration:g} rad/s2"
        return f"| {name} | {limits} | {jumps} | {added} |"

    air, ground = AirwalkConfig(), WALK_GUIDE.hand_over
    hip, knee = air.hand_over.carried
    fading = f"fades out within {1000.0 * air.guided_blend:g} ms"
    promises, paper = PAGES["docs/reference/guide-promises.md"], PAGES["docs/reference/paper.md"]
    assert row("in the air", air.hand_over, f"at most {hip:g}, {knee:g} Nm, {fading}") in promises
    assert row("on the ground", ground, "none") in promises
    assert ground.carried == (0.0, 0.0)
    assert f"fades out within {1000.0 * air.blend:g} ms; at hip and knee of a guided leg it {fading}" in paper
    for page in (paper, PAGES["docs/glossary.md"]):
        assert f"{hip:g} Nm and {knee:g} Nm" in page


def test_examples_of_a_new_diagnostic_and_a_new_fault_fit_into_the_lists() -> None:
    """The new code follows the last one, so no number changes. The new fault has the next free ID."""
    diagnostic, fault = PAGES["docs/howto/diagnostic.md"], PAGES["docs/howto/fault.md"]
    assert f"at the end of `Dtc` in `atalante_hal/safety/diagnostics.py`, after `{list(Dtc)[-1].name}`" in diagnostic
    new = f"F{max(int(id_[1:]) for id_ in load_matrix()) + 1}"
    for use in (f"| {new} | a foot is overloaded |", f'"{new}",', f"atalante faults run {new}`"):
        assert use in fault, use
    (table,) = re.findall(r"`(\w+)` of `tests/hal/safety/test_diagnostics.py`", diagnostic)
    assert f"\n{table} = {{" in (ROOT / "tests/hal/safety/test_diagnostics.py").read_text()
