from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from atalante_dbc import Network
from atalante_emulator.faults import Fault, FaultError
from atalante_emulator.link import BUS_OFF, FaultyBus
from atalante_hal.bus import BusFull
from atalante_hal.bus.joined import JoinedBus
from atalante_hal.bus.pair import lockstep_pair
from atalante_hal.bus.wrapped import WrappedBus
from atalante_hal.wire.e2e import Check
from atalante_hal.wire.frame import FLAG_BRS, FLAG_FDF, ID_ERROR, Frames, new_frames
from atalante_hal.wire.process_image import ReceiveImage, TransmitImage

KNEE, HIP, COMMAND, SYNC = "LEFT_SK_STATE", "LEFT_SH_STATE", "COMMAND_LEFT_LEG", "SYNC_LEFT_LEG"
FOREVER = None


class Line:
    """HAL that sends SYNC and command, and two drives that answer through a `FaultyBus`.

    If `ahead` is set, the nodes receive each command in an earlier call of `receive` than its SYNC.
    """

    def __init__(self, network: Network, *faults: Fault, seed: int = 0, ahead: bool = False) -> None:
        self.cycle, self.ahead = 0, ahead
        self.hal, wire = lockstep_pair()
        self.nodes = FaultyBus(wire, network, faults, lambda: self.cycle, seed=seed)
        self.commands = TransmitImage([network.message(COMMAND), network.message(SYNC)])
        self.states = TransmitImage([network.message(KNEE), network.message(HIP)])
        self.of_knee, self.of_command = (ReceiveImage([network.message(name)]) for name in (KNEE, COMMAND))
        self.to_hal: list[Frames] = []
        self.to_nodes: list[Frames] = []
        self.checks: list[tuple[Check, Check]] = []

    def run(self, cycles: int, *, room: int = 64) -> Line:
        for _ in range(cycles):
            buffer = new_frames(room)
            self.commands.values[self.commands.codec.index(COMMAND, "SK_TargetTorque")] = self.cycle
            sealed, count = self.commands.seal(), 0
            if self.ahead:
                self.hal.send(sealed[:1])
                count = self.nodes.receive(buffer)
            self.hal.send(sealed[self.ahead :])
            count += self.nodes.receive(buffer[count:])
            self.to_nodes.append(buffer[:count].copy())
            self.states.values[self.states.codec.index(KNEE, "Position")] = 0.01 * self.cycle
            self.nodes.send(self.states.seal())
            buffer = new_frames(64)
            count = self.hal.receive(buffer)
            self.to_hal.append(buffer[:count].copy())
            self.checks.append((self._check(self.of_command, self.to_nodes), self._check(self.of_knee, self.to_hal)))
            self.cycle += 1
        return self

    @staticmethod
    def _check(image: ReceiveImage, frames: list[Frames]) -> Check:
        image.new_cycle()
        image.accept_each(frames[-1], len(frames[-1]))
        return Check(int(image.check[0]))

    @property
    def knee(self) -> list[Check]:
        return [check for _, check in self.checks]

    @property
    def command(self) -> list[Check]:
        return [check for check, _ in self.checks]


@pytest.fixture
def line(network: Network) -> Callable[..., Line]:
    return lambda *faults, **options: Line(network, *faults, **options)


OK, LOST, NOTHING = Check.OK, Check.SOME_LOST, Check.NO_DATA
Make = Callable[..., Line]


def ids(frames: Frames) -> list[int]:
    return frames["can_id"].tolist()


class TestWithoutFault:
    def test_inactive_fault_does_not_change_any_byte(self, line: Make, network: Network) -> None:
        never = line(Fault("drop", KNEE, 1000)).run(20)
        plain = line().run(20)
        assert [f.tobytes() for f in never.to_hal] == [f.tobytes() for f in plain.to_hal]
        assert [f.tobytes() for f in never.to_nodes] == [f.tobytes() for f in plain.to_nodes]
        assert set(never.checks) == {(OK, OK)}

    def test_faulty_bus_has_a_name_a_size_and_can_be_closed(self, line: Make) -> None:
        nodes = line().nodes
        assert (nodes.name, nodes.dropped, len(nodes.stamps)) == ("embedded peer", 0, 1024)
        nodes.close()
        with pytest.raises(Exception, match="closed"):
            nodes.send(new_frames(1))


