"""Builds what is generated in the assets: each robot's URDF and meshes, from its spec.toml.

`python scripts/build_assets.py` writes; with `--check` it only compares and leaves with status 1 when a committed file is
stale.
"""

from __future__ import annotations

import sys
from pathlib import Path

import tyro
from rich.console import Console

from athlete_twin.assets import robot_dir, robot_names
from athlete_twin.errors import AthleteError
from athlete_twin.model.generated import generated_files


def build(robot: str, *, check: bool) -> list[Path]:
    """Writes a robot's generated files, or only compares; returns those that differed."""
    folder = robot_dir(robot)
    fresh = {folder / name: text for name, text in generated_files(robot).items()}
    old = set((folder / "meshes").glob("*.obj"))
    changed = [p for p, text in fresh.items() if not p.is_file() or p.read_bytes() != text.encode()]
    stale = sorted(old - set(fresh))
    if not check:
        for path in changed:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(fresh[path].encode())
        for path in stale:
            path.unlink()
    return changed + stale


def main(robot: str | None = None, check: bool = False) -> int:
    """Builds the generated assets.

    Args:
        robot: one robot's name; all robots when not given.
        check: write nothing, exit with status 1 when a file is not what the drawings give.
    """
    console = Console(highlight=False)
    try:
        changed = [p for name in ([robot] if robot else robot_names()) for p in build(name, check=check)]
    except AthleteError as e:
        Console(stderr=True, highlight=False).print(f"build_assets: {e}")
        return 2
    for path in changed:
        console.print(f"{'stale' if check else 'built'} {path}")
    console.print(f"{len(changed)} file(s) {'stale' if check else 'changed'}")
    return 1 if check and changed else 0


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
