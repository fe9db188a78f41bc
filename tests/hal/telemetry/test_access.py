"""Access control of telemetry: TLS and users on the loopback, and strict checks of the telemetry file."""

from __future__ import annotations

import datetime
import ipaddress
import json
import re
import socket
import time
import tomllib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh
from click.testing import CliRunner
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from mcap.reader import make_reader

import atalante_dbc
from atalante_hal.bus.pair import lockstep_pair
from atalante_hal.hal import Hal
from atalante_hal.record_layout import Layout
from atalante_hal.robot import Robot
from atalante_hal.telemetry import access
from atalante_hal.telemetry.access import Access, AccessError, load_telemetry_file
from atalante_hal.telemetry.process import TelemetryConfig, TelemetryError, TelemetryProcess
from atalante_hal.telemetry.publisher import Publisher
from atalante_hal.telemetry.sink import SinkError
from atalante_tools.cli import cli

TRIES = 100  # largest number of polls, one every 50 ms
STREAMS = [("imu", "ImuStates")]


def test_page_shows_each_key_of_the_telemetry_file() -> None:
    page = Path(__file__).resolve().parents[3] / "docs" / "howto" / "telemetry-subscriber.md"
    (example,) = re.findall(r"```toml\n(.*?)```", page.read_text(), re.DOTALL)
    assert set(tomllib.loads(example)) == {*access._TEXTS, *access._FILES}


class Authority:
    """Certificate authority that signs certificates for 127.0.0.1."""

    def __init__(self, folder: Path, name: str) -> None:
        self._folder, self._name = folder, name
        self._key = ec.generate_private_key(ec.SECP256R1())
        self.certificate = self._write(name, self._key, self._sign(name, self._key, of_authority=True))[0]

    def issue(self, name: str) -> tuple[Path, Path]:
        """Issue a certificate and its private key, for a server or a client. Return the paths of both files."""
        key = ec.generate_private_key(ec.SECP256R1())
        return self._write(name, key, self._sign(name, key, of_authority=False))

    def _sign(self, name: str, key: Any, *, of_authority: bool) -> x509.Certificate:
        now, day = datetime.datetime.now(datetime.UTC), datetime.timedelta(days=1)
        subject, issuer = (x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, n)]) for n in (name, self._name))
        addresses = [x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]
        builder = x509.CertificateBuilder(
            issuer, subject, key.public_key(), x509.random_serial_number(), now - day, now + day
        )
        builder = builder.add_extension(x509.BasicConstraints(ca=of_authority, path_length=None), critical=True)
        builder = builder.add_extension(x509.SubjectAlternativeName(addresses), critical=False)
        return builder.sign(self._key, hashes.SHA256())

    def _write(self, name: str, key: Any, certificate: x509.Certificate) -> tuple[Path, Path]:
        pem = serialization.Encoding.PEM
        paths = self._folder / f"{name}.pem", self._folder / f"{name}.key"
        paths[0].write_bytes(certificate.public_bytes(pem))
        paths[1].touch(0o600)
        paths[1].write_bytes(key.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()))
        return paths


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    return Authority(tmp_path, "lab")


@pytest.fixture
def users(tmp_path: Path) -> Path:
    path = tmp_path / "users.txt"
    path.touch(0o600)
    path.write_text("lab:secret\n")
    return path


@pytest.fixture
def layout(network: atalante_dbc.Network, robot: Robot) -> Layout:
    return Hal(network, robot, lockstep_pair()[0]).layout


def endpoint(protocol: str) -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"{protocol}/127.0.0.1:{probe.getsockname()[1]}"


@contextmanager
def client(where: str, transport: dict[str, Any]) -> Iterator[zenoh.Session]:
    config = {
        "mode": "client",
        "connect": {"endpoints": [where], "timeout_ms": 1500},
        "scouting": {"multicast": {"enabled": False}},
        "transport": {"shared_memory": {"enabled": False}, **transport},
    }
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
        yield session


def receives(publisher: Publisher, transport: dict[str, Any], where: str | None = None) -> bool:
    """Return whether a client with this configuration receives telemetry."""
    try:
        with client(where or publisher.endpoint, transport) as session, session.declare_subscriber("**") as subscriber:
            for _ in range(TRIES):
                publisher.put("imu", b"data", 0, 0)
                if subscriber.try_recv() is not None:
                    return True
                time.sleep(0.05)
    except zenoh.ZError:
        pass
    return False


