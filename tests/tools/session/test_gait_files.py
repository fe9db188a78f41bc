"""Options `--gait` and `--network` of walk, airwalk, demo and emulator, with files of `gait solve` and a gait network."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from atalante_control.dynamics.gait_network import DEFAULT_NETWORK, NetworkError, load_network, save_network
from atalante_control.gait.gait import gait_object, load_gait, write_gait
from atalante_control.gait.subject import Subject
from atalante_control.gait.walk import DEFAULT_WALK, load_walk, write_walk
from atalante_control.model import Patient
from atalante_hal.robot import JOINTS, load_robot
from atalante_tools.console.options import GaitFiles
from atalante_tools.session.gait_source import gait_in_the_air, patient_of_files
from atalante_tools.session.law import Law
from atalante_tools.session.walk_options import SpeedChange, WalkOptions, sections_of

ATALANTE = str(Path(sys.executable).with_name("atalante"))
ROBOT = load_robot()
PATIENT = ("--mass", "66", "--height", "1.68", "--step-length", "0.15", "--step-duration", "0.9")
WALKED = ("--steps", "2", "--engine", "mujoco", "--json")
COMMANDS = {
    "walk": ("walk", "--engine", "mujoco"),
    "airwalk": ("airwalk", "--steps", "1"),
    "demo": ("demo", "--steps", "1"),
    "emulator": ("emulator", "-i", "socketcan", "-c", "nobus0"),
}


def atalante(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([ATALANTE, *arguments], capture_output=True, text=True, timeout=300, cwd=folder)


def write_network(folder: Path) -> None:
    """Write network.npz: the network of the package, but only for patients of 60 to 70 kg."""
    network = load_network()
    low, high = network.low.copy(), network.high.copy()
    low[0], high[0] = 60.0, 70.0
    # The weights of the first layer are scaled, so that the narrower network computes the same gaits.
    first, old_span, new_span = network.layers[0], network.high - network.low, high - low
    weights = first.weights * (new_span / old_span)[:, None]
    bias = first.bias + ((low + high - network.low - network.high) / old_span) @ first.weights
    layers = (first._replace(weights=weights, bias=bias), *network.layers[1:])
    save_network(replace(network, low=low, high=high, layers=layers), folder / "network.npz")


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a gait and a walk of `atalante gait solve`, and a network for fewer patients."""
    made = tmp_path_factory.mktemp("solved")
    for kind in ("periodic", "walk"):
        done = atalante("gait", "solve", *PATIENT, "--kind", kind, "--out", f"{kind}.json", folder=made)
        assert done.returncode == 0, done.stderr
    write_network(made)
    return made


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the walk of the package, two of its steps as gaits, and a network for fewer patients."""
    made = tmp_path_factory.mktemp("gaits")
    walk = load_walk(DEFAULT_WALK, ROBOT)
    write_walk(walk, made / "walk.json")
    write_gait(walk.step, made / "periodic.json")
    write_gait(walk.start, made / "start.json")
    write_network(made)
    return made


@pytest.mark.parametrize(
    "options",
    [
        ("--gait", "walk.json"),
        ("--gait", "periodic.json"),
        ("--network", "network.npz", *PATIENT),
    ],
    ids=["walk file", "gait file", "network"],
)
@pytest.mark.long
def test_walk_to_the_end_with_the_given_gait(solved: Path, options: tuple[str, ...]) -> None:
    done = atalante("walk", *WALKED, *options, "--out", "walked", folder=solved)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert (result["outcome"], result["steps"]) == ("stood", 2)
    assert result["distance_m"] == pytest.approx(3 * 0.15, abs=0.05)
    given = json.loads((solved / "walked" / "summary.json").read_text())["options"]
    assert given[options[0].removeprefix("--")] == options[1]


@pytest.mark.parametrize("command", ["airwalk", "demo"])
@pytest.mark.parametrize(
    "options",
    [("--gait", "walk.json"), ("--gait", "periodic.json"), ("--network", "network.npz", *PATIENT)],
    ids=["walk file", "gait file", "network"],
)
@pytest.mark.long
def test_walk_in_the_air_to_the_end_with_the_given_gait(solved: Path, command: str, options: tuple[str, ...]) -> None:
    run = ("--shape", "pinched", "--steps", "2", "--out", "flown", "--json")
    done = atalante(command, *run, *options, folder=solved)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout.splitlines()[0])
    assert result["certified"]
    assert (result["steps"], result["inside"]) == (2, 1.0)
    assert "66 kg, 1.68 m, step 0.15 m in 0.9 s; the exoskeleton is empty" in done.stderr
    given = json.loads((solved / "flown" / "summary.json").read_text())
    assert given[options[0].removeprefix("--")] == options[1]


@pytest.mark.long
def test_gait_file_adjusts_the_exoskeleton_to_its_patient(solved: Path) -> None:
    for name in ("walk.json", "periodic.json"):
        files = GaitFiles(gait=solved / name)
        exoskeleton, gait, _ = gait_in_the_air(files, None, ROBOT)
        assert exoskeleton == exoskeleton.fitted(Patient(66.0, 1.68))
        assert patient_of_files(files, None, ROBOT) == Patient(
            66.0, 1.68, exoskeleton.thigh_length, exoskeleton.shank_length
        )
        assert gait.duration == 0.9
    heavier = Patient(70.0, 1.7)
    assert patient_of_files(GaitFiles(gait=solved / "walk.json"), heavier, ROBOT) == heavier
    assert patient_of_files(GaitFiles(network=solved / "network.npz"), heavier, ROBOT) == heavier


def test_gait_without_patient_walks_in_the_air_as_without_the_option() -> None:
    from atalante_control.gait.gait import AIRWALK_GAIT

    _, gait, _ = gait_in_the_air(GaitFiles(gait=AIRWALK_GAIT), None, ROBOT)
    assert gait.hash32 == load_gait(AIRWALK_GAIT, ROBOT).hash32


def truncated(folder: Path) -> Path:
    file = folder / "truncated.json"
    file.write_bytes((folder / "walk.json").read_bytes()[:5000])
    return file


def foreign(folder: Path) -> Path:
    file = folder / "foreign.json"
    file.write_text('{"format": "other/1", "joints": {}}')
    return file


def beyond_torque(folder: Path) -> Path:
    walk = load_walk(folder / "walk.json", ROBOT)
    file = folder / "beyond.json"
    document = gait_object(replace(walk.step, feedforward=9.0 * walk.step.feedforward))
    file.write_text(json.dumps(document))
    return file


def start_only(folder: Path) -> Path:
    return folder / "start.json"


def network_as_gait(folder: Path) -> Path:
    return DEFAULT_NETWORK


@pytest.mark.sample(5)
@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (truncated, "truncated.json is damaged or not a gait file: "),
        (foreign, "foreign.json: format must be 'atalante-gait/1' or 'atalante-walk/1', got 'other/1'"),
        (beyond_torque, "beyond.json: feedforward of joints."),
        (start_only, "start.json: kind must be periodic, got start"),
        (network_as_gait, "network.npz is not a gait file: a gait file is text in JSON"),
    ],
)
def test_wrong_gait_file_is_rejected_before_the_robot_moves(
    folder: Path, command: str, make: Callable[[Path], Path], message: str
) -> None:
    done = atalante(*COMMANDS[command], "--gait", str(make(folder)), folder=folder)
    assert done.returncode == 1, done.stderr
    assert done.stderr.startswith("atalante: ")
    assert message in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.sample(3)
@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--network", "network.npz", "--mass", "75", "--height", "175"), "mass for the gait network must be 60 to 70 kg"),
        (("--network", "walk.json", "--mass", "66", "--height", "168"), "walk.json is not a valid gait network: "),
    ],
)  # fmt: skip
def test_wrong_network_is_rejected_before_the_robot_moves(
    folder: Path, command: str, options: tuple[str, ...], message: str
) -> None:
    done = atalante(*COMMANDS[command], *options, folder=folder)
    assert done.returncode == 1, done.stderr
    assert message in done.stderr
    assert done.stderr.count("\n") == 1


def test_speed_change_takes_its_gait_from_the_given_network(folder: Path) -> None:
    change = SpeedChange(2, Subject(Patient(75.0, 1.75), 0.16, 0.8))
    options = WalkOptions(
        steps=2, xi=1.0, shape="pinched", passive=False, subject=None, files=GaitFiles(network=folder / "network.npz"),
        seed=0, friction=0.6, push=None, law=Law(), then=(change,),
    )  # fmt: skip
    with pytest.raises(NetworkError, match="mass for the gait network must be 60 to 70 kg"):
        sections_of(options, ROBOT)


@pytest.mark.parametrize("command", COMMANDS)
def test_gait_and_network_exclude_each_other(folder: Path, command: str) -> None:
    done = atalante(*COMMANDS[command], "--gait", "walk.json", "--network", "network.npz", folder=folder)
    assert done.returncode == 2
    assert "--gait and --network exclude each other" in done.stderr


@pytest.mark.parametrize("command", ["airwalk", "demo", "emulator"])
def test_network_requires_a_patient(folder: Path, command: str) -> None:
    done = atalante(*COMMANDS[command], "--network", "network.npz", folder=folder)
    assert done.returncode == 2
    assert "--network requires a patient: add --mass and --height" in done.stderr


@pytest.mark.parametrize("command", ["walk", "airwalk", "demo"])
def test_step_of_a_gait_file_is_not_replaced(folder: Path, command: str) -> None:
    options = ("--gait", "walk.json", "--mass", "66", "--height", "168", "--step-length", "0.2")
    done = atalante(*COMMANDS[command], *options, folder=folder)
    assert done.returncode == 2
    assert "--step-length has no effect with --gait" in done.stderr


def test_walk_whose_swing_foot_is_too_low_is_rejected(folder: Path) -> None:
    walk = load_walk(DEFAULT_WALK, ROBOT)
    coefficients = walk.step.coefficients.copy()
    coefficients[JOINTS.index("left_SK"), 3:5] -= 0.2
    write_walk(walk._replace(step=replace(walk.step, coefficients=coefficients)), folder / "low.json")
    done = atalante(*COMMANDS["walk"], "--gait", "low.json", folder=folder)
    assert done.returncode == 1, done.stderr
    assert "low.json: swing sole below its intended height in step must be at most 0.002 m, got " in done.stderr
    assert done.stderr.count("\n") == 1


def test_gait_file_that_states_no_patient_needs_one_on_the_ground(folder: Path) -> None:
    gait = load_gait(folder / "periodic.json", ROBOT)
    write_gait(replace(gait, parameters={}), folder / "bare.json")
    done = atalante(*COMMANDS["walk"], "--gait", "bare.json", folder=folder)
    assert done.returncode == 1
    assert (
        "the patient is unknown; add --mass and --height, or patient_mass and patient_height in the parameters"
        in done.stderr
    )
    done = atalante(*COMMANDS["walk"], "--gait", "bare.json", "--mass", "66", "--height", "168", folder=folder)
    assert done.returncode == 1
    assert "the parameters must contain step_length" in done.stderr
