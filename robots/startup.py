"""What every package here imports first, because afterwards it fails where nobody can tell why."""

from __future__ import annotations

import ctypes.util
import importlib.util
import os
import warnings
from pathlib import Path

_GL_LIBRARIES = {"osmesa": "OSMesa", "egl": "EGL"}
"""What MUJOCO_GL may ask for to the library that it needs."""
_PACKAGES = ("robots", "lowlevel", "highlevel", "tasks", "evaluation")
_HERE = Path(__file__).resolve().parents[1]


def require_own_packages() -> None:
    """Check that Python finds this project's packages and not others of the same names.

    Raises:
        ImportError: naming the other one.
    """
    for name in _PACKAGES:
        found = importlib.util.find_spec(name)
        places = [] if found is None else list(found.submodule_search_locations or [])
        if _HERE / name not in [Path(place).resolve() for place in places]:
            other = places[0] if places else None if found is None else found.origin
            raise ImportError(
                f"the package {name!r} that Python finds is {other}, not open-pilot's in {_HERE}: rename that one, or "
                "take its folder off the path that Python searches (PYTHONPATH, or the folder that you started from)"
            )


def do_without_missing_gl() -> None:
    """Let MuJoCo be imported where MUJOCO_GL asks for a library that is not there: only pictures need it."""
    wanted = os.environ.get("MUJOCO_GL", "").strip().lower()
    library = _GL_LIBRARIES.get(wanted)
    if library is not None and ctypes.util.find_library(library) is None:
        warnings.warn(f"MUJOCO_GL is {wanted}, but there is no {library} here: no pictures", stacklevel=2)
        os.environ["MUJOCO_GL"] = "disable"


require_own_packages()
do_without_missing_gl()
