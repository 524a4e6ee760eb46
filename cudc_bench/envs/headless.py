"""MuJoCo and dm_control, whatever the variables about drawing say: only the process that draws needs OpenGL (see ``drawing.py``).

Both choose their OpenGL when they are first imported, and fail where ``MUJOCO_GL`` or ``PYOPENGL_PLATFORM`` name a kind that is not there.
"""

from __future__ import annotations

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

__all__ = ["mujoco"]
_VARIABLES = ("MUJOCO_GL", "PYOPENGL_PLATFORM")


def _load() -> Any:
    """Import both: with the OpenGL that was asked for if it is there, for whoever draws by themselves, and else with none."""
    before = {name: os.environ.get(name) for name in _VARIABLES}
    try:
        return _import_both()
    except (ImportError, AttributeError, RuntimeError, OSError):  # PyOpenGL has None for a library that it did not find
        os.environ.pop("PYOPENGL_PLATFORM", None)
        os.environ["MUJOCO_GL"] = "disabled"
        try:
            return _import_both()
        finally:
            for name in _VARIABLES:
                os.environ.pop(name, None)
            os.environ.update({name: value for name, value in before.items() if value is not None})


def _import_both() -> Any:
    found = import_module("mujoco")
    import_module("dm_control._render")
    return found


if TYPE_CHECKING:
    import mujoco as mujoco
else:
    mujoco = _load()
