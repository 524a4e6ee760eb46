"""Hyperparameters and seeds: how they are declared, read, checked and put together into profiles."""
