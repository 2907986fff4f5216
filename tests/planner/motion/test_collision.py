import coal
import numpy as np
import pinocchio as pin
import pytest

from athlete_twin.errors import PlanningError, TerrainError
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.reach import all_legs_ik, leg_ik
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import regular_stance, stance_wheels_in_hex
from planner.motion.collision import BodyCollision, ClearanceTable, CollisionConfig, LegCollision, terrain_shape

ROBOTS = ("sdm_b", "t12")
CELL = 0.05
TOLERANCE = 0.005
"""between coal's triangles and bilinear heights, and between sampled points of a solid [m]"""


def ground(height=lambda x, y: 0.0 * x, half: float = 6.0) -> HeightGrid:
    n = int(2 * half / CELL) + 1
    x, y = np.meshgrid(-half + CELL * np.arange(n), -half + CELL * np.arange(n), indexing="ij")
    return HeightGrid(origin_x=-half, origin_y=-half, cell=CELL, heights=np.asarray(height(x, y), dtype=float))


def rolling(x, y):
    """Slope at most 0.1 * 1.5 = 0.15 along each axis."""
    return 0.1 * np.sin(1.5 * x) * np.cos(1.5 * y)


def standing(robot: str) -> SE3:
    return SE3.from_translation(np.array([0.0, 0.0, load_spec(robot).chassis_height]))


def cylinder_points(radius: float, length: float) -> np.ndarray:
    r, angle, z = np.meshgrid(
        np.linspace(0, radius, 5), np.linspace(0, 2 * np.pi, 60, endpoint=False), np.linspace(-length / 2, length / 2, 25)
    )
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=-1).reshape(-1, 3)


@pytest.mark.parametrize("margin", [0.0, 0.05])
def test_height_field_collides_where_sampled_points_of_a_cylinder_do(margin):
    heights = ground(rolling, half=2.0)
    field = terrain_shape(heights)
    shape = coal.Cylinder(0.25, 0.3)
    points = cylinder_points(0.25, 0.3)
    rng = np.random.default_rng(1)
    request = coal.CollisionRequest()
    request.security_margin = margin
    steepest = np.cos(np.arctan(0.15 * np.sqrt(2)))
    outcomes = set()
    for _ in range(300):
        placed = SE3.from_rotvec(rng.normal(0, 1.5, 3), np.append(rng.uniform(-1.2, 1.2, 2), rng.uniform(-0.2, 0.6)))
        at = placed.apply(points)
        gap = float(np.min(at[:, 2] - heights.sample(at[:, :2])))
        result = coal.CollisionResult()
        here = coal.Transform3s(placed.rotation, placed.translation)
        hit = bool(coal.collide(shape, here, field, coal.Transform3s.Identity(), request, result))
        if gap < margin - TOLERANCE:
            assert hit
            outcomes.add("hit")
        elif gap * steepest > margin + 3 * TOLERANCE:
            assert not hit
            outcomes.add("free")
    assert outcomes == {"hit", "free"}


def test_the_height_field_is_where_the_grid_says():
    """A single peak off the middle of a grid that is neither square nor centred."""
    heights = np.zeros((40, 60))
    heights[30, 10] = 1.0
    grid = HeightGrid(origin_x=3.0, origin_y=-7.0, cell=0.1, heights=heights)
    spec = load_spec("sdm_b")
    peak = np.array([3.0 + 30 * 0.1, -7.0 + 10 * 0.1])
    joints = regular_stance(spec)
    wheel = kinematics("sdm_b").wheels_in_hex(joints)[0]
    over_peak = np.append(peak, 0.9) - wheel
    near, far = SE3.from_translation(over_peak), SE3.from_translation(over_peak + np.array([0.0, 0.6, 0.0]))
    assert LegCollision(spec, grid, near, joints, 0, CollisionConfig()).first_collision(joints[0]) == (
        "wheel1 against terrain"
    )
    assert LegCollision(spec, grid, far, joints, 0, CollisionConfig()).first_collision(joints[0]) is None


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_standing_robot_is_free_but_for_its_wheels(robot):
    spec, joints = load_spec(robot), regular_stance(load_spec(robot))
    for leg in range(6):
        collision = LegCollision(spec, ground(), standing(robot), joints, leg, CollisionConfig())
        assert collision.first_collision(joints[leg]) == f"wheel{leg + 1} against terrain"
        assert collision.first_collision_near_ground(joints[leg]) is None
        assert collision.is_free_near_ground(joints[leg]) and not collision.is_free(joints[leg])
        lifted, ok = leg_ik(spec, leg, stance_wheels_in_hex(spec)[leg : leg + 1] + np.array([0.0, 0.0, 0.15]))
        assert ok.all() and collision.is_free(lifted[0])
    assert BodyCollision(spec, ground(), CollisionConfig()).is_free(joints, standing(robot))


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_chain_agrees_with_the_kinematics_of_the_drawings(robot):
    spec, kin = load_spec(robot), kinematics(robot)
    rng = np.random.default_rng(0)
    for leg in range(6):
        collision = LegCollision(spec, ground(), standing(robot), regular_stance(spec), leg, CollisionConfig())
        q = rng.uniform(spec.lower, spec.upper)
        wheel = kin.leg_wheel(leg, q)
        np.testing.assert_allclose(collision.wheel_in_hex(q), wheel.translation, atol=1e-9)
        np.testing.assert_allclose(collision.last_link_in_hex(q), wheel.rotation[:, 0], atol=1e-9)


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_leg_driven_into_a_wall_is_seen(robot):
    """A wall of 1 m stands 0.6 m outside of leg 1's axle."""
    spec, joints = load_spec(robot), regular_stance(load_spec(robot))
    wheel = stance_wheels_in_hex(spec)[0]
    outward = wheel[:2] / np.linalg.norm(wheel[:2])
    start = float(wheel[:2] @ outward) + 0.6
    walled = ground(lambda x, y: np.where(x * outward[0] + y * outward[1] > start, 1.0, 0.0))
    collision = LegCollision(spec, walled, standing(robot), joints, 0, CollisionConfig())
    reach = 0.6 - spec.wheel.radius
    for advance, expected in ((reach - 0.15, None), (reach + 0.05, "wheel1 against terrain")):
        target = wheel + np.append(advance * outward, 0.3)
        q, ok = leg_ik(spec, 0, target[None])
        assert ok.all()
        assert collision.first_collision(q[0]) == expected


