from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

import atalante_emulator.emulator as emulator_module
from atalante_dbc import Network
from atalante_emulator.bodies.pybullet_body import PyBulletBody
from atalante_emulator.drive import WATCHDOG
from atalante_emulator.emulator import Emulator
from atalante_emulator.faults import Fault
from atalante_emulator.pendant import Operator
from atalante_hal.bus import Bus
from atalante_hal.bus.joined import JoinedBus
from atalante_hal.bus.pair import lockstep_pair
from atalante_hal.bus.wrapped import WrappedBus
from atalante_hal.robot import JOINTS, Robot
from atalante_hal.types import PERIOD
from atalante_hal.wire.cia402 import Controlword, DriveState, controlword_towards_operation
from atalante_hal.wire.e2e import crc, data_id_bytes
from atalante_hal.wire.frame import Frames, new_frames
from atalante_hal.wire.process_image import ReceiveImage, TransmitImage

CROUCHED = [0.0, 0.0, -0.4, 0.7, -0.1, 0.0] * 2


class Master:
    """A minimal HAL: sends SYNC and commands, and receives the frames of the nodes."""

    def __init__(self, network: Network, robot: Robot, bus: Bus) -> None:
        self.bus, self.robot, self.cycle = bus, robot, 0
        cyclic = [m for m in network.sent_by("HAL") if m.cycle_ms == 1]
        self.syncs = TransmitImage([m for m in cyclic if m.name.startswith("SYNC_")])
        self.commands = TransmitImage([m for m in cyclic if not m.name.startswith("SYNC_")])
        values, codec = self.commands.values, self.commands.codec
        self.word, self.target = values[codec.slice("Controlword")], values[codec.slice("TargetTorque")]
        self.level = values[codec.slice("Level")]
        values[codec.slice("MaxTorque")] = robot.torque_max
        self.rx = ReceiveImage([m for m in network.received_by("HAL") if m.cycle_ms == 1])
        self.slow = ReceiveImage([m for m in network.received_by("HAL") if m.cycle_ms != 1])
        self.name_of = {m.frame_id: m.name for m in network.messages}
        self._buffer = new_frames(128)
        self.trace: list[list[str]] = []
        self.bytes: list[bytes] = []

    def sync(self, hal_state: int = 0, only: Callable[[Frames], Frames] = lambda frames: frames) -> None:
        self.cycle += 1
        codec = self.syncs.codec
        self.syncs.values[codec.slice("Cycle")] = self.cycle
        self.syncs.values[codec.slice("HalState")] = hal_state
        self.bus.send(np.ascontiguousarray(only(self.syncs.seal())))
        self.listen()

    def listen(self) -> None:
        count = self.bus.receive(self._buffer)
        frames = self._buffer[:count].copy()
        self.trace.append([self.name_of[i] for i in frames["can_id"].tolist()])
        self.bytes.append(frames.tobytes())
        self.rx.accept(self._buffer, count)
        self.slow.new_cycle()
        self.slow.accept_each(frames, count)

    def command(self, only: Callable[[Frames], Frames] = lambda frames: frames) -> None:
        frames = only(self.commands.seal(self.syncs.counter + 1 & 0xFF))  # the counter of the next SYNC
        if len(frames):
            self.bus.send(np.ascontiguousarray(frames))

    def joints(self, signal: str) -> np.ndarray:
        first = self.rx.codec.index("LEFT_FH_STATE", signal)
        return self.rx.values[first : first + 12]

    @property
    def states(self) -> set[int]:
        return set(self.joints("DriveState").astype(int).tolist())

    @property
    def position(self) -> np.ndarray:
        return self.joints("Position") / (self.robot.gear * self.robot.polarity)

    @property
    def velocity(self) -> np.ndarray:
        return self.joints("Velocity") / (self.robot.gear * self.robot.polarity)

    def enable(self) -> None:
        for _ in range(20):
            self.sync()
            self.word[:] = [controlword_towards_operation(int(state)) for state in self.joints("DriveState")]
            self.command()
            if self.states == {DriveState.OPERATION_ENABLED}:
                return
        raise AssertionError(f"drives are in {self.states}")

    def track(self, reference: np.ndarray) -> None:
        self.target[:] = self.robot.hold_kp * (reference - self.position) - 0.5 * self.robot.hold_kd * self.velocity


