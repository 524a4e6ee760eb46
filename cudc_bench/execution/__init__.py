"""How work is carried out: processes, locks, interruptions, checkpoints, progress and logs."""

from __future__ import annotations

# Here, where the command line finds them without what the modules need.
CHECKPOINT_EVERY = 60.0  # seconds between two checkpoints, unless somebody says otherwise
LOG_DIR = "runs"  # TensorBoard's own habit
