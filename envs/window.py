"""A window on the screen for `render_mode="human"`, by Pygame as Gymnasium's own environments do it.

Pygame is optional and imported when an environment asks what it can show. Without a display SDL would draw where nobody
looks; that is refused, unless the driver "dummy" was asked for by name.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
from functools import cache
from typing import Any

import numpy as np

from athlete_twin.errors import ConfigError

UNSEEN = "offscreen"
"""SDL's driver of last resort"""


@cache
def problem() -> str:
    """Why no window can be opened on this machine; empty when one can."""
    if importlib.util.find_spec("pygame") is None:
        return "Pygame is not installed: pip install pygame, or take render_mode 'rgb_array'"
    pygame = _pygame()
    try:
        pygame.display.init()
        unseen = pygame.display.get_driver() == UNSEEN
    except pygame.error as e:
        return f"no display is found ({e}): render_mode 'rgb_array' needs none"
    pygame.display.quit()
    return "no display is found: render_mode 'rgb_array' needs none" if unseen else ""


class Window:
    """One window, opened with its first picture."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._screen: Any = None

    def show(self, picture: np.ndarray) -> None:
        """Red, green, blue, 8 bit, shape (h, w, 3)."""
        pygame = _pygame()
        if self._screen is None:
            if problem():
                raise ConfigError(f"render_mode 'human' opens no window here, {problem()}")
            pygame.display.init()
            self._screen = pygame.display.set_mode(picture.shape[1::-1])
            pygame.display.set_caption(self._title)
        self._screen.blit(pygame.surfarray.make_surface(picture.swapaxes(0, 1)), (0, 0))
        pygame.event.pump()
        pygame.display.flip()

    def close(self) -> None:
        """Gone from the screen."""
        if self._screen is not None:
            _pygame().display.quit()
            self._screen = None


def _pygame() -> Any:
    with contextlib.redirect_stdout(io.StringIO()):  # it greets
        import pygame
    return pygame
