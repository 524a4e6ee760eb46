"""Runs that act in simulators and learn on the way."""
