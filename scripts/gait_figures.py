"""The rows of `bench_gait.py`: strides, sway, two legs at once, slopes, and cycles executed by the twin."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from bench_table import Row, row
from gait_yard import GaitYard, WalkedCycle

from athlete_twin.geometry.arrays import Vec2
from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.reach import all_legs_ik
from athlete_twin.model.spec import LEGS, load_spec
from athlete_twin.model.stance import stance_wheels_in_hex
from athlete_twin.model.statics import stance_loads
from planner.gait.cycle import CycleVerdict, GaitCycle, gait_cycle, judge_cycle
from planner.gait.limits import DECKS, Limit, longest_stride, steepest_slope
from planner.gait.slope_stance import NoSlopeStance, SlopeSearch, SlopeStance, stance_on, steepest_stance
from planner.gait.stepping import Crossing, Largest
from planner.gait.sway import ConstantPose, NoSway, SwayConfig, SwayGait, best_constant_pose, sway_gait
from planner.stability.rigid_stance import rigid_stances

AHEAD = np.array([1.0, 0.0])
PAIRS = ((0, 3), (1, 4), (2, 5))
"""opposite legs"""
HEADINGS_DEG = (0.0, 30.0, 60.0, 90.0)
REFERENCE = {"sdm_b": (0.6, 1.793, 1.75)}
"""stride, foot radius and chassis height by robot facts 12a; a robot without an entry walks as drawn [m]"""
SLOPES_DEG = (7.0, 14.0)
"""that SDM-B walked, [SunSpiral2012] s5.3.4 [deg]"""
WIDE = SlopeSearch(points=6)
"""for the steepest slope: its first grid is judged on many"""
SHORT = 0.1
"""a stride at which a robot barely walks, for limits of the stance [m]"""
MORE = ">= 0.2"
"""target of the sway's gain"""
COARSE = SwayConfig(points=5, resolution=0.02)
"""of the best constant pose: each place is a whole cycle"""


