"""Invalid files are rejected at the start: F52 (DBC), F54 (robot file), F55 (gait), each in one sentence with its code.

Every field of robot and gait file is mutated, the DBC line by line.
"""

from __future__ import annotations

import json
import math
import random
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import atalante_control.gait.gait
import atalante_dbc.loader
import atalante_hal.robot
from atalante_control.gait.gait import AIRWALK_GAIT, GaitError, check_gait, load_gait
from atalante_control.gait_optimization.library import Library, LibraryError
from atalante_dbc import DBC_FILE, DbcError
from atalante_hal.robot import JOINTS, LEG_JOINTS, ROBOT_FILE, RobotError, load_robot
from atalante_hal.wire.process_image import ReceiveImage, TransmitImage
from atalante_tools.canlog.validate.project import ProjectError, load_project
from atalante_tools.cli import cli

ROBOT = tomllib.loads(ROBOT_FILE.read_text())
KEYS = tuple(ROBOT["joints"]["FH"])
GAIT = json.loads(AIRWALK_GAIT.read_text())
#: Values that are valid in no field of a robot or gait.
INVALID = st.sampled_from(
    [math.nan, math.inf, -math.inf, 1e300, -1e300, 10**400, True, False, "4 rad/s", "", [], [[1.0, 2.0]], {}, {"a": 1}]
)
with_tmp_path = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


def toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value)
    if isinstance(value, list):
        return f"[{', '.join(map(toml, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key} = {toml(item)}' for key, item in value.items())}}}"
    return repr(value)


def robot_with(path: Path, joint: str, change: Callable[[dict[str, Any]], object]) -> Path:
    tables = {name: dict(ROBOT["joints"][name]) for name in LEG_JOINTS}
    change(tables[joint])
    lines = [f"joints.{name}.{key} = {toml(value)}" for name in LEG_JOINTS for key, value in tables[name].items()]
    lines += [f"{name} = {toml(table)}" for name, table in ROBOT.items() if name != "joints"]
    path.write_text("\n".join(lines))
    return path


def rejection_of(path: Path) -> str:
    with pytest.raises(RobotError) as refused:
        load_robot(path)
    assert "\n" not in str(refused.value)
    return str(refused.value)


class TestF54ConfigInvalid:
    @with_tmp_path
    @given(st.sampled_from(LEG_JOINTS), st.sampled_from(KEYS), INVALID, st.integers(0, 1))
    def test_f54_invalid_value_in_any_field_is_rejected_with_its_key(
        self, tmp_path: Path, joint: str, key: str, value: Any, position: int
    ) -> None:
        def change(table: dict[str, Any]) -> None:
            if isinstance(table[key], list):
                table[key] = [*table[key][:position], value, *table[key][position + 1 :]]
            else:
                table[key] = value

        error_text = rejection_of(robot_with(tmp_path / "robot.toml", joint, change))
        assert f"joints.{joint}.{key} must be " in error_text

    @with_tmp_path
    @given(
        st.sampled_from(LEG_JOINTS),
        st.sampled_from([key for key in KEYS if key not in ("position", "polarity")]),
        st.floats(max_value=0.0) | st.integers(max_value=0),
    )
    def test_f54_negative_or_zero_limit_is_rejected_with_its_key(
        self, tmp_path: Path, joint: str, key: str, value: float
    ) -> None:
        old = ROBOT["joints"][joint][key]
        error_text = rejection_of(
            robot_with(
                tmp_path / "robot.toml",
                joint,
                lambda table: table.update({key: [value, old[1]] if isinstance(old, list) else value}),
            )
        )
        assert f"joints.{joint}.{key} must be " in error_text

    @pytest.mark.parametrize("joint", LEG_JOINTS)
    @pytest.mark.parametrize("key", KEYS)
    def test_f54_missing_unknown_or_repeated_key_is_rejected(self, tmp_path: Path, joint: str, key: str) -> None:
        path = tmp_path / "robot.toml"
        assert f"joints.{joint}.{key} is missing" in rejection_of(robot_with(path, joint, lambda t: t.pop(key)))
        error_text = rejection_of(robot_with(path, joint, lambda t: t.update({f"{key}_": 1.0})))
        assert f"joints.{joint}.{key}_ is unknown; valid keys are position" in error_text
        line = f"\njoints.{joint}.{key} = {toml(ROBOT['joints'][joint][key])}"
        path.write_text(robot_with(path, joint, lambda t: None).read_text() + line)
        assert "overwrite" in rejection_of(path)

    @pytest.mark.parametrize("joint", LEG_JOINTS)
    @pytest.mark.parametrize("key", ["position", "velocity_max"])
    def test_f54_value_in_degrees_is_rejected(self, tmp_path: Path, joint: str, key: str) -> None:
        value = np.degrees(ROBOT["joints"][joint][key]).tolist()
        error_text = rejection_of(robot_with(tmp_path / "robot.toml", joint, lambda t: t.update({key: value})))
        assert re.search(rf"joints\.{joint}\.{key} must be .* \(rad", error_text)

    @with_tmp_path
    @given(st.sampled_from(LEG_JOINTS), st.floats(0.1, 400.0))
    def test_valid_limit_is_loaded_exactly_and_changes_the_hash(self, tmp_path: Path, joint: str, value: float) -> None:
        robot = load_robot(robot_with(tmp_path / "robot.toml", joint, lambda t: t.update(torque_max=value)))
        assert (robot.torque_max[[LEG_JOINTS.index(joint), LEG_JOINTS.index(joint) + 6]] == value).all()
        assert robot.hash32 != load_robot().hash32

    @with_tmp_path
    @given(st.binary(max_size=200) | st.text(max_size=200).map(str.encode) | st.just(b"a=" + b"[" * 100_000))
    def test_f54_file_of_random_bytes_is_rejected_with_its_path(self, tmp_path: Path, content: bytes) -> None:
        path = tmp_path / "robot.toml"
        path.write_bytes(content)
        assert str(path) in rejection_of(path)


