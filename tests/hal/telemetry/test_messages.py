"""Protobuf messages: every value of a record is in its field, and the committed schema matches the .proto file."""

from __future__ import annotations

import enum
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2

import atalante_dbc
from atalante_control.airwalk.controller import AirwalkController
from atalante_hal.bus.pair import lockstep_pair
from atalante_hal.hal import Hal
from atalante_hal.record_layout import Layout
from atalante_hal.robot import CELLS, FEET, IMUS, JOINTS, MOTORS, Robot
from atalante_hal.safety.events import SEVERITIES, Event, pack, unpack
from atalante_hal.telemetry import schema
from atalante_hal.telemetry.messages import Encoder
from atalante_hal.types import SupervisorState
from atalante_hal.wire.cia402 import DriveState

NANOSECONDS = 1_000_000_000


@pytest.fixture
def layout(network: atalante_dbc.Network, robot: Robot) -> Layout:
    """Return the layout of the records of the HAL with the airwalk controller."""
    return Hal(network, robot, lockstep_pair()[0], controller_fields=AirwalkController.telemetry_fields).layout


@pytest.fixture
def record(layout: Layout) -> np.ndarray:
    """Return a record with a different value at each index. float32 represents each value exactly."""
    values = np.arange(layout.size) / 8 + 1.0
    values[layout["cycle"]], values[layout["time"]] = 1234, 1.234
    values[layout["supervisor"]] = SupervisorState.ACTIVE
    values[layout["diagnostics"]], values[layout["diagnostics_high"]] = 0b101, 0b10
    values[layout["drive_state"]] = DriveState.OPERATION_ENABLED
    values[layout["controller.filter_active"]] = 0.0, 1.0
    values[layout["controller.stance"]], values[layout["controller.step"]] = 1.0, 7.0
    return values


def decoded(encoder: Encoder, key: str, record: np.ndarray, start_ns: int = 0) -> Any:
    stream = next(stream for stream in encoder.streams if stream.key == key)
    sample = encoder.sample(record, int(record[encoder.cycle_at]), start_ns, 2, "pinched")
    return schema.message_class(stream.message).FromString(stream.encode(sample))


class TestSchema:
    def test_committed_descriptor_set_matches_the_proto_file(self, tmp_path: Path) -> None:
        """If this test fails, regenerate the descriptor set with the command in the .proto file."""
        folder, made = schema.DESCRIPTORS.parent, tmp_path / "messages.binpb"
        text = (folder / "messages.proto").read_text()
        command = next(line for line in text.splitlines() if "-m grpc_tools.protoc" in line).strip("/ ").split()
        command[0] = sys.executable
        command = [f"--descriptor_set_out={made}" if "descriptor_set_out" in word else word for word in command]
        subprocess.run(command, check=True, cwd=folder.parents[1])
        committed = descriptor_pb2.FileDescriptorSet.FromString(schema.descriptor_set())
        ours = [file for file in committed.file if file.name == "messages.proto"]
        regenerated = descriptor_pb2.FileDescriptorSet.FromString(made.read_bytes())
        assert ours == [file for file in regenerated.file if file.name == "messages.proto"]

    def test_descriptor_set_lists_imports_before_their_users(self) -> None:
        seen: set[str] = set()
        for file in descriptor_pb2.FileDescriptorSet.FromString(schema.descriptor_set()).file:
            assert set(file.dependency) <= seen
            seen.add(file.name)

    @pytest.mark.parametrize(
        ("name", "hal_enum"),
        [("SupervisorState", SupervisorState), ("DriveState", DriveState)],
        ids=["supervisor", "drive"],
    )
    def test_enums_have_the_names_and_values_of_the_hal(self, name: str, hal_enum: type[enum.IntEnum]) -> None:
        proto_values = {value.name: value.number for value in _enum(name)}
        prefix = "".join(f"_{letter}" if letter.isupper() else letter for letter in name).upper().strip("_")
        assert proto_values == {f"{prefix}_{value.name}": value.value for value in hal_enum}

    def test_severities_are_in_the_order_of_the_enum(self) -> None:
        assert [value.name for value in _enum("Severity")] == [f"SEVERITY_{name.upper()}" for name in SEVERITIES]

    def test_encoding_names_the_message(self) -> None:
        assert schema.encoding("JointStates") == "application/protobuf;atalante.v1.JointStates"

    def test_unknown_message_raises_key_error(self) -> None:
        with pytest.raises(KeyError):
            schema.message_class("Nothing")


def _enum(name: str) -> Iterator[Any]:
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema.descriptor_set()).file:
        for found in file.enum_type:
            if found.name == name:
                yield from found.value


