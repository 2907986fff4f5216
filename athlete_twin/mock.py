"""A robot without physics, for developing against the link: it does at once what it is told, on flat ground.

The same executive runs the same commands. In place of physics stands a chassis that sinks into six equal linear foot
springs (the drawings' belief, so that guards see loads), keeps its planted wheels where they are and is always settled.
Joints do not wind up, and nothing breaks: `envs` refuses the mock a scenario that injects faults. Its pictures show a
flat, textured ground without robot or rocks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from athlete_twin.commanded import Commanded
from athlete_twin.driving import rolling_velocities
from athlete_twin.executive import CONTROL_PERIOD, Executive
from athlete_twin.flat_stance import stand, yawed
from athlete_twin.geometry.arrays import Image, Joints, PerLeg, RawImage, Vec3, Wheels
from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import ImageRequest, Message, StereoPair, Telemetry
from athlete_twin.model.kinematics import GRAVITY, Kinematics
from athlete_twin.model.placed_legs import LegChains
from athlete_twin.model.spec import LEGS, RobotSpec
from athlete_twin.model.stance import regular_stance
from athlete_twin.moment import Moment, taken
from athlete_twin.moves import Sensed
from athlete_twin.robot import ViewTruth
from athlete_twin.world.injected import InjectedFault

TELEMETRY_PERIOD = 1.0
"""while a sequence runs, DESIGN.md [s]"""
TRACK_PERIOD = 0.5
"""of the recorded motion while a sequence runs [s]"""
EXPOSURE = 0.004
"""of every picture [s]"""


@dataclass(frozen=True, kw_only=True)
class MockTruth:
    """What is so with the mock. The names are the twin's."""

    t: float
    world_from_hex: SE3
    joints: Joints
    motors: Joints
    torques: Joints
    wheel_loads: PerLeg
    wheels_in_world: Wheels
    com_in_world: Vec3
    phases: tuple[str, ...]
    moving: bool
    peak_torque_fraction: float


@dataclass(frozen=True, kw_only=True)
class MockTrackPoint:
    """One sample of the mock's motion."""

    t: float
    world_from_hex: SE3
    joints: Joints


