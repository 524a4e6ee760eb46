"""Trains d3rlpy's TD3+BC on a dataset of cudc-bench, and tries the policy in the environment that the dataset came from.

cudc-bench collect --method cudc && cudc-bench relabel walker/cudc-v0
pip install 'cudc-bench[d3rlpy]'
python examples/d3rlpy_td3bc.py walker/walk/cudc-v0 --steps 10000
"""

from __future__ import annotations

import argparse

import cudc_bench  # before d3rlpy, which loads MuJoCo: this tells it where there is no display

# isort: split
import d3rlpy  # type: ignore[import-not-found,import-untyped,unused-ignore]
import minari


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", nargs="?", default="walker/walk/cudc-v0", help="id of a dataset with rewards")
    parser.add_argument("--steps", type=int, default=10_000, help="gradient steps")
    parser.add_argument("--episodes", type=int, default=5, help="episodes that the policy is tried for")
    parser.add_argument("--device", default="cpu", help="as d3rlpy names it: cpu or cuda:0")
    arguments = parser.parse_args()

    d3rlpy.seed(1)
    dataset = cudc_bench.to_d3rlpy(arguments.dataset)
    print(f"{dataset.transition_count} transitions of {len(dataset.episodes)} episodes")

    algorithm = d3rlpy.algos.TD3PlusBCConfig(batch_size=256).create(device=arguments.device)
    algorithm.fit(
        dataset,
        n_steps=arguments.steps,
        n_steps_per_epoch=min(1000, arguments.steps),
        logger_adapter=d3rlpy.logging.NoopAdapterFactory(),  # writes no files
    )

    # Such as gymnasium.make("cudc_bench/walker-walk-v0").
    environment = minari.load_dataset(arguments.dataset).recover_environment()
    environment.reset(seed=1)  # the episodes after it follow from this seed, too
    evaluator = d3rlpy.metrics.EnvironmentEvaluator(environment, n_trials=arguments.episodes)
    print(f"mean return of {arguments.episodes} episodes in {environment.spec.id}: {evaluator(algorithm, dataset):.1f}")


if __name__ == "__main__":
    main()
