"""The twin: true body, sensors and on-board executive of one robot in one scenario. Implements the `Robot` protocol.

`advance` integrates physics at 240 Hz and the executive at 24 Hz. A robot that waits for the link and has come to
rest is held by its brakes: time passes without integration, which changes nothing and costs nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from athlete_twin.breakage import Breakage
from athlete_twin.commanded import Commanded
from athlete_twin.errors import PhysicsError
from athlete_twin.executive import CONTROL_PERIOD, Event, Executive
from athlete_twin.geometry.arrays import Joints, PerLeg, RawImage, Vec3, Wheels
from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import ImageRequest, Message, StereoPair, Telemetry
from athlete_twin.model.appearance import visual_parts
from athlete_twin.model.kinematics import GRAVITY, Kinematics
from athlete_twin.model.reach import all_legs_ik
from athlete_twin.model.spec import LEGS, RobotSpec
from athlete_twin.model.stance import stance_wheels_in_hex
from athlete_twin.moment import Moment, taken
from athlete_twin.moves import Sensed
from athlete_twin.physics.body import Body, settled
from athlete_twin.physics.truth import TrialTruth, draw_truth
from athlete_twin.physics.tyre import Footing
from athlete_twin.robot import ViewTruth
from athlete_twin.sensors.proprioception import Measurement, Proprioception, ProprioceptionNoise
from athlete_twin.world.bullet_world import TICK, BulletWorld
from athlete_twin.world.injected import InjectedFault
from athlete_twin.world.scenario import Scenario
from athlete_twin.world.terrain import Terrain, build_terrain

TICKS_PER_CONTROL = round(CONTROL_PERIOD / TICK)
CONTROLS_PER_CHECK = 2
"""strikes of wheels are looked for at 12 Hz: a wheel at 0.2 m/s moves 1.7 cm in between, and a look takes 3 to 4 % of a
control tick. Contacts of hulls are looked at in every control tick, 24 Hz: reading Bullet's list takes 0.3 % of one"""
SETTLE_LIMIT = 8.0
"""a robot that still moves after that long without a command is not at rest [s]"""
TELEMETRY_PERIOD = 1.0
"""while moving [s]"""
TRACK_PERIOD = 0.5
"""of the recorded truth while moving [s]"""
STRIKE_DEPTH = 0.01
"""a wheel's hull deeper than this in the ground outside lift-off and descent is a collision [m]"""
EPISODE_GAP = 1.0
"""contacts of the same pair closer than this are one episode [s]"""
TORQUE_FILTER = 0.1
"""[s]"""
LASTING = ("spec", "scenario", "kin", "terrain", "trial", "world", "body", "on_view", "_eyes")
"""attributes of an `Athlete` that never change, or, as the body, keep their own moments"""
CLEAR_RADIUS = 0.45
"""round each wheel's first patch no rock is placed [m]"""


@dataclass(frozen=True, kw_only=True)
class Collision:
    """One contact episode as DESIGN.md defines it."""

    t: float
    """when it began [s]"""
    part: str
    """link that touched"""
    other: str
    """ "ground" or another link"""
    place_in_world: Vec3
    """[m]"""
    force: float
    """at its beginning [N]"""


@dataclass(frozen=True, kw_only=True)
class TruthState:
    """What is really so, for scoring and films only."""

    t: float
    world_from_hex: SE3
    joints: Joints
    motors: Joints
    torques: Joints
    """[N m]"""
    wheel_forces: Wheels
    """of the ground on the wheels, in world [N]"""
    wheel_loads: PerLeg
    """along the ground's normal [N]"""
    wheels_in_world: Wheels
    """axle centres [m]"""
    com_in_world: Vec3
    phases: tuple[str, ...]
    """per leg "stance", "lift_off", "swing" or "descent" """
    moving: bool
    peak_torque_fraction: float
    """largest so far, low-passed at 0.1 s"""


@dataclass(frozen=True, kw_only=True)
class TrackPoint:
    """One sample of the true motion."""

    t: float
    world_from_hex: SE3
    joints: Joints
    docks: np.ndarray
    """dock angles in the order of the URDF, empty on SDM-B [rad]"""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Control:
    """What holds during one control period."""

    commands: Joints
    """of the motors, as they are and not as their encoders read them [rad]"""
    rates: Joints
    """[rad/s]"""
    events: list[Event]
    """to be told at its end"""
    changed: bool
    """whether the executive's state did"""