class MockAthlete(Commanded):
    """One robot on flat ground at height 0. Implements the `Robot` protocol and is asked for its truth like the twin."""

    def __init__(self, spec: RobotSpec) -> None:
        super().__init__(spec.name)
        self.spec = spec
        self.on_view: Callable[[ViewTruth], None] | None = None
        self.kin = Kinematics(spec)
        self._chains = LegChains(self.kin)
        self.executive = Executive(kin=self.kin, setpoint=regular_stance(spec))
        self.t = 0.0
        self.collisions: list[MockCollision] = []
        self.injected: list[InjectedFault] = []
        self.track: list[MockTrackPoint] = []
        self.peak_torque_fraction = 0.0
        self._last_telemetry = self._last_track = -np.inf
        self._since_control = 0.0
        self._height_tilt = np.array([spec.chassis_height, 0.0, 0.0])
        self._place_xy_yaw = np.zeros(3)
        wheels = self.kin.wheels_in_hex(self.executive.setpoint)
        self._anchors = wheels[:, :2].copy()
        self._loads = np.zeros(LEGS)
        self._held_by: Joints | None = None
        self._held_fraction = 0.0
        self._world_from_hex = SE3.identity()
        self._settle()
        self._record_track()

    # --- Robot protocol -------------------------------------------------------------------------------------------

    @property
    def busy(self) -> bool:
        """Whether the executive has anything to do."""
        return self.executive.busy

    def advance(self, until: float) -> list[Message]:
        """Run to mission time `until` [s], or until something goes down, whichever comes first.

        A control tick that ends later has not happened yet: what comes up until then finds the robot before it.
        """
        if self._last_telemetry < 0.0:
            return [self._telemetry()]
        out: list[Message] = []
        while self.t < until - 1e-9 and not out:
            if not self.executive.busy:
                self.t, self._since_control = until, 0.0
                break
            left = max(CONTROL_PERIOD - self._since_control, 0.0)
            if self.t + left > until + 1e-9:
                self._since_control += until - self.t
                self.t = until
                break
            self.t, self._since_control = self.t + left, 0.0
            out = self._control_tick()
        return out

    def close(self) -> None:
        """Holds nothing."""

    def save(self) -> Moment:
        """This moment: what follows `restore` of it equals what follows now, to the last bit."""
        changing = {name: value for name, value in vars(self).items() if name != "on_view"}
        return taken(changing, (self.spec, self.kin, self._chains, *self.track))

    def restore(self, moment: Moment) -> None:
        """Back to a moment that this robot saved, as often as wanted."""
        vars(self).update(taken(moment, (self.spec, self.kin, self._chains, *moment["track"])))

    def truth(self) -> MockTruth:
        """What is so now."""
        joints = self.executive.setpoint
        return MockTruth(
            t=self.t,
            world_from_hex=self._world_from_hex,
            joints=joints.copy(),
            motors=joints.copy(),
            torques=self._torques(),
            wheel_loads=self._loads.copy(),
            wheels_in_world=self._wheels_in_world.copy(),
            com_in_world=self._com_in_world.copy(),
            phases=tuple(self.executive.phases),
            moving=self.executive.busy,
            peak_torque_fraction=self.peak_torque_fraction,
        )

    def link_poses(self) -> dict[str, SE3]:
        """`world_from_link` of every link."""
        placed = self.kin.link_poses(self.executive.setpoint)
        return {link: self._world_from_hex.compose(hex_from_link) for link, hex_from_link in placed.items()}

    # --- internals ------------------------------------------------------------------------------------------------

    def _control_tick(self) -> list[Message]:
        state = self.executive.state
        torques = self._torques()
        self.peak_torque_fraction = max(self.peak_torque_fraction, self._held_fraction)
        sensed = Sensed(joints=self.executive.setpoint, torques=torques, attitude_rpy=self._world_from_hex.rpy())
        before = self.executive.setpoint
        events = self.executive.tick(sensed)
        if self.executive.rolling:
            velocities = rolling_velocities(self.kin, self.executive.setpoint, self.executive.wheel_rates)
            self._anchors = self._anchors + CONTROL_PERIOD * (velocities @ yawed(self._place_xy_yaw[2]).T)[:, :2]
        # By content: the set-points of a restored motion are equal ones, not the same.
        setpoint = self.executive.setpoint
        if self.executive.rolling or (setpoint is not before and (setpoint != before).any()):
            self._settle()
        if self.t - self._last_track >= TRACK_PERIOD:
            self._record_track()
        made = self._tell(events)
        due = self.executive.busy and self.t - self._last_telemetry >= TELEMETRY_PERIOD
        # A sequence that fails in its first tick leaves the state as it was, and still it has ended.
        ended = any(e.kind == "fault" or e.command_index < 0 for e in events)
        if due or ended or state != self.executive.state:
            made.append(self._telemetry())
        return made

    def _settle(self) -> None:
        """New chassis pose: height and tilt balance the weight on the springs, planted wheels keep their places."""
        spec = self.spec
        self._held_by = None
        self._placed = self._chains.placed(self.executive.setpoint)
        (
            self._height_tilt, self._loads, self._place_xy_yaw, self._anchors, rotation, translation, self._wheels_in_world,
            self._com_in_world,
        ) = stand(
            self._placed.wheels,
            self._placed.com,
            self._height_tilt,
            spec.wheel.radius,
            spec.believed_foot_stiffness,
            spec.mass * GRAVITY,
            np.array([phase == "stance" for phase in self.executive.phases]),
            self._place_xy_yaw,
            self._anchors,
        )  # fmt: skip
        self._world_from_hex = SE3(rotation, translation)

    def _torques(self) -> Joints:
        """What holds the legs where they settled last; computed once for each place where somebody asks."""
        if self._held_by is None:
            up = self._world_from_hex.rotation[2].copy()
            contacts = self._placed.wheels - self.spec.wheel.radius * up
            self._held_by = self._chains.held(self._placed, -GRAVITY * up, self._loads[:, None] * up, contacts)
            self._held_fraction = float((np.abs(self._held_by) / self.spec.torque_limits).max())
        return self._held_by.copy()

    def _capture(self, request: ImageRequest) -> list[Message]:
        state = self._telemetry()
        out: list[Message] = []
        for name in request.cameras:
            camera = self.spec.camera(name).riding(self.kin.link_poses(state.joints))
            eye = camera.eye.binned(request.binning)
            views = [
                ground_picture(eye.rays(), self._world_from_hex.compose(hex_from_eye))
                for hex_from_eye in (camera.hex_from_camera, camera.hex_from_right())
            ]
            for number, factor in enumerate(request.brackets):
                left, right = (exposed(view, factor, bits=request.bits) for view in views)
                out.append(
                    StereoPair(
                        seq=self._next("stereo_pair"), robot_id=self.robot_id, t=self.t, camera=name, binning=request.binning,
                        left=left, right=right, exposure=factor * EXPOSURE, state=state, bits=request.bits, bracket=number,
                    )
                )  # fmt: skip
        return out

    def _telemetry(self) -> Telemetry:
        self._last_telemetry = self.t
        up = self._world_from_hex.rotation.T @ np.array([0.0, 0.0, GRAVITY])
        return Telemetry(
            seq=self._next("telemetry"),
            robot_id=self.robot_id,
            t=self.t,
            joints=self.executive.setpoint.copy(),
            motors=self.executive.setpoint.copy(),
            torques=self._torques(),
            attitude_rpy=self._world_from_hex.rpy(),
            rates=np.zeros(3),
            acceleration=up,
            executive_state=self.executive.told_state,
            sequence_id=self.executive.sequence_id,
            command_index=self.executive.command_index,
        )

    def _record_track(self) -> None:
        self._last_track = self.t
        point = MockTrackPoint(t=self.t, world_from_hex=self._world_from_hex, joints=self.executive.setpoint.copy())
        self.track.append(point)


