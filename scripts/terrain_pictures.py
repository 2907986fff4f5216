"""One robot on slopes and across an obstacle, seen from the side: stances planned, crossings as the twin walked them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from gait_figures import Gaits
from gait_pictures import BLUE, GREEN, ORANGE

from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.reach import all_legs_ik
from athlete_twin.model.spec import LEGS, RobotSpec
from planner.gait.limits import DECKS
from planner.gait.slope_stance import SlopeStance, stance_on
from planner.gait.stepping import Crossing

STAGES = 4
"""of a crossing that are drawn"""
ANGLE_DEG = 14.0
"""of the slope that is drawn [deg]"""
COLOURS = (ORANGE, BLUE, GREEN)
"""of legs, by how far ahead their hips are: front, middle, rear"""


def draw(gaits: Gaits, path: Path) -> Path:
    """The slope with the deck level and parallel, and stages of the last ledge. Returns the path."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(2, 3, figsize=(15, 5.6), constrained_layout=True)
    flat = axes.ravel()
    for axis, deck in zip(flat, DECKS, strict=False):
        found = stance_on(gaits.spec, np.deg2rad(ANGLE_DEG), stride=gaits.stride, deck=deck)
        axis.set_title(f"{ANGLE_DEG:g} deg, deck {deck}" + ("" if isinstance(found, SlopeStance) else ": no stance"))
        if isinstance(found, SlopeStance):
            _slope(axis, gaits.spec, found)
    if "ledge" in gaits.crossed:
        crossing, walked = gaits.crossed["ledge"]
        chosen: list[int] = [round(s * (len(walked.poses) - 1)) for s in np.linspace(0.0, 1.0, STAGES)] if walked.poses else []
        for axis, k in zip(flat[2:], chosen, strict=False):
            _ledge(axis, crossing, walked.poses[k], walked.joints[k])
            axis.set_title(f"{crossing.profile.name}, twin, after step {k + 1} of {len(crossing.steps)}")
    for axis in flat:
        if not axis.has_data():
            axis.set_axis_off()
            continue
        axis.set(xlabel="ahead [m]", ylabel="up [m]")
        middle = float(np.mean(axis.get_xlim()))
        axis.set_xlim(middle - 3.2, middle + 3.2)
        axis.set_aspect("equal")
        axis.grid(alpha=0.3)
    figure.suptitle(f"{gaits.spec.name}: front legs orange, middle blue, rear green")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)
    plt.close(figure)
    return path


def _slope(axis: Any, spec: RobotSpec, stance: SlopeStance) -> None:
    cycle, heading = stance.cycle, stance.heading
    joints, _ = all_legs_ik(spec, cycle.start[0] - cycle.chassis[0], last_link_in_hex=-cycle.footing.up)
    # Seen along the slope's contour: heading to the right, gravity down.
    back = np.arctan2(heading[1], heading[0])
    lean = np.arcsin(np.clip(cycle.footing.up[:2] @ heading, -1.0, 1.0))
    turn = SE3.from_rotvec(np.array([0.0, -lean, 0.0]), np.zeros(3)).compose(SE3.from_rotvec(np.array([0.0, 0.0, -back]), np.zeros(3)))
    _robot(axis, spec, SE3(rotation=turn.rotation, translation=turn.rotate(cycle.chassis[0])), joints)
    x = np.array([-3.2, 3.2])
    axis.plot(x, np.tan(stance.angle) * x, color="k", linewidth=1.0)


def _ledge(axis: Any, crossing: Crossing, pose: SE3, joints: np.ndarray) -> None:
    _robot(axis, crossing.spec, pose, joints)
    x = pose.translation[0] + np.linspace(-3.2, 3.2, 1601)
    axis.plot(x, crossing.profile.height(x), color="k", linewidth=1.0)


def _robot(axis: Any, spec: RobotSpec, world_from_hex: SE3, joints: np.ndarray) -> None:
    """Links as lines between their pivots, wheels as circles, the hips joined as the chassis."""
    from matplotlib.patches import Circle

    poses = kinematics(spec.name).link_poses(joints)
    hips = world_from_hex.apply(np.array(spec.hips_in_hex))
    ring = np.vstack([hips, hips[:1]])
    axis.plot(ring[:, 0], ring[:, 2], color="0.3", linewidth=3.0)
    ahead = np.argsort(-hips[:, 0])
    for leg in range(LEGS):
        rank = int(np.flatnonzero(ahead == leg)[0]) // 2
        names = [*(f"leg{leg + 1}_{name}" for name in spec.joint_names), f"wheel{leg + 1}"]
        points = world_from_hex.apply(np.array([poses[name].translation for name in names]))
        axis.plot(points[:, 0], points[:, 2], "o-", color=COLOURS[rank], linewidth=1.8, markersize=3)
        axis.add_patch(Circle((points[-1, 0], points[-1, 2]), spec.wheel.radius, fill=False, color=COLOURS[rank]))
