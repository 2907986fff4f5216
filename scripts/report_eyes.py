"""Figure of one stereo pair on its way into the map: both pictures, the depth matched again, the robot cut out of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from report_style import MUTED, png, subplots
from trial_recording import TrialRecording

from athlete_twin.errors import AthleteError
from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import StereoPair
from athlete_twin.model.appearance import visual_parts
from athlete_twin.model.kinematics import Kinematics
from envs.build import variant_content
from envs.recording import recorded_downlinks
from planner.config import PlannerConfig, planner_config
from planner.perception.self_mask import MaskedDepth, remove_self
from planner.perception.stereo import DepthImage, match

CANDIDATES = 4
"""pairs looked at for one that shows something"""
WANTED_SHARE = 0.2
"""of the picture taken by the robot itself: legs in view, and ground too"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Seen:
    """A pair and what the ground made of it."""

    pair: StereoPair
    depth: DepthImage
    masked: MaskedDepth


def eyes_figure(trial: TrialRecording) -> bytes | None:
    """The pair that shows most, as figure; None of a trial without pictures."""
    seen = chosen_pair(trial)
    if seen is None:
        return None
    pair, depth = seen.pair, seen.depth
    figure, grid = subplots(2, 2, figsize=(10.5, 8.6))
    axes = grid.ravel()
    for ax, image, title in ((axes[0], pair.left, f"Left eye of {pair.camera} at {pair.t:.0f} s"), (axes[1], pair.right, "Right eye")):
        ax.imshow(image, cmap="gray", vmin=0, vmax=255)
        ax.set_title(title)
    known = depth.depth[np.isfinite(depth.depth)]
    near, far = np.percentile(known, [2, 98]) if len(known) else (0.5, 5.0)
    shown = axes[2].imshow(depth.depth, cmap="viridis_r", vmin=near, vmax=far)
    axes[2].set_title("Depth, matched by the ground")
    axes[2].set_facecolor("#d9dbde")
    bar = figure.colorbar(shown, ax=axes[2], location="bottom", shrink=0.7, pad=0.01, aspect=45)
    bar.set_label("distance along the boresight [m]; grey: no match", color=MUTED)
    bar.outline.set_visible(False)
    mask = seen.masked.mask
    overlay = np.repeat(depth.grey[..., None].astype(float) / 255.0, 3, axis=2)
    overlay[mask] = 0.45 * overlay[mask] + 0.55 * np.array([0.93, 0.27, 0.10])
    axes[3].imshow(np.clip(overlay, 0, 1))
    axes[3].set_title("Taken for the robot itself (red)")
    for ax in axes:
        ax.set_xticks([])
        ax.set_yticks([])
        for side in ax.spines.values():
            side.set_visible(False)
    return png(figure)


def chosen_pair(trial: TrialRecording) -> Seen | None:
    """Of some pairs of the trial's second half, the one that shows legs and ground."""
    config = _config(trial)
    pairs = [m for _, m in recorded_downlinks(trial.folder / "trial.mcap") if isinstance(m, StereoPair)]
    if config is None or not pairs:
        return None
    late = pairs[len(pairs) // 2 :]
    picked = late[:: max(1, len(late) // CANDIDATES)][:CANDIDATES]
    kin = Kinematics(trial.spec)
    seen = [looked_at(pair, kin, config) for pair in picked]
    return min(seen, key=lambda s: abs(float(s.masked.mask.mean()) - WANTED_SHARE))


def looked_at(pair: StereoPair, kin: Kinematics, config: PlannerConfig) -> Seen:
    """Depth and mask of a pair, from the drawings and the robot's state in the pair alone."""
    depth = match(pair, kin.spec.camera(pair.camera), config=config.stereo)
    roll, pitch = float(pair.state.attitude_rpy[0]), float(pair.state.attitude_rpy[1])
    up = SE3.from_rpy(roll, pitch, 0.0).rotation.T @ np.array([0.0, 0.0, 1.0])
    axles = kin.wheels_in_hex(pair.state.joints)
    # Pictures are taken with all wheels on the ground; one that hangs would only tilt the fitted ground a little.
    masked = remove_self(
        depth,
        config=config.self_mask,
        parts=visual_parts(kin.spec),
        hex_from_link=kin.link_poses(pair.state.joints),
        up_in_hex=up,
        ground_in_hex=axles - kin.spec.wheel.radius * up,
    )
    return Seen(pair=pair, depth=depth, masked=masked)


def _config(trial: TrialRecording) -> PlannerConfig | None:
    """The variant's configuration; None when its file is not at hand any more."""
    try:
        path, content = variant_content(trial.figures["variant"])
        return planner_config(content, trial.spec, name=path.stem)
    except AthleteError:
        return None
