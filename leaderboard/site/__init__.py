"""The static site over a leaderboard: a function of its models, and of nothing else."""
