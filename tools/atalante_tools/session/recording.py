"""Recording of a run by the telemetry process: `HAL record, events, frames -> recording.mcap, CAN log, Zenoh`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from atalante_tools.console.options import Target
from atalante_tools.console.outcome import Failed
from atalante_tools.console.terminal import print_message

if TYPE_CHECKING:
    from atalante_dbc import Network
    from atalante_hal.hal import Hal
    from atalante_hal.telemetry.child import TelemetryChild
    from atalante_hal.telemetry.process import Recording, TelemetryProcess, TelemetrySummary
    from atalante_tools.session.rig import Rig

#: Longest wait for the telemetry process before a run in real time [s].
#: After the wait, the run starts even if the process is not ready. Recording then begins as soon as the process is ready.
_TELEMETRY_WAIT: Final = 5.0
#: Time between two checks of the telemetry process [cycles].
_TEND_CYCLES: Final = 250


def _record_rate(text: str) -> int:
    """Convert the value of `--record-rate` to a number [Hz]. The rate must be a divisor of 1000 Hz.

    Args:
        text: Rate as the user typed it.

    Raises:
        click.BadParameter: If the text is not a divisor of 1000.
    """
    if text.isdecimal() and int(text) and not 1000 % int(text):
        return int(text)
    raise click.BadParameter(f"must be a divisor of 1000, such as 1, 10, 50, 100, 200, 250, 500 or 1000, got {text!r}")


#: Options of a command that records its run: `--record-rate`, `--can-log` and `--telemetry`.
RECORDING_OPTIONS: Final = [
    click.option("--record-rate", type=_record_rate, default="100", show_default=True, metavar="HZ",
                 help="Recording rate [Hz], a divisor of 1000. With 1000, every cycle is recorded."),
    click.option("--can-log", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE",
                 help="Log every CAN frame to this file. The suffix sets the format: .log, .asc, .blf, .log.gz, .asc.gz.  "
                      "[default: no CAN log]"),
    click.option("--telemetry", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE",
                 help="TOML file with Zenoh endpoint, TLS certificate and users.  "
                      "[default: publish on the loopback interface only]"),
]  # fmt: skip


@dataclass(frozen=True)
class RecordingOptions:
    """Values of the options `--record-rate`, `--can-log` and `--telemetry`."""

    record_rate: int = 100  # recording rate [Hz]
    can_log: Path | None = None  # log file for all CAN frames. None means no CAN log.
    #: TOML file with endpoint, TLS certificate and users. If None, the run publishes on the loopback interface only.
    telemetry: Path | None = None


@dataclass(frozen=True)
class Outputs:
    """Outputs of the telemetry process."""

    recording: Path | None  # MCAP file. None: no recording
    record_rate: int  # recording rate [Hz]
    can_log: Path | None  # log file for all CAN frames. None: no CAN log
    #: settings from the telemetry file (robot name, Zenoh endpoint, TLS files, users): field name of `TelemetryConfig` -> value
    outlet: Mapping[str, Any]


#: Recording rate above which the telemetry process needs a processor core of its own [Hz].
_LIGHT_RATE: Final = 100


def telemetry_cores(outputs: Outputs | None) -> int:
    """Return the number of processor cores that the telemetry process keeps busy in lock-step.

    For a recording at 100 Hz, the process needs a quarter of the computing time of the HAL. For a CAN log or a
    recording of every cycle, the process needs more computing time than the HAL.

    Args:
        outputs: Outputs of the telemetry process; None means no telemetry process.
    """
    return int(outputs is not None and (outputs.can_log is not None or outputs.record_rate > _LIGHT_RATE))


def outlet_of(telemetry: Path | None) -> Mapping[str, Any]:
    """Read the telemetry file, and return its fields. Without a file, return an empty mapping.

    Args:
        telemetry: TOML file with endpoint, TLS certificate and users.

    Raises:
        AccessError: If the file is invalid.
    """
    from atalante_hal.telemetry.access import load_telemetry_file

    return load_telemetry_file(telemetry) if telemetry else {}


def require_format(can_log: Path) -> None:
    """Check the suffix of a CAN log.

    Args:
        can_log: File of the CAN log.

    Raises:
        click.UsageError: If no format has this suffix.
    """
    from atalante_hal.telemetry.can_log import check_format
    from atalante_hal.telemetry.sink import SinkError

    try:
        check_format(can_log)
    except SinkError as error:
        raise click.UsageError(str(error)) from error


def require_complete(recording: Recording | None) -> None:
    """Check that the recording is one file that contains every cycle.

    Args:
        recording: Recording of the run. None: no recording.

    Raises:
        Failed: If there is no file, if cycles are missing, if the recording has several files, or if its file is truncated.
    """
    if recording is None or recording.complete:
        return
    files = ", ".join(recording.files)
    if not files:
        raise Failed("the recording is missing: no file was written")
    if recording.missing_cycles:
        raise Failed(f"the recording is incomplete: {recording.missing_cycles} cycles are missing in {files}")
    if len(recording.files) > 1:
        raise Failed(
            f"the recording must be one file, but the telemetry process was restarted and wrote several: {files}"
        )
    raise Failed(f"the recording is incomplete: {files} may have no index")


def require_complete_log(can_log: Path | None, complete: bool) -> None:
    """Check that the CAN log contains every frame.

    Args:
        can_log: File of the CAN log.
        complete: Whether no frame is missing.

    Raises:
        Failed: If frames are missing.
    """
    if not complete:
        raise Failed(f"the CAN log {can_log} must contain every frame, but frames are missing")


def start_telemetry(
    target: Target,
    outputs: Outputs,
    hal: Hal,
    network: Network,
    gait_hash: int,
    about: Mapping[str, Any],
    child: TelemetryChild | None,
) -> TelemetryProcess:
    """Start the telemetry process. The caller closes it with `close_telemetry`.

    Args:
        target: Bus and clock.
        outputs: Outputs of the process.
        hal: HAL of the run.
        network: Nodes and messages.
        gait_hash: Identifier of the gait.
        about: Options of the run, for the metadata of the recording.
        child: Subprocess that has already been started. None: start one now.
    """
    from atalante_hal.safety.diagnostics import Dtc
    from atalante_hal.telemetry.process import TelemetryConfig, TelemetryProcess

    config = TelemetryConfig(
        recording=outputs.recording,
        record_rate=outputs.record_rate,
        can_log=outputs.can_log,
        lock_step=target.lockstep,
        # Size of the ring buffer [cycles]. The buffer must not overflow during a pause of the telemetry process.
        # A run in lock-step continues during this pause, faster than real time, so the buffer holds several seconds of the run.
        slots=8192,
        **outputs.outlet,
    )
    telemetry = TelemetryProcess(
        config,
        hal.layout,
        bus_of={message.frame_id: message.bus for message in network.messages},
        buses=network.buses,
        diagnostics=[dtc.value for dtc in Dtc],
        about={
            "version": version("atalante-hal"),
            "dbc_hash": f"{network.hash32:08x}",
            "config_hash": f"{hal.robot.hash32:08x}",
            "gait_hash": f"{gait_hash:08x}",
            "target": target,
            **about,
        },
        child=child,
    )
    telemetry.start() if target.lockstep else telemetry.start(_TELEMETRY_WAIT)
    return telemetry


def close_telemetry(telemetry: TelemetryProcess) -> TelemetrySummary:
    """Close the telemetry, print its messages about lost data, and return its summary.

    Args:
        telemetry: Telemetry to close.
    """
    summary = telemetry.close()
    for notice in summary.notices:
        if notice not in telemetry.notices:  # the messages in `telemetry.notices` are already printed
            print_message(notice)
    if not summary.complete and not summary.notices:
        print_message("the telemetry process ended unexpectedly: the recording may be truncated")
    return summary


class EndpointReport:
    """Object that prints the Zenoh endpoint of the telemetry: once at the start, and again after a change of the endpoint."""

    def __init__(self, telemetry: TelemetryProcess) -> None:
        """Print the notices and the endpoint of the telemetry.

        Args:
            telemetry: Telemetry that is started.
        """
        for notice in telemetry.notices:
            print_message(notice)
        self._telemetry = telemetry
        self._endpoint: str | None = None
        self()

    def __call__(self) -> None:
        """Print the endpoint if it changed since the last call."""
        endpoint = self._telemetry.endpoint
        if endpoint != self._endpoint:
            self._endpoint = endpoint
            keys = f"keys atalante/{self._telemetry.config.robot}/**"
            print_message(
                f"telemetry on Zenoh at {endpoint}, {keys}" if endpoint else "telemetry is no longer published"
            )


class Recorder:
    """Recorder of one run: passes the record of each cycle, the events and the frames to the telemetry process."""

    def __init__(self, rig: Rig, telemetry: TelemetryProcess, endpoint: EndpointReport) -> None:
        """Connect the HAL with the telemetry.

        Args:
            rig: Rig of the run.
            telemetry: Telemetry that is started.
            endpoint: Printer of the endpoint.
        """
        self._hal, self._telemetry, self._report_endpoint = rig.hal, telemetry, endpoint
        self._reported = 0
        hal = rig.hal
        if telemetry.frames is not None:
            if rig.target.lockstep:
                hal.tap = telemetry.tap(lambda: hal.state.cycle * 1_000_000)
            else:
                hal.tap = telemetry.tap(stamps=lambda: hal.bus.stamps)

    def write(self) -> None:
        """Write the record of a cycle, and new events. Call this method once per cycle."""
        hal = self._hal
        self._telemetry.write(hal.record)
        if not hal.state.cycle % _TEND_CYCLES:
            self._telemetry.tend()
            self._report_endpoint()
        if hal.events.count != self._reported:
            self.report_events()

    def report_events(self) -> None:
        """Write the events since the last call."""
        events = self._hal.events
        for event in events.since(self._reported):
            self._telemetry.event(event)
        self._reported = events.count
