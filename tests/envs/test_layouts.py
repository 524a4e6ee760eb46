"""The names of observations and actions are those of dm_control's own parts, in its order."""

import numpy as np
import pytest
from dm_control import composer, suite

from cudc_bench.envs import DOMAINS, make_simulators
from cudc_bench.envs.jaco import _composer
from cudc_bench.envs.layouts import action_names, observation_layout


def theirs(domain):
    """dm_control's names and sizes."""
    if domain == "jaco":
        spec = composer.Environment(_composer()[0], time_limit=10).observation_spec()
    else:
        spec = suite.load(domain, "walk").observation_spec()
    return [(name, int(np.prod(part.shape))) for name, part in spec.items()]


@pytest.mark.parametrize("domain", DOMAINS)
def test_parts_are_dm_controls(domain):
    blocks = observation_layout(domain)
    assert [(block.name, len(block.elements)) for block in blocks] == theirs(domain)
    elements = [element for block in blocks for element in block.elements]
    assert len(set(elements)) == len(elements) == DOMAINS[domain].observation_size


@pytest.mark.parametrize("domain", DOMAINS)
def test_each_name_is_that_of_what_is_observed(domain):
    """Each joint and actuator is moved by itself; the numbers that bear its name must change, or show its velocity."""
    (simulator,) = make_simulators(domain, 1)
    model, _ = simulator.compiled
    elements = np.array([element for block in observation_layout(domain) for element in block.elements])
    simulator.reset(1)
    state = np.empty(DOMAINS[domain].physics_size)
    simulator.state(state)
    observation = np.empty(DOMAINS[domain].observation_size, np.float32)
    names = {"walker": "", "quadruped": ".velocity", "jaco": ".velocity"}
    for joint in range(model.njnt):
        name = model.joint(joint).name.rpartition("/")[2]
        if name == "root":
            continue
        changed = state.copy()
        changed[model.nq :] = 0.0
        changed[model.nq + model.jnt_dofadr[joint]] = 0.5
        simulator.set_state(changed)
        simulator.observe(observation)
        (row,) = np.flatnonzero(elements == name + names[domain])
        assert observation[row] == 0.5, name
        others = [i for i, element in enumerate(elements) if element != elements[row] and element.endswith(names[domain] or name)]
        assert not observation[others].any()
    for actuator in range(model.na):
        changed = state.copy()
        changed[model.nq + model.nv + actuator] = 0.25
        simulator.set_state(changed)
        simulator.observe(observation)
        assert observation[np.flatnonzero(elements == f"{action_names(domain)[actuator]}.activation")] == 0.25
    assert len(action_names(domain)) == DOMAINS[domain].action_size


@pytest.mark.parametrize(("domain", "seconds"), [("walker", 25.0), ("quadruped", 20.0), ("jaco", 10.0)])
def test_an_episode_takes_the_time_that_it_takes_in_dm_control(domain, seconds):
    (simulator,) = make_simulators(domain, 1)
    assert simulator.timestep * DOMAINS[domain].episode_length == pytest.approx(seconds)
