"""Loader of the network: `DBC file -> parser -> Network`.

Importing cantools and parsing the DBC take about half a second. So the result for the network of the robot is cached in
`__pycache__`, like the byte code of a module. The DBC is parsed again when the DBC, the parser, Python or cantools has changed.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import sys
from contextlib import suppress
from functools import cache
from importlib.metadata import version
from importlib.util import cache_from_source
from pathlib import Path

from atalante_dbc.network import Network

DBC_FILE = Path(__file__).with_name("atalante.dbc")
#: Source files that determine the parsed network: parser and data types.
SOURCES = tuple(Path(__file__).with_name(name) for name in ("parser.py", "attributes.py", "network.py"))
#: Length of the digest at the start of a cache file [byte].
_DIGEST = hashlib.sha256().digest_size


def load(path: Path | None = None) -> Network:
    """Load and check a DBC file.

    Args:
        path: DBC file. With None, the network of the robot is returned. This network is cached on disk, and read once
            per process.

    Raises:
        DbcError: If the file cannot be parsed or violates a rule, see `atalante_dbc.parser`.
    """
    return _load_once(DBC_FILE) if path is None else _parse(path)


def load_cached(path: Path) -> Network:
    """Load and check a DBC file, or read the result from the cache on disk.

    Args:
        path: DBC file.

    Raises:
        DbcError: If the file cannot be parsed or violates a rule, see `atalante_dbc.parser`.
    """
    try:
        key = _key(path)
    except OSError:
        return _parse(path)  # the file cannot be read, so `_parse` raises a `DbcError`
    file = Path(cache_from_source(str(path)))
    network = _cached(file, key)
    if network is None:
        network = _parse(path)
        if not sys.dont_write_bytecode:
            _store(file, key, network)
    return network


_load_once = cache(load_cached)


def _parse(path: Path) -> Network:
    from atalante_dbc.parser import parse  # imported only when needed, because cantools loads slowly

    return parse(path)


def _key(path: Path) -> bytes:
    """Return a digest that changes if the DBC, the parser, Python or cantools changes.

    Args:
        path: DBC file.
    """
    digest = hashlib.sha256(f"{sys.version} {version('cantools')}".encode())
    for source in (path, *SOURCES):
        digest.update(hashlib.sha256(source.read_bytes()).digest())
    return digest.digest()


def _cached(file: Path, key: bytes) -> Network | None:
    """Return the network in a cache file. Return None if the file is missing, is damaged, or has another key.

    Args:
        file: Cache file: digest of key and content, then the content.
        key: Key of the parsed DBC, see `_key`.
    """
    try:
        data = file.read_bytes()
    except OSError:
        return None
    if data[:_DIGEST] != _digest(key, data[_DIGEST:]):
        return None
    network = pickle.loads(data[_DIGEST:])
    assert isinstance(network, Network)
    return network


def _store(file: Path, key: bytes, network: Network) -> None:
    """Write a cache file. Do nothing if the folder is not writable: the DBC is then parsed at each start.

    Args:
        file: Cache file. Another process may read or write it at the same time.
        key: Key of the parsed DBC, see `_key`.
        network: Parsed network.
    """
    content = pickle.dumps(network)
    temporary = file.with_name(f"{file.name}.{os.getpid()}")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(_digest(key, content) + content)
        temporary.replace(file)
    except OSError:
        with suppress(OSError):
            temporary.unlink()


def _digest(key: bytes, content: bytes) -> bytes:
    return hashlib.sha256(key + content).digest()
