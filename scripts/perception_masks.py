"""How well each method tells the robot from the terrain: rows for the perception benchmark, and pictures to look at.

Scenes are those of `perception_scenes`, taken at the binning of a trial. Targets are for `combined` as a trial uses it: the
mask in the picture, then the sieve in space (`self_clearance`). Side by side stand the four masks alone, in soft light, in hard
shadow and with saturation. [SunSpiral2012] s5.2 names the case in which its watershed failed: "the sharp contrast between
sunshine and shadow"; it has a row of its own.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from bench_table import Row, row
from perception_scenes import SUNS_DEG, Scene, SceneView, look, stand, taken

from athlete_twin.errors import ConfigError
from athlete_twin.model.appearance import visual_parts
from envs.mask_score import MaskCounts, beside_wheels, count_mask, judged_pixels
from planner.perception.self_clearance import SelfClearanceConfig, without_hanging_points
from planner.perception.self_mask import MaskedDepth, SelfMaskConfig, remove_self
from planner.perception.stereo import DepthImage, StereoConfig, match

METHODS = ("flatten", "kinematic", "watershed", "combined")
LIGHTS = {"soft light": ("soft", 35.0), "hard shadow": ("sun", 15.0), "saturation": ("saturated", 35.0)}
"""condition and the sun's elevation [deg]"""
BINNING = 2
"""as trials look"""
RECALL, LOST, LOST_NEAR = ">= 0.99", "<= 0.02", "<= 0.15"
ROCK_PIXELS = 40
"""judged, of a rock beside a wheel that a view shows"""
ROCK_SURVIVES = 0.5
"""share of those that must keep their depth"""
LIGHT_SCENES = 8
"""of so many scenes the first two are looked at in all lights"""
COLOURS = {"flatten": (60, 190, 255), "kinematic": (255, 160, 40), "watershed": (220, 90, 220), "combined": (40, 60, 255)}
TRUTH_COLOUR = (90, 230, 90)
"""blue, green, red"""


@dataclass(kw_only=True)
class Tally:
    """What one method did under one condition."""

    counts: MaskCounts = field(default_factory=MaskCounts)
    matched: int = 0
    """pixels with a depth"""
    pixels: int = 0
    rocks: int = 0
    """beside a wheel, shown by a view"""
    rocks_kept: int = 0

    def add(self, view: SceneView, depth: DepthImage, removed: np.ndarray) -> None:
        """Count one view."""
        scene = view.scene
        beside = beside_wheels(view.points_in_world, scene.wheels_in_world)
        raised = () if scene.raised is None else (scene.raised,)
        self.counts += count_mask(
            label=view.label, matched=depth.depth, removed=removed, beside=beside, leg=view.leg, raised=raised
        )
        self.matched += int(np.isfinite(depth.depth).sum())
        self.pixels += depth.depth.size
        judged = judged_pixels(view.label, depth.depth) & (view.label == 2)
        for rock in np.unique(view.rock[judged & beside]):
            shown = judged & (view.rock == rock)
            if rock >= 0 and np.count_nonzero(shown) >= ROCK_PIXELS:
                self.rocks += 1
                self.rocks_kept += int(np.mean(removed[shown]) <= 1.0 - ROCK_SURVIVES)


def rows(*, robots: tuple[str, ...] = ("sdm_b", "t12"), scenes: int = 20) -> list[Row]:
    """Rows of the benchmark: `combined` against its targets by sun, then the four methods by light.

    Args:
        robots: by name.
        scenes: seeds 0 to `scenes` - 1 of each.
    """
    if scenes < 1:
        raise ConfigError(f"{scenes} scenes measure nothing, 20 are the figure that is asked for")
    out = []
    for robot in robots:
        by_sun: dict[float, Tally] = defaultdict(Tally)
        by_light: dict[tuple[str, bool, str], Tally] = defaultdict(Tally)
        for seed in range(scenes):
            scene = stand(robot, seed)
            for sun_deg in SUNS_DEG:
                for view, depth in _views(scene, "sun", sun_deg, brackets=False):
                    masked = masked_by("combined", view, depth)
                    by_sun[sun_deg].add(view, depth, _removed(_sieved(view, masked), masked))
            if seed % LIGHT_SCENES in (0, 1):
                for light, (condition, sun_deg) in LIGHTS.items():
                    for brackets in (False, True):
                        for view, depth in _views(scene, condition, sun_deg, brackets=brackets):
                            for method in METHODS:
                                masked = masked_by(method, view, depth)
                                by_light[light, brackets, method].add(view, depth, _removed(masked.depth, masked))
        out += _target_rows(robot, by_sun) + _light_rows(robot, by_light)
    return out


def masked_by(method: str, view: SceneView, depth: DepthImage) -> MaskedDepth:
    """A method's mask of a view, from what the ground believes."""
    scene = view.scene
    return remove_self(
        depth, config=SelfMaskConfig(method=method), parts=visual_parts(scene.spec), hex_from_link=scene.hex_from_link,
        up_in_hex=scene.up_in_hex(), ground_in_hex=scene.ground_in_hex(),
    )  # fmt: skip