def any_receives(publisher: Publisher, *clients: tuple[dict[str, Any], str | None]) -> bool:
    """Return whether any of the clients receives telemetry.

    The clients run in parallel, because a rejected client retries until its timeout.
    """
    with ThreadPoolExecutor() as pool:
        return any(pool.map(lambda one: receives(publisher, *one), clients))


def user(name: str, password: str) -> dict[str, Any]:
    return {"auth": {"usrpwd": {"user": name, "password": password}}}


def trusting(authority: Authority, certificate: tuple[Path, Path] | None = None) -> dict[str, Any]:
    tls: dict[str, Any] = {"root_ca_certificate": str(authority.certificate)}
    if certificate:
        files = {"connect_certificate": str(certificate[0]), "connect_private_key": str(certificate[1])}
        tls |= {**files, "enable_mtls": True}
    return {"link": {"tls": tls}}


class TestLoopback:
    def test_tls_with_users_accepts_only_clients_with_both(self, authority: Authority, users: Path) -> None:
        access = Access(*authority.issue("robot"), users=users)
        other_authority = Authority(users.parent, "other")
        with Publisher("exo", STREAMS, endpoint("tls"), access) as publisher:
            assert receives(publisher, trusting(authority) | user("lab", "secret"))
            assert not any_receives(
                publisher,
                (trusting(authority) | user("lab", "guess"), None),
                (trusting(authority), None),
                (
                    trusting(other_authority) | user("lab", "secret"),
                    None,
                ),  # the client does not trust the authority of the publisher
                (user("lab", "secret"), publisher.endpoint.replace("tls/", "tcp/")),
            )

    def test_client_authority_requires_a_client_certificate(self, authority: Authority) -> None:
        other_authority = Authority(authority.certificate.parent, "other")
        access = Access(*authority.issue("robot"), client_ca=authority.certificate)
        with Publisher("exo", STREAMS, endpoint("tls"), access) as publisher:
            assert receives(publisher, trusting(authority, authority.issue("desk")))
            spy = trusting(authority, other_authority.issue("spy"))
            assert not any_receives(publisher, (spy, None), (trusting(authority), None))

    def test_quic_accepts_only_clients_with_certificate_and_password(self, authority: Authority, users: Path) -> None:
        access = Access(*authority.issue("robot"), client_ca=authority.certificate, users=users)
        desk, lab = trusting(authority, authority.issue("desk")), user("lab", "secret")
        with Publisher("exo", STREAMS, endpoint("quic"), access) as publisher:
            assert receives(publisher, desk | lab)
            assert not any_receives(publisher, (desk, None), (trusting(authority) | lab, None))

    def test_tcp_with_users_requires_a_password(self, users: Path) -> None:
        with Publisher("exo", STREAMS, endpoint("tcp"), Access(users=users)) as publisher:
            assert receives(publisher, user("lab", "secret"))
            assert not receives(publisher, {})

    def test_comment_in_the_user_file_is_no_user(self, users: Path) -> None:
        users.write_text("# the users of the lab\nlab:secret\n  #old:secret\n#gone:secret\n")
        with Publisher("exo", STREAMS, endpoint("tcp"), Access(users=users)) as publisher:
            assert receives(publisher, user("lab", "secret"))
            assert not any_receives(
                publisher, *((user(name, "secret"), None) for name in ("old", "#old", "gone", "#gone"))
            )

    def test_default_endpoint_with_another_private_key_names_the_reason(self, authority: Authority) -> None:
        certificate, _ = authority.issue("robot")
        _, other_key = authority.issue("other")
        with pytest.raises(SinkError, match=r"cannot listen on tls/127.*KeyMismatch") as refused:
            Publisher("exo", STREAMS, None, Access(certificate, other_key))
        assert "port" not in str(refused.value)

    @pytest.mark.parametrize("protocol", ["tls", "quic"])
    def test_requested_endpoint_with_another_private_key_names_the_reason(
        self, authority: Authority, protocol: str
    ) -> None:
        certificate, _ = authority.issue("robot")
        _, other_key = authority.issue("other")
        with pytest.raises(SinkError, match=r"KeyMismatch$"):
            Publisher("exo", STREAMS, endpoint(protocol), Access(certificate, other_key))

    def test_accepted_client_cannot_put(self, authority: Authority, users: Path) -> None:
        with (
            Publisher("exo", STREAMS, endpoint("tls"), Access(*authority.issue("robot"), users=users)) as publisher,
            publisher._session.declare_subscriber("**", zenoh.handlers.FifoChannel(1000)) as inside,
            client(publisher.endpoint, trusting(authority) | user("lab", "secret")) as session,
        ):
            for _ in range(100):
                session.put("atalante/exo/command", b"forged")
            list(session.get("atalante/exo/none", timeout=1.0))  # the answer follows all earlier puts
            publisher.put("imu", b"ours", 0, 0)
            assert {sample.payload.to_bytes() for sample in iter(inside.try_recv, None)} == {b"ours"}

    def test_default_endpoint_uses_tls_with_a_certificate(self, authority: Authority) -> None:
        with Publisher("exo", STREAMS, None, Access(*authority.issue("robot"))) as publisher:
            assert publisher.endpoint.startswith("tls/127.0.0.1:")