class TestDrop:
    def test_frames_are_dropped_exactly_in_the_cycles_of_the_fault(self, line: Make) -> None:
        assert line(Fault("drop", KNEE, 3, 4)).run(9).knee == [OK] * 3 + [NOTHING] * 4 + [LOST, OK]

    def test_command_is_dropped_towards_the_nodes_only(self, line: Make) -> None:
        run = line(Fault("drop", COMMAND, 3, 2)).run(7)
        assert run.command == [OK] * 3 + [NOTHING] * 2 + [LOST, OK]
        assert set(run.knee) == {OK}

    def test_command_received_before_its_sync_is_dropped(self, line: Make) -> None:
        run = line(Fault("drop", COMMAND, 3, 2), Fault("drop", KNEE, 0, 3), ahead=True).run(7)
        assert run.command == [OK] * 3 + [NOTHING] * 2 + [LOST, OK]

    def test_drop_of_one_message_keeps_the_others(self, line: Make, network: Network) -> None:
        run = line(Fault("drop", KNEE, 0)).run(2)
        assert [ids(f) for f in run.to_hal] == [[network.message(HIP).frame_id]] * 2

    @pytest.mark.parametrize("kind", ["drop", "silence"])
    def test_drop_or_silence_of_a_node_removes_its_frames(self, line: Make, kind: str) -> None:
        assert set(line(Fault(kind, "LEFT_SK", 0)).run(3).knee) == {NOTHING}

    def test_drop_of_a_bus_removes_frames_in_both_directions(self, line: Make) -> None:
        run = line(Fault("drop", "left_leg", 0)).run(3)
        assert not any(len(f) for f in run.to_hal + run.to_nodes)

    def test_drop_with_probability_is_seeded_and_has_its_rate(self, line: Make) -> None:
        runs = [line(Fault("drop", KNEE, 0, p=0.3), seed=seed).run(1000) for seed in (1, 1, 2)]
        lost = [[check is NOTHING for check in run.knee] for run in runs]
        assert lost[0] == lost[1] != lost[2]
        assert sum(lost[0]) == pytest.approx(300, abs=50)

    def test_two_faults_of_one_kind_draw_independently(self, line: Make) -> None:
        run = line(Fault("drop", KNEE, 0, p=0.5), Fault("drop", HIP, 0, p=0.5)).run(100)
        assert {len(f) for f in run.to_hal} == {0, 1, 2}


class TestOrderAndTime:
    def test_duplicated_frame_arrives_with_its_copies(self, line: Make, network: Network) -> None:
        run = line(Fault("duplicate", KNEE, 1, 1, copies=2)).run(3)
        assert [ids(f).count(network.message(KNEE).frame_id) for f in run.to_hal] == [1, 3, 1]
        assert run.knee == [OK] * 3

    @pytest.mark.parametrize("by", [1, 3])
    def test_delayed_frames_arrive_after_the_given_cycles(self, line: Make, by: int) -> None:
        run = line(Fault("delay", KNEE, 2, by=by)).run(10)
        assert run.knee == [OK] * 2 + [NOTHING] * by + [OK] * (8 - by)
        assert run.of_knee.values[run.of_knee.codec.index(KNEE, "Position")] == pytest.approx(0.01 * (9 - by), abs=1e-4)

    def test_delay_towards_the_nodes_does_not_change_frames_of_the_hal(self, line: Make) -> None:
        run = line(Fault("delay", COMMAND, 2, 1, by=2)).run(6)
        assert [len(f) for f in run.to_nodes] == [2, 2, 1, 2, 3, 2]
        assert [len(f) for f in run.to_hal] == [2] * 6
        assert run.command[4] is not NOTHING
        assert run.to_nodes[4]["data"][:, 2].tolist() == [2, 4, 4]

    def test_delayed_frame_arrives_after_the_end_of_the_fault(self, line: Make) -> None:
        run = line(Fault("delay", KNEE, 2, 1, by=3)).run(7)
        assert [len(f) for f in run.to_hal] == [2, 2, 1, 2, 2, 3, 2]

    def test_reordered_frames_arrive_in_swapped_pairs(self, line: Make) -> None:
        run = line(Fault("reorder", KNEE, 2, 4)).run(7)
        assert [len(f) for f in run.to_hal] == [2, 2, 1, 3, 1, 3, 2]
        counters = [int(f["data"][0, 2]) for frames in run.to_hal for f in [frames[i : i + 1] for i in range(len(frames))]
                    if int(f["can_id"][0]) == run.states.codec.messages[0].frame_id]  # fmt: skip
        assert counters == [0, 1, 3, 2, 5, 4, 6]

    def test_reorder_over_an_odd_number_of_cycles_loses_no_frame(self, line: Make) -> None:
        assert [len(f) for f in line(Fault("reorder", KNEE, 2, 3)).run(6).to_hal] == [2, 2, 1, 3, 2, 2]


