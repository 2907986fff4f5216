"""What stands on a film's frames: mission time, the step, what the robot does or what is awaited, and a bar of the whole trial."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import matplotlib as mpl
import numpy as np
from PIL import Image, ImageDraw, ImageFont
from report_style import BIN_COLOURS, LEG_COLOURS
from trial_recording import TrialRecording

PANEL = 54
"""height of the panel at the lower edge [px]"""
BAR = 6
"""height of the bar of the whole trial [px]"""
WAITS = {"link": "link", "ground": "ground", "operator": "operator"}


@dataclass(frozen=True, kw_only=True)
class State:
    """What a frame says."""

    t: float
    """mission time [s]"""
    moves: bool
    leg: int
    """index of the leg in the air, -1 for none"""
    step: int
    """number of the step, 0 before the first"""
    waited: dict[str, float] = field(default_factory=dict)
    """seconds of a pause by what was awaited"""
    ended: bool = False
    """whether the trial is over"""


class Captions:
    """Draws them for one trial."""

    def __init__(self, trial: TrialRecording, size: tuple[int, int]) -> None:
        fonts = Path(mpl.get_data_path()) / "fonts" / "ttf"
        self._large, self._small, self._bold = (
            ImageFont.truetype(str(fonts / name), points)
            for name, points in (("DejaVuSans-Bold.ttf", 21), ("DejaVuSans.ttf", 15), ("DejaVuSans-Bold.ttf", 15))
        )
        self._size = size
        title, scenario = trial.spec.title, trial.figures["scenario"]
        self._titles = (f"{title}, {scenario}, {trial.figures['link']['delay_s']:g} s of delay each way", f"{title}, {scenario}", "")
        """the longest that leaves room for what happens is shown"""
        self._end = max(float(trial.track.t[-1]), trial.spans[-1][2] if trial.spans else 0.0, 1e-9)
        self._bar = self._whole_bar(trial)
        f = trial.figures
        self._outcome = f"{f['outcome'].replace('_', ' ')}: {f['progress_m']:.2f} m of way, {f['steps_taken']} steps"

    def drawn(self, frame: np.ndarray, state: State) -> np.ndarray:
        """The frame (blue, green, red) with its captions, as a new array."""
        width, height = self._size
        out = frame.copy()
        panel = out[height - PANEL :]
        panel[:] = (0.28 * panel + 0.72 * np.array([30, 26, 22])).astype(np.uint8)
        out[height - BAR :] = (0.35 * self._bar).astype(np.uint8)
        done = int(width * min(state.t / self._end, 1.0))
        out[height - BAR :, :done] = self._bar[:, :done]
        image = Image.fromarray(out[..., ::-1])
        draw = ImageDraw.Draw(image)
        middle = height - (PANEL + BAR) // 2
        draw.text((18, middle), _clock(state.t), font=self._large, fill="white", anchor="lm")
        words, colour = self._words(state)
        left = 150
        draw.ellipse((left, middle - 7, left + 14, middle + 7), fill=colour)
        draw.text((left + 24, middle), words, font=self._bold, fill="white", anchor="lm")
        room = width - 18 - (left + 24) - self._bold.getlength(words) - 18
        shown = next(title for title in self._titles if not title or self._small.getlength(title) <= room)
        draw.text((width - 18, middle), shown, font=self._small, fill=(205, 209, 214), anchor="rm")
        return np.asarray(image)[..., ::-1].copy()

    def _words(self, state: State) -> tuple[str, str]:
        if state.ended:
            return self._outcome, "#ffffff"
        if not state.moves:
            parts = [f"{WAITS[name]} {seconds:.0f} s" for name, seconds in state.waited.items() if seconds >= 0.5]
            most = max(state.waited, key=lambda name: state.waited[name], default="link")
            return "waits for " + (", ".join(parts) or "link"), BIN_COLOURS[most]
        step = f"step {state.step}" if state.step else "looks around"
        if state.leg >= 0:
            return f"{step}: leg {state.leg + 1}", LEG_COLOURS[state.leg]
        return (f"{step}: all wheels down" if state.step else step), BIN_COLOURS["motion"]

    def _whole_bar(self, trial: TrialRecording) -> np.ndarray:
        """Parts of the mission time along the lower edge, shape (BAR, w, 3)."""
        width = self._size[0]
        bar = np.full((BAR, width, 3), 90, dtype=np.uint8)
        for name, begin, end in trial.spans:
            a, b = (int(width * t / self._end) for t in (begin, end))
            bar[:, a : max(b, a + 1)] = _bgr(BIN_COLOURS[name])
        return bar


def _bgr(colour: str) -> tuple[int, int, int]:
    return int(colour[5:7], 16), int(colour[3:5], 16), int(colour[1:3], 16)


def _clock(seconds: float) -> str:
    hours, rest = divmod(int(seconds), 3600)
    return f"{hours}:{rest // 60:02d}:{rest % 60:02d}" if hours else f"{rest // 60:02d}:{rest % 60:02d} min"
