"""What a machine with a GPU and without a network needs, and what is tried on it."""
