"""How each kind of figure is drawn."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from ...numbers import figures
from ...numbers.study import Study
from .comparisons import draw_estimates
from .drawing import figure_files
from .runs import draw_bars, draw_curves
from .studies import draw_bounds, draw_sizes

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw(figure: figures.Figure) -> Figure:
    """The drawing of some data."""
    match figure:
        case figures.Curves():
            return draw_curves(figure.runs)
        case figures.Bars():
            return draw_bars(figure.runs)
        case figures.Bounds():
            return draw_bounds(figure)
        case figures.Intervals():
            return draw_estimates(figure)
        case figures.Sizes():
            return draw_sizes(figure)


def study_figure_files(study: Study) -> dict[str, bytes]:
    """Each of a study's figures as ``<study>-<figure>.svg`` and ``.pdf``."""
    files: dict[str, bytes] = {}
    for name, figure in study.figures.items():
        files |= figure_files(f"{study.name}-{name}", partial(draw, figure))
    return files
