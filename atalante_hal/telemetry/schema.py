"""Protobuf messages of `messages.proto`, loaded from the compiled file `messages.binpb`.

The file contains a descriptor set, which every protobuf release can load. Generated `_pb2` modules work only with certain
protobuf releases.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

PACKAGE = "atalante.v1"
DESCRIPTORS = Path(__file__).with_name("messages.binpb")


@cache
def _pool() -> Any:
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(descriptor_set()).file:
        pool.Add(file)
    return pool


@cache
def descriptor_set() -> bytes:
    """Return the serialised FileDescriptorSet of `messages.proto` and its imports: the schema of the MCAP channels."""
    return DESCRIPTORS.read_bytes()


@cache
def message_class(name: str) -> Any:
    """Return the class of a protobuf message.

    Args:
        name: Name of the message without its package, e.g. "JointStates".

    Returns:
        Message class.

    Raises:
        KeyError: If there is no message of that name.
    """
    return message_factory.GetMessageClass(_pool().FindMessageTypeByName(f"{PACKAGE}.{name}"))


def encoding(name: str) -> str:
    """Return the Zenoh encoding of a message, e.g. application/protobuf;atalante.v1.JointStates.

    Args:
        name: Name of the message without its package.

    Returns:
        Encoding text.
    """
    return f"application/protobuf;{PACKAGE}.{name}"