class Athlete(Commanded):
    """One robot in one scenario, from one seed."""

    def __init__(
        self,
        spec: RobotSpec,
        scenario: Scenario,
        seed: int,
        *,
        payload_kg: float = 0.0,
        trial: TrialTruth | None = None,
        terrain: Terrain | None = None,
        start: tuple[Joints, SE3] | None = None,
    ) -> None:
        """Set the robot down and let it come to rest.

        Args:
            spec: the drawings.
            scenario: where.
            seed: of the ground and of the individual.
            payload_kg: on the middle of the deck [kg]
            trial: the individual; drawn from the seed by default.
            terrain: the ground; made from scenario and seed by default.
            start: angles, shape (6, dof) [rad], and `world_from_hex` with all wheels just above the ground; the drawings'
                stance, level, at the origin by default.
        """
        self._breakage = Breakage(scenario, spec)  # before there is a physics client that a refusal would leave behind
        super().__init__(spec.name)
        self.spec, self.scenario, self.seed = spec, scenario, seed
        self.on_view: Callable[[ViewTruth], None] | None = None
        self.kin = Kinematics(spec)
        stance = stance_wheels_in_hex(spec)
        self.terrain = terrain or build_terrain(scenario, seed, clear_xy=stance[:, :2], clear_radius=CLEAR_RADIUS)
        names = tuple(self.kin.link_poses(np.zeros((LEGS, spec.dof))))
        self.trial = trial or draw_truth(spec, seed, link_names=names)
        self.world = BulletWorld(self.terrain.grid)
        self.body = Body(self.world, spec, self.trial, footing=Footing.of(self.terrain), payload_kg=payload_kg)
        self.payload_kg = payload_kg
        truth = self.trial.truth
        self._senses = Proprioception(
            seed=seed,
            encoder_zero=self.trial.encoder_zero,
            noise=ProprioceptionNoise(
                encoder_bits=int(truth.encoder_bits),
                attitude=truth.attitude_noise,
                yaw_drift=truth.yaw_drift,
                rate=truth.rate_noise,
                acceleration=truth.acceleration_noise,
            ),
        )
        self._lost: list[Event] = []
        self._eyes: Any = None
        self.t = 0.0
        self._readings, self._controls = 0, 0
        self._ticks = 0
        """of physics since the control period began"""
        self._rest = False
        self._captures = 0
        self._last_telemetry = -np.inf
        self._last_track = -np.inf
        self._torque_fraction = np.zeros((LEGS, spec.dof))
        self.peak_torque_fraction = 0.0
        self.collisions: list[Collision] = []
        self._touching: dict[tuple[str, str], float] = {}
        self.track: list[TrackPoint] = []
        joints, world_from_hex = self._first_stance(stance) if start is None else start
        # Motors take angles as their encoders read them: what is commanded is off by the encoders' zeros.
        self.executive = Executive(kin=self.kin, setpoint=joints + self.trial.encoder_zero)
        # However it begins, the robot is one and the same: its dampers are those of the drawings' stance.
        self.body.place(world_from_hex, joints, damped_for=None if start is None else all_legs_ik(spec, stance)[0])
        self._settle()
        self._record_track()
        self._waiting: list[Message] = [self._telemetry()]

    # --- Robot protocol -------------------------------------------------------------------------------------------

    @property
    def busy(self) -> bool:
        """Whether the executive has anything to do, or will have once its power is back."""
        return self.executive.busy or self._breakage.dark(self.t)

    def advance(self, until: float) -> list[Message]:
        """Run to the mission time `until` [s], or until something is to be sent down, whichever comes first.

        Time may pass `until` by less than a physics tick; what comes up meanwhile is heard at that tick.
        """
        out, self._waiting = self._waiting, []
        while self.t < until - 1e-9 and not out:
            if self._ticks:
                out = self._physics_tick()
                continue
            out = self._break()
            if out:
                break
            if not self.executive.busy and self._rest:
                later = min(until, self._breakage.next_change(self.t))
                # What touches while nothing moves goes on touching: no new episode when time runs again.
                self._touching = {p: t + later - self.t for p, t in self._touching.items()}
                self.t = later
            else:
                self._begin_control()
                out = self._physics_tick()
        return out

    def close(self) -> None:
        """Free the physics client."""
        self.world.close()

    def save(self) -> Moment:
        """This moment: what follows `restore` of it equals what follows now, to the last bit.

        Not while a hull touches something, see `Body.save`: that raises `PhysicsError`.
        """
        changing = {name: value for name, value in vars(self).items() if name not in LASTING}
        return {"body": self.body.save(), "rest": taken(changing, (*self._lasting(), *self.track, *self.collisions))}

    def restore(self, moment: Moment) -> None:
        """Back to a moment that this robot saved, as often as wanted."""
        self.body.restore(moment["body"])
        rest = moment["rest"]
        vars(self).update(taken(rest, (*self._lasting(), *rest["track"], *rest["collisions"])))

    def _lasting(self) -> tuple[object, ...]:
        return tuple(vars(self)[name] for name in LASTING)

    # --- truth, for scoring and films -----------------------------------------------------------------------------

    @property
    def injected(self) -> list[InjectedFault]:
        """What the scenario has broken so far."""
        return self._breakage.applied

    def truth(self) -> TruthState:
        """What is really so now."""
        body = self.body
        return TruthState(
            t=self.t,
            world_from_hex=body.world_from_hex(),
            joints=body.joints.copy(),
            motors=body.motors,
            torques=body.torques(),
            wheel_forces=body.tyre.forces_in_world.copy(),
            wheel_loads=body.tyre.loads.copy(),
            wheels_in_world=body.axles.copy(),
            com_in_world=body.com_in_world(),
            phases=tuple(self.executive.phases),
            moving=not self._rest,
            peak_torque_fraction=self.peak_torque_fraction,
        )

    def link_poses(self) -> dict[str, SE3]:
        """True `world_from_link` of every link."""
        return self.body.link_poses()

    # --- internals ------------------------------------------------------------------------------------------------

    def _first_stance(self, stance: Wheels) -> tuple[Joints, SE3]:
        """Joints and pose of the first stance: each unloaded wheel just touches the ground below it, chassis level."""
        heights = self.terrain.grid.sample(stance[:, :2])
        wheels = stance.copy()
        datum = float(heights.mean())
        wheels[:, 2] += heights - datum
        joints, ok = all_legs_ik(self.spec, wheels)
        if not ok.all():
            legs = ", ".join(str(leg + 1) for leg in np.flatnonzero(~ok))
            raise PhysicsError(f"{self.spec.name} cannot stand level at the start of {self.scenario.name}: legs {legs} do not reach")
        height = self.spec.chassis_height + datum
        return joints, SE3.from_translation(np.array([0.0, 0.0, height]))

    def _break(self) -> list[Message]:
        """What breaks now; what there is to tell once the executive has its power back."""
        due = self._breakage.apply(self.t, self.body, self._senses)
        if due:
            self._rest = False
        if any(fault.kind == "brown_out" for fault in due):
            self._lost += self.executive.brown_out()
        if not self._lost or self._breakage.dark(self.t):
            return []
        lost, self._lost = self._lost, []
        return [*self._tell(lost), self._telemetry()]

    def _settle(self) -> None:
        limit = np.full((LEGS, self.spec.dof), self.spec.speed_loaded)
        commands = self.executive.setpoint - self.trial.encoder_zero
        for k in range(round(SETTLE_LIMIT / TICK)):
            self.body.step(commands, limit)
            if k > 480 and k % 60 == 0 and settled(self.body):
                break
        self._rest = settled(self.body)

    def _sense(self) -> Measurement:
        body = self.body
        _, angular = body.velocity()
        world_from_hex = body.world_from_hex()
        to_hex = world_from_hex.rotation.T
        self._readings += 1
        self._senses.torque_offset = self._breakage.torque_offset(self.t)
        return self._senses.measure(
            body.joints,
            body.motors,
            stiffness=self.trial.truth.joint_stiffness,
            world_from_hex=world_from_hex,
            rates_in_hex=to_hex @ angular,
            acceleration_in_hex=to_hex @ np.array([0.0, 0.0, GRAVITY]),
            t=self.t,
            index=self._readings,
        )

    def _begin_control(self) -> None:
        """What the executive makes of what it feels: how the motors go until the next control tick."""
        measured = self._sense()
        sensed = Sensed(joints=measured.joints, torques=measured.torques, attitude_rpy=measured.attitude_rpy)
        before, state = self.executive.setpoint, self.executive.state
        events = [] if self._breakage.dark(self.t) else self.executive.tick(sensed)
        rates = np.maximum(np.abs(self.executive.setpoint - before) / CONTROL_PERIOD, 1e-3)
        self._control = _Control(
            commands=self.executive.setpoint - self.trial.encoder_zero,
            rates=np.minimum(rates, self.spec.speed_unloaded),
            events=events,
            changed=state != self.executive.state,
        )

    def _physics_tick(self) -> list[Message]:
        """One tick of physics; at the end of a control period what there is to send down."""
        control = self._control
        self.body.step(control.commands, control.rates, self.executive.wheel_rates if self.executive.rolling else None)
        fraction = np.abs(self.body.torques()) / self.spec.torque_limits
        self._torque_fraction += (fraction - self._torque_fraction) * (TICK / TORQUE_FILTER)
        self.t += TICK
        self._ticks = (self._ticks + 1) % TICKS_PER_CONTROL
        return [] if self._ticks else self._end_control(control)

    def _end_control(self, control: _Control) -> list[Message]:
        self.peak_torque_fraction = max(self.peak_torque_fraction, float(self._torque_fraction.max()))
        self._rest = not self.executive.busy and settled(self.body)
        self._controls += 1
        self._look_for_collisions(strikes=self._controls % CONTROLS_PER_CHECK == 0)
        if self.t - self._last_track >= TRACK_PERIOD:
            self._record_track()
        made = self._tell(control.events)
        changed = control.changed or any(
            e.kind == "fault" or (e.kind == "receipt" and e.command_index < 0) for e in control.events
        )
        if changed or (self.executive.busy and self.t - self._last_telemetry >= TELEMETRY_PERIOD):
            made.append(self._telemetry())
        return made

    def _deaf(self) -> bool:
        return self._breakage.dark(self.t)

    def _capture(self, request: ImageRequest) -> list[Message]:
        if self._eyes is None:
            from athlete_twin.sensors.renderer import Renderer
            from athlete_twin.sensors.stereo_camera import StereoRig

            renderer = Renderer(self.terrain, visual_parts(self.spec))
            self._eyes = StereoRig(self.spec, renderer, seed=self.seed, camera_error=self.trial.camera_error)
        state = self._telemetry()
        shots = self._eyes.capture(
            request.cameras,
            request.binning,
            self.body.link_poses(),
            world_from_hex=self.body.world_from_hex(),
            index=self._captures,
            bits=request.bits,
            brackets=request.brackets,
        )
        self._captures += 1
        if self.on_view is not None:
            for name, bracket in shots.items():
                self.on_view(bracket[0].truth(camera=name, t=self.t, wheels_in_world=self.body.axles.copy()))
        return [
            StereoPair(
                seq=self._next("stereo_pair"), robot_id=self.robot_id, t=self.t, camera=name, binning=request.binning,
                left=self._seen(name, shot.left), right=self._seen(name, shot.right), exposure=shot.exposure, state=state,
                bits=request.bits, bracket=number,
            )
            for name, bracket in shots.items()
            for number, shot in enumerate(bracket)
        ]  # fmt: skip

    def _seen(self, camera: str, image: RawImage) -> RawImage:
        return np.zeros_like(image) if camera in self._breakage.dead_cameras else image

    def _telemetry(self) -> Telemetry:
        self._last_telemetry = self.t
        return Telemetry(
            seq=self._next("telemetry"),
            robot_id=self.robot_id,
            t=self.t,
            executive_state=self.executive.told_state,
            sequence_id=self.executive.sequence_id,
            command_index=self.executive.command_index,
            **self._sense().fields(),
        )

    def _record_track(self) -> None:
        self._last_track = self.t
        self.track.append(
            TrackPoint(
                t=self.t,
                world_from_hex=self.body.world_from_hex(),
                joints=self.body.joints.copy(),
                docks=self.body.dock_angles.copy(),
            )
        )

    def _look_for_collisions(self, *, strikes: bool) -> None:
        """Hulls on ground or robot, and if asked wheels driven into the ground."""
        found = [(c.part, c.other, c.place_in_world, c.force, c.force > 0.0) for c in self.body.hull_contacts()]
        if strikes:
            found += self._strikes()
        for part, other, place, force, begins in found:
            pair = (part, other)
            goes_on = self.t - self._touching.get(pair, -np.inf) <= EPISODE_GAP
            if begins and not goes_on:
                self.collisions.append(Collision(t=self.t, part=part, other=other, place_in_world=place, force=force))
            if begins or goes_on:
                self._touching[pair] = self.t

    def _strikes(self) -> list[tuple[str, str, Vec3, float, bool]]:
        rolling = self.executive.rolling
        depths, places = self.body.hull_depths(standing=rolling)
        return [
            (f"wheel{leg + 1}", "ground", places[leg], float(self.body.tyre.loads[leg]), True)
            for leg, phase in enumerate(self.executive.phases)
            if (rolling or phase == "swing") and depths[leg] > STRIKE_DEPTH
        ]