def test_a_shank_over_a_rock_is_seen_near_the_ground_too():
    """A spire inside the stance, lower than the shank of a leg that reaches over it is not."""
    spec, joints = load_spec("sdm_b"), regular_stance(load_spec("sdm_b"))
    ankle = 1.95
    spire = ground(lambda x, y: np.where((np.abs(x - ankle) < 0.08) & (np.abs(y) < 0.3), 0.95, 0.0))
    collision = LegCollision(spec, spire, standing("sdm_b"), joints, 0, CollisionConfig())
    hit = collision.first_collision_near_ground(joints[0])
    assert hit is not None and hit.endswith("terrain") and "wheel" not in hit
    whole = BodyCollision(spec, spire, CollisionConfig()).first_collision(joints, standing("sdm_b"))
    assert whole is not None and whole.endswith("terrain") and "leg1" in whole


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_leg_swung_against_its_neighbour_is_seen(robot):
    """The neighbour stands two fifths of the way towards leg 1."""
    spec, joints = load_spec(robot), regular_stance(load_spec(robot))
    wheels = stance_wheels_in_hex(spec)
    for neighbour in (1, 5):
        close = joints.copy()
        towards, ok = leg_ik(spec, neighbour, wheels[neighbour] + 0.4 * (wheels[:1] - wheels[neighbour]))
        assert ok.all()
        close[neighbour] = towards[0]
        collision = LegCollision(spec, ground(), standing(robot), close, 0, CollisionConfig())
        way = wheels[0] + np.linspace(0, 0.5, 40)[:, None] * (wheels[neighbour] - wheels[0]) + [0.0, 0.0, 0.2]
        path, ok = leg_ik(spec, 0, way)
        hits = [collision.first_collision(q) for q in path[ok]]
        assert hits[0] is None
        first = next(h for h in hits if h is not None)
        assert f"leg{neighbour + 1}_" in first or f"wheel{neighbour + 1}" in first


