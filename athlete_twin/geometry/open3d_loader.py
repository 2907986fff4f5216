"""Open3D, imported late and with its system libraries explained.

Importing it takes 1.7 s, so nothing imports it at the top of a file. It links libusb, which the PyPI package
`libusb-package` ships: loading that one first makes a plain `pip install` enough. libGL and a few more must come from the
system; a slim container lacks them, and the error then names the Debian package instead of a linker's line.
"""

from __future__ import annotations

import ctypes
import importlib
import re
from functools import cache
from typing import Any

from athlete_twin.errors import MissingLibraryError

_DEBIAN_PACKAGES = {
    "libusb-1.0": "libusb-1.0-0",
    "libGL": "libgl1",
    "libEGL": "libegl1",
    "libX11": "libx11-6",
    "libudev": "libudev1",
    "libgomp": "libgomp1",
    "libstdc++": "libstdc++6",
    "libxcb": "libxcb1",
    "libc++abi": "libc++abi1",
    "libc++": "libc++1",
    "libtbb": "libtbb12",
}
_LIBRARY = re.compile(r"(lib[A-Za-z0-9_+.-]+?\.so[0-9.]*)\b")


@cache
def open3d() -> Any:
    """The module `open3d`."""
    try:
        _preload_libusb()
        return importlib.import_module("open3d")
    except (OSError, ImportError) as e:
        raise MissingLibraryError(explain(str(e))) from e


def explain(problem: str) -> str:
    """What to install, from the dynamic linker's or the importer's complaint."""
    found = _LIBRARY.search(problem)
    if found is None:
        return f"open3d cannot be imported ({problem}); pip install open3d-cpu libusb-package"
    library = found.group(1)
    stem = library.split(".so")[0]
    package = _DEBIAN_PACKAGES.get(stem)
    if package is None:
        return f"open3d needs the system library {library}; find its package with: apt-file search {library}"
    return f"open3d needs the system library {library}, in {package}: apt-get install {package}"


def _preload_libusb() -> None:
    libusb_package = importlib.import_module("libusb_package")
    ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
