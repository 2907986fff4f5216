"""The preview of a sequence: command after command, what the motors do, where that puts the robot, and what is wrong with it.

Place in the flow: belief, terrain and a `CommandSequence` -> `Preview`, before the operator decides. It knows what the ground knows:
drawings, contact springs, the fused terrain. Motion is taken as slow: at each moment the robot stands as it would at rest.

A motion is sampled finely for where the joints are and coarsely (`TURNS`) for how the springs stand; in between both change evenly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt

from athlete_twin.errors import ConfigError, KinematicsError
from athlete_twin.geometry.arrays import Joints, Wheels
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import BodyMove, CommandSequence, Drive, JointMove, LegMove
from athlete_twin.model.kinematics import GRAVITY, Kinematics
from athlete_twin.model.spec import LEGS
from athlete_twin.model.straight_moves import OutOfReachError
from planner.belief import Belief
from planner.motion.collision import BodyCollision
from planner.motion.collision_parts import CollisionConfig
from planner.preview.preview import Preview, PreviewFault, between
from planner.preview.standing import WORLD_UP, Stance, Standing
from planner.preview.ways import AIRBORNE_LOAD, BREAK_HOLD, SETTLING_TIME, TICK, BadCommandError, Stretch, stretch
from planner.sag.sag_model import FootSprings
from planner.stability.margin import support_margin

TURNS = 3
"""moments of a command at which the springs are solved: its ends and its middle"""
TORQUE_RECOVERY = 0.03
"""by which a joint that is beyond its limit at the begin may go further, as the executive allows"""
RIM = 16
"""points of a wheel's rim that are looked at for ground"""
TOUCH_TRIES = 6
"""solutions of the springs to find where a descent carries its load"""


