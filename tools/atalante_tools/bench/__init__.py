"""Command `atalante bench`: measure the speed of the stack against baselines in the same run.

The modules `wire`, `motion`, `ground`, `startup`, `gaits`, `gait_solve` and `log_check` contain the benchmarks. The module
`catalogue` lists the benchmarks.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from atalante_tools.console.names import find
from atalante_tools.console.options import json_option
from atalante_tools.console.outcome import Failed
from atalante_tools.console.stop_request import check_stop
from atalante_tools.console.terminal import Progress, print_message, show_json, table

if TYPE_CHECKING:
    from atalante_tools.bench.catalogue import Benchmark
    from atalante_tools.bench.measure import Measurement


@click.command()
@click.argument("names", metavar="[NAME]...", nargs=-1)
@click.option("--quick", is_flag=True, help="Run only a few rounds per benchmark, to check that all benchmarks work.")
@click.option(
    "--one-process",
    is_flag=True,
    help="Run each benchmark once, in this process, instead of in several new processes. --quick implies this option.",
)
@json_option
def command(names: tuple[str, ...], quick: bool, one_process: bool, as_json: bool) -> None:
    """Measure the speed of the stack against baselines and print the ratios of the median times.

    The measured function and the baseline run alternately in short blocks. Absolute times depend on the machine and the
    load of the machine, so only the ratio is comparable. If a ratio differs between processes, the benchmark runs in
    several processes. The report shows the median, the lowest and the highest ratio. Every benchmark checks the computed
    results. The exit code is 1 if a result is wrong. The report shows each missed target, but a missed target does not
    change the exit code.

    \b
    Example: atalante bench
             atalante bench --json hal_cycle decode_cycle
    """
    from atalante_tools.bench.catalogue import BENCHMARKS
    from atalante_tools.bench.measure import BenchmarkError, Effort, median

    known = [benchmark.name for benchmark in BENCHMARKS]
    chosen = [BENCHMARKS[find(name, known, "benchmark")] for name in dict.fromkeys(names)] or list(BENCHMARKS)
    progress = Progress()
    rows: list[tuple[str, ...]] = [
        ("benchmark", "value", "baseline", "unit", "ratio", "spread", "target", "", "baseline is")
    ]
    for number, benchmark in enumerate(chosen, start=1):
        check_stop()
        label = f"{benchmark.name} ({number} of {len(chosen)})"

        def show(done: int, total: int, label: str = label) -> None:
            if progress.due():
                progress.show(f"{label}: round {done} of {total}")

        progress.show(f"{label}: preparing")
        try:
            if quick or one_process or benchmark.processes == 1:
                measured = benchmark.run(Effort(quick, show))
            else:
                progress.clear()
                measured = median([in_new_process(benchmark) for _ in range(benchmark.processes)])
        except BenchmarkError as error:
            progress.clear()
            raise Failed(f"the benchmark {benchmark.name} is invalid: {error}") from error
        progress.clear()
        for remark in measured.remarks:
            print_message(f"{benchmark.name}: {remark}")
        if as_json:
            show_json(line(benchmark, measured))
        rows.append(row(benchmark, measured))
    if not as_json:
        click.echo(table(rows))


def in_new_process(benchmark: Benchmark) -> Measurement:
    """Run a benchmark in a new process. The new process prints the progress of the benchmark.

    Args:
        benchmark: benchmark to run.

    Raises:
        BenchmarkError: If the process fails. The process prints the reason.
    """
    import json
    import subprocess
    import sys

    from atalante_tools.bench.measure import Measurement, require

    check_stop()
    program = [sys.executable, "-c", "from atalante_tools.entry import main; main()"]
    done = subprocess.run(
        [*program, "bench", "--one-process", "--json", benchmark.name], stdout=subprocess.PIPE, text=True, check=False
    )
    check_stop()
    require(done.returncode == 0, f"its process ended with the code {done.returncode}")
    result = json.loads(done.stdout)
    value, baseline = (
        None if figure is None else figure / benchmark.per_second
        for figure in (result["value"], result["baseline_value"])
    )
    return Measurement(value, baseline)


def line(benchmark: Benchmark, measured: Measurement) -> dict[str, Any]:
    """Return a benchmark as a JSON object; a value that was not measured is null."""
    return {
        "name": benchmark.name,
        "value": _in_unit(benchmark, measured.value),
        "unit": benchmark.unit,
        "baseline": benchmark.baseline,
        "baseline_value": _in_unit(benchmark, measured.baseline),
        "ratio": measured.ratio,
        "ratios": measured.ratios or (measured.ratio,),
    }


def row(benchmark: Benchmark, measured: Measurement) -> tuple[str, ...]:
    """Return a benchmark as a row of the table."""
    ratio, target = measured.ratio, benchmark.target
    if ratio is None:
        verdict = "not measured"
    elif target is None:
        verdict = ""
    else:
        verdict = "met" if ratio <= target else "MISSED"
    figures = [_in_unit(benchmark, seconds) for seconds in (measured.value, measured.baseline)]
    return (
        benchmark.name,
        *("-" if figure is None else f"{figure:.3f}" for figure in figures),
        benchmark.unit,
        "-" if ratio is None else f"{ratio:.4f}",
        f"{measured.ratios[0]:.4f} to {measured.ratios[-1]:.4f}" if measured.ratios else "-",
        "-" if target is None else f"{target:.4f}",
        verdict,
        benchmark.baseline,
    )


def _in_unit(benchmark: Benchmark, seconds: float | None) -> float | None:
    return None if seconds is None else seconds * benchmark.per_second