def pictures(out: Path, *, robots: tuple[str, ...] = ("sdm_b", "t12"), seed: int = 1) -> list[Path]:
    """One PNG a robot: four methods side by side, three suns below each other; the truth green, masks in colour."""
    out.mkdir(parents=True, exist_ok=True)
    made = []
    for robot in robots:
        scene, lines = stand(robot, seed), []
        for sun_deg in SUNS_DEG:
            view, depth = next(_views(scene, "sun", sun_deg, brackets=False))
            lines.append(np.hstack([_panel(view, masked_by(method, view, depth), method) for method in METHODS]))
        path = out / f"masks_{robot}.png"
        cv2.imwrite(str(path), np.vstack(lines))
        made.append(path)
    return made


def _views(scene: Scene, condition: str, sun_deg: float, *, brackets: bool) -> Iterator[tuple[SceneView, DepthImage]]:
    for seen in look(scene, sun_deg, condition, binning=BINNING):
        view = taken(scene, seen, sun_deg=sun_deg, condition=condition, brackets=brackets, binning=BINNING)
        yield view, match(view.pair, view.camera, config=StereoConfig())


def _sieved(view: SceneView, masked: MaskedDepth) -> DepthImage:
    scene = view.scene
    return without_hanging_points(
        masked.depth, scene.spec, scene.hex_from_link, up_in_hex=scene.up_in_hex(), ground_in_hex=scene.ground_in_hex(),
        config=SelfClearanceConfig(),
    )  # fmt: skip


def _removed(left: DepthImage, masked: MaskedDepth) -> np.ndarray:
    return np.asarray(~np.isfinite(left.depth) | masked.mask)


def _target_rows(robot: str, by_sun: dict[float, Tally]) -> list[Row]:
    out = []
    for sun_deg, tally in sorted(by_sun.items()):
        name, counts = f"{robot} combined, sun {sun_deg:.0f} deg", tally.counts
        kept = tally.rocks_kept / tally.rocks if tally.rocks else None
        out += [
            row(f"{name}: pixels of legs on the ground removed", counts.share("standing"), "1", target=RECALL),
            row(f"{name}: pixels of the raised leg removed", counts.share("raised"), "1", target=RECALL),
            row(f"{name}: terrain lost", counts.share("terrain"), "1", target=LOST),
            row(f"{name}: terrain lost within 0.4 m of a wheel", counts.share("near"), "1", target=LOST_NEAR),
            row(f"{name}: rocks beside a wheel that survive, of {tally.rocks}", kept, "1", target=">= 1.0"),
        ]
    return out


def _light_rows(robot: str, by_light: dict[tuple[str, bool, str], Tally]) -> list[Row]:
    out = []
    for (light, brackets, method), tally in by_light.items():
        counts, name = tally.counts, f"{robot} {method}, {light}, {'three exposures' if brackets else 'one exposure'}"
        if method == METHODS[0]:
            out.append(row(f"{name.replace(method, 'stereo')}: pixels with a depth", tally.matched / tally.pixels, "1"))
        out += [
            row(f"{name}: pixels of legs on the ground removed", counts.share("standing"), "1"),
            row(f"{name}: pixels of the raised leg removed", counts.share("raised"), "1"),
            row(f"{name}: terrain lost within 0.4 m of a wheel", counts.share("near"), "1"),
        ]
        if (light, brackets, method) == ("hard shadow", False, "watershed"):
            ours, theirs = (_legs(by_light[light, brackets, m].counts) for m in ("combined", method))
            failed = f"{robot} the paper's failure, watershed between sunshine and shadow: pixels of all legs combined removes"
            out.append(row(failed, ours, "1", target=RECALL, peer_name="watershed", peer=theirs))
    return out


def _legs(counts: MaskCounts) -> float | None:
    """Share removed of the pixels of all legs."""
    whole = counts.standing + counts.raised
    return (counts.standing_removed + counts.raised_removed) / whole if whole else None


def _panel(view: SceneView, masked: MaskedDepth, method: str) -> np.ndarray:
    picture = cv2.cvtColor(view.pair.left, cv2.COLOR_GRAY2BGR)
    tint = picture.copy()
    tint[masked.mask] = COLOURS[method]
    picture = cv2.addWeighted(tint, 0.35, picture, 0.65, 0.0)
    for mask, colour in ((masked.mask, COLOURS[method]), (view.label == 3, TRUTH_COLOUR)):
        lines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(picture, lines, -1, colour, 1, cv2.LINE_AA)
    text = f"{method}, sun {view.sun_deg:.0f} deg"
    bottom = picture.shape[0]
    (width, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.55, 1)
    cv2.rectangle(picture, (0, bottom - 30), (width + 20, bottom), (30, 30, 30), cv2.FILLED)
    cv2.putText(picture, text, (10, bottom - 10), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (255, 255, 255), 1, cv2.LINE_AA)
    return np.asarray(picture)
