"""What runs have in common: how the work of a command is carried out, and members that act in simulators and learn on the way."""
