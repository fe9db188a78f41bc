"""CAN network of the robot: `atalante.dbc`, the only definition of all frames, and its strict loader."""

from atalante_dbc.loader import DBC_FILE, load
from atalante_dbc.network import DbcError, Message, Network, Node, Signal, wire_time

__all__ = ["DBC_FILE", "DbcError", "Message", "Network", "Node", "Signal", "load", "wire_time"]
