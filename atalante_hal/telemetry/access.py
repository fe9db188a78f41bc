"""Access control of the telemetry endpoint: TLS certificates, users, and the telemetry file with these settings.

`telemetry file -> TelemetryConfig -> publisher`. Without these settings every client that reaches the endpoint may subscribe. The
default endpoint (loopback) can be reached only from this machine. A subscriber can only receive, see `publisher`.
"""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# Keys of a telemetry file. _TEXTS: the value is a text. _FILES: the value is a path relative to the telemetry file.
_TEXTS, _FILES = ("robot", "listen"), ("certificate", "private_key", "client_ca", "users")


# Valid protocols of an endpoint: _PROTECTED if there is a TLS certificate, otherwise _UNPROTECTED.
_PROTECTED, _UNPROTECTED = ("tls", "quic"), ("tcp",)
#: Valid endpoint: protocol, host, port. Zenoh's suffixes `?` and `#` are rejected, because they override TLS settings.
_ENDPOINT = re.compile(r"(?P<protocol>[^/]+)/(?:[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\]):(?P<port>[0-9]{1,5})", re.ASCII)
_LARGEST_PORT = 65535


class AccessError(RuntimeError):
    """Error in the telemetry file or in a file that it refers to; the message names the key and its valid values."""

    code = "CONFIG_INVALID"


@dataclass(frozen=True)
class Access:
    """Files that restrict the access to the endpoint. Without these files, every client may subscribe."""

    certificate: Path | None = None  # PEM certificate of the publisher; the endpoint uses TLS only with a certificate
    private_key: Path | None = None  # PEM private key of the publisher; only the owner of the file may have access
    client_ca: Path | None = None  # PEM certificate of the authority that signs the certificates of the subscribers
    users: Path | None = None  # file of lines "name:password", one per user; only the owner of the file may have access

    def __post_init__(self) -> None:
        if (self.certificate is None) != (self.private_key is None):
            raise AccessError("certificate and private_key must be given together, got only one: give both or none")
        if self.client_ca is not None and self.certificate is None:
            raise AccessError("client_ca requires certificate and private_key of the publisher: give all three files")
        for name in _FILES:
            path = getattr(self, name)
            if path is not None and not path.is_file():
                raise AccessError(f"{name} must be a readable file, got {path}")
        for name in ("private_key", "users"):
            path = getattr(self, name)
            if path is not None and path.stat().st_mode & 0o077:
                raise AccessError(f"{name} {path} must be readable only by its owner; type: chmod 600 {path}")
        if self.users is not None:
            try:
                lines = self.user_lines()
            except (OSError, UnicodeDecodeError) as error:
                raise AccessError(f"users {self.users} must be a readable file in UTF-8: {error}") from error
            if not lines or not all(name and password for name, _, password in (line.partition(":") for line in lines)):
                raise AccessError(
                    f"users {self.users} must contain only lines name:password, one for each user, and comments that begin with #"
                )

    @property
    def protocols(self) -> tuple[str, ...]:
        """Return the valid protocols of the endpoint. The first protocol is the default."""
        return _PROTECTED if self.certificate is not None else _UNPROTECTED

    def check_endpoint(self, listen: str) -> None:
        """Check that an endpoint uses an allowed protocol and has no further options.

        Args:
            listen: Zenoh endpoint, PROTOCOL/HOST:PORT.

        Raises:
            AccessError: If the protocol is not allowed, the text is not PROTOCOL/HOST:PORT, or the port is not 1 to 65535.
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

    def user_lines(self) -> list[str]:
        """Return the lines `name:password` of the file `users`. Comments, and spaces at both ends of a line, are removed."""
        lines = self.users.read_text(encoding="utf-8").splitlines() if self.users is not None else []
        return [line for line in map(str.strip, lines) if not line.startswith("#")]

    def transport(self, users: str) -> dict[str, Any]:
        """Return the section `transport` of the Zenoh configuration.

        Args:
            users: Path of a file with the `user_lines`. The file of the operator may contain comments, and Zenoh would take a
                comment as a user.
        """
        link: dict[str, Any] = {}
        if self.certificate is not None:
            link["tls"] = {"listen_certificate": str(self.certificate), "listen_private_key": str(self.private_key)}
            if self.client_ca is not None:
                link["tls"] |= {"root_ca_certificate": str(self.client_ca), "enable_mtls": True}
        auth = {"auth": {"usrpwd": {"dictionary_file": users}}} if self.users is not None else {}
        return {"link": link, **auth}


def load_telemetry_file(path: Path) -> dict[str, Any]:
    """Read a telemetry file and check it.

    Args:
        path: TOML file with the keys `robot` (name), `listen` (Zenoh endpoint), `certificate`, `private_key`, `client_ca` and
            `users` (files). All keys are optional.

    Returns:
        Value of each key that is set, under the field names of `TelemetryConfig`.

    Raises:
        AccessError: If a file cannot be read, a key is unknown or a value is not valid.
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
            raise AccessError(f"{path}: {key} must be a text that is not empty, got {value!r}")
    files = {key: path.parent / document[key] for key in _FILES if key in document}
    try:
        access = Access(**files)
        if "listen" in document:
            access.check_endpoint(document["listen"])
    except AccessError as error:
        raise AccessError(f"{path}: {error}") from error
    return {**{key: document[key] for key in _TEXTS if key in document}, **files}
