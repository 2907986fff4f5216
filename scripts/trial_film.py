"""A trial seen from outside: the true motion on the true terrain, faster, without the waiting.

    python scripts/trial_film.py results/trial

Writes `film.webm` (VP8, plays in a browser) into a trial's folder, from `trial.json` and `trial.mcap` alone. Where the
robot stands still only a caption says for how long and what was awaited. Exit status 0 when it was written, 2 and one
line when the folder holds no trial.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from film_captions import PANEL, Captions, State
from trial_recording import TrialRecording, load_recording

from athlete_twin.errors import AthleteError, RecordingError
from athlete_twin.model.camera import Pinhole
from athlete_twin.sensors.onlooker import FIELD_OF_VIEW, Canvas, Posture, looking, stand_point
from athlete_twin.world.terrain import Terrain, bare_terrain

SIZE = (960, 540)
FRAME_RATE = 12.0
"""[1/s]"""
SPEED = 24.0
"""mission seconds that pass in a second of film while the robot moves, if that is not too many frames"""
MOST_FRAMES = 250
"""drawn: a longer walk is shown faster, not longer"""
PAUSE_GAP = 3.0
"""without a sample of the motion so long, the robot waited [s]"""
PAUSE_FRAMES, LAST_FRAMES = 3, 24
"""for which a caption stands"""
FOLLOW = 0.06
"""share of the way to the robot that the window slides in a frame"""
LOOK_AT = 0.42
"""height in the robot that the window is centred on, as a share of the chassis' height"""


@dataclass(frozen=True, kw_only=True)
class Shot:
    """One frame: a place in the track, and whether the robot moves there."""

    index: int
    """into the track"""
    state: State


@dataclass(frozen=True, kw_only=True)
class Options:
    """Films a recorded trial."""

    folder: tyro.conf.Positional[Path]
    """a trial's folder"""
    speed: float = SPEED
    """mission seconds in a second of film"""
    most_frames: int = MOST_FRAMES
    """drawn; a longer walk is shown faster"""


def write_film(out_dir: Path, *, speed: float = SPEED, most_frames: int = MOST_FRAMES) -> Path:
    """Writes `film.webm` into a trial's folder; its path."""
    from rich.progress import track

    trial = load_recording(out_dir)
    shots = storyboard(trial, speed=speed, most_frames=most_frames)
    path = out_dir / "film.webm"
    part = out_dir / "film.part.webm"
    writer = _writer(part)
    try:
        for frame in track(frames(trial, shots), total=len(shots), description="film", transient=True):
            writer.write(frame)
    finally:
        writer.release()
    part.replace(path)
    return path


def frames(trial: TrialRecording, shots: list[Shot]) -> Iterator[np.ndarray]:
    """The film's frames: blue, green, red, 8 bit."""
    terrain = trial.terrain() or bare_ground(trial)
    posture = Posture(trial.spec)
    track = trial.track
    path = track.places * [1.0, 1.0, LOOK_AT]
    world_from_camera = looking(stand_point(terrain, trial.spec, _middle(path)), _middle(path))
    frame_eye = Pinhole.from_fov(*SIZE, FIELD_OF_VIEW)
    corners = _windows(frame_eye.project(world_from_camera.inverse().apply(path))[0], [s.index for s in shots])
    left_top = corners.min(axis=0)
    width, height = corners.max(axis=0) - left_top + SIZE
    whole = Pinhole(
        width_px=int(width),
        height_px=int(height),
        focal_px=frame_eye.focal_px,
        cx_px=frame_eye.cx_px - float(left_top[0]),
        cy_px=frame_eye.cy_px - float(left_top[1]),
    )
    canvas = Canvas(terrain, trial.spec, world_from_camera, whole)
    captions = Captions(trial, SIZE)
    for shot, (u, v) in zip(shots, corners - left_top, strict=True):
        canvas.show(posture.link_poses(track.world_from_hex[shot.index], track.joints[shot.index], track.docks[shot.index]))
        yield captions.drawn(canvas.picture[v : v + SIZE[1], u : u + SIZE[0]], shot.state)


