"""What carries a collector through its run: commands, loop, storage, pilots."""
