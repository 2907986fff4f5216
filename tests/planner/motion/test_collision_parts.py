import dataclasses
import itertools

import numpy as np
import pinocchio as pin
import pytest

from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import regular_stance
from planner.motion.collision_parts import STANCE_SHARE, ClearanceTable, CollisionConfig, link_name, robot_parts
from planner.motion.part_sigma import relative_sigmas

ROBOTS = ("sdm_b", "t12")
BY_HAND = ClearanceTable(same_leg=(0.02, 0.03), body=0.04, other_leg=0.06)
"""the figures that stood here before clearances followed from uncertainties: a reference for their size"""
SIGMAS = ("encoder_sigma_deg", "wind_up_sigma_deg", "dock_sigma_deg")


def clearances(robot, config):
    return {(i, j): clearance for i, j, clearance in robot_parts(robot, config).pairs}


def kind(parts, i, j):
    if parts.leg[i] < 0 or parts.leg[j] < 0:
        return "body"
    if parts.leg[i] == parts.leg[j]:
        return "same_leg"
    return "neighbour" if (parts.leg[i] - parts.leg[j]) % 6 in (1, 5) else "opposite"


def by_kind(robot, config):
    parts = robot_parts(robot, config)
    out: dict[str, list[float]] = {}
    for i, j, clearance in parts.pairs:
        out.setdefault(kind(parts, i, j), []).append(clearance)
    return out


