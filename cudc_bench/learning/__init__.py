"""What learns: networks, optimisers, replay, captured updates, and the arithmetic that methods share."""
