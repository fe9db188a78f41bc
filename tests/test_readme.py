"""The README is true: its examples run, its commands parse, its files exist."""

from __future__ import annotations

import itertools
import re
import shlex
import subprocess
import sys
from pathlib import Path

import click
import pytest

from atalante_tools.cli import cli

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


def example(name: str) -> str:
    match = re.search(rf"<!-- example: {name} -->\n```python\n(.*?)```", README, re.DOTALL)
    assert match, f"the README has no example {name!r}"
    return match[1]


def commands() -> list[str]:
    lines = [line for block in re.findall(r"```sh\n(.*?)```", README, re.DOTALL) for line in block.splitlines()]
    return [line.split("#")[0].strip() for line in lines if line.strip()]


def test_there_are_commands_to_check():
    assert sum(c.startswith("atalante ") for c in commands()) >= 9
    assert sum(c.startswith("make ") for c in commands()) >= 2


@pytest.mark.parametrize("line", [c for c in commands() if c.startswith("atalante ")])
def test_a_command_of_the_readme_is_one_the_program_takes(line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Parsed by the program's own parser, down to the subcommand; nothing is run."""
    (tmp_path / "runs").mkdir()  # as the commands before it left it
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


@pytest.mark.parametrize("line", [c for c in commands() if c.startswith("make ")])
def test_a_make_target_of_the_readme_exists(line: str):
    assert re.search(rf"^{line.split()[1]}:", (ROOT / "Makefile").read_text(), re.MULTILINE)


@pytest.mark.parametrize("path", sorted(set(re.findall(r"`((?:[a-z_]+/)+[a-z_.]+)`", README))))
def test_a_path_of_the_readme_exists(path: str):
    assert path.startswith("runs/") or (ROOT / path).exists()


def test_the_controller_of_twenty_lines_runs(tmp_path: Path):
    program = tmp_path / "controller.py"
    program.write_text(example("controller"))
    assert sum(bool(line.strip()) for line in example("controller").splitlines()) <= 20
    done = subprocess.run([sys.executable, program], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("the program is ending [")  # and not anything the robot went to HOLD for


def test_the_subscriber_imports_nothing_of_ours_and_receives_joint_states(tmp_path: Path):
    """The example as it stands, from the root of the project, while a walk is published."""
    program = tmp_path / "subscriber.py"
    text = example("subscriber")
    assert sum(bool(line.strip()) for line in text.splitlines()) <= 14
    assert "import atalante" not in text
    assert "from atalante" not in text
    endpoint = re.search(r"tcp/127\.0\.0\.1:\d+", text)
    assert endpoint
    walk = [str(Path(sys.executable).with_name("atalante")), "hang", "--steps", "40", "--out", str(tmp_path / "run")]
    with subprocess.Popen(walk, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as hal:
        assert hal.stderr is not None
        try:
            listening = next(line for line in hal.stderr if "Zenoh at" in line)
            actual = re.search(r"tcp/127\.0\.0\.1:\d+", listening)
            assert actual
            program.write_text(text.replace(endpoint[0], actual[0]))
            with subprocess.Popen(
                [sys.executable, "-u", program], stdout=subprocess.PIPE, cwd=ROOT, text=True
            ) as subscriber:
                assert subscriber.stdout is not None
                lines = [subscriber.stdout.readline() for _ in range(20)]
                subscriber.kill()
        finally:
            hal.kill()
            hal.stderr.close()
    cycles = [int(line.split()[0]) for line in lines]
    # 100 Hz of robot time: every tenth cycle, in order.
    assert all(b - a == 10 for a, b in itertools.pairwise(cycles))
    assert "'left_SH'" in lines[0]
    assert lines[0].count(":") == 12
