"""Command `atalante decode`: convert the signals of CAN logs to Parquet or MCAP.

Data flow of each chunk of frames: log -> column codec -> columns of values -> file.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import click

from atalante_tools.console.outcome import FAILED, Failed
from atalante_tools.console.stop_request import check_stop
from atalante_tools.console.terminal import Progress, print_message

if TYPE_CHECKING:
    from atalante_tools.canlog.decode.signals import Sink
    from atalante_tools.canlog.plan import Plan

_FILE = click.Path(exists=True, dir_okay=False, path_type=Path)


@click.command()
@click.argument("logs", nargs=-1, required=True, metavar="LOG...", type=click.Path(path_type=Path))
@click.option(
    "-o", "--out", required=True, type=click.Path(dir_okay=False, path_type=Path), metavar="FILE",
    help="Output file: .parquet (one row per signal value) or .mcap (protobuf, one topic per message).",
)  # fmt: skip
@click.option("--dbc", type=_FILE, default=None, help="DBC to decode with.  [default: the DBC of the robot]")
def command(logs: tuple[Path, ...], out: Path, dbc: Path | None) -> None:
    """Decode CAN logs (.log of candump, .asc, .blf, .mf4, .trc, .csv) to signals in physical units.

    The command checks no rules; for that, use `atalante validate`. Frames with an unknown identifier or a payload that
    is too short are counted and skipped. If the logs have no frame, no file is written. If a log is truncated,
    the file has the values of all readable frames, and the exit code is 1.

    \b
    Example: atalante decode night.log -o night.parquet
             atalante decode drive.blf --dbc vehicle.dbc -o drive.mcap
    """
    if out.suffix.lower() not in (".parquet", ".mcap"):
        raise click.UsageError(f"--out must end in .parquet or .mcap, got {out}")
    from atalante_dbc import DBC_FILE
    from atalante_dbc.foreign import catalogue
    from atalante_tools.canlog.decode.signals import Decoder
    from atalante_tools.canlog.plan import Plan
    from atalante_tools.canlog.reader.log import open_log

    plan = Plan(catalogue(dbc or DBC_FILE))
    for unsupported in plan.refused:
        print_message(f"{unsupported.name} is not decoded: {unsupported.reason}")
    sources = [open_log(path) for path in logs]
    decoder = Decoder(plan)
    progress = Progress()
    truncated = False
    with _complete_file(out) as part, closing(_sink(part, out.suffix.lower(), plan)) as sink:
        for source in sources:
            for chunk in source.chunks():
                check_stop()  # a library may have discarded the exception of a stop signal
                for decoded in decoder.decode(chunk):
                    sink.write(decoded, source.channels.names)
                sink.flush()
                if progress.due():
                    share = 100.0 * source.position / max(1, source.size)
                    progress.show(f"{source.path.name}: {share:.0f} %, {decoder.frames} frames, {sink.values} values")
            progress.clear()
            check_stop()
            for remark in source.remarks:
                print_message(remark.sentence)
                truncated |= remark.rule == "log-truncated"
        if not decoder.frames:
            raise Failed(f"a log must have at least one frame to decode, got none; {out} was not written")
    print_message(f"{out}: {sink.values} values of {decoder.decoded} frames")
    if decoder.skipped:
        print_message(f"skipped: {decoder.skipped}")
    if truncated or not decoder.decoded:
        raise SystemExit(FAILED)


@contextmanager
def _complete_file(out: Path) -> Iterator[Path]:
    """Yield the path of a temporary file, and rename this file to `out` after the `with` block.

    The temporary file is in its own folder next to `out`, so it replaces no file of the user. If the block raises an exception,
    the temporary file is removed, and a file `out` that already exists is unchanged.

    Raises:
        Failed: If the file cannot be written.
    """
    try:
        with TemporaryDirectory(prefix=f"{out.name}.", dir=out.parent) as folder:
            part = Path(folder) / out.name
            yield part
            part.replace(out)
    except OSError as error:
        raise Failed(f"{out} cannot be written: {error.strerror or error}") from error


def _sink(out: Path, suffix: str, plan: Plan) -> Sink:
    """Open the output file as Parquet or MCAP, according to the suffix of the file name.

    Raises:
        Failed: If a package for the format is not installed.
    """
    try:
        if suffix == ".parquet":
            from atalante_tools.canlog.decode.parquet import ParquetSink

            return ParquetSink(out, plan)
        if suffix == ".mcap":
            from atalante_tools.canlog.decode.mcap import McapSink

            return McapSink(out, plan)
    except ModuleNotFoundError as error:
        raise Failed(f"a {suffix} file needs {error.name}: type `pip install 'atalante-hal[decode]'`") from error
    raise AssertionError(f"suffix must be .parquet or .mcap, got {suffix}")
