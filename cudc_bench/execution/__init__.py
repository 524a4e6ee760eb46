"""How work is carried out: processes, locks, interruptions, checkpoints, progress and logs."""
