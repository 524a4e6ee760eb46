"""Small offline agents and datasets in memory for tests."""

from cudc_bench.evaluators.contract import SMALL, batch_for, make, random_walker_data

__all__ = ["SMALL", "batch_for", "make", "random_walker_data"]