def crosses_a_dock(parts, i, j):
    """Whether two parts hang on different decks, or one on a deck and one on the pallet; never of a robot without docks."""
    if not parts.spec.decks:
        return False
    side = [None if leg < 0 else leg // 3 for leg in (parts.leg[i], parts.leg[j])]
    for end, k in enumerate((i, j)):
        name = link_name(parts.geometry.geometryObjects[k].name)
        if name.startswith("deck"):
            side[end] = int(name == "deck_right")
    return side[0] != side[1]


@pytest.mark.parametrize("robot", ROBOTS)
def test_sigmas_are_those_of_perturbed_joints(robot):
    """Monte Carlo through Pinocchio's kinematics: the rms way of each part's worst point."""
    parts = robot_parts(robot, CollisionConfig())
    model, rng = parts.model, np.random.default_rng(4)
    sigmas = np.zeros(model.nv)
    for joint in range(1, model.njoints):
        name = model.names[joint]
        sigmas[model.joints[joint].idx_v] = 0.0 if name.startswith("wheel") else np.deg2rad(0.5 if name.startswith("dock") else 0.2)
    q = parts.configuration(regular_stance(parts.spec))
    found = relative_sigmas(model, parts.geometry, q, sigmas)
    chosen = [parts.pairs[k][:2] for k in rng.choice(len(parts.pairs), 25, replace=False)]
    scratch, state = model.createData(), parts.geometry.createData()
    shared = {pair: last_shared_joint(parts, *pair) for pair in chosen}
    corners = [corner_points(solid.geometry) for solid in parts.geometry.geometryObjects]

    def seen(angles):
        """Corners of both parts of each pair in the frame of the joint that carries both, which moves neither against the other."""
        pin.updateGeometryPlacements(model, scratch, parts.geometry, state, angles)
        places = {}
        for pair, joint in shared.items():
            held = [scratch.oMi[joint].actInv(state.oMg[k]) for k in pair]
            places[pair] = [corners[k] @ at.rotation.T + at.translation for k, at in zip(pair, held, strict=True)]
        return places

    draws, drawn = 900, seen(q)
    squares = {pair: [np.zeros(len(points)) for points in ends] for pair, ends in drawn.items()}
    for _ in range(draws):
        now = seen(pin.integrate(model, q, sigmas * rng.normal(size=model.nv)))
        for pair in chosen:
            for end in (0, 1):
                squares[pair][end] += np.square(now[pair][end] - drawn[pair][end]).sum(axis=1) / draws
    for pair, ends in squares.items():
        assert found[pair] == pytest.approx(float(np.sqrt(ends[0].max() + ends[1].max())), rel=0.1)
    assert found[chosen[0]] == found[chosen[0][::-1]]


def last_shared_joint(parts, i, j):
    """0, the hex, of parts that nothing but the hex carries."""
    chains = [list(parts.model.supports[parts.geometry.geometryObjects[k].parentJoint]) for k in (i, j)]
    return max(set(chains[0]) & set(chains[1]))


def corner_points(shape):
    if hasattr(shape, "halfSide"):
        return np.array(list(itertools.product(*([-h, h] for h in shape.halfSide))))
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    rim = np.column_stack([shape.radius * np.cos(angle), shape.radius * np.sin(angle), 0 * angle])
    return np.concatenate([rim + [0, 0, shape.halfLength], rim - [0, 0, shape.halfLength]])


@pytest.mark.parametrize("robot", ROBOTS)
def test_two_legs_sigma_is_that_of_both_against_the_chassis(robot):
    """Joints of different legs are independent: their parts' sigmas against the hex add as squares."""
    parts = robot_parts(robot, CollisionConfig())
    sigmas = np.full(parts.model.nv, 1e-3)
    found = relative_sigmas(parts.model, parts.geometry, parts.configuration(regular_stance(parts.spec)), sigmas)
    between = [(i, j) for i, j, _ in parts.pairs if parts.between_legs(i, j)]
    hex_ = next(k for k, o in enumerate(parts.geometry.geometryObjects) if o.name.startswith("hex"))
    for i, j in between[::25]:
        if robot == "sdm_b" or parts.leg[i] // 3 != parts.leg[j] // 3:
            assert found[i, j] == pytest.approx(np.hypot(found[i, hex_], found[j, hex_]))
        else:
            assert found[i, j] < np.hypot(found[i, hex_], found[j, hex_])


@pytest.mark.parametrize("robot", ROBOTS)
def test_without_uncertainty_one_length_is_left(robot):
    sure = dataclasses.replace(CollisionConfig(part_clearance=0.02), **dict.fromkeys(SIGMAS, 0.0))
    assert set(clearances(robot, sure).values()) == {0.02}
    assert set(clearances(robot, CollisionConfig(part_clearance=0.02, deviations=0.0)).values()) == {0.02}


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("name", SIGMAS)
def test_clearances_grow_with_each_sigma(robot, name):
    config = CollisionConfig()
    parts, now = robot_parts(robot, config), clearances(robot, config)
    more = clearances(robot, dataclasses.replace(config, **{name: 1.3 * getattr(config, name)}))
    assert set(now) <= set(more)
    for (i, j), clearance in now.items():
        if name != "dock_sigma_deg" or crosses_a_dock(parts, i, j):
            assert more[i, j] > clearance
        else:
            assert more[i, j] == clearance


@pytest.mark.parametrize("robot", ROBOTS)
def test_parts_farther_apart_along_the_chain_need_more_as_the_table_by_hand_said(robot):
    """Docks apart: the table's author had SDM-B before him, and one length for each kind."""
    found = {name: np.array(values) for name, values in by_kind(robot, CollisionConfig(dock_sigma_deg=0.0)).items()}
    assert np.median(found["same_leg"]) < np.median(found["body"]) < np.median(found["neighbour"])
    # Of parts at the ends of their chains, with which the table's lengths are to be compared.
    assert max(BY_HAND.same_leg) / 2 < found["same_leg"].max() < 2 * max(BY_HAND.same_leg)
    assert BY_HAND.body / 2 < found["body"].max() < 2 * BY_HAND.body
    assert BY_HAND.other_leg / 2 < found["neighbour"].max() < 2 * BY_HAND.other_leg
    assert found["same_leg"].min() > min(BY_HAND.same_leg) / 2


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("boxes", [{}, {"payload_above": (2.2, 1.6, 1.5), "payload_below": (1.2, 1.0, 0.5)}])
def test_no_pair_is_dropped_for_a_clearance_larger_than_its_distance(robot, boxes):
    """With uncertainties of degrees too: such pairs keep half of their distance in the drawings' stance."""
    table = CollisionConfig(table=BY_HAND, **boxes)
    vague = CollisionConfig(encoder_sigma_deg=5.0, **boxes)
    reference, usual, wide = (clearances(robot, config) for config in (table, CollisionConfig(**boxes), vague))
    unmet = set(reference) - set(usual)
    assert all(robot_parts(robot, table).between_legs(i, j) for i, j in unmet), "only legs out of each other's reach are left out"
    assert set(usual) <= set(wide)
    parts = robot_parts(robot, vague)
    geometry = pin.GeometryModel(parts.geometry)
    for i, j in wide:
        geometry.addCollisionPair(pin.CollisionPair(i, j))
    state = geometry.createData()
    pin.updateGeometryPlacements(parts.model, parts.model.createData(), geometry, state, parts.configuration(regular_stance(parts.spec)))
    apart = np.array([pin.computeDistance(geometry, state, k).min_distance for k in range(len(wide))])
    kept = np.array(list(wide.values()))
    assert (kept <= STANCE_SHARE * apart + 1e-9).all() and (np.abs(kept - STANCE_SHARE * apart) < 1e-9).any()


@pytest.mark.parametrize("robot", ROBOTS)
def test_every_leg_is_checked_against_every_part_it_could_meet(robot):
    """No random posture brings two solids together whose pair is not checked: those left out share a pivot or a housing."""
    parts = robot_parts(robot, CollisionConfig(payload_above=(2.2, 1.6, 1.5), payload_below=(1.2, 1.0, 0.5)))
    spec, rng = load_spec(robot), np.random.default_rng(7)
    checked = {(i, j) for i, j, _ in parts.pairs}
    assert {tuple(sorted((parts.leg[i], parts.leg[j]))) for i, j in checked} >= {(-1, leg) for leg in range(6)}
    geometry = pin.GeometryModel(parts.geometry)
    others = [
        (i, j)
        for i, j in itertools.combinations(range(len(parts.leg)), 2)
        if (i, j) not in checked and parts.between_legs(i, j)
    ]
    for i, j in others:
        geometry.addCollisionPair(pin.CollisionPair(i, j))
    state, scratch = geometry.createData(), parts.model.createData()
    for _ in range(60):
        q = parts.configuration(rng.uniform(spec.lower, spec.upper, (6, spec.dof)))
        pin.updateGeometryPlacements(parts.model, scratch, geometry, state, q)
        assert not pin.computeCollisions(geometry, state, True)
    hips = [(i, j) for i, j in checked if parts.order[i] == 0 and "payload" in parts.geometry.geometryObjects[j].name]
    assert len(hips) == 2 * sum(order == 0 for order in parts.order)
