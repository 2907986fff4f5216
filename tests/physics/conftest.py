from collections.abc import Callable, Iterator

import numpy as np
import pytest

from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import regular_stance
from athlete_twin.physics.body import Body
from athlete_twin.physics.truth import nominal_truth
from athlete_twin.physics.tyre import Footing
from athlete_twin.world.bullet_world import TICK, BulletWorld

MakeBody = Callable[..., Body]


def flat(size: float = 12.0, cell: float = 0.05) -> HeightGrid:
    n = int(size / cell) + 1
    return HeightGrid(origin_x=-0.5 * size, origin_y=-0.5 * size, cell=cell, heights=np.zeros((n, n)))


@pytest.fixture
def make_body() -> Iterator[MakeBody]:
    """Builds a robot of nominal truth in its regular stance; its worlds are closed afterwards."""
    worlds: list[BulletWorld] = []

    def make(
        robot: str,
        *,
        ground: HeightGrid | None = None,
        foot_radius: float | None = None,
        height: float | None = None,
        tick: float = TICK,
    ) -> Body:
        spec = load_spec(robot)
        world = BulletWorld(flat() if ground is None else ground, tick=tick)
        worlds.append(world)
        body = Body(world, spec, nominal_truth(spec), footing=Footing.hard(0.7))
        joints = regular_stance(spec, foot_radius, height)
        chassis = spec.chassis_height if height is None else height
        body.place(SE3.from_translation(np.array([0.0, 0.0, chassis])), joints)
        return body

    yield make
    for world in worlds:
        world.close()