class OneAtATime(WrappedBus):
    """Bus that returns one frame in each call of `receive`."""

    def receive(self, frames: Frames, timeout: float = 0.0) -> int:
        return super().receive(frames[:1], timeout)


Setup = tuple[Master, Emulator]


@pytest.fixture
def make(network: Network, robot: Robot, urdf_text: str) -> Iterator[Callable[..., Setup]]:
    bodies: list[PyBulletBody] = []

    def build(
        *, seed: int = 0, operator: Operator | None = None, ground: float | None = None, faults: Sequence[Fault] = ()
    ) -> Setup:
        ours, theirs = lockstep_pair()
        bodies.append(PyBulletBody(urdf_text, ground=ground))
        bodies[-1].reset(CROUCHED)
        emulator = Emulator(network, robot, bodies[-1], theirs, seed=seed, operator=operator, faults=faults)
        ours.step = emulator.poll
        return Master(network, robot, ours), emulator

    yield build
    for body in bodies:
        body.close()


def walk(setup: Setup, cycles: int) -> bytes:
    """Enable the drives, swing both legs, and return every frame of the nodes as bytes."""
    master, _ = setup
    master.enable()
    start = master.position.copy()
    swing = np.array([0.0, 0.0, -0.3, 0.5, 0.0, 0.0] * 2)
    for step in range(cycles):
        master.sync(hal_state=2)
        master.track(start + swing * (0.5 - 0.5 * np.cos(6.0 * step * PERIOD)))
        master.level[:] = step % 3 * 0.5
        master.command()
    return b"".join(master.bytes)


class TestDeterminism:
    def test_same_seed_gives_the_same_bytes(self, make: Callable[..., Setup]) -> None:
        first = walk(make(seed=5, operator=Operator(0.5)), 400)
        again = walk(make(seed=5, operator=Operator(0.5)), 400)
        assert first == again

    def test_another_seed_gives_other_bytes(self, make: Callable[..., Setup]) -> None:
        assert walk(make(seed=5), 50) != walk(make(seed=6), 50)

    def test_faults_injected_before_their_start_give_the_same_bytes(self, make: Callable[..., Setup]) -> None:
        faults = [
            Fault("drop", "left_leg", 42, 20, p=0.3),
            Fault("encoder_stuck", "LEFT_SK", 42, 20),
            Fault("imu_saturated", "IMU_PELVIS", 42, 20),
        ]
        known = walk(make(seed=5, faults=faults), 80)
        setup = make(seed=5)
        sync, (master, emulator) = setup[0].sync, setup

        def inject_then_sync(hal_state: int = 0) -> None:
            if emulator.cycle == 40:
                emulator.inject(faults)
            sync(hal_state)

        master.sync = inject_then_sync  # type: ignore[method-assign]
        assert walk(setup, 80) == known != walk(make(seed=5), 80)