class TestTelemetryFile:
    @pytest.fixture
    def folder(self, authority: Authority, users: Path) -> Path:
        authority.issue("robot")
        return users.parent

    def read(self, folder: Path, text: str) -> dict[str, Any]:
        (folder / "telemetry.toml").write_text(text)
        return load_telemetry_file(folder / "telemetry.toml")

    def test_telemetry_file_gives_the_configuration(self, folder: Path) -> None:
        read = self.read(
            folder,
            'robot = "blue"\nlisten = "tls/127.0.0.1:7448"\ncertificate = "robot.pem"\nprivate_key = "robot.key"\n'
            'client_ca = "lab.pem"\nusers = "users.txt"\n',
        )
        config = TelemetryConfig(**read)
        assert config.listen == "tls/127.0.0.1:7448"
        assert config.access == Access(*(folder / n for n in ("robot.pem", "robot.key", "lab.pem", "users.txt")))
        assert TelemetryConfig.from_json(json.loads(json.dumps(config.to_json()))) == config
        assert self.read(folder, "") == {}

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ('lisen = "tcp/127.0.0.1:1"', "lisen is unknown; valid keys are robot, listen, certificate"),
            ("listen = 7447", "listen must be a text that is not empty, got 7447"),
            ('users = ""', "users must be a text"),
            ('users = "nobody.txt"', "users must be a readable file, got"),
            ('certificate = "robot.pem"', "certificate and private_key must be given together"),
            ('private_key = "robot.key"', "certificate and private_key must be given together"),
            ('client_ca = "lab.pem"', "client_ca requires certificate and private_key"),
            ('connect = "tcp/127.0.0.1:7447"', "connect is unknown; valid keys are robot, listen, certificate"),
            ('certificate = "robot.pem"\nprivate_key = "open.key"', "only by its owner; type: chmod 600"),
            ('users = "open.key"', "open.key must be readable only by its owner"),
            ('users = "empty"', "must contain only lines name:password"),
            ("listen", "telemetry.toml: "),
        ],
    )
    def test_invalid_telemetry_file_is_rejected_with_its_key(self, folder: Path, text: str, message: str) -> None:
        (folder / "open.key").touch(0o644)
        (folder / "empty").touch(0o600)
        with pytest.raises(AccessError) as refused:
            self.read(folder, text)
        assert message in str(refused.value)
        assert "\n" not in str(refused.value)

    @pytest.mark.parametrize(
        "listen",
        [
            "tcp/127.0.0.1:7447",
            "udp/127.0.0.1:7447",
            "ws/127.0.0.1:7447",
            "unixsock-stream/robot.sock",
            "serial//dev/ttyS0",
            "vsock/-1:7447",
            "TLS/127.0.0.1:7447",
            " tls/127.0.0.1:7447",
            "tls/127.0.0.1:7447 ",
            "tls /127.0.0.1:7447",
            "tls/127.0.0.1:7447\\n",
            "tls/127.0.0.1:7447,udp/127.0.0.1:7448",
            "tls/127.0.0.1:7447;udp/127.0.0.1:7448",
            "tls/127.0.0.1:7447#enable_mtls=false",
            "tls/127.0.0.1:7447?rel=0",
            "tls/udp/127.0.0.1:7447",
            "tls/127.0.0.1:0",
            "tls/127.0.0.1:65536",
            "tls/127.0.0.1",
            "tls/:7447",
            "tls",
            "127.0.0.1:7447",
        ],
    )
    def test_with_a_certificate_only_plain_tls_and_quic_endpoints_are_accepted(self, folder: Path, listen: str) -> None:
        with pytest.raises(AccessError) as refused:
            self.read(folder, f'listen = "{listen}"\ncertificate = "robot.pem"\nprivate_key = "robot.key"')
        valid = "listen must be tls/HOST:PORT or quic/HOST:PORT because a certificate is given, got "
        assert valid in str(refused.value)
        assert "\n" not in str(refused.value)

    @pytest.mark.parametrize(
        ("listen", "valid"),
        [
            ("tls/127.0.0.1:7447", "tcp/HOST:PORT unless certificate and private_key are given"),
            ("quic/127.0.0.1:7447", "tcp/HOST:PORT unless certificate and private_key are given"),
            ("udp/127.0.0.1:7447", "tcp/HOST:PORT, got 'udp/"),
            ("udp/224.0.0.224:7446", "tcp/HOST:PORT, got 'udp/"),
            ("ws/127.0.0.1:7447", "tcp/HOST:PORT, got 'ws/"),
            ("TCP/127.0.0.1:7447", "tcp/HOST:PORT, got 'TCP/"),
            ("tcp/127.0.0.1:7447#iface=eth0", "tcp/HOST:PORT, got "),
            ("nonsense", "tcp/HOST:PORT, got 'nonsense'"),
        ],
    )
    def test_without_a_certificate_only_plain_tcp_endpoints_are_accepted(
        self, folder: Path, listen: str, valid: str
    ) -> None:
        with pytest.raises(AccessError, match=f"listen must be {valid}"):
            self.read(folder, f'listen = "{listen}"')

    @pytest.mark.parametrize("host", ["127.0.0.1", "[::1]", "robot-7.lab.example"])
    @pytest.mark.parametrize(("protocols", "files"), [(("tcp",), ()), (("tls", "quic"), ("robot.pem", "robot.key"))])
    def test_host_names_and_addresses_are_accepted(
        self, folder: Path, host: str, protocols: tuple[str, ...], files: tuple[str, ...]
    ) -> None:
        access = Access(*(folder / name for name in files))
        for protocol in protocols:
            access.check_endpoint(f"{protocol}/{host}:7447")

    @pytest.mark.parametrize(
        "content",
        ["lab", "lab:", "lab: ", ":secret", "lab:secret\n\nother:x", "#lab:secret\n", "# note\n  # other:x\n"],
    )
    def test_invalid_user_file_is_rejected(self, users: Path, content: str) -> None:
        users.write_text(content)
        with pytest.raises(AccessError, match="name:password"):
            Access(users=users)

    def test_user_file_that_is_not_utf_8_is_rejected(self, users: Path) -> None:
        users.write_bytes(b"lab:\xff\xfe")
        with pytest.raises(AccessError, match="must be a readable file in UTF-8"):
            Access(users=users)

    def test_f54_invalid_telemetry_file_is_rejected_before_the_run(self, folder: Path) -> None:
        (folder / "telemetry.toml").write_text("lisen = 1")
        arguments = ["demo", "--telemetry", str(folder / "telemetry.toml"), "--out", str(folder / "run")]
        result = CliRunner().invoke(cli, arguments)
        assert result.exit_code == 1
        assert result.stderr.startswith(f"atalante: CONFIG_INVALID: {folder / 'telemetry.toml'}: lisen is unknown")
        assert not (folder / "run").exists()


