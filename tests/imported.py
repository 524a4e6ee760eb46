"""Everything that a command may need, for a process from which others are forked: see ``served``."""

import os
import sys

import matplotlib.figure  # noqa: F401
import minari.cli  # noqa: F401
import torch
import typer

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
# The command line is made of the same functions in every process: to make it takes longer than most of what it is asked.
command_line = typer.main.get_command(app.build_app())
app.build_app = lambda: command_line
torch.set_num_threads(1)
