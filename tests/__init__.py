"""The tests: a folder for each of the package's, and those of what goes through all of it: faults, documents, the whole chain."""

from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
