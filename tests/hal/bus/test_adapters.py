"""Facts about the interfaces of python-can, compared with the installed python-can. Some backends also run on a loopback."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import inspect
import re
import socket
import threading
import time
import types
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import can
import can.interfaces.slcan
import numpy as np
import pytest

from atalante_hal.bus import BusAbsent, BusDown, open_bus
from atalante_hal.bus.adapters import ADAPTERS, Adapter, refusal
from atalante_hal.bus.python_can import PythonCanBus
from atalante_hal.wire.frame import FLAG_BRS, FLAG_FDF, Frames, new_frames

if TYPE_CHECKING:
    from can_remote import RemoteServer

BUILT_IN = sorted(set(ADAPTERS) - {"remote"})
CLASSIC = [name for name in ADAPTERS if not ADAPTERS[name].can_fd]


def sources(name: str) -> str:
    """Return the source code of a backend: of its module, or of all modules of its package."""
    module, _ = can.interfaces.BACKENDS[name]
    spec = importlib.util.find_spec(module)
    assert spec is not None
    assert spec.origin is not None
    path = Path(spec.origin)
    files = path.parent.glob("*.py") if path.parent.name not in ("interfaces", "can_remote") else [path]
    if name == "remote":
        files = path.parent.glob("*.py")
    return "\n".join(file.read_text() for file in files)


def test_every_built_in_interface_of_python_can_is_covered() -> None:
    built_in = {name for name, (module, _) in can.interfaces.BACKENDS.items() if module.startswith("can.interfaces.")}
    assert built_in == set(BUILT_IN)
    assert len(BUILT_IN) == 23
    assert "remote" in can.interfaces.BACKENDS


# The backend `virtual` passes message objects to the receiver, so its source code does not mention `is_fd`.
@pytest.mark.parametrize("name", [name for name in ADAPTERS if name != "virtual"])
def test_can_fd_support_agrees_with_the_source_code(name: str) -> None:
    assert ("is_fd" in sources(name)) == ADAPTERS[name].can_fd


@pytest.mark.parametrize("name", [name for name in ADAPTERS if ADAPTERS[name].can_fd])
def test_reported_protocol_agrees_with_the_source_code(name: str) -> None:
    assert bool(re.search(r"CanProtocol\.CAN_FD|= protocol\b", sources(name))) == ADAPTERS[name].reports_can_fd


@pytest.mark.parametrize("name", [name for name in BUILT_IN if ADAPTERS[name].library])
def test_backend_loads_the_named_library(name: str) -> None:
    assert ADAPTERS[name].library in sources(name)


@pytest.mark.parametrize("name", [name for name in ADAPTERS if "python-can[" in ADAPTERS[name].install])
def test_named_extra_of_python_can_exists(name: str) -> None:
    extras = importlib.metadata.metadata("python-can").get_all("Provides-Extra")
    (extra,) = re.findall(r"python-can\[([\w-]+)\]", ADAPTERS[name].install)
    assert extra in (extras or [])


def timing_of(adapter: Adapter, folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, object]:
    """Return what python-can reads from the sample configuration of an adapter."""
    (folder / "can.conf").write_text(adapter.configuration)
    monkeypatch.setenv("HOME", str(folder))
    return dict(can.util.load_config(config={"interface": adapter.name, "channel": "0", "fd": True}))


@pytest.mark.parametrize("adapter", [adapter for adapter in ADAPTERS.values() if adapter.options], ids=lambda a: a.name)
def test_sample_configuration_sets_1_and_5_megabits(
    adapter: Adapter, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = timing_of(adapter, tmp_path, monkeypatch)
    timing = config.get("timing")
    if "bitrate" in config:
        assert (config["bitrate"], config["data_bitrate"]) == (1_000_000, 5_000_000)
        assert "data_bitrate" in sources(adapter.name)
        return
    assert isinstance(timing, can.BitTimingFd)
    for found in (timing, timing.recreate_with_f_clock(40_000_000)):  # nixnet requires 40 MHz
        assert (found.nom_bitrate, found.data_bitrate) == (1_000_000, 5_000_000)
        assert (found.nom_sample_point, found.data_sample_point) == (75.0, 75.0)
    assert "BitTimingFd" in sources(adapter.name)


def test_ixxat_has_presets_for_the_bit_rates() -> None:
    text = sources("ixxat")
    for preset, rate in (("CAN_BITRATE_PRESETS", 1_000_000), ("CAN_DATABITRATE_PRESETS", 5_000_000)):
        assert re.search(rf"^{preset} = {{[^}}]*\b{rate}: ", text, re.MULTILINE)


@pytest.mark.parametrize("name", [name for name in BUILT_IN if ADAPTERS[name].can_fd])
def test_backend_accepts_the_options_of_the_bus(name: str) -> None:
    module, class_name = can.interfaces.BACKENDS[name]
    if name in ("etas", "ixxat"):  # cannot be imported on Linux
        assert "receive_own_messages: bool = False" in sources(name)
        return
    parameters = inspect.signature(getattr(importlib.import_module(module), class_name).__init__).parameters
    kinds = {parameter.kind for parameter in parameters.values()}
    assert {"fd", "receive_own_messages"} <= set(parameters) or inspect.Parameter.VAR_KEYWORD in kinds


@pytest.mark.parametrize("name", CLASSIC)
def test_classic_interface_is_rejected_before_it_is_opened(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(can, "Bus", None)
    with pytest.raises(BusAbsent) as error:
        open_bus(name, "0")
    assert str(error.value) == refusal(name)
    assert "classic CAN only" in refusal(name)


@pytest.mark.parametrize("name", ["virtual", "udp_multicast"])
def test_interface_for_one_process_is_rejected_only_between_processes(name: str) -> None:
    assert "use a CAN FD adapter" in refusal(name)
    assert refusal(name, one_process=True) == ""


def test_interface_of_a_plug_in_is_not_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(can, "VALID_INTERFACES", can.VALID_INTERFACES | {"candle"})
    assert refusal("candle") == ""


def test_rejection_of_an_unknown_interface_lists_only_usable_interfaces() -> None:
    for one_process in (False, True):
        listed = refusal("pigeon", one_process=one_process).split("use one of ")[1].split(", ")
        assert "socketcan" in listed
        assert listed == [name for name in sorted(can.VALID_INTERFACES) if refusal(name) == ""]


# -- on loopback -----------------------------------------------------------------------------------------------------


class SerialPort:
    """Serial port in memory, with the interface of pyserial. A CANable at its other end passes each frame to the port `peer`."""

    def __init__(self) -> None:
        self.peer = self
        self.buffer: deque[int] = deque()
        self.write_timeout: float | None = None

    @property
    def in_waiting(self) -> int:
        return len(self.buffer)

    def read(self, count: int) -> bytes:
        return bytes(self.buffer.popleft() for _ in range(min(count, len(self.buffer))))

    def write(self, line: bytes) -> int:
        if line[:1] in b"tTrRdDbB":
            self.peer.buffer.extend(line)
        return len(line)

    def flush(self) -> None: ...

    def reset_input_buffer(self) -> None:
        self.buffer.clear()

    def close(self) -> None: ...


class Expired:
    """Timeout of pyserial that has always expired, so that the test never waits."""

    def __init__(self, seconds: float) -> None: ...

    def expired(self) -> bool:
        return True


@pytest.fixture
def ports(monkeypatch: pytest.MonkeyPatch) -> dict[str, SerialPort]:
    found = {"/dev/a": SerialPort(), "/dev/b": SerialPort()}
    found["/dev/a"].peer, found["/dev/b"].peer = found["/dev/b"], found["/dev/a"]
    serial = types.SimpleNamespace(serial_for_url=lambda channel, **options: found[channel], Timeout=Expired)
    monkeypatch.setattr(can.interfaces.slcan, "serial", serial)
    return found


def fd_frames(count: int = 20) -> Frames:
    rng = np.random.default_rng(7)
    frames = new_frames(count)
    frames["can_id"] = rng.integers(0, 0x800, count)
    frames["len"] = rng.choice([0, 8, 12, 48, 64], count)
    frames["flags"] = FLAG_FDF | FLAG_BRS
    frames["data"] = rng.integers(0, 256, (count, 64))
    frames["data"][np.arange(64) >= frames["len"][:, None]] = 0
    return frames


def test_slcan_transfers_can_fd_frames_bit_for_bit(ports: dict[str, SerialPort]) -> None:
    ours, theirs = (open_bus("slcan", port, sleep_after_open=0.0) for port in ports)
    sent, received = fd_frames(), new_frames(20)
    ours.send(sent)
    assert theirs.receive(received, 1.0) == 20
    assert received.tobytes() == sent.tobytes()
    assert ours.receive(received) == 0
    for bus in (ours, theirs):
        bus.close()


def test_damaged_line_of_slcan_is_dropped_and_counted(ports: dict[str, SerialPort]) -> None:
    bus = open_bus("slcan", "/dev/a", sleep_after_open=0.0)
    sent, received = fd_frames(1), new_frames(4)
    ports["/dev/a"].buffer.extend(b"bXYZ8\rb\r")
    open_bus("slcan", "/dev/b", sleep_after_open=0.0).send(sent)
    assert bus.receive(received, 1.0) == 1
    assert received[:1].tobytes() == sent.tobytes()
    assert bus.dropped == 2


@pytest.fixture
def server() -> Iterator[RemoteServer]:
    from can_remote import RemoteServer

    server = RemoteServer(
        "127.0.0.1",
        0,
        interface="virtual",
        channel="remote test",
        protocol=can.CanProtocol.CAN_FD,
        preserve_timestamps=True,
    )
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


def test_remote_transfers_can_fd_frames_bit_for_bit(server: RemoteServer) -> None:
    ours, theirs = (open_bus("remote", f"127.0.0.1:{server.server_port}") for _ in range(2))
    sent, received = fd_frames(), new_frames(20)
    ours.send(sent)
    count = 0
    while count < 20:
        got = theirs.receive(received[count:], 5.0)
        assert got
        count += got
    assert received.tobytes() == sent.tobytes()
    assert ours.receive(new_frames(1)) == 0
    for bus in (ours, theirs):
        bus.close()


def test_lost_server_raises_bus_down(server: RemoteServer) -> None:
    bus = open_bus("remote", f"127.0.0.1:{server.server_port}")
    while not server.clients:
        time.sleep(0.001)
    server.clients[0].close()
    with pytest.raises(BusDown, match="restart this program when the link works again"):
        bus.receive(new_frames(1), 5.0)
    bus.close()


def test_socketcand_sends_a_can_fd_frame_as_a_classic_frame() -> None:
    """This is the reason why `refusal` rejects the interface: its client sends a text without CAN FD flags."""
    lines: list[str] = []
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            peer, _ = listener.accept()
            with peer:
                peer.sendall(b"< hi >")
                for answer in (b"< ok >", b"< ok >", b""):
                    lines.append(peer.recv(1024).decode())
                    peer.sendall(answer)

        thread = threading.Thread(target=serve)
        thread.start()
        bus = can.Bus(interface="socketcand", channel="can0", host="127.0.0.1", port=listener.getsockname()[1])
        bus.send(
            can.Message(arbitration_id=0x123, is_extended_id=False, is_fd=True, bitrate_switch=True, data=[1] * 12)
        )
        thread.join(5.0)
        bus.shutdown()
    assert lines[:2] == ["< open can0 >", "< rawmode >"]
    assert lines[2] == f"< send 123 C {' '.join(['1'] * 12)} >"


def test_own_frames_are_not_received_by_default(monkeypatch: pytest.MonkeyPatch) -> None:
    found: dict[str, object] = {}

    def bus(**options: object) -> types.SimpleNamespace:
        found.update(options)
        return types.SimpleNamespace(protocol=can.CanProtocol.CAN_FD, shutdown=lambda: None)

    monkeypatch.setattr(can, "Bus", bus)
    PythonCanBus("neovi", "HSCAN").close()
    assert found == {"interface": "neovi", "channel": "HSCAN", "fd": True, "receive_own_messages": False}