def box_distance(points: np.ndarray, half: np.ndarray) -> np.ndarray:
    outside = np.abs(points) - half
    return np.linalg.norm(np.maximum(outside, 0.0), axis=-1) + np.minimum(outside.max(axis=-1), 0.0)


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_wheel_hits_the_chassis_where_its_sampled_points_come_too_close(robot):
    from athlete_twin.assets import robot_dir

    spec, kin, joints = load_spec(robot), kinematics(robot), regular_stance(load_spec(robot))
    urdf = str(robot_dir(robot) / "robot.urdf")
    model = pin.buildModelFromUrdf(urdf)
    geometry = pin.buildGeomFromUrdf(model, urdf, pin.COLLISION)
    state, scratch = geometry.createData(), model.createData()
    pin.updateGeometryPlacements(model, scratch, geometry, state, pin.neutral(model))
    boxes = [
        (SE3(state.oMg[i].rotation, state.oMg[i].translation), np.array(o.geometry.halfSide))
        for i, o in enumerate(geometry.geometryObjects)
        if o.name.startswith(("hex", "deck"))
    ]
    table = ClearanceTable(same_leg=(0.02, 0.03), body=0.04, other_leg=0.06)
    config = CollisionConfig(table=table)
    collision = LegCollision(spec, ground(lambda x, y: 0 * x - 9.0), standing(robot), joints, 0, config)
    hull = cylinder_points(spec.wheel.radius, spec.wheel.width)[:, [0, 2, 1]]
    rng = np.random.default_rng(3)
    seen = {"hit": 0, "free": 0}
    for _ in range(90):
        q = rng.uniform(spec.lower, spec.upper)
        at = kin.leg_wheel(0, q).apply(hull)
        gap = min(float(box_distance(placed.inverse().apply(at), half).min()) for placed, half in boxes)
        hit = collision.first_collision(q)
        if gap < table.body - TOLERANCE:
            assert hit is not None
            seen["hit"] += 1
        elif gap > table.body + 3 * TOLERANCE:
            assert hit is None or not ("wheel1" in hit and ("hex" in hit or "deck" in hit))
            seen["free"] += 1
    assert min(seen.values()) > 5


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_quick_answer_is_the_full_one_and_culling_hides_nothing(robot, monkeypatch):
    spec, joints = load_spec(robot), regular_stance(load_spec(robot))
    tilted = standing(robot).compose(SE3.from_rpy(0.08, -0.06, 0.5, np.array([0.3, 0.2, -0.05])))
    collision = LegCollision(spec, ground(rolling), tilted, joints, 2, CollisionConfig())
    rng = np.random.default_rng(5)
    configurations = [joints[2] + rng.normal(0, 0.5, spec.dof) for _ in range(150)]
    quick = [collision.is_free(q) for q in configurations]
    near = [collision.is_free_near_ground(q) for q in configurations]
    monkeypatch.setattr(
        "planner.motion.collision._Bound.may_touch", lambda self, centres: np.ones(len(centres), dtype=bool)
    )
    assert quick == [collision.first_collision(q) is None for q in configurations]
    assert near == [collision.first_collision_near_ground(q) is None for q in configurations]
    assert 10 < sum(quick) < 140


@pytest.mark.parametrize("robot", ROBOTS)
def test_one_leg_and_the_whole_body_agree(robot):
    spec, joints = load_spec(robot), regular_stance(load_spec(robot))
    heights, config = ground(rolling), CollisionConfig()
    pose = standing(robot)
    leg, body = LegCollision(spec, heights, pose, joints, 4, config), BodyCollision(spec, heights, config)
    assert body.is_free(joints, pose)
    rng = np.random.default_rng(6)
    for _ in range(60):
        moved = joints.copy()
        moved[4] += rng.normal(0, 0.5, spec.dof)
        hit = leg.first_collision_near_ground(moved[4])
        assert (hit is None) == body.is_free(moved, pose), hit


@pytest.mark.parametrize("robot", ROBOTS)
def test_wheel_sink_is_the_depth_of_the_lowest_point(robot):
    spec, joints = load_spec(robot), regular_stance(load_spec(robot))
    for depth in (-0.1, 0.0, 0.07):
        collision = LegCollision(spec, ground(lambda x, y, depth=depth: 0 * x + depth), standing(robot), joints, 1, CollisionConfig())
        assert collision.wheel_sink(joints[1]) == pytest.approx(depth, abs=1e-3)
    rock = ground(lambda x, y: np.where(np.hypot(x, y) > 1.0, 0.15, 0.0))
    flank = LegCollision(spec, rock, standing(robot), joints, 1, CollisionConfig())
    assert flank.wheel_sink(joints[1]) == pytest.approx(0.15, abs=1e-3)


HABITAT, GENERATORS = (2.2, 1.6, 1.5), {"sdm_b": (1.2, 1.0, 0.5), "t12": (1.6, 1.2, 0.9)}


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("where", ["payload_above", "payload_below"])
def test_a_payload_is_in_the_way_and_is_named(robot, where):
    spec, joints = load_spec(robot), regular_stance(load_spec(robot))
    box = HABITAT if where == "payload_above" else GENERATORS[robot]
    bare = LegCollision(spec, ground(), standing(robot), joints, 0, CollisionConfig())
    loaded = LegCollision(spec, ground(), standing(robot), joints, 0, CollisionConfig(**{where: box}))
    rng = np.random.default_rng(2)
    only = [
        hit
        for q in rng.uniform(spec.lower, spec.upper, (600, spec.dof))
        if bare.is_free(q) and (hit := loaded.first_collision(q)) is not None
    ]
    assert only and all(where in hit for hit in only)