class TestStreams:
    def test_every_message_carries_time_and_cycle(self, layout: Layout, record: np.ndarray) -> None:
        encoder = Encoder(layout)
        start = 1_700_000_000 * NANOSECONDS + 900_000_000
        for stream in encoder.streams:
            message = decoded(encoder, stream.key, record, start)
            assert message.cycle == 1234
            assert message.timestamp.seconds * NANOSECONDS + message.timestamp.nanos == start + 1_234_000_000
            assert 0 <= message.timestamp.nanos < NANOSECONDS

    def test_joint_states_contain_the_recorded_values(self, layout: Layout, record: np.ndarray) -> None:
        message = decoded(Encoder(layout), "joint_states", record)
        assert list(message.name) == list(JOINTS)
        for field, name in {
            "position": "position",
            "velocity": "velocity",
            "effort": "torque",
            "commanded_effort": "torque_command",
            "temperature": "temperature",
            "drive_state": "drive_state",
        }.items():
            assert list(getattr(message, field)) == record[layout[name]].tolist(), field

    def test_imu_states_contain_the_recorded_values(self, layout: Layout, record: np.ndarray) -> None:
        message = decoded(Encoder(layout), "imu", record)
        assert [imu.name for imu in message.imu] == list(IMUS)
        for index, imu in enumerate(message.imu):
            turn, rate, force = imu.orientation, imu.angular_velocity, imu.linear_acceleration
            assert [turn.w, turn.x, turn.y, turn.z] == record[layout["imu_quaternion"]].reshape(4, 4)[index].tolist()
            assert [rate.x, rate.y, rate.z] == record[layout["imu_gyro"]].reshape(4, 3)[index].tolist()
            assert [force.x, force.y, force.z] == record[layout["imu_accel"]].reshape(4, 3)[index].tolist()

    def test_foot_forces_contain_the_recorded_values(self, layout: Layout, record: np.ndarray) -> None:
        message = decoded(Encoder(layout), "foot_forces", record)
        assert [foot.name for foot in message.foot] == list(FEET)
        assert all(list(foot.cell) == list(CELLS) for foot in message.foot)
        forces = [[[force.x, force.y, force.z] for force in foot.force] for foot in message.foot]
        assert forces == record[layout["foot_force"]].reshape(2, 4, 3).tolist()

    def test_haptics_contain_the_recorded_values(self, layout: Layout, record: np.ndarray) -> None:
        message = decoded(Encoder(layout), "haptics", record)
        assert list(message.name) == list(MOTORS)
        assert list(message.amplitude) == record[layout["vibration"]].tolist()
        assert list(message.commanded_amplitude) == record[layout["vibration_command"]].tolist()

    def test_guide_contains_the_values_of_the_swing_leg(self, layout: Layout, record: np.ndarray) -> None:
        message = decoded(Encoder(layout), "guide", record)
        assert list(message.name) == ["left_SH", "left_SK"]  # right stance: the left leg swings
        for field, name in {"error": "error", "bound": "q_bound", "h": "h", "lambda": "lambda"}.items():
            assert list(getattr(message, field)) == record[layout[f"controller.{name}"]].tolist(), field
        assert list(message.desired_position) == record[layout["controller.q_des"]].tolist()
        assert list(message.active) == [False, True]
        assert (message.step, message.stance) == (7, 1)
        assert message.phase == record[layout["controller.phase"]][0]
        record[layout["controller.stance"]] = 0.0
        assert list(decoded(Encoder(layout), "guide", record).name) == ["right_SH", "right_SK"]

    @pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300, 2.0**32])
    def test_guide_values_that_are_no_integers_become_zero(
        self, layout: Layout, record: np.ndarray, value: float
    ) -> None:
        for name in ("step", "stance", "phase", "error", "filter_active", "q_des"):
            record[layout[f"controller.{name}"]] = value
        message = decoded(Encoder(layout), "guide", record)
        assert (message.step, message.stance) == (0, 0)
        assert list(message.name) == ["right_SH", "right_SK"]

    def test_other_controller_fields_are_in_the_controller_message(self, layout: Layout, record: np.ndarray) -> None:
        message = decoded(Encoder(layout), "controller", record)
        fields = {field.name: list(field.value) for field in message.field}
        assert fields == {name: record[layout[f"controller.{name}"]].tolist() for name in fields}
        known = {"q_des", "error", "q_bound", "h", "lambda", "filter_active", "step", "phase", "stance"}
        assert set(fields) == {name for name, _ in AirwalkController.telemetry_fields} - known

    def test_controller_without_a_guide_publishes_all_its_fields(
        self, network: atalante_dbc.Network, robot: Robot
    ) -> None:
        layout = Hal(network, robot, lockstep_pair()[0], controller_fields=[("h", 2), ("gain", 1)]).layout
        encoder = Encoder(layout)
        assert "guide" not in [key for key, _ in encoder.keys]
        message = decoded(encoder, "controller", np.arange(layout.size, dtype=float))
        assert [field.name for field in message.field] == ["h", "gain"]

    def test_no_controller_stream_without_a_controller(self, network: atalante_dbc.Network, robot: Robot) -> None:
        keys = [key for key, _ in Encoder(Hal(network, robot, lockstep_pair()[0]).layout).keys]
        assert keys == ["joint_states", "imu", "foot_forces", "haptics", "system", "loop"]

    def test_system_state_contains_run_state_and_diagnostics(self, layout: Layout, record: np.ndarray) -> None:
        message = decoded(Encoder(layout, ["NODES_WELL", "DRIVES_ENABLED", "DEAD_MAN"]), "system", record)
        assert (message.run, message.run_name) == (2, "pinched")
        assert message.supervisor == SupervisorState.ACTIVE
        assert message.assistance_factor == record[layout["assistance_factor"]][0]
        assert message.diagnostics == 5 | 1 << 49
        assert list(message.diagnostic) == ["NODES_WELL", "DEAD_MAN"]

    def test_encoder_keeps_no_values_of_the_last_message(self, layout: Layout, record: np.ndarray) -> None:
        used, empty = Encoder(layout, ["NODES_WELL"]), np.zeros_like(record)
        for stream in used.streams:
            decoded(used, stream.key, record)
            assert decoded(used, stream.key, empty) == decoded(Encoder(layout, ["NODES_WELL"]), stream.key, empty)


