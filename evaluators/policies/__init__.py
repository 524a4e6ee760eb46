"""Trained policies after their training: kept, played, rendered and exported."""
