"""What is known of methods by their names: order, colours and lines, names that stand for one setting, and the names of losses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

# In tables and figures: the paper's as there, then our others by their categories; all else follows by name.
METHOD_ORDER = (
    "random", "icm", "apt", "proto", "aps", "cudc",
    "ctec", "disagreement", "rnd",
    "be",
    "cic", "diayn", "metra", "moss", "smm",
)  # fmt: skip
BASELINES = ("icm", "apt", "cudc")  # of studies: methods that main tables have, too
LEARNER_ORDER = ("td3", "cql")  # of offline algorithms: the paper's
# Of CUDC's diagnostics.
LOSSES = {"loss_forward": "forward", "loss_inverse": "inverse", "loss_step": "step", "loss_reach": "contrastive"}
# Two names of one class: whatever was collected under the first can stand wherever the second is asked for, and the other way round.
ALIASES = {"cudc-kmax6": "cudc", "cudc-stopgrad": "cudc", "cudc-no-regularize": "cudc-reach", "cudc-no-vary": "cudc-kmax3"}

# From Okabe and Ito's palette, which colour-blind people can tell apart; a method has the same colour in every figure.
COLOURS = {
    "random": "#7F7F7F", "icm": "#56B4E9", "apt": "#009E73", "proto": "#CC79A7", "aps": "#E69F00", "cudc": "#D55E00",
}  # fmt: skip
_OTHER_COLOURS = ("#0072B2", "#000000", "#8C6D1F", "#882255", "#117733", "#7B5FD0")
DASHES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (6.0, 1.5, 1.0, 1.5, 1.0, 1.5)))
_LIGHT, _OWN, _DIM, _DARK, _RED = "#F4B183", COLOURS["cudc"], "#9A4400", "#4A1C00", "#A11D33"
# CUDC's relatives have its hue, lighter or darker, or that of the method that they start from; dashes tell apart those of one colour.
_STYLED: dict[str, tuple[str, Any]] = {
    name: (colour, dashes)
    for colour, names in (
        # Later ones are solid, in the colour of a relative.
        (_OTHER_COLOURS[0], ("ctec",)),
        (_OTHER_COLOURS[1], ("moss",)),
        (_OTHER_COLOURS[2], ("metra",)),
        *((colour, ("", name)) for colour, name in zip(_OTHER_COLOURS, ("be", "cic", "diayn", "disagreement", "rnd", "smm"), strict=True)),
        (COLOURS["icm"], ("", "cudc-vary-icm")),
        (COLOURS["apt"], ("", "cudc-vary-apt", "apt-k6", "apt-ksched")),
        (_LIGHT, ("cudc-kmax3", "cudc-kmax4", "cudc-no-regularize", "cudc-no-reach", "cudc-uniform-k")),
        (_OWN, ("", "cudc-kmax5", "cudc-reward", "cudc-one-setting", "cudc-kmax6")),
        (_RED, ("cudc-live", "cudc-stopgrad", "cudc-momentum")),
        (_DIM, ("cudc-no-entropy", "cudc-no-inverse", "cudc-no-pe", "cudc-reach", "cudc-kmix")),
        (_DARK, ("cudc-kmax8", "cudc-kmax7", "cudc-normal-k", "cudc-no-vary", "cudc-literal")),
    )
    for dashes, name in zip(DASHES, names, strict=False)
    if name
}

# Every colour that a method can have.
PALETTE = tuple(dict.fromkeys((*COLOURS.values(), *_OTHER_COLOURS, *(colour for colour, _ in _STYLED.values()))))


def canonical(method: str) -> str:
    """The one of a setting's names under which its results are compared."""
    return ALIASES.get(method, method)


def styles(methods: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Colour and line style of each method: fixed for this project's, in turn for others."""
    others = [method for method in methods if method not in COLOURS and method not in _STYLED]
    found: dict[str, dict[str, Any]] = {}
    for method in methods:
        if method in COLOURS:
            colour, dashes = COLOURS[method], DASHES[0]
        elif method in _STYLED:
            colour, dashes = _STYLED[method]
        else:
            turn, place = divmod(others.index(method), len(_OTHER_COLOURS))
            colour, dashes = _OTHER_COLOURS[place], DASHES[(turn + 2) % len(DASHES)]
        found[method] = {"color": colour, "linestyle": dashes}
    return found