@pytest.mark.parametrize("robot", ROBOTS)
def test_generators_below_refuse_a_leg_move_that_is_free_without_them(robot):
    """Leg 1 folds inward below the chassis."""
    spec, joints, deep = load_spec(robot), regular_stance(load_spec(robot)), ground(lambda x, y: 0 * x - 9.0)
    folded = np.deg2rad({"sdm_b": [0.0, 80.0, 100.0, 0.0, 20.0, 0.0], "t12": [0.0, 90.0, 80.0, 30.0, 0.0, 0.0, 0.0]}[robot])
    move = joints[0] + np.linspace(0.0, 1.0, 60)[:, None] * (folded - joints[0])
    above = CollisionConfig(payload_above=HABITAT)
    both = CollisionConfig(payload_above=HABITAT, payload_below=GENERATORS[robot])
    without, with_them = (LegCollision(spec, deep, standing(robot), joints, 0, config) for config in (above, both))
    assert all(without.is_free(q) for q in move)
    hits = [with_them.first_collision(q) for q in move]
    first = next(hit for hit in hits if hit is not None)
    assert hits[0] is None and first == "wheel1 against payload_below"
    assert with_them.refusal(move[-1]) == "own_leg_or_body"


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_body_comes_down_on_a_rock_that_only_the_generators_reach(robot):
    spec = load_spec(robot)
    bottom = {"sdm_b": -0.217, "t12": 0.284}[robot] - GENERATORS[robot][2]
    rock = ground(lambda x, y: np.where(np.hypot(x, y) < 0.3, spec.chassis_height + bottom - 0.1, 0.0))
    loaded = CollisionConfig(payload_below=GENERATORS[robot])
    for lower, expected in ((0.0, None), (0.15, "payload_below against terrain")):
        pose = SE3.from_translation(np.array([0.0, 0.0, spec.chassis_height - lower]))
        wheels = stance_wheels_in_hex(spec) + [0.0, 0.0, lower]
        bent, ok = all_legs_ik(spec, wheels)
        assert ok.all()
        assert BodyCollision(spec, rock, CollisionConfig()).first_collision(bent, pose) is None
        assert BodyCollision(spec, rock, loaded).first_collision(bent, pose) == expected


@pytest.mark.parametrize("robot", ROBOTS)
def test_parts_that_are_too_near_already_may_stay_or_part_and_come_no_nearer(robot):
    """Leg 2 folds at its knee (T12: thigh) until two of its links are inside their clearance, and not yet in touch."""
    spec, deep = load_spec(robot), ground(lambda x, y: 0 * x - 9.0)
    pose, bare = standing(robot), CollisionConfig(part_clearance=0.0, deviations=0.0)

    def folded(by: float) -> np.ndarray:
        joints = regular_stance(spec)
        joints[1, 2] += by
        return joints

    def folds_until(config: CollisionConfig) -> float:
        body = BodyCollision(spec, deep, config)
        return next(by for by in np.arange(0.0, 2.0, 0.002) if not body.is_free(folded(by), pose))

    near, touch = folds_until(CollisionConfig()), folds_until(bare)
    assert touch > near + 0.01
    body, inside = BodyCollision(spec, deep, CollisionConfig()), near + 0.25 * (touch - near)
    pair = body.first_collision(folded(inside), pose)
    assert pair is not None and "leg2" in pair
    body.come_no_nearer(folded(inside))
    assert [body.first_collision(folded(by), pose) for by in (inside, near, 0.0)] == [None, None, None]
    assert body.first_collision(folded(inside + 0.15 * (touch - near)), pose) == pair
    for by in np.linspace(near, touch, 200):  # ever nearer, asked each time: half of the clearance stays
        body.come_no_nearer(folded(by))
    assert body.first_collision(folded(near + 0.4 * (touch - near)), pose) is None
    assert body.first_collision(folded(near + 0.6 * (touch - near)), pose) == pair


def test_wrong_use_is_refused():
    spec, joints = load_spec("sdm_b"), regular_stance(load_spec("sdm_b"))
    unknown = ground()
    unknown.heights[3, 4] = np.nan
    with pytest.raises(TerrainError, match="1 cells of the terrain are unknown"):
        LegCollision(spec, unknown, standing("sdm_b"), joints, 0, CollisionConfig())
    with pytest.raises(PlanningError, match=r"need \(6, 6\) and 0 to 5"):
        LegCollision(spec, ground(), standing("sdm_b"), joints, 6, CollisionConfig())
    with pytest.raises(PlanningError, match=r"terrain_clearance is -0\.1, must be finite and not negative"):
        CollisionConfig(terrain_clearance=-0.1)
    with pytest.raises(PlanningError, match=r"payload_below is .*three positive lengths"):
        CollisionConfig(payload_below=(1.0, 0.0, 0.4))
    with pytest.raises(PlanningError, match="table of clearances needs finite lengths"):
        ClearanceTable(same_leg=(), body=0.04, other_leg=0.06)
    with pytest.raises(PlanningError, match="payload_below reaches into leg1_hip_yaw in the drawings' stance of sdm_b"):
        LegCollision(spec, ground(), standing("sdm_b"), joints, 0, CollisionConfig(payload_below=(2.6, 1.0, 0.5)))
