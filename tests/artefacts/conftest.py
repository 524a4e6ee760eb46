"""Small datasets to name and describe."""

from tests.data.conftest import make_dataset, make_episodes

__all__ = ["make_dataset", "make_episodes"]