class TestLoop:
    def test_loop_statistics_contain_mean_maximum_and_counts(self, layout: Layout) -> None:
        encoder = Encoder(layout)
        records = np.zeros((4, layout.size))
        records[:, layout["cycle"].start] = range(4)
        records[:, layout["cost_us"].start] = 50, 70, 90, 30
        records[:, layout["lateness_us"].start] = 0, 2000, 100, 0
        records[:, layout["frames"].start] = 20, 40, 60, 80
        encoder.window.add(records[:1])
        encoder.window.add(records[1:3])
        encoder.window.add(records[3:3])
        first = self._decoded(encoder, records[2], lost=9)
        assert (first.cycles, first.frames, first.telemetry_lost) == (3, 60, 9)
        assert first.cost_mean == pytest.approx(70e-6)
        assert first.cost_max == pytest.approx(90e-6)
        assert first.lateness_max == pytest.approx(2e-3)
        encoder.window.add(records[3:])
        second = self._decoded(encoder, records[3], lost=9)
        assert (second.cycles, second.frames) == (1, 80)
        assert (second.cost_max, second.lateness_max) == (pytest.approx(30e-6), 0.0)

    def test_empty_window_has_mean_zero(self, layout: Layout) -> None:
        assert self._decoded(Encoder(layout), np.zeros(layout.size), lost=0).cost_mean == 0.0

    @staticmethod
    def _decoded(encoder: Encoder, record: np.ndarray, lost: int) -> Any:
        sample = encoder.sample(record, int(record[encoder.cycle_at]), 0)
        return schema.message_class("LoopStatistics").FromString(encoder.window.encode(sample, lost))


class TestEvents:
    EVENT = Event(42, "NODE_TIMEOUT", "IMU_TORSO timed out for 5 cycles", "error", "IMU_TORSO", 5.0, 7)

    def test_event_message_contains_every_field(self, layout: Layout) -> None:
        message = schema.message_class("Event").FromString(Encoder(layout).event(self.EVENT, 3 * NANOSECONDS + 7))
        assert (message.timestamp.seconds, message.timestamp.nanos, message.cycle) == (3, 7, 42)
        assert (message.severity, message.code, message.node) == (2, "NODE_TIMEOUT", "IMU_TORSO")
        assert (message.value, message.text, message.count) == (5.0, self.EVENT.text, 7)

    def test_event_is_unchanged_by_pack_and_unpack(self) -> None:
        assert unpack(pack(self.EVENT, 77)) == (self.EVENT, 77)

    def test_long_text_is_cut_at_a_character(self) -> None:
        event, _ = unpack(pack(Event(1, "C" * 60, "é" * 300), 0))
        assert set(event.code) == {"C"}
        assert set(event.text) == {"é"}
        assert len(event.text) == 110

    def test_unknown_severity_is_rejected_with_the_valid_ones(self) -> None:
        with pytest.raises(ValueError, match="info, warning, error"):
            Event(1, "X", "y", "fatal")