class TestContent:
    def test_flip_inverts_the_given_number_of_bits(self, line: Make) -> None:
        run = line(Fault("flip", KNEE, 1, 50, bits=3)).run(52)
        assert run.knee[0] is OK
        assert set(run.knee[1:51]) == {Check.CRC}
        plain = line().run(52)
        wrong = [np.unpackbits(a["data"] ^ b["data"]).sum() for a, b in zip(run.to_hal, plain.to_hal, strict=True)]
        assert wrong == [0] + [3] * 50 + [0]

    def test_flip_of_more_bits_than_the_payload_inverts_all(self, line: Make) -> None:
        run = line(Fault("flip", KNEE, 0, 1, bits=512)).run(1)
        plain = line().run(1)
        assert np.unpackbits(run.to_hal[0]["data"] ^ plain.to_hal[0]["data"]).sum() == 96

    def test_frozen_counter_gives_conflicts(self, line: Make) -> None:
        run = line(Fault("freeze_counter", KNEE, 2, 4)).run(8)
        assert run.knee == [OK] * 3 + [Check.CONFLICT] * 3 + [LOST, OK]
        assert len({f["data"][0, 4:8].tobytes() for f in run.to_hal}) == 8

    def test_masquerade_frame_fails_its_crc_and_passes_that_of_the_other(self, line: Make, network: Network) -> None:
        run = line(Fault("masquerade", KNEE, 1, 1, like=HIP)).run(3)
        assert run.knee == [OK, Check.CRC, LOST]
        as_hip = ReceiveImage([network.message(HIP)])
        frame = run.to_hal[1][:1].copy()
        frame["can_id"] = network.message(HIP).frame_id
        as_hip.accept_each(frame, 1)
        assert Check(int(as_hip.check[0])) is OK

    @pytest.mark.parametrize("length", [0, 2, 3, 8, 16, 64])
    def test_wrong_length_is_rejected(self, line: Make, length: int) -> None:
        run = line(Fault("length", KNEE, 1, 1, bytes=length)).run(3)
        assert run.to_hal[1]["len"].tolist() == [length, 12]
        assert run.knee == [OK, Check.LENGTH, LOST]

    def test_classic_can_frame_is_rejected(self, line: Make) -> None:
        run = line(Fault("flags", KNEE, 1, 1, flags=FLAG_BRS)).run(2)
        assert (run.to_hal[1]["len"][0], run.to_hal[1]["flags"][0]) == (8, 0)
        assert run.knee == [OK, Check.LENGTH]

    def test_frame_without_bit_rate_switch_is_rejected(self, line: Make) -> None:
        run = line(Fault("flags", KNEE, 1, 1, flags=FLAG_FDF)).run(2)
        assert (run.to_hal[1]["len"][0], run.to_hal[1]["flags"][0]) == (12, FLAG_FDF)
        assert run.knee == [OK, Check.LENGTH]

    def test_value_fault_changes_signals_and_reseals_the_frame(self, line: Make) -> None:
        run = line(Fault("value", KNEE, 1, 1, Position=-0.5, Velocity=2.0)).run(2)
        assert run.knee == [OK, OK]
        values, codec = run.of_knee.values, run.of_knee.codec
        assert values[codec.index(KNEE, "Position")] == pytest.approx(-0.5, abs=1e-4)
        assert values[codec.index(KNEE, "Velocity")] == pytest.approx(2.0)

    def test_raw_invalid_code_is_rejected(self, line: Make) -> None:
        assert line(Fault("raw", KNEE, 1, 1, Position=0x800000)).run(2).knee == [OK, Check.INVALID]


