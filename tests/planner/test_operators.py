import dataclasses
from functools import lru_cache

import numpy as np
import pytest

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import CommandSequence, Wait
from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.spec import load_spec
from planner.decisions import Proposal
from planner.footfall import unknown_share
from planner.operators import SCRIPTED_OPERATORS, Cautious, Distracted, Slow, ThinkTime, scripted_operator
from planner.preview.foresee import posing
from planner.preview.preview import PreviewFault


@lru_cache(maxsize=1)
def preview():
    return posing(kinematics("sdm_b"), np.zeros((1, 6, 6)), (SE3.identity(),))


def proposal(**changes):
    sequence = CommandSequence(seq=0, robot_id="sdm_b", t=0.0, sequence_id=0, commands=(Wait(duration=1.0),))
    pose = SE3.identity()
    made = Proposal(
        index=0, t=0.0, kind="step", leg=0, footfall_in_world=np.array([1.0, 2.0, 0.0]), sequence=sequence,
        preview=preview(),
        terrain=HeightGrid(origin_x=0.0, origin_y=0.0, cell=1.0, heights=np.zeros((3, 3))),
        footfall_ok=np.ones((3, 3), dtype=bool), cost=np.zeros((3, 3)), world_from_hex=pose, predicted_margin=0.5,
        predicted_sag=0.05, text="a step", predicted_torque_fraction=0.5, predicted_clearance=0.2, unknown_share=0.0,
    )  # fmt: skip
    return dataclasses.replace(made, **changes)


LIMITS = [
    ("predicted_margin", "margin_above_rule", -1, "margin"),
    ("predicted_clearance", "min_clearance", -1, "clearance"),
    ("predicted_torque_fraction", "max_torque_fraction", 1, "torque"),
    ("unknown_share", "max_unknown_share", 1, "unknown ground"),
]


@pytest.mark.parametrize(("figure", "limit", "bad", "word"), LIMITS)
def test_cautious_approves_at_a_threshold_and_rejects_just_beyond(figure, limit, bad, word):
    operator = Cautious()
    border = getattr(operator, limit) + (load_spec("sdm_b").min_support_margin if limit == "margin_above_rule" else 0.0)
    for at, kind in (
        (border, "approve"),
        (np.nextafter(border, bad * np.inf), "reject"),
        (np.nextafter(border, -bad * np.inf), "approve"),
        (float("nan"), "approve"),
    ):
        decision, seconds = operator.decide(proposal(**{figure: float(at)}), 0.0)
        assert decision.kind == kind and seconds == operator.seconds
        assert (word in decision.reason) == (kind == "reject")


def moving(margins, torques):
    """A preview of a motion with these figures along it."""
    n = len(margins)
    still = posing(kinematics("sdm_b"), np.zeros((n, 6, 6)), (SE3.identity(),) * n, seconds=1.0)
    return dataclasses.replace(still, margins=np.array(margins, dtype=float), torque_fractions=np.array(torques, dtype=float))


NAN = float("nan")
UNFORESEEN = {"kind": "shift", "leg": -1, "predicted_margin": NAN, "predicted_torque_fraction": NAN, "predicted_clearance": NAN}


@pytest.mark.parametrize("planned", [{}, UNFORESEEN])
@pytest.mark.parametrize(
    ("margins", "torques", "said"),
    [
        ((1.6, 0.9, 1.6), (0.2, NAN, 0.6), ""),
        ((NAN, NAN, NAN), (NAN, NAN, NAN), ""),
        ((1.6, 0.9, 1.6), (0.2, 0.95, NAN), "torque 0.950 of the limit, wants at most 0.9"),
        ((1.6, NAN, 0.2), (0.2, 0.2, 0.2), "margin 0.200 m, wants at least 0.35"),
        ((1.6, -np.inf, 1.6), (0.2, np.inf, 0.2), "margin -inf m, wants at least 0.35; torque inf of the limit, wants at most 0.9"),
    ],
)
def test_cautious_judges_the_whole_motion_whatever_the_planner_foresaw(planned, margins, torques, said):
    decision, _ = Cautious().decide(proposal(preview=moving(margins, torques), **planned), 0.0)
    assert decision.reason == said and decision.kind == ("reject" if said else "approve")


def test_cautious_takes_the_worse_of_plan_and_preview():
    shown = {"preview": moving((1.6, 0.5), (0.2, 0.5)), "predicted_margin": 0.1, "predicted_torque_fraction": 0.99}
    decision, _ = Cautious().decide(proposal(**shown), 0.0)
    assert decision.reason.startswith("margin 0.100 m") and "torque 0.990" in decision.reason


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_cautious_approves_the_sound_steps_of_a_walk_on_flat_ground(robot, tmp_path):
    """A whole gait cycle of this project's planner on the mock: no fault, nothing near a limit, nothing to refuse."""
    from athlete_twin.link import downlink, uplink
    from envs.prepare import Wanted, prepared

    wanted = Wanted(
        robot=robot, scenario="rock_field", variant="blind", seed=1, operator="cautious", up=uplink(1.0), down=downlink(1.0),
        cycles=1, body="mock",
    )  # fmt: skip
    result = prepared(wanted, tmp_path).run()
    assert result.outcome == "cycles_done" and result.steps_taken == 6
    assert (result.decisions, result.rejections) == (6, 0)