#: Keys that lead to each field of a gait file.
FIELDS: list[tuple[str | int, ...]] = [
    *((key,) for key in GAIT),
    *(("joints", joint) for joint in JOINTS),
    *(("joints", joint, point) for joint in JOINTS for point in range(8)),
]


def gait_with(path: Path, field: tuple[str | int, ...], value: Any) -> Path:
    document = json.loads(AIRWALK_GAIT.read_text())
    *parents, last = field
    container = document
    for parent in parents:
        container = container[parent]
    container[last] = value
    path.write_text(json.dumps(document))
    return path


def gait_rejection_of(path: Path) -> str:
    with pytest.raises(GaitError) as refused:
        load_gait(path, load_robot())
    assert "\n" not in str(refused.value)
    return str(refused.value)


class TestF55GaitInvalid:
    @with_tmp_path
    @given(st.sampled_from(FIELDS), INVALID)
    def test_f55_invalid_value_in_any_field_is_rejected_with_its_key(
        self, tmp_path: Path, field: Any, value: Any
    ) -> None:
        if field in (("parameters",), ("solver",)) and isinstance(value, dict):
            return  # free content
        if field == ("name",) and value:
            value = 3
        error_text = gait_rejection_of(gait_with(tmp_path / "gait.json", field, value))
        # The end of each joint is compared with the start of the same joint of the other leg, so a jump can be reported for the
        # other leg. A missing joint is reported by its own name.
        expected = (
            ".".join(str(part) for part in field[:2]).replace("left_", "right_").replace("right_", "(left|right)_")
        )
        assert re.search(f"{expected}[ .]|must be finite, got (NaN|-?Infinity)", error_text)

    @with_tmp_path
    @given(st.sampled_from(JOINTS), st.floats(0.05, 1e6), st.sampled_from([0, 1, 6, 7]), st.sampled_from([-1, 1]))
    def test_f55_jump_at_the_step_change_is_rejected(
        self, tmp_path: Path, joint: str, by: float, point: int, sign: int
    ) -> None:
        moved = GAIT["joints"][joint][point] + sign * by
        error_text = gait_rejection_of(gait_with(tmp_path / "gait.json", ("joints", joint, point), moved))
        assert re.search(r"joints\.(left|right)_(FH|TH|SH|SK|SA|HA) (at the stance change )?must be ", error_text)

    def test_f55_gait_in_degrees_is_rejected(self, tmp_path: Path) -> None:
        degrees = {joint: np.degrees(points).tolist() for joint, points in GAIT["joints"].items()}
        assert " deg beyond" in gait_rejection_of(gait_with(tmp_path / "gait.json", ("joints",), degrees))

    @pytest.mark.parametrize("joint", JOINTS)
    def test_f55_feedforward_beyond_the_torque_limit_is_rejected(self, tmp_path: Path, joint: str) -> None:
        robot = load_robot()
        most = robot.torque_max[JOINTS.index(joint)]
        for factor in (1.0, -1.0, 1.01, -1.01):
            feedforward = {name: [most * factor * (name == joint)] * 8 for name in JOINTS}
            path = gait_with(tmp_path / "gait.json", ("feedforward",), feedforward)
            if abs(factor) == 1.0:
                load_gait(path, robot)
            else:
                error_text = gait_rejection_of(path)
                assert f"feedforward of joints.{joint} must be {-most:.4g} to {most:.4g} Nm, got " in error_text
                assert f", {0.01 * most:.2g} Nm beyond" in error_text

    def test_f55_repeated_key_is_rejected(self, tmp_path: Path) -> None:
        path = tmp_path / "gait.json"
        path.write_text(AIRWALK_GAIT.read_text().replace("{", '{"duration": 0.8, ', 1))
        assert "key 'duration' must occur once, got it 2 times" in gait_rejection_of(path)

    @with_tmp_path
    @given(st.binary(max_size=200) | st.text(max_size=200).map(str.encode) | st.just(b"[" * 100_000))
    def test_f55_file_of_random_bytes_is_rejected_with_its_path(self, tmp_path: Path, content: bytes) -> None:
        path = tmp_path / "gait.json"
        path.write_bytes(content)
        assert str(path) in gait_rejection_of(path)


