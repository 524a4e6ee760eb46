"""Datasets themselves: what is in them, and how their collection went."""
