"""Data sets of others, brought in as if they had been collected here."""