class TestCycle:
    def test_every_node_answers_sync_once_intact_and_in_sequence(self, make: Callable[..., Setup]) -> None:
        master, _ = make(operator=Operator())
        expected = {m.name for m in master.rx.codec.messages}
        assert len(expected) == 19
        for _ in range(300):
            master.sync()
            cyclic = [name for name in master.trace[-1] if name in expected]
            assert len(cyclic) == len(expected)
            assert set(cyclic) == expected
            assert master.rx.all_fresh or master.cycle == 1
            master.command()
        assert master.rx.crc_errors == master.slow.crc_errors == 0

    def test_pendant_sends_nothing_without_an_operator(self, make: Callable[..., Setup]) -> None:
        master, _ = make()
        for _ in range(120):
            master.sync()
        assert not any(name.startswith("PENDANT") for names in master.trace for name in names)

    def test_state_is_sampled_before_the_body_moves(self, make: Callable[..., Setup]) -> None:
        master, emulator = make()
        for _ in range(20):
            before = emulator.body.position.copy()
            master.sync()
            np.testing.assert_allclose(master.position, before, atol=1e-6)
            assert (emulator.body.position != before).any()

    def test_command_acts_from_the_next_sync_on(self, make: Callable[..., Setup]) -> None:
        master, _ = make()
        master.enable()
        master.target[:] = 0.0
        for _ in range(30):
            master.sync()
            master.command()
        master.sync()  # k
        master.target[3] = 100.0
        master.command()  # command(k)
        master.sync()  # k + 1: the drive latches command(k)
        assert abs(master.joints("Torque")[3]) < 1.0
        master.command()
        master.sync()  # k + 2: command(k) has acted for 1 ms
        assert master.joints("Torque")[3] > 50.0

    def test_nodes_of_a_bus_without_sync_do_not_answer(self, make: Callable[..., Setup], network: Network) -> None:
        master, emulator = make()
        master.sync()
        master.command()
        before = emulator.cycle
        master.sync(only=lambda frames: frames[[0, 2, 3]])  # no SYNC_RIGHT_LEG
        buses = {network.message(name).bus for name in master.trace[-1] if name.endswith("_STATE")}
        assert buses == {"left_leg", "left_sense", "right_sense"}
        assert emulator.cycle == before + 1

    def test_late_sync_is_answered_without_a_second_cycle(self, make: Callable[..., Setup], network: Network) -> None:
        master, emulator = make()
        late: list[Frames] = []

        def keep_one(frames: Frames) -> Frames:
            late.append(frames[[1]].copy())
            return frames[[0, 2, 3]]

        master.sync()
        master.sync(only=keep_one)
        cycle = emulator.cycle
        master.bus.send(late[0])
        master.listen()
        assert {network.message(name).bus for name in master.trace[-1]} == {"right_leg"}
        assert len(master.trace[-1]) == 6
        assert emulator.cycle == cycle

    @pytest.mark.parametrize("first", ["SYNC_LEFT_LEG", "SYNC_RIGHT_SENSE"])
    def test_cycle_runs_once_if_a_lost_sync_arrives_before_the_others(
        self, make: Callable[..., Setup], network: Network, first: str
    ) -> None:
        master, emulator = make(faults=[Fault("drop", first, 3)])
        emulator.bus.bus = OneAtATime(emulator.bus.bus)
        master.bus.step = lambda: [emulator.poll() for _ in range(20)]
        row = master.syncs.codec.rows[first]
        for cycle in range(8):
            master.sync(only=lambda frames: np.concatenate([frames[[row]], np.delete(frames, row)]))
            assert emulator.cycle == cycle + 1
            lost = {network.message(first).bus} if cycle >= 3 else set()
            buses = {network.message(name).bus for name in master.trace[-1] if name.endswith("_STATE")}
            assert buses == set(network.buses) - lost
            master.command()

    def test_commands_received_before_their_sync_take_effect_with_it(self, make: Callable[..., Setup]) -> None:
        """On a real bus, about a millisecond passes between a command and the next SYNC."""
        master, emulator = make()
        master.enable()
        for _ in range(50):
            cycle = emulator.cycle
            assert not emulator.poll()
            assert emulator.cycle == cycle
            master.sync()
            master.command()
            assert emulator.cycle == cycle + 1
            assert emulator.drives.missed == [0, 0]

    def test_foreign_frames_are_ignored(self, make: Callable[..., Setup], network: Network) -> None:
        master, emulator = make()
        master.enable()
        status = TransmitImage([network.message("HAL_STATUS")])
        for _ in range(20):
            master.bus.send(status.seal())
            master.sync()
            master.command()
        assert emulator.drives.missed == [0, 0]
        assert master.states == {DriveState.OPERATION_ENABLED}

    def test_answer_is_sent_in_one_batch_before_the_body_moves(
        self, make: Callable[..., Setup], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """A HAL in another process then receives the whole batch or nothing, and can compute while the body moves."""
        master, emulator = make(operator=Operator())
        master.sync()
        done: list[str] = []
        sizes: set[int] = set()

        class Recorder:
            def __init__(self, bus: Bus) -> None:
                self.receive = bus.receive
                self._send = bus.send

            def send(self, frames: Frames) -> None:
                done.append("send")
                sizes.add(len(frames))
                self._send(frames)

        def recorded(what: str, call: Callable[..., object]) -> Callable[..., object]:
            return lambda *arguments: (done.append(what), call(*arguments))[1]

        emulator.bus = Recorder(emulator.bus)  # type: ignore[assignment]
        monkeypatch.setattr(emulator.body, "step", recorded("step", emulator.body.step))
        monkeypatch.setattr(emulator.drives, "sample", recorded("sample", emulator.drives.sample))
        for _ in range(200):
            master.sync()
        assert done == ["send", "step", "sample"] * 200
        assert sizes == {19, 20, 21}

    def test_value_changed_by_a_before_send_hook_is_sent(self, make: Callable[..., Setup]) -> None:
        master, emulator = make()
        accel = emulator.signals.index("IMU_PELVIS_STATE", "AccelX")
        emulator.before_send.append(
            lambda cycle, values: values.__setitem__(accel, 7.0 if cycle == 1 else values[accel])
        )
        master.sync()
        assert master.rx.values[master.rx.codec.index("IMU_PELVIS_STATE", "AccelX")] < 1.0
        master.sync()
        assert master.rx.values[master.rx.codec.index("IMU_PELVIS_STATE", "AccelX")] == 7.0

    def test_four_channels_give_the_same_values_as_one(
        self, network: Network, robot: Robot, urdf_text: str, make: Callable[..., Setup]
    ) -> None:
        pairs = {bus: lockstep_pair() for bus in network.buses}
        body = PyBulletBody(urdf_text)
        body.reset(CROUCHED)
        emulator = Emulator(network, robot, body, JoinedBus(network, {n: p[1] for n, p in pairs.items()}), seed=1)
        for ours, _ in pairs.values():
            ours.step = emulator.poll
        separate = Master(network, robot, JoinedBus(network, {n: p[0] for n, p in pairs.items()}))
        joined, _ = make(seed=1)
        walk((separate, emulator), 100)
        walk((joined, emulator), 100)
        body.close()
        assert separate.rx.values.tobytes() == joined.rx.values.tobytes()
        assert [sorted(names) for names in separate.trace] == [sorted(names) for names in joined.trace]


class TestDrives:
    def test_legs_sink_slowly_until_enabled(self, make: Callable[..., Setup]) -> None:
        master, emulator = make()
        for _ in range(200):
            master.sync()
            master.command()
        assert master.states == {DriveState.SWITCH_ON_DISABLED}
        assert CROUCHED[3] - 0.05 < emulator.body.position[3] < CROUCHED[3] - 0.01
        assert np.abs(emulator.body.velocity).max() < 0.3
        assert np.abs(master.joints("Torque")).max() < 0.5

    def test_drives_hold_after_five_lost_commands_and_not_after_four(self, make: Callable[..., Setup]) -> None:
        for lost, expected in ((WATCHDOG - 1, DriveState.OPERATION_ENABLED), (WATCHDOG, DriveState.QUICK_STOP_ACTIVE)):
            master, emulator = make()
            master.enable()
            master.sync()
            for _ in range(lost):
                master.sync()
            assert set(emulator.drives.state) == {expected}
            master.command()
            master.sync()
            master.sync()
            assert master.states == {expected}

    @pytest.mark.parametrize("how", ["crc", "length", "repeated", "range"])
    def test_invalid_commands_trip_the_command_watchdog(self, make: Callable[..., Setup], how: str) -> None:
        master, emulator = make()
        master.enable()
        good: list[Frames] = []

        def damage(frames: Frames) -> Frames:
            frames = frames.copy()
            if how == "crc":
                frames["data"][:, 20] ^= 0x10
            elif how == "length":
                frames["len"] = 12
            elif how == "repeated":
                frames = good[0]
            else:
                frames["data"][:2, 3] = 0xFF  # FH_Controlword
                for frame, message in zip(frames, master.commands.codec.messages, strict=True):
                    payload = frame["data"][: message.length].tobytes()
                    frame["data"][:2] = list(crc(payload[2:], data_id_bytes(message.data_id)).to_bytes(2, "little"))
            return frames

        master.sync()
        master.command(only=lambda frames: good.append(frames.copy()) or frames)
        master.sync()
        for _ in range(WATCHDOG):
            assert not any(emulator.drives.latched)
            master.command(only=damage)
            master.sync()
        assert all(emulator.drives.latched)

    def test_latched_hold_keeps_the_pose_until_a_quick_stop_acknowledges_it(self, make: Callable[..., Setup]) -> None:
        master, emulator = make()
        master.enable()
        hold = master.position.copy()
        for _ in range(400):
            master.sync()
            master.track(hold)
            master.command()
        before = emulator.body.position.copy()
        for _ in range(600):  # the HAL sends no commands
            master.sync()
        assert set(emulator.drives.state) == {DriveState.QUICK_STOP_ACTIVE}
        assert np.abs(emulator.body.position - before).max() < np.radians(1.5)
        assert np.abs(emulator.body.velocity).max() < 0.01
        for _ in range(300):  # the HAL sends commands again without an acknowledgement
            master.sync()
            master.command()
        assert set(emulator.drives.state) == {DriveState.QUICK_STOP_ACTIVE}
        master.sync()
        master.word[:] = Controlword.QUICK_STOP
        master.command()
        master.sync()
        master.word[:] = Controlword.ENABLE_OPERATION
        master.command()
        master.sync()
        assert set(emulator.drives.state) == {DriveState.OPERATION_ENABLED}

    @pytest.mark.parametrize(
        ("delays", "state"), [((4,), DriveState.OPERATION_ENABLED), ((4, 8), DriveState.QUICK_STOP_ACTIVE)]
    )
    def test_growing_delay_of_commands_leads_to_a_hold(
        self, make: Callable[..., Setup], delays: tuple[int, ...], state: DriveState
    ) -> None:
        master, emulator = make()
        master.enable()
        waiting: list[Frames] = []

        def delayed(delay: int, frames: Frames) -> Frames:
            waiting.append(frames.copy())
            return waiting.pop(0) if len(waiting) > delay else frames[:0]

        for delay in delays:
            for _ in range(20):
                master.sync()
                master.command(only=partial(delayed, delay))
        master.sync()
        assert set(emulator.drives.state) == {state}

    def test_command_far_ahead_of_its_sync_is_rejected(self, make: Callable[..., Setup]) -> None:
        master, emulator = make()
        master.enable()
        for _ in range(WATCHDOG + 1):
            master.sync()
            master.bus.send(np.ascontiguousarray(master.commands.seal(master.syncs.counter + 1 + 100 & 0xFF)))
        master.sync()
        assert set(emulator.drives.state) == {DriveState.QUICK_STOP_ACTIVE}

    def test_hold_during_a_fast_swing_comes_to_rest(self, make: Callable[..., Setup]) -> None:
        setup = make()
        master, emulator = setup
        walk(setup, 260)
        assert np.abs(emulator.body.velocity).max() > 0.5
        for _ in range(700):
            master.sync()
        assert np.abs(emulator.body.velocity).max() < 0.01

    def test_only_the_leg_without_sync_holds(self, make: Callable[..., Setup]) -> None:
        master, emulator = make()
        master.enable()
        for _ in range(2 * WATCHDOG):
            master.sync(only=lambda frames: frames[[0, 2, 3]])
            master.command(only=lambda frames: frames[[0, 2]])
        assert set(emulator.drives.state[:6]) == {DriveState.OPERATION_ENABLED}
        assert set(emulator.drives.state[6:]) == {DriveState.QUICK_STOP_ACTIVE}

    def test_every_drive_sends_one_emergency_when_commands_time_out(self, make: Callable[..., Setup]) -> None:
        master, _ = make()
        master.enable()
        del master.trace[:]
        for _ in range(40):
            master.sync()
        emergencies = [name for names in master.trace for name in names if name.endswith("_EMCY")]
        assert emergencies == [f"{joint.upper()}_EMCY" for joint in JOINTS]
        code = master.slow.codec.index("LEFT_SK_EMCY", "ErrorCode")
        assert master.slow.values[code] == 0x8250


class TestSensors:
    def test_suspended_imus_measure_gravity_with_noise(self, make: Callable[..., Setup]) -> None:
        master, _ = make(seed=2)
        accel, gyro = [], []
        for _ in range(400):
            master.sync()
            master.command()
            codec = master.rx.codec
            accel.append(master.rx.values[codec.slice("Accel")].reshape(4, 3)[:2].copy())
            gyro.append(master.rx.values[codec.slice("Gyro")].reshape(4, 3)[:2].copy())
        np.testing.assert_allclose(np.mean(accel, axis=0), [[0.0, 0.0, 9.81]] * 2, atol=0.1)
        assert np.std(accel, axis=0).min() > 0.04
        assert np.std(accel, axis=0).max() < 0.06
        assert np.abs(np.mean(gyro)) < 1e-3

    def test_cells_measure_noise_in_the_air_and_weight_on_the_ground(self, make: Callable[..., Setup]) -> None:
        sums = []
        for ground in (None, -0.90):
            master, emulator = make(ground=ground)
            master.enable()
            total = np.zeros((2, 3))
            reach = np.array([0.0, 0.0, -0.1, 0.2, -0.1, 0.0] * 2)
            for step in range(500):
                master.sync()
                master.track(np.array(CROUCHED) + (reach - CROUCHED) * min(1.0, step / 300))
                master.command()
                if step >= 400:
                    force = master.rx.values[master.rx.codec.slice("Force")].reshape(2, 4, 3)
                    total += force.sum(axis=1) / 100
            sums.append(total)
            assert emulator.body.touching == (ground is not None)
        assert np.abs(sums[0]).max() < 15.0
        assert (sums[1][:, 2] > 100.0).all()

    def test_vibration_follows_its_command_every_ten_milliseconds(self, make: Callable[..., Setup]) -> None:
        master, _ = make()
        master.level[:] = [0.0, 1.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.25]
        for _ in range(400):
            master.sync()
            master.command()
        amplitude = master.slow.values[master.slow.codec.slice("Amplitude")]
        np.testing.assert_allclose(amplitude, master.level, atol=0.005)
        when = [cycle for cycle, names in enumerate(master.trace) if "HAPTICS_STATE" in names]
        assert set(np.diff(when)) == {10}
        for _ in range(400):
            master.sync()
        np.testing.assert_allclose(master.slow.values[master.slow.codec.slice("Amplitude")], 0.0)


class TestStatus:
    def test_each_node_sends_its_status_every_100_ms_and_never_two_in_a_cycle(
        self, make: Callable[..., Setup], network: Network
    ) -> None:
        master, _ = make(operator=Operator())
        states: dict[str, list[int]] = {}
        for _ in range(350):
            master.sync()
            status = [name for name in master.trace[-1] if name.endswith("_STATUS")]
            assert len(status) <= 1
            for name in status:
                index = master.slow.codec.index
                states.setdefault(name, []).append(int(master.slow.values[index(name, "NodeState")]))
                assert master.slow.values[index(name, "DbcHash")] == network.hash32
        assert set(states) == {f"{node.name}_STATUS" for node in network.nodes if node.kind != "master"}
        for seen in states.values():
            assert seen in ([0, 5, 5], [0, 5, 5, 5])

    def test_uptime_counts_seconds(self, make: Callable[..., Setup]) -> None:
        master, _ = make()
        for _ in range(2110):
            master.sync()
        codec = master.slow.codec
        assert master.slow.values[codec.index("HAPTICS_STATUS", "Uptime")] == 2.0


class TestOperator:
    def test_pendant_reports_the_reactions_of_the_operator_to_the_hal_state(self, make: Callable[..., Setup]) -> None:
        operator = Operator(0.25)
        master, _ = make(operator=operator)
        index = master.rx.codec.index

        def pendant(signal: str) -> float:
            return float(master.rx.values[index("PENDANT_STATE", signal)])

        master.sync(hal_state=0)
        assert (pendant("DeadMan"), pendant("Request"), pendant("AssistanceSet")) == (1, 0, 1)
        assert pendant("AssistanceFactor") == pytest.approx(0.25)
        for _ in range(Operator.REACTION + 1):
            master.sync(hal_state=1)
        assert (pendant("Request"), pendant("RequestCounter")) == (1, 1)
        operator.release()
        operator.hold()
        operator.assist(None)
        master.sync(hal_state=2)
        assert (pendant("DeadMan"), pendant("Request"), pendant("AssistanceSet")) == (0, 3, 0)


class TestWallClock:
    def test_without_sync_the_drives_hold_and_the_heartbeats_continue(self, make: Callable[..., Setup]) -> None:
        master, emulator = make()
        master.enable()
        for _ in range(50):
            master.sync()
            master.command()
        held = emulator.body.position.copy()
        stopped = emulator.cycle + 300
        emulator.run(lambda: emulator.cycle >= stopped)
        assert set(emulator.drives.state) == {DriveState.QUICK_STOP_ACTIVE}
        assert all(emulator.drives.latched)
        assert np.abs(emulator.body.position - held).max() < np.radians(1.5)
        master.bus.step = None
        master.listen()
        names = set(master.trace[-1])
        assert not any(name.endswith("_STATE") and name != "HAPTICS_STATE" for name in names)
        assert sum(name.endswith("_STATUS") for name in names) == 19
        assert sum(name.endswith("_EMCY") for name in names) == 12

    @pytest.mark.parametrize("pause", [0.0, 60.0])
    def test_slow_computer_or_long_pause_does_not_delay_the_end_of_a_run_without_sync(
        self, make: Callable[..., Setup], monkeypatch: pytest.MonkeyPatch, pause: float
    ) -> None:
        """Each simulated millisecond takes two, or the process is stopped for a minute at the start."""
        _, emulator = make()
        now, cycles, calls = [100.0], [0], [0]

        def idle() -> None:
            now[0] += 2e-3 if not pause else 1e-5
            cycles[0] += 1

        def poll(timeout: float = 0.0) -> int:
            now[0] += timeout
            return 0

        def stop() -> bool:
            assert cycles[0] <= 20 * calls[0]
            calls[0] += 1
            now[0] += pause if calls[0] == 2 else 0.0
            return calls[0] > 50

        monkeypatch.setattr(emulator_module, "time", SimpleNamespace(monotonic=lambda: now[0]))
        monkeypatch.setattr(emulator, "idle", idle)
        monkeypatch.setattr(emulator, "poll", poll)
        emulator.run(stop)
        assert calls[0] == 51
        assert cycles[0] > 40

    def test_run_answers_every_sync_and_keeps_the_drives_enabled(self, make: Callable[..., Setup]) -> None:
        master, emulator = make()
        master.enable()
        beats = 0

        def beat() -> bool:
            nonlocal beats
            if beats >= 100:
                return True
            beats += 1
            master.bus.step = None
            master.sync()
            master.command()
            return False

        cycle = emulator.cycle
        emulator.run(beat)
        assert set(emulator.drives.state) == {DriveState.OPERATION_ENABLED}
        assert emulator.cycle - cycle >= 99