def storyboard(trial: TrialRecording, *, speed: float = SPEED, most_frames: int = MOST_FRAMES) -> list[Shot]:
    """Which samples of the track are shown, with what is said beside them."""
    t = trial.track.t
    moving = float(np.sum(np.diff(t)[np.diff(t) < PAUSE_GAP]))
    step = max(speed / FRAME_RATE, moving / max(most_frames, 1))
    shots, due = [], -np.inf
    for k, now in enumerate(t):
        last = k + 1 == len(t)
        pause = 0.0 if last else float(t[k + 1] - now)
        if now < due and pause < PAUSE_GAP and not last:
            continue
        due = max(due + step, now + 0.5 * step) if np.isfinite(due) else now + step
        state = State(t=float(now), moves=True, leg=_leg(trial, float(now)), step=_step(trial, float(now)), waited={})
        shots.append(Shot(index=k, state=state))
        if pause >= PAUSE_GAP:
            waited = _spent(trial, float(now), float(t[k + 1]))
            resting = replace(state, t=float(t[k + 1]), moves=False, leg=-1, waited=waited)
            shots += [Shot(index=k, state=resting)] * PAUSE_FRAMES
            due = -np.inf
    shots += [replace(shots[-1], state=replace(shots[-1].state, moves=False, leg=-1, ended=True))] * LAST_FRAMES
    return shots


def bare_ground(trial: TrialRecording) -> Terrain:
    """The recorded surface with plain looks: the trial ran where no scenario's ground lies, as the mock does."""
    from athlete_twin.world.scenario import load_scenario

    return bare_terrain(load_scenario("calibration_yard"), trial.surface)


def _writer(path: Path) -> Any:
    import cv2

    # OpenCV tells standard error that WebM keeps VP8 under another tag, which is so and does no harm.
    kept = os.dup(2)
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 2)
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"VP80"), FRAME_RATE, SIZE)
    finally:
        os.dup2(kept, 2)
        os.close(null)
        os.close(kept)
    if not writer.isOpened():
        raise RecordingError(f"{path}: OpenCV cannot write VP8 there; a folder you may write to would have worked")
    return writer


def _windows(pixels: np.ndarray, indices: list[int]) -> np.ndarray:
    """Left upper corner of each frame's window on the picture plane: it slides after the robot, shape (n, 2)."""
    # The robot stands clear of the captions.
    offset = 0.5 * (np.array(SIZE) - 1 - [0, PANEL])
    centre = pixels[indices[0]].copy()
    out = []
    for k in indices:
        centre += FOLLOW * (pixels[k] - centre)
        out.append(np.rint(centre - offset))
    return np.array(out, dtype=int)


def _middle(path: np.ndarray) -> np.ndarray:
    return 0.5 * np.asarray(path.min(axis=0) + path.max(axis=0))


def _leg(trial: TrialRecording, t: float) -> int:
    """Index of the leg in the air, -1 for none."""
    k = int(np.searchsorted(trial.states.t, t, side="right")) - 1
    phases = trial.states.phases[max(k, 0)]
    return next((leg for leg, phase in enumerate(phases) if phase != "stance"), -1)


def _step(trial: TrialRecording, t: float) -> int:
    """Number of the step under way or last done, 0 before the first."""
    return sum(p.kind == "step" and p.decision == "approve" and p.decided <= t for p in trial.proposals)


def _spent(trial: TrialRecording, begin: float, end: float) -> dict[str, float]:
    """Seconds of a pause by what was awaited."""
    out: dict[str, float] = {}
    for name, a, b in trial.spans:
        seconds = min(b, end) - max(a, begin)
        if name != "motion" and seconds > 0.0:
            out[name] = out.get(name, 0.0) + seconds
    return out


def main(arguments: list[str] | None = None) -> int:
    """Runs the script; the exit status."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    try:
        path = write_film(options.folder, speed=options.speed, most_frames=options.most_frames)
    except AthleteError as e:
        sys.stderr.write(f"trial_film: {' '.join(str(e).split())}\n")
        return 2
    sys.stdout.write(f"written: {path}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