@dataclass(frozen=True, kw_only=True)
class PreviewConfig:
    """What counts as a fault."""

    part_clearance: float = 0.005
    """of any two parts of the robot: less than plans keep, so that a plan that keeps it is no fault [m]"""
    min_margin: float = 0.05
    """of the centre of mass to the border of the standing wheels: what the ground does not know of it [m]"""
    max_wheel_sink: float = 0.05
    """of a wheel in the air into the believed terrain: what the map errs by [m]"""

    friction: float = 0.5
    """of a wheel that leaves the ground sideways, a tyre on sand or rock: more holds it longer where its leg is wound up"""

    def __post_init__(self) -> None:
        if not 0.0 <= self.friction < np.inf:
            raise ConfigError(f"preview: friction is {self.friction}, must be finite and not negative")
        for name in ("part_clearance", "min_margin", "max_wheel_sink"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ConfigError(f"preview: {name} is {getattr(self, name)} m, must be finite and not negative")


def foresee(
    kin: Kinematics,
    belief: Belief,
    sequence: CommandSequence,
    *,
    terrain: HeightGrid,
    springs: FootSprings,
    payload_kg: float = 0.0,
    docks: bool = True,
    config: PreviewConfig | None = None,
) -> Preview:
    """What a sequence will do from the last known state. Its cost grows with the samples: the radians and metres moved.

    Args:
        kin: of the robot.
        belief: the last known state.
        sequence: as it would be sent.
        terrain: believed heights, without NaN.
        springs: believed, of the feet.
        payload_kg: on the deck [kg].
        docks: whether the decks of a robot that has docks twist on them.
        config: what counts as a fault.
    """
    config = PreviewConfig() if config is None else config
    return _Foresight(kin, belief, sequence, terrain, springs, payload_kg, docks, config).run()


def posing(
    kin: Kinematics, joints: Float[np.ndarray, "n 6 dof"], world_from_hex: tuple[SE3, ...], *, seconds: float = 0.0
) -> Preview:
    """Of a ground that foresees nothing but poses, evenly in time over so many seconds: no margins, torques and faults."""
    n = len(joints)
    wheels = [pose.apply(kin.wheels_in_hex(q)) for pose, q in zip(world_from_hex, joints, strict=True)]
    return Preview(
        times=np.linspace(0.0, seconds, n), joints=np.asarray(joints, dtype=float), world_from_hex=world_from_hex,
        wheels_in_world=np.array(wheels), margins=np.full(n, np.nan), torque_fractions=np.full(n, np.nan), begins=(), faults=(),
    )  # fmt: skip


def known_ground(terrain: HeightGrid, belief: Belief) -> HeightGrid:
    """Believed heights without NaN: unknown ground as the nearest known; level through the wheels' contacts where none is known."""
    unknown = ~np.isfinite(terrain.heights)
    if unknown.all():
        height = float(belief.contacts_in_world[belief.planted, 2].mean())
        heights = np.full(terrain.shape, height)
    elif unknown.any():
        nearest = distance_transform_edt(unknown, return_distances=False, return_indices=True)
        heights = terrain.heights[tuple(nearest)]
    else:
        return terrain
    return HeightGrid(origin_x=terrain.origin_x, origin_y=terrain.origin_y, cell=terrain.cell, heights=heights)


class _Foresight:
    def __init__(
        self, kin: Kinematics, belief: Belief, sequence: CommandSequence, terrain: HeightGrid, springs: FootSprings, payload_kg: float,
        docks: bool, config: PreviewConfig,
    ) -> None:  # fmt: skip
        self.kin, self.spec, self.belief, self.sequence, self.config = kin, kin.spec, belief, sequence, config
        self.terrain, self.payload = terrain, payload_kg
        self.stance = Stance(kin, belief, springs=springs, payload_kg=payload_kg, docks=docks)
        bare = CollisionConfig(part_clearance=config.part_clearance, deviations=0.0, near_ground_clearance=0.0)
        self.body = BodyCollision(kin.spec, terrain, bare)
        self.t, self.motors = 0.0, belief.motors.copy()
        self._leaving = -1
        """leg whose wheel is being lifted off and may still be held by the ground"""
        self._wound_besides = np.zeros(self.spec.dof)
        """of that leg, while it stands: what its encoders show more than its believed torques explain [rad]"""
        self.begins: list[float] = []
        self.faults: list[PreviewFault] = []
        self.rows: list[tuple[float, Joints, SE3, Wheels, float, float]] = []
        now = self.stance.at(self.motors)
        asked = np.abs(self._torques(self.motors, now) / self.spec.torque_limits)
        self.allowed = np.maximum(sequence.max_torque_fraction, asked + TORQUE_RECOVERY)
        """of each joint's limit, shape (6, dof)"""

    def run(self) -> Preview:
        self._at_once()
        now = self.stance.at(self.motors)
        self._take(-1, None, np.zeros(1), self.motors[None], [now])
        for index, command in enumerate(self.sequence.commands):
            self.begins.append(self.t)
            try:
                way = stretch(self.kin, command, self.motors)
            except OutOfReachError as e:
                self._fault("joint_limit", index, self.t, e.leg, str(e))
                break
            except BadCommandError as e:
                self._fault("bad_command", index, self.t, getattr(command, "leg", -1), str(e))
                break
            except KinematicsError as e:
                self._fault("joint_limit", index, self.t, getattr(command, "leg", -1), str(e))
                break
            if not self._follow(index, way):
                break
        end = self.rows[-1]
        if len(self.begins) == len(self.sequence.commands) and not self.faults:
            self.rows.append((end[0] + SETTLING_TIME, *end[1:]))
        elif self.t > end[0]:  # what refuses a command is told a tick after the one before it
            self.rows.append((self.t, *end[1:]))
        times, joints, poses, wheels, margins, torques = zip(*self.rows, strict=True)
        return Preview(
            times=np.array(times), joints=np.array(joints), world_from_hex=poses, wheels_in_world=np.array(wheels),
            margins=np.array(margins), torque_fractions=np.array(torques), begins=tuple(self.begins),
            faults=tuple(sorted(self.faults, key=lambda fault: fault.t)),
        )  # fmt: skip

    def _at_once(self) -> None:
        if self.sequence.robot_id != self.spec.name:
            text = f"the sequence is for {self.sequence.robot_id!r}, this is {self.spec.name}"
            self._fault("wrong_robot", -1, 0.0, -1, text)

    def _follow(self, index: int, way: Stretch) -> bool:
        """Goes through one command; whether the sequence goes on."""
        command = way.command
        if isinstance(command, Drive):
            return self._roll(index, way, command)
        if isinstance(command, LegMove) and command.lands and not self.stance.stands[command.leg]:
            return self._descend(index, way, command)
        if isinstance(command, JointMove) and self._presses(index, way, command):
            return False
        if isinstance(command, LegMove) and command.guard == "break_contact" and self.stance.stands[command.leg]:
            return self._lift(index, way, command.leg)
        return self._go(index, way)

    def _go(self, index: int, way: Stretch) -> bool:
        n = len(way.times)
        turns = np.unique(np.linspace(0, n - 1, min(TURNS, n)).round().astype(int))
        solved = {int(k): self.stance.at(way.motors[k]) for k in turns}
        moments = [_even(solved, k, way.times) for k in range(n)]
        return self._take(index, way, way.times, way.motors, moments)

    def _lift(self, index: int, way: Stretch, leg: int) -> bool:
        """Up to where the wheel leaves the ground, and from there."""
        first, last, breaks = self.stance.at(way.motors[0]), self.stance.at(way.motors[-1]), len(way.times) - 1
        self.stance.lifts(leg)
        free = self.stance.at(way.motors[-1])
        if free.status == "converged" and last.status == "converged" and last.loads[leg] > 0.0:
            self.stance.stays(leg)
            text = f"leg {leg + 1} still carries {last.loads[leg]:.0f} N at the end of its lift-off"
            self._go(index, way)
            self._fault("contact_not_broken", index, self.t, leg, text)
            return False
        place = self.kin.leg_wheel(leg, way.motors[0, leg]).translation
        drop = float((first.world_from_leg[leg].apply(place) - free.world_from_leg[leg].apply(place))[2])
        loads, lifts = self.stance.unloading(leg, drop, self.config.friction)
        height = np.maximum.accumulate(self._commanded_height(way, leg))
        carried = np.interp(height, lifts, loads)
        free_from = float(np.interp(AIRBORNE_LOAD, loads[::-1], lifts[::-1]))
        reached = float(np.interp(free_from, height, np.arange(breaks + 1.0)))
        moments = [_mixed(first, free, 1.0 - load / max(loads[0], 1e-9)) for load in carried]
        if way.free_times is not None:
            way = way.hastened(reached, way.free_times).held(BREAK_HOLD)
            moments.append(moments[-1])
        self._leaving = leg
        self._wound_besides = np.zeros(self.spec.dof)
        if self.belief.planted[leg] and np.array_equal(self.motors, self.belief.motors):
            self._wound_besides = (self.belief.joints - self._joints(self.motors, first))[leg]
        stands = self._take(index, way, way.times, way.motors, moments)
        self._leaving = -1
        return stands

    def _commanded_height(self, way: Stretch, leg: int) -> np.ndarray:
        up = -self.belief.gravity_in_hex() / GRAVITY
        axles = np.array([self.kin.leg_wheel(leg, q[leg]).translation for q in way.motors])
        return np.asarray((axles - axles[0]) @ up)

    def _descend(self, index: int, way: Stretch, command: LegMove) -> bool:
        """Down until the wheel carries what the command asks for, or to the end of a way that asks for nothing."""
        leg = command.leg
        free = self.stance.at(way.motors[0])
        axles = self._axles_on(way, free, leg)
        ground = self._ground_under(axles)
        bottom = axles[:, 2] - self.spec.wheel.radius
        below = np.flatnonzero(bottom <= ground)
        if len(below) == 0:
            moments = [self.stance.at(way.motors[0])] * len(way.times)
            goes_on = self._take(index, way, way.times, way.motors, moments)
            if command.guard == "place":  # the robot goes on, this wheel in the air
                return goes_on
            over = float((bottom - ground).min())
            self._fault("no_contact", index, self.t, leg, f"leg {leg + 1} ends {100 * over:.0f} cm above the believed ground")
            return False
        k = int(below[0])
        touch = float(k)
        if k > 0:
            above, under = bottom[k - 1] - ground[k - 1], ground[k] - bottom[k]
            touch = k - 1 + above / max(above + under, 1e-12)
        at_touch = way.cut(touch)
        fork = free.world_from_leg[leg].rotation @ self.kin.leg_wheel(leg, at_touch.motors[-1, leg]).rotation
        height = float(np.interp(touch, np.arange(len(ground)), ground))
        self.stance.lands(leg, fork, self._axles_on(at_touch, free, leg)[-1], height)
        if command.guard == "place":
            end, loaded = float(len(way.times) - 1), self.stance.at(way.motors[-1])
        else:
            end, loaded = self._carries(way, touch, leg, command.contact_load)
        cut = way.cut(end)
        moments = [
            _mixed(free, loaded, float(np.clip((min(k, end) - touch) / max(end - touch, 1e-9), 0.0, 1.0)))
            for k in range(len(cut.times))
        ]
        ok = self._take(index, cut, cut.times, cut.motors, moments)
        if command.guard == "contact" and loaded.status == "converged" and loaded.loads[leg] < 0.5 * command.contact_load:
            text = f"leg {leg + 1} carries {loaded.loads[leg]:.0f} of {command.contact_load:.0f} N at the end of its way"
            self._fault("no_contact", index, self.t, leg, text)
            return False
        return ok

    def _carries(self, way: Stretch, touch: float, leg: int, load: float) -> tuple[float, Standing]:
        """Where on the way the wheel carries a load, by secants: the springs are nearly linear."""
        last = float(len(way.times) - 1)
        low, low_load = touch, 0.0
        high = last
        found = self.stance.at(way.cut(high).motors[-1])
        if found.status == "converged" and found.loads[leg] <= load:
            return high, found
        high_load = found.loads[leg] if found.status == "converged" else np.inf
        for _ in range(TOUCH_TRIES):
            share = (load - low_load) / (high_load - low_load) if np.isfinite(high_load) else 0.5
            middle = low + float(np.clip(share, 0.05, 0.95)) * (high - low)
            found = self.stance.at(way.cut(middle).motors[-1])
            carried = found.loads[leg] if found.status == "converged" else np.inf
            if abs(carried - load) <= 0.02 * load:
                return middle, found
            if carried < load:
                low, low_load = middle, carried
            else:
                high, high_load = middle, carried
        return middle, found

    def _presses(self, index: int, way: Stretch, command: JointMove) -> bool:
        """Whether a leg that stands is led as if it were free."""
        leg = command.leg
        if not self.stance.stands[leg] or np.abs(way.motors[-1, leg] - way.motors[0, leg]).max() < 1e-3:
            return False
        self._fault("dragging", index, self.t, leg, f"leg {leg + 1} stands on the ground; lift it off before a joint move")
        self._go(index, way)
        return True

    def _roll(self, index: int, way: Stretch, command: Drive) -> bool:
        """On the wheels: of the terrain only the rise from here to there is taken."""
        first = self.stance.at(self.motors)
        along = first.world_from_hex.rotate(np.append(command.translation_in_hex, 0.0))
        length = float(np.linalg.norm(along))
        here = self.stance.axles(first, self._joints(self.motors, first))
        moments, wheels = [], []
        before, risen = 0.0, np.zeros(LEGS)
        for share in np.linspace(0.0, 1.0, len(way.times)):
            place = here[:, :2] + share * along[:2]
            rise = np.asarray(self.terrain.sample(place) - self.terrain.sample(here[:, :2]))
            self.stance.rolled((share - before) * along, rise - risen)
            before, risen = share, rise
            moments.append(self.stance.at(self.motors))
            wheels.append(self.stance.axles(moments[-1], self._joints(self.motors, moments[-1])))
        if length == 0.0:
            return True
        return self._take(index, way, way.times, way.motors, moments, wheels=wheels)

    def _axles_on(self, way: Stretch, standing: Standing, leg: int) -> np.ndarray:
        """Axles of a leg in the air along a way, shape (n, 3) [m]; its own weight winds it up alike all the way."""
        wound = self._joints(way.motors[0], standing)[leg] - way.motors[0, leg]
        return np.array(
            [standing.world_from_leg[leg].apply(self.kin.leg_wheel(leg, q[leg] + wound).translation) for q in way.motors]
        )

    def _ground_under(self, axles: np.ndarray) -> np.ndarray:
        return np.asarray(self.terrain.sample(axles[:, :2]))

    def _joints(self, motors: Joints, standing: Standing) -> Joints:
        """Behind the wind-up that the torques of the stance cause."""
        return np.asarray(motors - self._torques(motors, standing) / self.belief.joint_stiffness)

    def _torques(self, motors: Joints, standing: Standing) -> Joints:
        """Shape (6, dof) [N m]."""
        gravity = -GRAVITY * standing.world_from_hex.rotation.T @ WORLD_UP
        contacts = self.kin.wheels_in_hex(motors) + self.spec.wheel.radius * gravity / GRAVITY
        return self.kin.gravity_torques(motors, gravity, self._forces(standing, gravity), contacts)

    def _forces(self, standing: Standing, gravity: np.ndarray) -> Wheels:
        """The springs' vertical forces, and what the torques told of horizontal ones on wheels that have stood since."""
        up, belief = -gravity / GRAVITY, self.belief
        forces = np.outer(standing.loads, up)
        kept = belief.planted & self.stance.stands & (standing.loads > 0.0)
        forces[kept] += (belief.forces - np.outer(belief.forces @ up, up))[kept]
        if self._leaving >= 0:
            load = float(standing.loads[self._leaving])
            forces[self._leaving] = self.stance.leaving_force(self._leaving, load, self.config.friction)
        return np.asarray(forces)

    def _take(
        self, index: int, way: Stretch | None, times: np.ndarray, motors: np.ndarray, moments: list[Standing], *,
        wheels: list[Wheels] | None = None,
    ) -> bool:  # fmt: skip
        """Adds samples, judges them, and goes on from the last; whether the robot still stands."""
        moving = getattr(way.command, "leg", -1) if way is not None and isinstance(way.command, JointMove | LegMove) else -1
        for k, (t, q, standing) in enumerate(zip(times, motors, moments, strict=True)):
            if k == 0 and index >= 0:  # where the command before it ended
                continue
            torques = self._torques(q, standing)
            fractions, joints = np.abs(torques / self.spec.torque_limits), q - torques / self.belief.joint_stiffness
            if self._leaving >= 0:
                left = standing.loads[self._leaving] / max(float(moments[0].loads[self._leaving]), 1e-9)
                joints[self._leaving] += left * self._wound_besides
            axles = self.stance.axles(standing, joints) if wheels is None else wheels[k]
            margin = self._margin(standing, joints, axles)
            now = self.t + float(t)
            self.rows.append((now, joints, standing.world_from_hex, axles, margin, float(fractions.max())))
            if index >= 0:
                self._judge(index, now, standing, joints, margin, fractions, moving, way)
        moves = way is not None and isinstance(way.command, JointMove | LegMove | BodyMove | Drive)
        self.t += float(times[-1]) + (TICK if moves else 0.0)
        self.motors = motors[-1].copy()
        return not any(fault.code == "tip_over" for fault in self.faults)

    def _margin(self, standing: Standing, joints: Joints, axles: Wheels) -> float:
        if standing.status in ("too_few_feet", "tips"):
            return -np.inf
        carries = self.stance.stands & (standing.loads > 0.0)
        com = standing.world_from_hex.apply(self.kin.com_in_hex(joints, self.payload))
        contacts = axles[carries] - self.spec.wheel.radius * WORLD_UP
        return float(support_margin(com, contacts)) if carries.sum() >= 3 else -np.inf

    def _judge(
        self, index: int, t: float, standing: Standing, joints: Joints, margin: float, fractions: Joints, moving: int,
        way: Stretch | None,
    ) -> None:  # fmt: skip
        if margin < self.config.min_margin:
            text = f"margin {margin:.2f} m over the wheels that stand, at least {self.config.min_margin:.2f} m"
            if not np.isfinite(margin):
                text = f"{int(self.stance.stands.sum())} wheels do not carry the robot: the springs say {standing.status}"
            self._fault("tip_over", index, t, moving, text)
        tilt = float(np.arccos(np.clip(standing.world_from_hex.rotation[2, 2], -1.0, 1.0)))
        if tilt > self.sequence.max_tilt:
            limit = np.rad2deg(self.sequence.max_tilt)
            self._fault("tilt", index, t, -1, f"chassis tilts by {np.rad2deg(tilt):.1f} deg, allowed {limit:.1f} deg")
        over = fractions - self.allowed
        if over.max() > 0.0:
            leg, joint = (int(v) for v in np.unravel_index(int(np.argmax(over)), over.shape))
            asked, allowed = 100 * fractions[leg, joint], 100 * self.allowed[leg, joint]
            text = f"{self.spec.joint_names[joint]} of leg {leg + 1} at {asked:.0f} % of its limit, allowed {allowed:.0f} %"
            self._fault("torque", index, t, leg, text)
        if way is not None and isinstance(way.command, JointMove | LegMove | BodyMove | Drive):
            hit = self.body.first_collision(joints, standing.world_from_hex)
            if hit is not None:
                code = "terrain_collision" if hit.endswith("terrain") else "self_collision"
                self._fault(code, index, t, moving, hit)
        if way is not None and isinstance(way.command, JointMove) and not self.stance.stands[moving]:
            sink = self._sink(standing, joints, moving)
            if sink > self.config.max_wheel_sink:
                text = f"wheel {moving + 1} would be {100 * sink:.0f} cm in the believed ground"
                self._fault("terrain_collision", index, t, moving, text)

    def _sink(self, standing: Standing, joints: Joints, leg: int) -> float:
        """Depth of a wheel's rim in the terrain [m]."""
        pose = standing.world_from_leg[leg].compose(self.kin.leg_wheel(leg, joints[leg]))
        angle = np.linspace(0.0, 2.0 * np.pi, RIM, endpoint=False)
        rim = self.spec.wheel.radius * np.column_stack([np.cos(angle), np.zeros(RIM), np.sin(angle)])
        points = pose.apply(rim)
        return float((self.terrain.sample(points[:, :2]) - points[:, 2])[points[:, 2] < pose.translation[2]].max())

    def _fault(self, code: str, index: int, t: float, leg: int, text: str) -> None:
        """Each kind once a command: the first says where to look."""
        if any(fault.code == code and fault.command_index == index for fault in self.faults):
            return
        self.faults.append(PreviewFault(code=code, command_index=index, t=t, leg=leg, text=text))


def _even(solved: dict[int, Standing], k: int, times: np.ndarray) -> Standing:
    """The standing at a sample, evenly between the solved ones around it."""
    if k in solved:
        return solved[k]
    before, after = max(i for i in solved if i < k), min(i for i in solved if i > k)
    span = max(float(times[after] - times[before]), 1e-12)
    return _mixed(solved[before], solved[after], float(times[k] - times[before]) / span)


def _mixed(first: Standing, second: Standing, share: float) -> Standing:
    return Standing(
        world_from_hex=between(first.world_from_hex, second.world_from_hex, share),
        world_from_leg=tuple(between(a, b, share) for a, b in zip(first.world_from_leg, second.world_from_leg, strict=True)),
        forces=(1.0 - share) * first.forces + share * second.forces,
        loads=(1.0 - share) * first.loads + share * second.loads,
        sideways_in_world=(1.0 - share) * first.sideways_in_world + share * second.sideways_in_world,
        rolled_in_world=(1.0 - share) * first.rolled_in_world + share * second.rolled_in_world,
        status=second.status if second.status != "converged" else first.status,
    )
