"""Everything that a command may need, for a process from which others are forked: see ``served``."""

import os
import sys

import matplotlib.figure  # noqa: F401
import minari.cli  # noqa: F401
import torch

import cudc_bench
from cudc_bench import plugins
from cudc_bench.cli import app

# Of "", where ``python -c`` started, packages would be looked for in whatever folder a command runs.
sys.path[:] = [os.path.abspath(place) for place in sys.path]

for kind in ("collectors", "evaluators", "relabelers", "commands"):
    for name in plugins.names(kind):
        plugins.load(kind, name)
for name in cudc_bench.__all__:
    getattr(cudc_bench, name)
app.build_app()
torch.set_num_threads(1)