LINES = DBC_FILE.read_text().splitlines(keepends=True)
NUMBERS = ("0", "-1", "65", "1e999", "1.5", "99999999999999999999", "nan")


def mutant(rng: random.Random) -> str:
    """Return the DBC with one line removed, doubled, swapped or cut, or one character or number changed."""
    lines = list(LINES)
    position, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    kind, line = rng.choice(("removed", "doubled", "swapped", "cut", "character", "number", "number")), lines[position]
    if kind == "removed":
        del lines[position]
    elif kind == "doubled":
        lines.insert(other, line)
    elif kind == "swapped":
        lines[position], lines[other] = lines[other], line
    elif kind == "cut":
        lines = [*lines[:position], line[: len(line) // 2]]
    elif kind == "character":
        at = rng.randrange(len(line))
        lines[position] = line[:at] + chr(rng.randrange(32, 127)) + line[at + 1 :]
    elif numbers := list(re.finditer(r"-?\d+(\.\d+)?", line)):
        number = rng.choice(numbers)
        lines[position] = line[: number.start()] + rng.choice(NUMBERS) + line[number.end() :]
    return "".join(lines)


@pytest.mark.sample(4)
@pytest.mark.parametrize("seed", range(60))
def test_f52_mutated_dbc_is_rejected_with_its_path_or_loads_completely(seed: int, tmp_path: Path) -> None:
    path = tmp_path / "mutant.dbc"
    path.write_text(mutant(random.Random(seed)))
    error_text = ""
    try:
        network = atalante_dbc.load(path)
    except DbcError as error:
        error_text = str(error)
    else:
        images = [ReceiveImage(network.messages), TransmitImage(network.messages)]
        assert [len(image.frames) for image in images] == [len(network.messages)] * 2
    assert not error_text or error_text.startswith(f"{path}:")


@pytest.mark.parametrize(
    ("module", "name", "file", "old", "new", "error_text"),
    [
        (atalante_dbc.loader, "DBC_FILE", DBC_FILE, "(0.0125,0)", "(0,0)", "DBC_INVALID: "),
        (atalante_hal.robot, "ROBOT_FILE", ROBOT_FILE, "torque_max = 350.0", "torque_max = -350.0", "CONFIG_INVALID: "),
        (
            atalante_control.gait.gait,
            "AIRWALK_GAIT",
            AIRWALK_GAIT,
            '"duration": 0.8',
            '"duration": 8',
            "GAIT_INVALID: ",
        ),
    ],
    ids=["f52", "f54", "f55"],
)
def test_command_with_an_invalid_file_fails_with_one_line(
    module: Any,
    name: str,
    file: Path,
    old: str,
    new: str,
    error_text: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert old in file.read_text()
    path = tmp_path / file.name
    path.write_text(file.read_text().replace(old, new, 1))
    monkeypatch.setattr(module, name, path)
    result = CliRunner().invoke(cli, ["demo", "--steps", "1", "--out", str(tmp_path / "run")])
    assert result.exit_code == 1
    assert result.stderr.startswith(f"atalante: {error_text}{path}")
    assert result.stderr.count("\n") == 1
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("load", "error"),
    [
        (load_robot, RobotError),
        (lambda path: load_gait(path, load_robot()), GaitError),
        (atalante_dbc.load, DbcError),
        (load_project, ProjectError),
        (lambda path: Library(path.parent), LibraryError),
    ],
    ids=["robot", "gait", "DBC", "rules", "library"],
)
def test_unreadable_file_is_rejected_with_its_path_and_reason(
    tmp_path: Path, load: Callable[[Path], object], error: type[Exception]
) -> None:
    folder = tmp_path / "grid.json"
    folder.mkdir()
    with pytest.raises(error) as refused:
        load(folder)
    assert str(refused.value) == f"{folder} cannot be read: Is a directory"


def test_installed_gait_passes_the_check_of_the_controller() -> None:
    gait = load_gait(AIRWALK_GAIT, load_robot())
    check_gait(gait, load_robot())