def test_cautious_names_every_reason_with_its_figure():
    decision, _ = Cautious().decide(proposal(predicted_margin=0.1, unknown_share=0.4), 0.0)
    assert decision.reason == "margin 0.100 m, wants at least 0.35; unknown ground 0.400 of the footfall, wants at most 0.05"


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_cautious_wants_more_than_the_robots_own_rule_which_the_planner_keeps(robot):
    rule = load_spec(robot).min_support_margin
    sequence = CommandSequence(seq=0, robot_id=robot, t=0.0, sequence_id=0, commands=(Wait(duration=1.0),))
    for margin, kind in ((rule + 0.04, "reject"), (rule + 0.06, "approve")):
        assert Cautious().decide(proposal(sequence=sequence, predicted_margin=margin), 0.0)[0].kind == kind


def test_cautious_rejects_what_the_preview_finds_a_fault_in():
    fault = PreviewFault(code="tip_over", command_index=1, t=3.0, leg=2, text="margin -0.10 m over the wheels that stand")
    made = proposal()
    decision, _ = Cautious().decide(dataclasses.replace(made, preview=dataclasses.replace(made.preview, faults=(fault,))), 0.0)
    assert decision.kind == "reject" and decision.reason == "tip_over: margin -0.10 m over the wheels that stand"


def test_cautious_refuses_a_threshold_that_is_no_number():
    with pytest.raises(ConfigError, match="margin_above_rule is nan"):
        Cautious(margin_above_rule=float("nan"))


@pytest.mark.parametrize("name", SCRIPTED_OPERATORS)
def test_one_seed_gives_one_row_of_answers(name):
    def answers(seed):
        operator = scripted_operator(name, rng=np.random.default_rng(seed))
        out = []
        for index in range(200):
            decision, seconds = operator.decide(proposal(index=index), 0.0)
            place = None if decision.footfall_in_world is None else decision.footfall_in_world.tolist()
            out.append((decision.kind, decision.reason, place, decision.duration, seconds))
        return out

    assert answers(3) == answers(3)
    assert (answers(3) != answers(4)) == (name in ("slow", "distracted"))


def test_think_times_are_lognormal_with_the_median_asked_for():
    operator = Slow(rng=np.random.default_rng(0), think=ThinkTime(median=20.0, spread=0.5))
    logs = np.log([operator.decide(proposal(), 0.0)[1] for _ in range(4000)])
    # Four standard errors of mean and deviation.
    assert np.mean(logs) == pytest.approx(np.log(20.0), abs=4 * 0.5 / np.sqrt(4000))
    assert np.std(logs) == pytest.approx(0.5, abs=4 * 0.5 / np.sqrt(8000))


def test_nobody_thinks_longer_than_the_longest():
    assert ThinkTime(median=60.0, spread=1.0).seconds(9.0) == 600.0


def test_distracted_errs_as_often_as_it_says():
    n = 4000
    operator = Distracted(rng=np.random.default_rng(1))
    kinds = [operator.decide(proposal(), 0.0)[0].kind for _ in range(n)]
    for kind, share in (("reject", 0.1), ("edit_footfall", 0.1), ("wait", 0.1), ("approve", 0.7)):
        assert kinds.count(kind) / n == pytest.approx(share, abs=4 * np.sqrt(share * (1 - share) / n))


def test_distracted_moves_no_footfall_of_what_has_none():
    operator = Distracted(rng=np.random.default_rng(1))
    kinds = {operator.decide(proposal(kind="shift", leg=-1), 0.0)[0].kind for _ in range(500)}
    assert kinds == {"reject", "wait", "approve"}


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: ThinkTime(median=0.0, spread=1.0), "median think-time is 0.0 s"),
        (lambda: ThinkTime(median=1.0, spread=-1.0), "spread of the think-time is -1.0"),
        (lambda: Distracted(rng=np.random.default_rng(0), rejects=0.9, misplaces=0.9), "shares"),
        (lambda: scripted_operator("bob", rng=np.random.default_rng(0)), "known: approve_all, cautious, slow, distracted, human"),
    ],
)
def test_nonsense_is_refused(make, said):
    with pytest.raises(ConfigError, match=said):
        make()


def test_unknown_share_counts_the_cells_under_the_wheel():
    heights = np.zeros((41, 41))
    heights[20:, :] = np.nan
    grid = HeightGrid(origin_x=-1.0, origin_y=-1.0, cell=0.05, heights=heights)
    assert unknown_share(grid, np.array([-0.5, 0.0, 0.0]), radius=0.2) == 0.0
    assert unknown_share(grid, np.array([0.5, 0.0, 0.0]), radius=0.2) == 1.0
    # Half and the middle row.
    assert unknown_share(grid, np.array([0.0, 0.0, 0.0]), radius=0.2) == pytest.approx(0.5, abs=0.12)
    assert unknown_share(grid, np.array([9.0, 0.0, 0.0]), radius=0.2) == 1.0
