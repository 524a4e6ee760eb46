"""Figures: plain data in, drawings out."""
