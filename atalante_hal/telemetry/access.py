"""Who may subscribe: TLS and users of the publisher's endpoint, and the telemetry file that asks for them.

`telemetry file -> TelemetryConfig -> publisher`. Without any of it the endpoint is open to whoever reaches it, which on the
default loopback is this machine. What a subscriber may do is the same for all: listen (access control, see `publisher`).
"""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

#: Keys of a telemetry file; the last four are files, relative to it.
_TEXTS, _FILES = ("robot", "listen"), ("certificate", "private_key", "client_ca", "users")


#: Protocols of an endpoint that a certificate protects, and of one without; the first of each is the default.
_PROTECTED, _UNPROTECTED = ("tls", "quic"), ("tcp",)
#: One endpoint: protocol, host, port. A Zenoh endpoint may go on with `?` and `#`, which override TLS settings of the files.
_ENDPOINT = re.compile(r"(?P<protocol>[^/]+)/(?:[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\]):(?P<port>[0-9]{1,5})", re.ASCII)
_LARGEST_PORT = 65535


class AccessError(RuntimeError):
    """The telemetry file or what it names is not right; the message names the key and what is valid."""

    code = "CONFIG_INVALID"


@dataclass(frozen=True)
class Access:
    """Files that decide who may subscribe; none: everybody who reaches the endpoint."""

    certificate: Path | None = None  # PEM, of the publisher: the endpoint speaks TLS
    private_key: Path | None = None  # PEM, of that certificate; for this user's eyes only
    client_ca: Path | None = None  # PEM: subscribers need a certificate that this authority signed
    users: Path | None = None  # a line "name:password" each; for this user's eyes only

    def __post_init__(self) -> None:
        if (self.certificate is None) != (self.private_key is None):
            raise AccessError("certificate and private_key belong together: give both or none")
        if self.client_ca is not None and self.certificate is None:
            raise AccessError("client_ca asks subscribers for certificates, which needs a certificate of our own")
        for name in _FILES:
            path = getattr(self, name)
            if path is not None and not path.is_file():
                raise AccessError(f"{name} is a file that can be read, not {path}")
        for name in ("private_key", "users"):
            path = getattr(self, name)
            if path is not None and path.stat().st_mode & 0o077:
                raise AccessError(f"{name} {path} can be read by others; type: chmod 600 {path}")
        if self.users is not None:
            lines = self.users.read_text(encoding="utf-8").splitlines()
            if not lines or not all(name and password for name, _, password in (line.partition(":") for line in lines)):
                raise AccessError(f"users {self.users} has a line name:password for each user, and nothing else")

    @property
    def protocols(self) -> tuple[str, ...]:
        """Protocols that the endpoint may speak, first parts of a Zenoh locator; the first is the default."""
        return _PROTECTED if self.certificate is not None else _UNPROTECTED

    def check_endpoint(self, listen: str) -> None:
        """Accept one endpoint that speaks a protocol the files protect, and nothing else.

        Args:
            listen: Zenoh endpoint, PROTOCOL/HOST:PORT.

        Raises:
            AccessError: it is another protocol, not one plain endpoint, or its port is 0 or too large.
        """
        found = _ENDPOINT.fullmatch(listen)
        if found and found["protocol"] in self.protocols and 0 < int(found["port"]) <= _LARGEST_PORT:
            return
        valid = " or ".join(f"{protocol}/HOST:PORT" for protocol in self.protocols)
        if self.certificate is not None:
            valid += " because a certificate is given"
        elif found and found["protocol"] in _PROTECTED:
            valid += " unless certificate and private_key are given"
        raise AccessError(f"listen must be {valid}, got {listen!r}")

    def transport(self) -> dict[str, Any]:
        """The part of Zenoh's configuration under `transport`."""
        link: dict[str, Any] = {}
        if self.certificate is not None:
            link["tls"] = {"listen_certificate": str(self.certificate), "listen_private_key": str(self.private_key)}
            if self.client_ca is not None:
                link["tls"] |= {"root_ca_certificate": str(self.client_ca), "enable_mtls": True}
        auth = {"auth": {"usrpwd": {"dictionary_file": str(self.users)}}} if self.users is not None else {}
        return {"link": link, **auth}


def load_telemetry_file(path: Path) -> dict[str, Any]:
    """What a telemetry file (TOML) sets, by the names of `TelemetryConfig`.

    Keys: `robot` (name), `listen` (Zenoh endpoint), `certificate`, `private_key`, `client_ca`, `users` (files).

    Raises:
        AccessError: the file cannot be read, an unknown key, a value that is no text, a file that is not there.
    """
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise AccessError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise AccessError(f"{path}: {error}") from error
    for key, value in document.items():
        if key not in (*_TEXTS, *_FILES):
            raise AccessError(f"{path}: {key} is unknown; valid keys are {', '.join((*_TEXTS, *_FILES))}")
        if not isinstance(value, str) or not value:
            raise AccessError(f"{path}: {key} is a text that is not empty, not {value!r}")
    files = {key: path.parent / document[key] for key in _FILES if key in document}
    try:
        access = Access(**files)
        if "listen" in document:
            access.check_endpoint(document["listen"])
    except AccessError as error:
        raise AccessError(f"{path}: {error}") from error
    return {**{key: document[key] for key in _TEXTS if key in document}, **files}
