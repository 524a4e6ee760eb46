"""Datasets of others, brought in as if they had been collected here, and mixtures of datasets."""
