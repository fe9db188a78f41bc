"""Certificates of the guides, printed for the user before a walk: `certificates -> lines on the terminal`."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import TYPE_CHECKING, Any

from atalante_hal.types import PERIOD
from atalante_tools.console.terminal import print_message

if TYPE_CHECKING:
    from atalante_control.guide.certificate import Certificate
    from atalante_control.guide.disturbance import Mismatch
    from atalante_control.guide.statistics import GuideStatistics


def weakest(certificates: Iterable[Certificate]) -> Certificate:
    """Return the certificate with the smallest certified hip torque.

    A certificate without certified torques counts as smaller than every other certificate.

    Args:
        certificates: Certificates of one guide shape, for each assistance factor and each gait. At least one is needed.
    """
    return min(certificates, key=lambda c: -1.0 if c.promise is None else c.promise.hip)


def promise_fields(certificate: Certificate | None) -> dict[str, Any]:
    """Return the fields `certified`, `promise_hip_nm` and `promise_knee_nm` of a result.

    Args:
        certificate: Certificate of the guide. None if there is no guide; the values are then None.
    """
    promise = None if certificate is None else certificate.promise
    return {
        "certified": None if certificate is None else certificate.certified,
        "promise_hip_nm": None if promise is None else promise.hip,
        "promise_knee_nm": None if promise is None else promise.knee,
    }


def announce(certificates: Collection[Certificate], mismatch: Mismatch, leg: str) -> None:
    """Print the certificate of each guide shape: the certified torques, or the reason why there are none.

    Args:
        certificates: Certificates to print.
        mismatch: Errors of the model under which the promises hold.
        leg: Description of the leg for which the promises are made.
    """
    for certificate in certificates:
        name, xi, promise = certificate.shape, certificate.xi, certificate.promise
        if promise is None:
            print_message(f"{name}: NOT CERTIFIED at Xi {xi:g}: {certificate.reason}")
            continue
        print_message(
            f"{name}: promise at Xi {xi:g}: both joints stay in the guide while disturbances of up to {promise.hip:.2f} Nm "
            f"at the hip and {promise.knee:.2f} Nm at the knee act at the same time; {certificate.reason}"
        )
    if any(certificate.certified for certificate in certificates):
        print_message(
            f"the promise includes joint torque and rate limits, delay ({_covered_delay()} more than normal), the torque jump at "
            f"a stance change, and errors of friction ({100.0 * mismatch.friction:g} %) and inertia "
            f"({100.0 * mismatch.inertia:g} %); it is made for the {leg}, and for steps that start inside the hand-over box. "
            "Steps that start outside are counted"
        )


def report_hand_overs(name: str, statistics: GuideStatistics) -> None:
    """Print how many steps the certificate does not cover, and how many steps were at least partly without a guide.

    A number that is zero is not printed.

    Args:
        name: Name of the guide shape.
        statistics: Statistics of the guide.
    """
    if statistics.hand_overs_exceeded:
        print_message(
            f"{name}: the certificate did not apply to {statistics.hand_overs_exceeded} of {statistics.hand_overs} steps: at the "
            "stance change, an angle, a speed, an acceleration or a torque jump was larger than the certificate assumes"
        )
    if statistics.late:
        print_message(
            f"{name}: {statistics.late} steps had full assistance, at least in part, because data or torques were more than "
            f"{_covered_delay()} late"
        )


def _covered_delay() -> str:
    """Return the additional delay that the guides cover, as text."""
    from atalante_control.guide.loop_delay import COVERED

    return f"{1e3 * COVERED * PERIOD:g} ms"