class TestCommand:
    """The command `atalante airwalk --telemetry FILE`, with each combination of keys that the README shows."""

    @pytest.mark.sample(4)
    @pytest.mark.parametrize(
        "keys",
        [
            (),
            ("users",),
            ("certificate", "private_key"),
            ("certificate", "private_key", "client_ca", "users"),
        ],
        ids=["plain", "users", "tls", "everything"],
    )
    def test_subscriber_gets_the_messages_of_a_run(
        self, keys: tuple[str, ...], authority: Authority, users: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        folder, transport = users.parent, {}
        authority.issue("robot")
        if "certificate" in keys:
            transport |= trusting(authority, authority.issue("desk") if "client_ca" in keys else None)
        if "users" in keys:
            transport |= user("lab", "secret")
        names = {"certificate": "robot.pem", "private_key": "robot.key", "client_ca": "lab.pem", "users": "users.txt"}
        listen = endpoint("tls" if "certificate" in keys else "tcp")
        lines = [f'listen = "{listen}"', *(f'{key} = "{names[key]}"' for key in keys)]
        (folder / "telemetry.toml").write_text("\n".join(lines))
        got: list[zenoh.Sample] = []
        begin_run = TelemetryProcess.begin_run

        with ExitStack() as stack:

            def subscribe_first(telemetry: TelemetryProcess, *arguments: Any) -> None:
                assert telemetry.endpoint == listen
                session = stack.enter_context(client(listen, transport))
                stack.enter_context(session.declare_subscriber("atalante/*/joint_states", got.append))
                list(session.get("atalante/exo/none", timeout=1.0))  # the subscription arrives before the answer
                begin_run(telemetry, *arguments)

            monkeypatch.setattr(TelemetryProcess, "begin_run", subscribe_first)
            out = folder / "run"
            command = ["airwalk", "--steps", "1", "--telemetry", str(folder / "telemetry.toml"), "--out", str(out)]
            result = CliRunner().invoke(cli, command)
            assert (result.exit_code, result.exception) == (0, None), result.stderr
            for _ in range(TRIES):
                if got:
                    break
                time.sleep(0.05)
        assert str(got[0].encoding) == "application/protobuf;atalante.v1.JointStates"
        summary = json.loads((out / "summary.json").read_text())
        assert summary["telemetry"] == str(folder / "telemetry.toml")
        assert [shape["steps"] for shape in summary["shapes"]] == [1]
        assert (out / "guide_shapes.png").read_bytes().startswith(b"\x89PNG")
        with (out / "recording.mcap").open("rb") as file:
            counts = make_reader(file).get_summary().statistics.channel_message_counts
        assert min(counts.values()) > 0


def test_session_with_another_private_key_and_no_endpoint_does_not_start(authority: Authority, layout: Layout) -> None:
    certificate, _ = authority.issue("robot")
    _, other_key = authority.issue("other")
    config = TelemetryConfig(certificate=certificate, private_key=other_key, lock_step=True)
    with pytest.raises(TelemetryError, match="KeyMismatch"), TelemetryProcess(config, layout):
        pass


@pytest.mark.parametrize("requested", ["listen", "users", "nothing"])
def test_missing_package_is_an_error_only_if_an_endpoint_or_users_are_requested(
    users: Path, layout: Layout, requested: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = users.parent
    (folder / "sitecustomize.py").write_text("import sys\nsys.modules['google.protobuf'] = None\n")
    monkeypatch.setenv("PYTHONPATH", str(folder))
    options: dict[str, Any] = {"listen": {"listen": endpoint("tcp")}, "users": {"users": users}, "nothing": {}}
    telemetry = TelemetryProcess(TelemetryConfig(lock_step=True, **options[requested]), layout)
    if requested == "nothing":
        with telemetry:
            assert "is missing" in telemetry.notices[0]
    else:
        with pytest.raises(TelemetryError, match="nothing is published, because"):
            telemetry.start()


def test_configuration_from_code_is_checked() -> None:
    with pytest.raises(TelemetryError, match="unless certificate and private_key are given"):
        TelemetryConfig(listen="tls/127.0.0.1:7447")


def test_configuration_from_code_with_certificate_requires_tls_or_quic(authority: Authority) -> None:
    certificate, key = authority.issue("robot")
    with pytest.raises(TelemetryError, match="listen must be tls/HOST:PORT or quic/HOST:PORT"):
        TelemetryConfig(listen="udp/127.0.0.1:7447", certificate=certificate, private_key=key)
