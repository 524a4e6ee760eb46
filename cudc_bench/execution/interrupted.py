"""What an interrupted run left, without loading it: how far it came, and what determines its result."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

RUN = "run.json"  # beside the checkpoints of a run


def progress(folder: Path) -> tuple[int, dict[str, Any]] | None:
    """How far the run came whose checkpoints lie in a folder, and what determines its result; None if there is nothing to continue."""
    there, files = run_there(folder), checkpoint_files(folder)
    return None if there is None or not files or not files[0].stem.isdecimal() else (int(files[0].stem), there)


def run_there(folder: Path) -> dict[str, Any] | None:
    """What determines the result of the run whose checkpoints lie in a folder, or None."""
    try:
        found = json.loads((folder / RUN).read_bytes())
    except (OSError, ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def checkpoint_files(folder: Path) -> list[Path]:
    """The checkpoints in a folder, newest first."""
    return sorted(folder.glob("*.pt"), reverse=True) if folder.is_dir() else []