@dataclass(frozen=True, kw_only=True)
class MockCollision:
    """Never made: the mock touches nothing. It stands here so that its list has the twin's type."""

    t: float
    part: str
    other: str
    place_in_world: Vec3
    force: float


def ground_picture(rays: np.ndarray, world_from_eye: SE3) -> Image:
    """What an eye sees of flat textured ground at height 0, sky above, 8-bit grey."""
    directions = world_from_eye.rotate(rays)
    down = -directions[..., 2]
    on_ground = down > 0.02
    reach = world_from_eye.translation[2] / np.where(on_ground, down, 1.0)
    xy = world_from_eye.translation[:2] + reach[..., None] * directions[..., :2]
    xy = np.where(on_ground[..., None], xy, 0.0)
    grey = 110.0 + 50.0 * _texture(xy / 0.05) + 40.0 * _texture(xy / 0.31 + 17.0)
    return np.where(on_ground, np.clip(grey, 0.0, 255.0), 225.0).astype(np.uint8)


def exposed(image: Image, factor: float, *, bits: int) -> RawImage:
    """A picture at a multiple of its exposure, cut off at white; 8 bits in uint8, 12 in uint16."""
    white = 2.0**bits - 1.0
    grey = np.clip(np.rint(image * (factor * white / 255.0)), 0.0, white)
    return np.asarray(grey.astype(np.uint8 if bits == 8 else np.uint16))


def _texture(xy: np.ndarray) -> np.ndarray:
    """Value noise in [-1, 1] at points (..., 2), one lattice cell a unit."""
    base = np.floor(xy)
    f = xy - base
    f = f * f * (3.0 - 2.0 * f)
    i, j = base[..., 0].astype(np.int64), base[..., 1].astype(np.int64)
    low = _hash(i, j) * (1 - f[..., 0]) + _hash(i + 1, j) * f[..., 0]
    high = _hash(i, j + 1) * (1 - f[..., 0]) + _hash(i + 1, j + 1) * f[..., 0]
    return np.asarray(low * (1 - f[..., 1]) + high * f[..., 1])


def _hash(i: np.ndarray, j: np.ndarray) -> np.ndarray:
    mixed = (i * 73856093) ^ (j * 19349663)
    mixed = ((mixed ^ (mixed >> 13)) * 1274126177) & 0xFFFFFF
    return np.asarray(mixed / float(0x7FFFFF) - 1.0)
