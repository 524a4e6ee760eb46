"""The lists of wrong formulas fit the code: ``python -m tests.mutants`` can run, which takes minutes."""

from __future__ import annotations

import importlib
import pkgutil

import pytest

import tests.mutants
from cudc_bench import plugins
from tests.mutants.__main__ import ROOT, misplaced

LISTS = [module.name for module in pkgutil.iter_modules(tests.mutants.__path__) if module.name != "__main__"]


@pytest.mark.parametrize("name", LISTS)
def test_every_change_applies_to_the_code_as_it_is(name: str) -> None:
    module = importlib.import_module(f"tests.mutants.{name}")
    assert (ROOT / module.TESTS).exists()
    assert not [problem for mutant in module.MUTANTS if (problem := misplaced(mutant))]
    assert len(set(module.MUTANTS)) == len(module.MUTANTS)


@pytest.mark.parametrize("name", LISTS)
def test_all_that_must_notice_is_registered(name: str) -> None:
    module = importlib.import_module(f"tests.mutants.{name}")
    assert {one for mutant in module.MUTANTS for one in mutant.noticed_by} <= set(plugins.names(name))