class Gaits:
    """What is planned of one robot's gait, found when first asked for, and what its twin made of it."""

    def __init__(self, robot: str) -> None:
        self.spec = load_spec(robot)
        drawn = (self.spec.stride, self.spec.foot_radius, self.spec.chassis_height)
        self.stride, self.foot_radius, self.height = REFERENCE.get(robot, drawn)
        self.walked: dict[str, WalkedCycle] = {}
        """executed cycles by name, once `twin` was asked for"""
        self.slopes_walked: dict[str, WalkedCycle] = {}
        """the same on slopes, once `slopes_twin` was asked for"""
        self.obstacles: tuple[str, ...] = ()
        """kinds that are stepped onto or over; all when empty"""
        self.largest_crossings: dict[str, Largest] = {}
        """by kind of obstacle, once planned"""
        self.crossed: dict[str, tuple[Crossing, Any]] = {}
        """by kind of obstacle, the last one executed and what became of it, once `steps_twin` was asked for"""

    @cached_property
    def wave(self) -> GaitCycle:
        """The reference: one leg after the other."""
        return self._cycle(None)

    @cached_property
    def pairs(self) -> GaitCycle:
        """Opposite legs together."""
        return self._cycle(PAIRS)

    @cached_property
    def sway_of_wave(self) -> SwayGait | NoSway:
        """The wave, the chassis displaced."""
        return sway_gait(self.wave)

    @cached_property
    def constant(self) -> ConstantPose | NoSway:
        """The best that height and foot radius alone can do."""
        return best_constant_pose(self.spec, AHEAD, stride=self.stride, config=COARSE)

    def verdicts(self) -> dict[str, CycleVerdict]:
        """The planned gaits, judged, by name."""
        out, sway = {"reference gait": judge_cycle(self.wave)}, self.sway_of_wave
        if isinstance(sway, SwayGait):
            out["sway gait"] = sway.sway
        return out | {"pairs of opposite legs": judge_cycle(self.pairs)}

    def strides(self) -> list[Row]:
        """The longest stride by heading."""
        out, name = [], self.spec.name
        for degrees in HEADINGS_DEG:
            for groups, how in ((None, "one leg at a time"), (PAIRS, "opposite legs together")):
                found = longest_stride(self.spec, _heading(degrees), groups=groups)
                out.append(row(f"{name}: longest stride, heading {degrees:g} deg, {how}; {_end(found)}", found.value, "m"))
        return out

    def sway(self) -> list[Row]:
        """Margin to saturation of sway, reference and best constant pose, and what two legs in the air ask."""
        name, reference = self.spec.name, judge_cycle(self.wave)
        out = [row(f"{name}: peak torque of the reference gait", 100.0 * reference.peak, "%")]
        found = self.sway_of_wave
        if isinstance(found, NoSway):
            return [*out, row(f"{name}: sway gait: no, {found.reason}", None, "%", target=MORE)]
        largest = float(np.linalg.norm(found.displacements, axis=1).max())
        out += [
            row(f"{name}: peak torque of the sway gait", 100.0 * found.sway.peak, "%"),
            row(f"{name}: margin to saturation gained by sway on the reference", found.gain, "share", target=MORE),
            row(f"{name}: largest displacement of the chassis", largest, "m"),
        ]
        best = self.constant
        if isinstance(best, NoSway):
            out.append(row(f"{name}: best constant pose: no, {best.reason}", None, "%"))
        else:
            pose = f"{best.chassis_height:.2f} m over feet at {best.foot_radius:.2f} m"
            own = found.sway.margin_to_saturation / best.verdict.margin_to_saturation - 1.0
            out.append(row(f"{name}: peak torque of the best constant pose, {pose}", 100.0 * best.verdict.peak, "%"))
            out.append(row(f"{name}: margin gained by sway from the reference's footfalls on that pose", own, "share"))
        return out + self._two_legs()

    def _two_legs(self) -> list[Row]:
        name, pairs = self.spec.name, judge_cycle(self.pairs)
        one, two = self.lifted((0,)), self.lifted((0, 3))
        asked = f"asked of the joints by the pairs' cycle ({pairs.refusal(self.spec) or 'it may be walked'})"
        return [
            row(f"{name}: peak torque, legs 1 and 4 in the air, over leg 1 alone (the paper: 43.43 and 50.28 %)", 100.0 * two, "%",
                peer_name="leg 1", peer=100.0 * one),
            row(f"{name}: peak torque {asked}, over the wave's", 100.0 * pairs.peak, "%", peer_name="wave",
                peer=100.0 * judge_cycle(self.wave).peak),
            row(f"{name}: least support margin while a pair swings", pairs.swing_margin, "m",
                target=f">= {self.spec.min_support_margin:g}"),
        ]  # fmt: skip

    def lifted(self, legs: tuple[int, ...]) -> float:
        """Peak torque over its limit with some legs straight up from the reference stance."""
        return float(rigid_stances(self.spec, self._raised(legs)[None], standing=~np.isin(np.arange(LEGS), legs)).peak[0])

    def loads(self, legs: tuple[int, ...]) -> np.ndarray:
        """Vertical forces on the wheels in that stance, shape (6,) [N]."""
        joints, _ = all_legs_ik(self.spec, self._raised(legs), last_link_in_hex=np.array([0.0, 0.0, -1.0]))
        return stance_loads(kinematics(self.spec.name), joints, supporting=~np.isin(np.arange(LEGS), legs))[0][:, 2]

    def _raised(self, legs: tuple[int, ...]) -> np.ndarray:
        axles = stance_wheels_in_hex(self.spec, self.foot_radius, self.height).copy()
        axles[list(legs), 2] += self.wave.lift
        return axles

    def _cycle(self, groups: tuple[tuple[int, ...], ...] | None) -> GaitCycle:
        return gait_cycle(
            self.spec, AHEAD, stride=self.stride, groups=groups, foot_radius=self.foot_radius, chassis_height=self.height
        )

    def slopes(self) -> list[Row]:
        """The steepest slope as drawn, on a regular circle of feet, and in the best stance; and the stances on the paper's slopes."""
        out, name = [], self.spec.name
        for deck in DECKS:
            for stride in (self.stride, SHORT):
                what = f"{name}: steepest slope, deck {deck}, stride {stride:g} m"
                drawn = steepest_slope(self.spec, AHEAD, stride=stride, deck=deck)
                out.append(row(f"{what}, stance as drawn; {_end(drawn)}", _deg(drawn), "deg"))
                best = steepest_stance(self.spec, stride=stride, deck=deck, search=WIDE)
                if isinstance(best, NoSlopeStance):
                    out.append(row(f"{what}: no, {best.reason}", None, "deg"))
                else:
                    out.append(row(f"{what}, best stance: {told(best)}", np.rad2deg(best.angle), "deg"))
            for degrees in SLOPES_DEG:
                found = stance_on(self.spec, np.deg2rad(degrees), stride=self.stride, deck=deck)
                what = f"{name}: peak torque on {degrees:g} deg, deck {deck}, stride {self.stride:g} m"
                if isinstance(found, NoSlopeStance):
                    out.append(row(f"{what}: no, {found.reason}", None, "%"))
                else:
                    out.append(row(f"{what}, {told(found)}", 100.0 * found.verdict.peak, "%"))
        return out

    def twin(self, seed: int) -> list[Row]:
        """The three gaits, walked."""
        name, sway = self.spec.name, self.sway_of_wave
        tried: list[tuple[str, GaitCycle, np.ndarray | None]]
        tried = [("reference gait", self.wave, None), ("pairs of opposite legs", self.pairs, None)]
        if isinstance(sway, SwayGait):
            tried.insert(1, ("sway gait", self.wave, sway.displacements))
        out: list[Row] = []
        for what, cycle, displacements in tried:
            yard = GaitYard(name, seed)
            try:
                self.walked[what] = done = yard.walk(cycle, displacements)
            finally:
                yard.close()
            planned = judge_cycle(cycle, displacements).peak
            ended = f", ended in {done.ended_by}" if done.ended_by else ""
            out.append(row(f"{name}: twin, peak torque of the {what}{ended}", 100.0 * done.peak, "%",
                           peer_name="planned", peer=100.0 * planned))  # fmt: skip
            out.append(row(f"{name}: twin, advance of the {what}", done.advance, "m", peer_name="planned", peer=self.stride))
        if "sway gait" in self.walked:
            pair = self.walked["sway gait"], self.walked["reference gait"]
            whole = not any(walked.ended_by for walked in pair)
            gain = (1.0 - pair[0].peak) / (1.0 - pair[1].peak) - 1.0 if whole and pair[1].peak < 1.0 else None
            out.append(row(f"{name}: twin, margin to saturation gained by sway on the reference", gain, "share", target=MORE))
        return out


def told(stance: SlopeStance) -> str:
    """Where feet and chassis are."""
    across, uphill, downhill, height = stance.lengths
    direction = np.rad2deg(np.arctan2(stance.heading[1], stance.heading[0]))
    return (
        f"feet {across:.2f} m across, {uphill:.2f} m uphill and {downhill:.2f} m downhill, chassis at {height:.2f} m, "
        f"uphill at {direction:.0f} deg of hex"
    )


def _heading(degrees: float) -> Vec2:
    return np.array([np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))])


def _end(found: Limit) -> str:
    return f"ended by: {found.ended_by}"


def _deg(found: Limit) -> float:
    return float(np.rad2deg(found.value))
