"""What carries a learner through its run: commands, loops, arena, references."""
