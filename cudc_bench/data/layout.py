"""How a dataset lies in its files."""

from __future__ import annotations

MAIN_FILE = "main_data.hdf5"


def has_reset_row(name: str) -> bool:
    """Whether a field has one row more than the episode has steps."""
    return name == "observations" or name.startswith("infos/")
