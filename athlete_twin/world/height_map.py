"""Measured height maps from files, as regular grids: .npy, .npz, 16-bit .png, ESRI ASCII .asc.

An array is addressed `[ix, iy]`, x first. In an image and in an .asc file the first row is the far side (largest y),
and columns run along x, as on a printed map.
"""

from __future__ import annotations

import zipfile
from pathlib import Path

import cv2
import numpy as np

from athlete_twin.errors import TerrainError
from athlete_twin.geometry.grid import HeightGrid

SUFFIXES = (".npy", ".npz", ".png", ".asc")
SMALLEST_MAP = 8
"""cells along either side; fewer are no map"""


def read_height_map(path: Path, *, cell: float | None, height_unit: float | None) -> HeightGrid:
    """The map with the centre of its first cell at (0, 0).

    Args:
        path: the file; its suffix decides how it is read.
        cell: edge of a cell [m]; needed unless the file carries it (.asc, or `cell` in an .npz).
        height_unit: metres per count, needed for a 16-bit image; 1.0 where heights are in metres.

    Raises:
        TerrainError: the file is missing or damaged, the heights are not a finite 2-D array, or the cell is not known.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise TerrainError(f"suffix {suffix!r} is not one of {', '.join(SUFFIXES)}")
    if not path.is_file():
        siblings = sorted(p.name for p in path.parent.glob("*") if p.suffix.lower() in SUFFIXES)
        raise TerrainError(f"no such file; height maps beside it: {', '.join(siblings) or 'none'}")
    try:
        if suffix == ".png":
            heights, own_cell = _read_png(path), None
        elif suffix == ".asc":
            heights, own_cell = _read_asc(path)
        else:
            heights, own_cell = _read_numpy(path)
    except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile) as e:
        raise TerrainError(f"the file cannot be read as {suffix}: {e}") from e
    cell = own_cell if cell is None else cell
    if cell is None:
        raise TerrainError("the file does not say how large a cell is; give map_cell [m] beside it")
    if suffix == ".png" and height_unit is None:
        raise TerrainError("an image does not say how high a count is; give height_unit [m] beside it, such as 0.001")
    heights = _checked(heights) * (1.0 if height_unit is None else height_unit)
    return HeightGrid(origin_x=0.0, origin_y=0.0, cell=float(cell), heights=heights)


def _checked(heights: np.ndarray) -> np.ndarray:
    if heights.ndim != 2 or min(heights.shape) < SMALLEST_MAP:
        raise TerrainError(
            f"heights have shape {heights.shape}; need a 2-D array, {SMALLEST_MAP} or more cells each way"
        )
    if not np.issubdtype(heights.dtype, np.number) or np.iscomplexobj(heights):
        raise TerrainError(f"heights have type {heights.dtype}; need real numbers")
    heights = heights.astype(float)
    bad = int(np.count_nonzero(~np.isfinite(heights)))
    if bad:
        raise TerrainError(
            f"{bad} of {heights.size} heights are NaN or infinite; every height must be finite: fill the gaps first"
        )
    return heights


def _read_numpy(path: Path) -> tuple[np.ndarray, float | None]:
    content = np.load(path, allow_pickle=False)
    if isinstance(content, np.ndarray):
        return content, None
    with content:
        if "heights" not in content.files:
            raise KeyError(f"array 'heights' is missing, the file holds {', '.join(content.files) or 'nothing'}")
        cell = float(content["cell"]) if "cell" in content.files else None
        return np.asarray(content["heights"]), cell


def _read_png(path: Path) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(path.read_bytes(), dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.dtype != np.uint16 or image.ndim != 2:
        found = "no image" if image is None else f"{image.dtype} of shape {image.shape}"
        raise ValueError(f"need one 16-bit channel, found {found}")
    return np.asarray(image[::-1].T)


def _read_asc(path: Path) -> tuple[np.ndarray, float]:
    header: dict[str, float] = {}
    rows: list[list[float]] = []
    for line in path.read_text().splitlines():
        words = line.split()
        if len(words) == 2 and words[0][0].isalpha() and words[0].lower() != "nan":
            header[words[0].lower()] = float(words[1])
        elif words:
            rows.append([float(w) for w in words])
    values = np.array([v for row in rows for v in row])
    shape = (int(header["nrows"]), int(header["ncols"]))
    if values.size != shape[0] * shape[1]:
        raise ValueError(f"header says {shape[0]} x {shape[1]} heights, the file holds {values.size}")
    values[values == header.get("nodata_value", np.nan)] = np.nan
    return values.reshape(shape)[::-1].T, header["cellsize"]