class TestAddedFrames:
    def test_injected_command_is_received_first_by_nodes_and_hal(self, line: Make) -> None:
        run = line(Fault("inject", COMMAND, 3, 2, SK_TargetTorque=100.0)).run(6)
        assert [len(f) for f in run.to_nodes] == [2, 2, 2, 3, 3, 2]
        assert [len(f) for f in run.to_hal] == [2, 2, 2, 3, 3, 2]
        received = ReceiveImage([run.commands.codec.messages[0]])
        torque = received.codec.index(COMMAND, "SK_TargetTorque")
        for cycle, frames in enumerate(run.to_nodes):
            received.new_cycle()
            received.accept_each(frames, len(frames))
            assert received.values[torque] == pytest.approx(100.0 if cycle in (3, 4) else cycle)
            assert received.check[0] == OK

    def test_injected_frames_have_counters_at_the_given_distance(self, line: Make) -> None:
        run = line(Fault("inject", COMMAND, 3, 1, ahead=100, count=2)).run(4)
        counters = run.to_nodes[3]["data"][:, 2].tolist()
        assert counters == [102, 103, 3, 3]

    def test_injection_starts_in_the_first_cycle(self, line: Make) -> None:
        run = line(Fault("inject", KNEE, 0, 1, Position=1.0)).run(1)
        assert len(run.to_hal[0]) == 3
        assert run.to_hal[0]["data"][0, 2] == 1

    def test_foreign_frames_are_received_and_change_no_check(self, line: Make) -> None:
        run = line(Fault("foreign", "left_leg", 1, 1, can_id=0, count=3)).run(3)
        assert [ids(f)[:3] for f in (run.to_hal[1], run.to_nodes[1])] == [[0] * 3] * 2
        assert set(run.checks) == {(OK, OK)}
        long = line(Fault("foreign", "left_leg", 0, 1, can_id=0x800, bytes=64)).run(1).to_hal[0]
        assert (long["can_id"][0], long["len"][0]) == (0x80000800, 64)

    def test_foreign_frames_are_sent_once_if_sync_is_received_twice_in_a_cycle(self, line: Make) -> None:
        one = line(Fault("foreign", "left_leg", 0, 2, can_id=0))
        for received in (3, 2):
            one.hal.send(one.commands.seal())
            assert one.nodes.receive(new_frames(8)) == received

    def test_frames_beyond_the_buffer_of_the_nodes_are_received_later(self, line: Make) -> None:
        run = line(Fault("foreign", "left_leg", 0, 1, can_id=0, count=5)).run(4, room=3)
        assert [len(f) for f in run.to_nodes] == [3, 3, 3, 3]
        assert ids(run.to_nodes[1])[:2] == [0, 0]

    def test_error_frames_are_received_by_the_hal_only(self, line: Make) -> None:
        run = line(Fault("error_frame", "left_leg", 1, 1, error=4)).run(2)
        assert ids(run.to_hal[1])[0] == ID_ERROR | 4
        assert len(run.to_nodes[1]) == 2

    def test_bus_off_blocks_both_directions_and_sends_one_error_frame(self, line: Make) -> None:
        run = line(Fault("bus_off", "left_leg", 2, 2)).run(5)
        assert [len(f) for f in run.to_nodes] == [2, 2, 0, 0, 2]
        assert [ids(f) for f in run.to_hal[2:4]] == [[ID_ERROR | BUS_OFF], []]


