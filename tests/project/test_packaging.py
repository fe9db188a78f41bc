"""Check the installed files: all packages with their data, no need of PyBullet on the robot, no package named control."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from atalante_tools.session.body import ENGINE_PYTHON

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    done = subprocess.run(build, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return zipfile.ZipFile(next(folder.glob("*.whl"))).namelist()


@pytest.mark.parametrize(
    "path",
    [
        "atalante_dbc/atalante.dbc",
        "atalante_hal/robot.toml",
        "atalante_hal/telemetry/messages.binpb",
        "atalante_control/gaits/airwalk.json",
        "atalante_control/gaits/network.npz",
        "atalante_emulator/emulator.py",
        "atalante_tools/cli.py",
        *(f"atalante_{package}/py.typed" for package in ("dbc", "hal", "control", "emulator", "tools")),
    ],
)
def test_wheel_contains_the_file(wheel: list[str], path: str):
    assert path in wheel


def test_wheel_has_only_atalante_packages_at_the_top(wheel: list[str]):
    top = {path.split("/")[0] for path in wheel}
    assert {name for name in top if not name.startswith("atalante_")} == set()


def test_emulator_extra_supports_the_python_versions_of_its_error_message():
    (engine,) = PROJECT["optional-dependencies"]["emulator"]
    marker = re.fullmatch(r"pybullet>=[\d.]+; python_version < '3\.(\d+)'", engine)
    assert marker, engine
    assert (3, int(marker[1]) - 1) == ENGINE_PYTHON


@pytest.mark.parametrize("extra", sorted({"", *PROJECT["optional-dependencies"]}))
def test_each_requirement_has_a_lower_bound(extra: str):
    """`make lowest` does not test a requirement without a lower bound."""
    requirements = PROJECT["optional-dependencies"][extra] if extra else PROJECT["dependencies"]
    assert requirements
    for requirement in requirements:
        assert requirement.startswith("atalante-hal[") or re.match(r"[a-z0-9-]+(\[[a-z,]+\])?>=\d", requirement), (
            requirement
        )


def run(program: str, *path: Path) -> str:
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=120, cwd=path[0] if path else None
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_hal_and_controller_import_without_pybullet_and_telemetry_libraries():
    run(
        "import sys\n"
        "for name in ('pybullet', 'zenoh', 'mcap', 'google', 'matplotlib'): sys.modules[name] = None\n"
        "import atalante_hal.hal, atalante_hal.loop, atalante_hal.bus.socketcan, atalante_hal.telemetry.process\n"
        "import atalante_control.airwalk.controller, atalante_control.guide.certificate\n"
    )


def test_import_control_gives_python_control(tmp_path: Path):
    """The folders of the components are no packages, so that `import control` imports python-control."""
    package = tmp_path / "control"
    package.mkdir()
    (package / "__init__.py").write_text("owner = 'python-control'\n")
    program = f"import sys; sys.path.append({str(tmp_path)!r}); import control; print(control.owner)"
    assert run(program, ROOT).strip() == "python-control"


def test_loop_process_opens_no_network_socket():
    """Run the embedded stack without telemetry: no socket is created (audit hook of the interpreter) and none is open."""
    run(
        "import os, sys\n"
        "made = []\n"
        "sys.addaudithook(lambda event, what: made.append(what) if event == 'socket.__new__' else None)\n"
        "from atalante_tools.console.options import Target\n"
        "from atalante_tools.session.rig import open_hal\n"
        "with open_hal(Target('embedded', '', lockstep=True)) as rig:\n"
        "    for _ in range(300):\n"
        "        rig.hal.read()\n"
        "        rig.hal.hold()\n"
        "    links = [os.readlink(entry.path) for entry in os.scandir('/proc/self/fd') if os.path.islink(entry.path)\n"
        "             and os.path.lexists(entry.path) and int(entry.name) > 2 and os.path.exists(entry.path)]\n"
        "assert not made, made\n"
        "assert not [link for link in links if link.startswith('socket:')], links\n"
    )
