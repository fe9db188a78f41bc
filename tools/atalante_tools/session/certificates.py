"""Certificates of the guides, printed for the user before a walk: `certificates -> lines on the terminal`."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING

from atalante_tools.console.terminal import print_message

if TYPE_CHECKING:
    from atalante_control.guide.certificate import Certificate
    from atalante_control.guide.disturbance import Mismatch


def announce(certificates: Collection[Certificate], mismatch: Mismatch, leg: str) -> None:
    """Print the certificate of each guide shape: the disturbance torques for which the running filter is built.

    Args:
        certificates: Certificates to print.
        mismatch: Errors of the model under which the promises hold.
        leg: Leg for which the promises are made, in words.
    """
    for certificate in certificates:
        name, xi, promise = certificate.shape, certificate.xi, certificate.promise
        if promise is None:
            print_message(f"{name}: NOT CERTIFIED at Xi {xi:g}: {certificate.reason}")
            continue
        print_message(
            f"{name}: promise at Xi {xi:g}: disturbances up to {promise.hip:.2f} Nm at the hip and {promise.knee:.2f} Nm at the "
            f"knee together leave both joints in the guide; {certificate.reason}"
        )
    if any(certificate.certified for certificate in certificates):
        print_message(
            "the promise includes joint torque and rate limits, delay, the torque carried over a stance change, and errors of "
            f"friction ({100.0 * mismatch.friction:g} %) and inertia ({100.0 * mismatch.inertia:g} %); it is made for the {leg}"
        )
