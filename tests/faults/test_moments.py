"""Tests of faults at other moments than the walk: their schedule, their checks, and random pairs."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from atalante_hal.safety.events import Event
from atalante_hal.types import SupervisorState
from atalante_hal.wire.cia402 import Controlword
from atalante_tools.faults import moments
from atalante_tools.faults.catalogue import SCENARIOS
from atalante_tools.faults.matrix import load_matrix
from atalante_tools.faults.moments import Extreme, Extremes, Moment, MomentTask, MomentVerdict, random_pairs, schedule
from atalante_tools.faults.observation import Observation
from atalante_tools.faults.report import Summary
from atalante_tools.faults.runner import CaseRun
from atalante_tools.faults.scenario import Case

S = SupervisorState
ENGINE = "pybullet"


def index(id_: str, name: str) -> tuple[str, int]:
    return id_, [case.name for case in SCENARIOS[id_].cases].index(name)


NO_FAULT = Case("nothing", ())


@pytest.mark.parametrize(
    ("moment", "state"),
    [
        (Moment.BOOT, S.OFF),
        (Moment.READY, S.READY),
        (Moment.START, S.READY),
        (Moment.WALKING, S.ACTIVE),
        (Moment.HOLD, S.HOLD),
        (Moment.RESTART, S.HOLD),
    ],
)
def test_fault_begins_in_the_state_of_its_moment(moment: Moment, state: S) -> None:
    plan = schedule(moment, ENGINE)
    run = CaseRun(NO_FAULT, plan.begins, starts=False)
    for cycle in plan.starts:
        run.presses[cycle].append("start")
    if plan.stop is not None:
        run.presses[plan.stop].append("stop")
    run.execute(lambda now: now.cycle >= plan.begins)
    assert run.states[-1] is state


@pytest.mark.sample(3)
@pytest.mark.parametrize("moment", Moment)
def test_silent_drive_at_any_moment_breaks_no_limit(moment: Moment) -> None:
    verdict = MomentTask(moment, (index("F04", "LEFT_SK"),))()
    assert verdict.failures == ()
    assert verdict.extremes is not None
    assert 0.0 < verdict.extremes.speed.value < 1.2
    if moment in (Moment.WALKING, Moment.HOLD):
        assert verdict.state == "HOLD"


def test_random_pairs_depend_only_on_the_seed() -> None:
    one, two, other = (random_pairs(50, seed, ENGINE) for seed in (1, 1, 2))
    assert one == two != other
    assert {task.moment for task in one} == set(Moment)
    assert all(task.cases[0] != task.cases[1] for task in one)


def test_pair_of_faults_runs_both() -> None:
    verdict = MomentTask(Moment.WALKING, (index("F03", "4 frames"), index("F45", "ValueError")), (0, 20))()
    assert verdict.faults == ("F03 4 frames", "F45 ValueError")
    assert (verdict.state, verdict.failures) == ("HOLD", ())


NO_EFFECT = MomentTask(Moment.READY, (index("F24", "1 frames"),))


def patched(
    monkeypatch: pytest.MonkeyPatch, change: Callable[[Observation], None], task: MomentTask = NO_EFFECT
) -> MomentVerdict:
    """Run a task, by default with a case without effect, change its observation, and return the verdict."""
    observe = moments._observe

    def changed(case: Case, plan: moments.Schedule) -> Observation:
        run = observe(case, plan)
        change(run)
        return run

    monkeypatch.setattr(moments, "_observe", changed)
    return task()


def test_sag_during_the_start_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    def sag(run: Observation) -> None:
        run.position[schedule(Moment.READY, ENGINE).starts[0] + 20, 4] += np.radians(1.2)

    (failure,) = patched(monkeypatch, sag).failures
    assert failure.startswith("left_SA must not move by more than 1 deg during a start, got 1.2")


def test_motion_before_the_first_drive_is_on_or_after_the_start_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    start = schedule(Moment.READY, ENGINE).starts[0]

    def sag(run: Observation) -> None:
        run.position[: start + 1, 4] += np.radians(1.2)
        active = run.states.index(S.ACTIVE)
        run.position[active:, 5] += np.radians(1.2)

    assert patched(monkeypatch, sag).failures == ()


@pytest.mark.parametrize("code", ["START_FAILED", "START_REFUSED"])
def test_motion_after_a_failed_start_does_not_count(monkeypatch: pytest.MonkeyPatch, code: str) -> None:
    start = schedule(Moment.READY, ENGINE).starts[0]

    def sag(run: Observation) -> None:
        object.__setattr__(run, "events", (*run.events, Event(start + 15, code, "the start ends")))
        run.position[start + 20, 4] += np.radians(1.2)

    assert patched(monkeypatch, sag).failures == ()


def test_fast_joint_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    def fast(run: Observation) -> None:
        run.velocity[100, 3] = 1.25 * run.robot.velocity_max[3]

    verdict = patched(monkeypatch, fast)
    assert verdict.failures == ("a joint was above its velocity limit: left_SK in cycle 101",)
    assert verdict.extremes is not None
    assert verdict.extremes.speed == (pytest.approx(1.25), "left_SK")


@pytest.mark.parametrize(("joint", "share", "failures"), [(3, 1.59, 0), (3, 1.61, 1), (4, 1.01, 1)])
def test_only_a_strong_motor_may_exceed_its_torque_limit(
    monkeypatch: pytest.MonkeyPatch, joint: int, share: float, failures: int
) -> None:
    def strong(run: Observation) -> None:
        run.torque[100, joint] = share * run.robot.torque_max[joint]

    task = MomentTask(Moment.READY, (index("F75", "LEFT_SK with 1.6 times its torque"),))
    assert len(patched(monkeypatch, strong, task).failures) == failures


def test_wrong_motors_are_found_within_the_bound_of_the_fault_matrix() -> None:
    assert load_matrix()["F84"].detected == moments.FOUND
    for case in SCENARIOS["F84"].cases:
        assert case.detected == case.stimuli[1].start + moments.FOUND


MOTOR_IN_HOLD = MomentTask(Moment.HOLD, (index("F84", "LEFT_SH in HOLD with 0 times its torque"),))


def begin_of_motor_fault() -> int:
    """Return the first cycle of the motor fault of `MOTOR_IN_HOLD`."""
    ((id_, number),) = MOTOR_IN_HOLD.cases
    return schedule(Moment.HOLD, ENGINE).begins + SCENARIOS[id_].cases[number].stimuli[1].start


@pytest.mark.sample(2)
@pytest.mark.parametrize(("cycle", "failures"), [(0, 0), (moments.FOUND - 1, 0), (-1, 1), (moments.FOUND, 1)])
def test_a_wrong_motor_may_move_a_joint_fast_until_it_is_found(
    monkeypatch: pytest.MonkeyPatch, cycle: int, failures: int
) -> None:
    begins = begin_of_motor_fault()

    def fast(run: Observation) -> None:
        run.velocity[begins + cycle - 1, 3] = 1.25 * run.robot.velocity_max[3]

    assert len(patched(monkeypatch, fast, MOTOR_IN_HOLD).failures) == failures


def test_a_wrong_motor_may_not_move_a_joint_of_the_other_leg_fast(monkeypatch: pytest.MonkeyPatch) -> None:
    row = begin_of_motor_fault() + moments.FOUND // 2 - 1

    def fast(run: Observation) -> None:
        run.velocity[row, :] = 1.25 * run.robot.velocity_max

    (failure,) = patched(monkeypatch, fast, MOTOR_IN_HOLD).failures
    assert failure == f"a joint was above its velocity limit: right_FH in cycle {row + 1}"


@pytest.mark.parametrize(("cycle", "failures"), [(moments.FOUND + 29, 0), (moments.FOUND + 30, 1)])
def test_cycles_without_data_of_a_wrong_motor_do_not_count_until_it_is_found(
    monkeypatch: pytest.MonkeyPatch, cycle: int, failures: int
) -> None:
    begins = begin_of_motor_fault()

    def silent(run: Observation) -> None:
        run.age[begins + 9 : begins + 39, run.messages.index("LEFT_SH_STATE")] = 5
        run.age[begins + 49 : begins + 59, run.messages.index("LEFT_SH_STATE")] = 4
        run.age[begins + 69 : begins + 79, run.messages.index("RIGHT_SH_STATE")] = 5
        run.velocity[begins + cycle - 1, 3] = 1.25 * run.robot.velocity_max[3]

    assert len(patched(monkeypatch, silent, MOTOR_IN_HOLD).failures) == failures


@pytest.mark.parametrize(("moved", "failures"), [(4.0, 0), (6.0, 1)])
def test_a_wrong_motor_may_move_a_joint_during_a_start(
    monkeypatch: pytest.MonkeyPatch, moved: float, failures: int
) -> None:
    def sag(run: Observation) -> None:
        run.position[schedule(Moment.READY, ENGINE).starts[0] + 3, 4] += np.radians(moved)

    task = MomentTask(Moment.READY, (index("F72", "LEFT_SK dead"),))
    assert len(patched(monkeypatch, sag, task).failures) == failures


@pytest.mark.parametrize(
    ("id_", "name", "left", "right"),
    [
        ("F72", "LEFT_SK dead", 5.0, 1.0),
        ("F71", "25 Nm on LEFT_HA", np.inf, 1.0),
        ("F72", "encoders of SA exchanged", 5.0, 5.0),
        ("F57", "0.3 rad/s, possible with the filter of the drive", 1.0, 5.0),
        ("F34", "the right foot lifts", 1.0, 1.0),
        ("F24", "1 frames", 1.0, 1.0),
    ],
)
def test_only_the_leg_of_the_fault_has_a_wider_limit_of_motion(id_: str, name: str, left: float, right: float) -> None:
    (case,) = [case for case in SCENARIOS[id_].cases if case.name == name]
    assert moments._sag_limits(case.stimuli).tolist() == [left] * 6 + [right] * 6


def test_a_motor_fault_in_one_leg_does_not_excuse_the_other_leg(monkeypatch: pytest.MonkeyPatch) -> None:
    def sag(run: Observation) -> None:
        run.position[schedule(Moment.READY, ENGINE).starts[0] + 20, 10] += np.radians(1.2)

    task = MomentTask(Moment.READY, (index("F72", "LEFT_SK dead"),))
    (failure,) = patched(monkeypatch, sag, task).failures
    assert failure.startswith("right_SA must not move by more than 1 deg")


@pytest.mark.parametrize("moment", [Moment.START, Moment.RESTART])
def test_state_that_improves_after_the_start_by_itself_fails(monkeypatch: pytest.MonkeyPatch, moment: Moment) -> None:
    begins = schedule(moment, ENGINE).begins

    def improve(run: Observation) -> None:
        states = list(run.states)
        states[begins + 9 : begins + 29] = [S.FAULT] * 20
        states[begins + 29 :] = [S.HOLD] * (len(states) - begins - 29)
        object.__setattr__(run, "states", tuple(states))

    assert patched(monkeypatch, improve, MomentTask(moment, NO_EFFECT.cases)).failures == (
        f"the state must not improve without the operator, but it became HOLD in cycle {begins + 30}",
    )


def test_start_of_a_case_may_end_hold() -> None:
    verdict = MomentTask(Moment.WALKING, (index("F21", "same emergency before and after a restart"),))()
    assert (verdict.state, verdict.failures) == ("ACTIVE", ())


def test_motion_that_is_not_a_number_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    def lose(run: Observation) -> None:
        run.velocity[100, 3] = np.nan

    assert patched(monkeypatch, lose).failures == ("the motion of a joint was not a number: left_SK in cycle 101",)


def test_drive_that_holds_from_power_on_moves_like_any_other() -> None:
    verdict = MomentTask(Moment.BOOT, (index("F22", "QUICK_STOP_ACTIVE"),))()
    assert verdict.failures == ()
    assert verdict.extremes is not None
    assert verdict.extremes.speed.value < 1.2


def test_enabling_before_start_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    def early(run: Observation) -> None:
        run.commands._legs[0].word[49] = Controlword.ENABLE_OPERATION

    (failure,) = patched(monkeypatch, early).failures
    assert "ENABLE OPERATION must not be sent before START in cycle" in failure


def test_exception_in_a_run_is_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    def crash(run: Observation) -> None:
        raise RuntimeError("the run failed")

    verdict = patched(monkeypatch, crash)
    assert (verdict.state, verdict.extremes) == ("-", None)
    assert verdict.failures == ("exception in the run: RuntimeError: the run failed",)


def test_report_shows_the_extremes_of_each_moment_and_fault() -> None:
    slow, fast = (
        Extremes(Extreme(v, "left_SK"), Extreme(2.0, "left_SA"), Extreme(0.1, "left_FH"), Extreme(5.0, "left_SH"))
        for v in (0.5, 1.1)
    )
    runs = [
        MomentVerdict("walking", ("F04 LEFT_SK",), "HOLD", True, slow, ()),
        MomentVerdict("boot", ("F04 LEFT_SA",), "OFF", False, fast, ("a failure",)),
        MomentVerdict("hold", ("F04 LEFT_SA", "F03 4 frames"), "HOLD", True, None, ()),
    ]
    summary = Summary.of(runs)
    assert not summary.passed
    text = summary.markdown()
    for row in (
        "| all, boot | 1 | 1 | 0 | 1.10 left_SK | 2.00 left_SA | 0.10 left_FH | 5.00 left_SH |",
        "| random pairs | 1 | 0 | 1 | - | - | - | - |",
        "| F04 | 2 | 1 | 1 | 1.10 left_SK |",
        "- F04 LEFT_SA, moment boot: a failure",
    ):
        assert row in text
