"""From stereo pairs to the fused map: the perception half of the ground agent, in data-flow order.

stereo pair (of a bracket, merged) -> depth -> depth without the robot's own legs -> aligned to each other and to the map
-> fused into it
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace

import numpy as np

from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import StereoPair, Telemetry
from athlete_twin.model.appearance import VisualPart, visual_parts
from athlete_twin.model.kinematics import Kinematics
from planner.belief import Belief
from planner.config import PlannerConfig
from planner.perception.bundle import MountCalibration, View
from planner.perception.exposure import merged
from planner.perception.icp import align_by_icp
from planner.perception.localise import Alignment, align_to_map
from planner.perception.pose_filter import PoseFilter
from planner.perception.quality import PairQuality, judge
from planner.perception.self_clearance import without_hanging_points
from planner.perception.self_mask import MaskedDepth, remove_self
from planner.perception.stereo import DepthImage, match
from planner.terrain.fusion import FusedTerrain, TerrainMap, points_in_world
from planner.terrain.ground_level import ground_over_contacts

StageTimer = Callable[[str], AbstractContextManager[None]]
UP = np.array([0.0, 0.0, 1.0])


def untimed(_stage: str) -> AbstractContextManager[None]:
    """A stage timer that measures nothing."""
    return nullcontext()


@dataclass(frozen=True, eq=False, kw_only=True)
class Look:
    """What one stereo pair gave."""

    camera: str
    t: float
    matched: DepthImage
    """with the robot in it"""
    masked: MaskedDepth
    world_from_camera: SE3
    """believed, after alignment"""
    alignment: Alignment | None
    """None where none was tried"""
    cells: int
    """of the map that it measured"""


class Eyes:
    """The map and how pictures get into it."""

    def __init__(self, kinematics: Kinematics, config: PlannerConfig, *, timer: StageTimer = untimed) -> None:
        self._kin, self._config, self._timer = kinematics, config, timer
        self._parts: tuple[VisualPart, ...] = ()
        self.map = TerrainMap.around(0.0, 0.0, config=config.fusion)
        self.mounts = MountCalibration(tuple(c.name for c in kinematics.spec.cameras), config=config.bundle)
        """of the cameras, learned from overlaps"""
        self.filter = PoseFilter(config=config.pose_filter)
        """of the chassis' error, for the localisation of that name"""
        self._moved = False
        self.looks: list[Look] = []
        """of the latest set of pictures"""
        self.on_look: Callable[[Look], None] | None = None
        """told of every look, for whoever keeps scores"""
        self.unusable: list[PairQuality] = []
        """pairs of the latest set that were left out, with the reasons"""

    def take(self, pairs: list[StereoPair], belief: Belief) -> SE3:
        """Fuse one set of pairs taken at the same time; the correction of the world that aligning them gave.

        The set is aligned as a whole, since its pairs share the chassis' pose: the points of all of them together are
        fitted to the map as it was before, then all are fused. Exposures of one camera and instant are merged first, and
        what a camera spoiled is left out: `unusable` has the reasons.
        """
        self.looks = []
        self.map.follow(float(belief.world_from_hex.translation[0]), float(belief.world_from_hex.translation[1]))
        pairs = self._merged(pairs)
        if not pairs:
            return SE3.identity()
        matched = [self._matched(pair) for pair in pairs]
        masked = [self._masked(pair, depth, belief) for pair, depth in zip(pairs, matched, strict=True)]
        with self._timer("bundle"):
            poses = self._poses(masked, belief)
        correction, alignment = SE3.identity(), None
        if self._config.localisation_method != "wheels":
            with self._timer("localise"):
                correction, alignment = self._located(masked, poses, pairs[0].state, belief)
        with self._timer("fuse"):
            for pair, full, depth, pose in zip(pairs, matched, masked, poses, strict=True):
                world_from_camera = correction.compose(pose)
                cells = self.map.fuse(depth.depth, world_from_camera)
                self.looks.append(
                    Look(
                        camera=pair.camera, t=pair.t, matched=full, masked=depth, world_from_camera=world_from_camera,
                        alignment=alignment, cells=cells,
                    )
                )
        if self.on_look is not None:
            for look in self.looks:
                self.on_look(look)
        return correction

    def touch(self, contacts: np.ndarray, *, t: float) -> None:
        """The ground under standing wheels is known by touch, shape (n, 3) [m], at mission time `t` [s]."""
        contacts = np.atleast_2d(contacts)
        self.map.set_known(contacts[:, :2], contacts[:, 2], radius=0.5 * self._kin.spec.wheel.width, variance=4e-4, t=t)

    def level(self, belief: Belief) -> float | None:
        """How much higher the ground beside the standing wheels was seen than their contacts are believed [m]; None: unseen."""
        return ground_over_contacts(self.map.fused(), belief.contacts_in_world[belief.planted])

    def forget(self, belief: Belief) -> None:
        """An empty map round the robot."""
        x, y = belief.world_from_hex.translation[:2]
        self.map = TerrainMap.around(float(x), float(y), config=self._config.fusion)

    def _merged(self, pairs: list[StereoPair]) -> list[StereoPair]:
        """One usable 8-bit pair a camera and instant, in the order in which they came."""
        self.unusable = []
        brackets: dict[tuple[str, float], list[StereoPair]] = {}
        for pair in pairs:
            brackets.setdefault((pair.camera, pair.t), []).append(pair)
        out = []
        with self._timer("exposure"):
            for exposures in brackets.values():
                verdicts = [judge(pair, self._kin.spec.camera(pair.camera)) for pair in exposures]
                self.unusable += [v for v in verdicts if not v.mendable]
                if any(v.usable for v in verdicts):
                    out.append(merged([p for p, v in zip(exposures, verdicts, strict=True) if v.mendable]))
                else:
                    self.unusable += [v for v in verdicts if v.mendable]
        return out

    def _matched(self, pair: StereoPair) -> DepthImage:
        camera = self._kin.spec.camera(pair.camera).riding(self._kin.link_poses(pair.state.joints))
        with self._timer("stereo"):
            return match(pair, camera, config=self._config.stereo)

    def _masked(self, pair: StereoPair, depth: DepthImage, belief: Belief) -> MaskedDepth:
        if not self._parts and self._config.self_mask.method in ("kinematic", "combined"):
            self._parts = visual_parts(self._kin.spec)
        hex_from_world = belief.world_from_hex.inverse()
        up, ground = hex_from_world.rotate(UP), hex_from_world.apply(belief.contacts_in_world[belief.planted])
        links = self._kin.link_poses(pair.state.joints)
        with self._timer("self_mask"):
            masked = remove_self(
                depth, config=self._config.self_mask, parts=self._parts, hex_from_link=links, up_in_hex=up, ground_in_hex=ground
            )
            clear = without_hanging_points(
                masked.depth, self._kin.spec, links, up_in_hex=up, ground_in_hex=ground, config=self._config.self_clearance
            )
        return replace(masked, depth=clear)

    def _poses(self, masked: list[MaskedDepth], belief: Belief) -> list[SE3]:
        """`world_from_camera` of a set's pictures, as their overlaps make it."""
        drawn = [belief.world_from_hex.compose(m.depth.camera.hex_from_camera) for m in masked]
        names = [m.depth.camera.name for m in masked]
        poses = [d.compose(self.mounts.correction(n)) for d, n in zip(drawn, names, strict=True)]
        if self._config.bundle.refine == "none":
            return drawn
        views = []
        for m, name, pose in zip(masked, names, poses, strict=True):
            points, sigma = points_in_world(m.depth, pose, config=self._config.fusion)
            views.append(View(camera=name, world_from_camera=pose, points_in_world=points, sigma_z=sigma))
        self.mounts.refine(views)
        return [d.compose(self.mounts.correction(n)) for d, n in zip(drawn, names, strict=True)]

    def _located(
        self, masked: list[MaskedDepth], poses: list[SE3], telemetry: Telemetry, belief: Belief
    ) -> tuple[SE3, Alignment | None]:
        """`world_from_believed` by the chosen method, and the alignment it rests on."""
        pose = belief.world_from_hex
        if self._config.localisation_method == "filter":
            if self._moved:
                self.filter.moved(
                    belief.contacts_in_world, pose.translation, planted=belief.planted, fit_rmse=belief.fit_rmse
                )
            self._moved = True
            self.filter.attitude(pose, telemetry.attitude_rpy)
        alignment = self._align(masked, poses, self.map.fused())
        if alignment is None:
            return SE3.identity(), None
        if self._config.localisation_method == "filter":
            return self.filter.aligned(alignment, pose.translation), alignment
        return alignment.correction, alignment

    def _align(self, masked: list[MaskedDepth], poses: list[SE3], before: FusedTerrain) -> Alignment | None:
        if before.unknown.all() or not masked:
            return None
        clouds = [
            points_in_world(m.depth, pose, config=self._config.fusion) for m, pose in zip(masked, poses, strict=True)
        ]
        points = np.concatenate([p for p, _ in clouds])
        sigma = np.concatenate([s for _, s in clouds])
        if len(points) == 0:
            return None
        align = align_by_icp if self._config.localisation_method == "icp" else align_to_map
        return align(points, before, sigma_z=sigma, config=self._config.align)
