"""Solver of one step: `subject -> initial guess or similar gait -> IPOPT -> gait with constraint violations in SI units`.

The nonlinear program of each kind of step is built once per process and used for every subject. A warm start is faster.
In all cases tried, the gait was the same with and without a warm start.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Mapping
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import casadi
import numpy as np

from atalante_control.dynamics.stance import stance_dynamics
from atalante_control.gait.gait import Gait, Kind
from atalante_control.gait.subject import Subject
from atalante_control.gait_optimization.compiled import compiled
from atalante_control.gait_optimization.guess import guess
from atalante_control.gait_optimization.nlp import Functions
from atalante_control.gait_optimization.progress import Progress, Watch
from atalante_control.gait_optimization.reach import Reach
from atalante_control.gait_optimization.requirements import Requirements
from atalante_control.gait_optimization.result import SOLVED, Residual, SolvedGait
from atalante_control.gait_optimization.step_problem import TRANSITION, StepProblem
from atalante_hal.robot import ROBOT_FILE, load_robot

RESIDUAL = 1e-6  # largest accepted violation of each constraint in a solved gait, in the SI unit of this constraint
_OPTIONS: dict[str, Any] = {
    "ipopt.nlp_scaling_method": "none",  # no scaling by IPOPT, because constraints and unknowns are already scaled
    "ipopt.max_iter": 150,
    "ipopt.tol": 1e-8,
    "ipopt.constr_viol_tol": 1e-10,
    "ipopt.bound_relax_factor": 0.0,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "print_time": False,
    "error_on_fail": False,
    "calc_lam_p": False,
    # CasADi must not build the function nlp_grad: the compiled functions lack the derivatives that nlp_grad requires.
    # CasADi uses nlp_grad only for sensitivities of the solution, which are not computed here.
    "no_nlp_grad": True,
}
#: IPOPT options of a warm start: a small initial barrier parameter mu, and bound multipliers computed from mu.
#: A warm start takes 17 to 21 iterations with these options, and 34 to 36 iterations with the default options.
_WARM: dict[str, Any] = {"ipopt.mu_init": 1e-3, "ipopt.bound_mult_init_method": "mu-based"}
#: Patterns of the source files that determine a gait; `code_version` hashes these files.
_SOURCES = (
    *(
        f"gait_optimization/{module}.py"
        for module in (
            "symbolic_dynamics",
            "guess",
            "step_problem",
            "nlp",
            "requirements",
            "solve",
            "compiled",
            "reach",
            "result",
            "second_start",
            "verify",
        )
    ),
    *("gait/gait.py", "gait/subject.py", "dynamics/gravity.py", "dynamics/stance.py", "model/*.py", "structured.py"),
)


def solve(
    subject: Subject,
    warm_start: Gait | None = None,
    kind: Kind = "periodic",
    progress: Progress | None = None,
    machine_code: bool = False,
    around: Gait | None = None,
) -> SolvedGait:
    """Optimise the gait of one step.

    A start step leads from rest on both feet to the end of the periodic step of the subject. A stop step leads from the
    start of the periodic step to rest. Start and stop step last `step_problem.TRANSITION` seconds. The step duration of
    the subject has no effect on them.

    Args:
        subject: patient and step parameters.
        warm_start: gait of a similar subject as the initial guess. If None, the initial guess is the result of `guess`.
        kind: kind of step, `periodic`, `start` or `stop`.
        progress: function to call at each iteration, or None for no progress report.
        machine_code: whether compiled functions are used. The compilation takes about 15 s at the first use on a
            computer, so it saves time only if many gaits are solved.
        around: periodic gait before a stop step or after a start step. If None, this gait is solved first.

    Returns:
        The gait. If the solver failed, the gait is the last iterate and the status names the violated constraint.

    Raises:
        ValueError: If `around` is given for a periodic step.
    """
    if kind == "periodic" and around is not None:
        raise ValueError("a periodic step must be solved without the argument `around`")
    if kind != "periodic" and around is None:
        periodic = solve(subject, machine_code=machine_code)
        if not periodic.solved:
            return periodic
        around = periodic.gait
    problem, functions = _built(kind, machine_code)
    duration = subject.step_duration if around is None else TRANSITION
    parameters = problem.parameters(subject.patient, duration, subject.step_length)
    lower, upper = problem.bounds(duration)
    low, high = problem.constraint_bounds(around)
    coefficients = guess(problem, parameters, subject) if warm_start is None else warm_start.coefficients
    refusal = _reach().refusal(parameters, subject.step_length) if kind == "periodic" else None
    ending, iterations = "not started", 0
    started = time.perf_counter()
    if refusal is None:
        if progress is None:
            solver = _silent_solver(kind, machine_code, warm_start is not None)
        else:
            watch = Watch(problem.program.unknowns, (low, high), progress)
            solver = _solver(kind, machine_code, warm_start is not None, {"iteration_callback": watch})
        x0 = problem.unknowns(coefficients, parameters)
        solution = solver(x0=x0, p=parameters, lbx=lower, ubx=upper, lbg=low, ubg=high)
        ending, iterations = solver.stats()["return_status"], int(solver.stats()["iter_count"])
        coefficients = problem.coefficients(np.array(solution["x"]).ravel())
    seconds = time.perf_counter() - started

    x = problem.unknowns(coefficients, parameters)
    residuals = problem.residuals(x, np.array(functions.constraints(x, parameters)).ravel(), (low, high), duration)
    worst = max(residuals.values(), key=lambda residual: residual.value).value
    if ending == "Solve_Succeeded" and worst <= RESIDUAL:
        status = SOLVED
    else:
        status = f"no such gait for {subject}: {refusal or _unmet(problem, residuals)}"
    record = {
        "method": f"{kind} step, IPOPT: {ending}",
        "status": status,
        "max_residual": worst,
        "iterations": iterations,
        "solve_s": round(seconds, 3),
        "version": code_version(),
    }
    feedforward = stance_dynamics(load_robot(), subject.patient).feedforward(coefficients, duration)
    gait = Gait(f"{kind}, {subject}", duration, coefficients, feedforward, subject.parameters(), record, kind)
    peak = np.abs(problem.torques(x)).max(axis=0)
    return SolvedGait(gait, status, worst, seconds, iterations, residuals, peak)


@cache
def code_version() -> str:
    """Return the version of the package and a hash of all files that determine a gait: `_SOURCES` and the robot file."""
    package = Path(__file__).parents[1]
    digest = hashlib.sha256(ROBOT_FILE.read_bytes())
    for pattern in _SOURCES:
        for source in sorted(package.glob(pattern)):
            digest.update(source.read_bytes())
    return f"{version('atalante-hal')}+{digest.hexdigest()[:12]}"


def _unmet(problem: StepProblem, residuals: Mapping[str, Residual]) -> str:
    """Return a sentence that names the constraint with the largest violation relative to its scale."""
    name = max(residuals, key=lambda group: residuals[group].value / problem.units[group][1])
    value, unit = residuals[name]
    return f"the constraint '{name}' is violated by {value:.3g} {unit}"


@cache
def _reach() -> Reach:
    return Reach(_built("periodic", False)[0])


@cache
def _built(kind: Kind, machine_code: bool) -> tuple[StepProblem, Functions]:
    if machine_code:
        problem, interpreted = _built(kind, False)
        return problem, compiled(interpreted) or interpreted
    problem = StepProblem(kind, load_robot(), Requirements())
    return problem, problem.program.functions()


@cache
def _silent_solver(kind: Kind, machine_code: bool, warm: bool) -> Any:
    return _solver(kind, machine_code, warm, {})


def _solver(kind: Kind, machine_code: bool, warm: bool, options: dict[str, Any]) -> Any:
    problem, functions = _built(kind, machine_code)
    x = casadi.MX.sym("x", problem.program.unknowns)
    p = casadi.MX.sym("p", functions.objective.size1_in(1))
    program = {"x": x, "p": p, "f": functions.objective(x, p), "g": functions.constraints(x, p)}
    derivatives = {"grad_f": functions.gradient, "jac_g": functions.jacobian, "hess_lag": functions.hessian}
    return casadi.nlpsol("gait", "ipopt", program, _OPTIONS | (_WARM if warm else {}) | derivatives | options)
