"""Small offline agents and datasets in memory for tests, and the names of the algorithms that train on rewards, and of those without."""

from cudc_bench import plugins
from cudc_bench.evaluators.contract import SMALL, batch_for, labelled_for, make, random_walker_data
from cudc_bench.evaluators.zero_shot import ZeroShotLearner

ZERO_SHOT = [name for name in plugins.names("evaluators") if issubclass(plugins.load("evaluators", name), ZeroShotLearner)]
LABELLED = [name for name in plugins.names("evaluators") if name not in ZERO_SHOT]

__all__ = ["LABELLED", "SMALL", "ZERO_SHOT", "batch_for", "labelled_for", "make", "random_walker_data"]