def test_several_faults_of_one_message_apply_together(line: Make) -> None:
    run = line(Fault("value", KNEE, 0, Position=0.5), Fault("flip", KNEE, 1, 1, bits=1), Fault("drop", KNEE, 2, 1)).run(
        4
    )
    assert run.knee == [OK, Check.CRC, NOTHING, LOST]


def test_synced_stays_true_after_a_sync_until_it_is_reset(line: Make) -> None:
    one = line(Fault("drop", SYNC, 0))
    assert not one.nodes.synced
    one.run(1)
    assert one.nodes.receive(new_frames(4)) == 0
    assert one.nodes.synced
    one.nodes.synced = False
    assert one.nodes.receive(new_frames(4)) == 0
    assert not one.nodes.synced


@pytest.mark.parametrize(
    ("fault", "can_id"),
    [
        (Fault("foreign", "right_leg", 0, can_id=0x7F0), 0x7F0),
        (Fault("flood", "right_leg", 0, can_id=5, load=0.2), 5),
        (Fault("error_frame", "right_leg", 0, error=4), ID_ERROR | 4),
        (Fault("bus_off", "right_leg", 0), ID_ERROR | BUS_OFF),
    ],
)
def test_added_frames_are_sent_on_the_channel_of_their_bus(network: Network, fault: Fault, can_id: int) -> None:
    pairs = {bus: lockstep_pair() for bus in network.buses}
    nodes = FaultyBus(JoinedBus(network, {bus: pair[1] for bus, pair in pairs.items()}), network, [fault], lambda: 0)
    pairs["left_leg"][0].send(TransmitImage([network.message(SYNC)]).seal())
    nodes.receive(new_frames(64))
    received = {}
    for bus, (hal, _) in pairs.items():
        buffer = new_frames(64)
        received[bus] = set(ids(buffer[: hal.receive(buffer)]))
    assert received == {bus: {can_id} if bus == "right_leg" else set() for bus in network.buses}


def test_added_frames_are_lost_if_the_transmit_queue_is_full(network: Network) -> None:
    class FullBus(WrappedBus):
        def send(self, frames: Frames) -> None:
            raise BusFull("the transmit queue is full")

    hal, wire = lockstep_pair()
    nodes = FaultyBus(FullBus(wire), network, [Fault("foreign", "left_leg", 0, can_id=0x7F0)], lambda: 0)
    hal.send(TransmitImage([network.message(SYNC)]).seal())
    buffer = new_frames(64)
    assert ids(buffer[: nodes.receive(buffer)]) == [0x7F0, network.message(SYNC).frame_id]


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        (
            Fault("drop", "LEFT_KNEE"),
            "drop: the target must be of type message, node or bus, got 'LEFT_KNEE'; valid targets: SYNC_LEFT_LEG, ",
        ),
        (
            Fault("value", "LEFT_SK", Position=0.0),
            "value: the target must be of type message, got 'LEFT_SK'; valid targets: SYNC_LEFT_LEG, ",
        ),
        (
            Fault("silence", KNEE),
            "silence: the target must be of type node, got 'LEFT_SK_STATE'; valid targets: HAL, LEFT_FH, ",
        ),
        (
            Fault("bus_off", "HAL"),
            "bus_off: the target must be of type bus, got 'HAL'; valid targets: left_leg, right_leg, left_sense, right_sense$",
        ),
        (
            Fault("value", KNEE, Angle=0.0),
            "value: unknown signal 'Angle' of LEFT_SK_STATE; valid signals: Crc, Counter, ",
        ),
        (
            Fault("masquerade", KNEE, like="KNEE"),
            "masquerade: the parameter 'like' must be the name of a message, got 'KNEE'; valid: SYNC_LEFT_LEG",
        ),
    ],
    ids=str,
)
def test_fault_that_does_not_fit_the_network_is_rejected_with_the_valid_names(
    network: Network, fault: Fault, expected: str
) -> None:
    with pytest.raises(FaultError, match=expected):
        FaultyBus(lockstep_pair()[1], network, [fault], lambda: 0)
