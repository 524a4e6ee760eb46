"""What the field's collectors start from, draw and refuse; their formulas are held in test_oracles.py."""

import math

import pytest
import torch

from cudc_bench.collectors.be import BE
from cudc_bench.collectors.contract import SPACES
from cudc_bench.learning.knn import neighbour_distances
from cudc_bench.learning.networks import MemberRandom
from cudc_bench.learning.running_mean_std import RunningMeanStd

from .helpers import batch_for, make


def test_an_ensembles_models_start_apart_within_the_default_bounds():
    models = make("disagreement", (1, 2), models=4).models
    first = next(models.parameters()).detach()
    assert first.shape[0] == 8
    assert len({tuple(row[0].tolist()) for row in first}) == 8
    bound = 30**-0.5  # inputs: 24 + 6
    assert first.abs().max() <= bound
    assert first.std().item() == pytest.approx(bound / math.sqrt(3), rel=0.05)
    assert list(models.parameters())[1].abs().max() > 0


def test_behavioural_entropy_is_apt_at_alpha_one():
    apt, be = make("apt"), make("be", alpha=1.0)
    batch = batch_for(apt)
    with torch.no_grad():
        torch.testing.assert_close(be.reward(batch), apt.reward(batch), atol=1e-5, rtol=1e-5)
    assert issubclass(BE, type(apt))


@pytest.mark.parametrize(("name", "settings"), [("apt", {}), ("aps", {}), ("cic", {}), ("moss", {}), ("be", {})])
def test_more_neighbours_than_a_minibatch_has_are_refused(name, settings):
    with pytest.raises(ValueError, match="40 neighbours cannot be found in a batch_size of 32"):
        make(name, neighbours=40, **settings)


def test_one_number_says_nothing_of_its_spread():
    moments = RunningMeanStd(2, "cpu")
    moments.add(torch.randn(2, 50))
    moments.add(torch.ones(2, 1))
    assert moments.variance.isfinite().all()


def test_neighbours_among_other_points():
    generator = torch.Generator().manual_seed(0)
    points, others = torch.randn(2, 20, 4, generator=generator) + 50, torch.randn(2, 30, 4, generator=generator) + 50
    found = neighbour_distances(points, 3, among=others).sort(-1).values
    expected = torch.cdist(points.double(), others.double()).sort(-1).values[..., :3]
    torch.testing.assert_close(found.double(), expected, atol=1e-4, rtol=1e-4)


def test_skills_are_drawn_from_each_members_own_stream():
    for name in ("diayn", "smm", "aps", "cic", "moss", "metra"):
        pair, alone = make(name, (5, 6)), make(name, (6,))
        for t in range(0, 200, 50):
            assert torch.equal(pair.next_skill(t)[1:], alone.next_skill(t))


def test_skills_are_one_hot_codes_points_of_a_sphere_or_of_a_cube():
    def draws(name):
        return torch.cat([make(name).sample_skills(MemberRandom([seed], "x"), 0) for seed in range(400)])

    for name, count in (("diayn", 16), ("smm", 4)):
        skills = draws(name)
        assert skills.shape == (400, count)
        assert (skills.sum(1) == 1).all()
        assert (skills.amax(1) == 1).all()
        assert (skills.sum(0) > 5).all()
    task_vectors, corners = draws("aps"), draws("cic")
    torch.testing.assert_close(task_vectors.norm(dim=1), torch.ones(400))
    assert task_vectors.mean(0).abs().max() < 4 / math.sqrt(400 * 10)  # four standard errors of a direction's mean
    assert 0 <= corners.min() < 0.01 < 0.99 < corners.max() < 1


def episode_of_skills(collector, length):
    return torch.stack([collector.next_skill(t)[0].clone() for t in range(length)])


@pytest.mark.parametrize("mode", ["half", "sign"])
@pytest.mark.parametrize(("domain", "length", "control"), [("walker", 1000, 500), ("jaco", 250, 200)])
def test_mosss_skills_say_whether_they_explore(mode, domain, length, control):
    """On Jaco the period of 166 steps ends within a skill, which lasts on."""
    skills = episode_of_skills(make("moss", sizes=SPACES[domain], skill_mode=mode, skill_dim=5), length)
    explores = skills[:, 0] > 0
    assert explores.tolist() == [t < control for t in range(length)]
    if mode == "sign":
        assert (skills[explores] > 0).all()
        assert (skills[~explores] < 0).all()
        assert skills.abs().max() <= 1
    else:
        assert (skills[explores, :3] > 0).all()
        assert not skills[explores, 3:].any()
        assert (skills[~explores, 2:] > 0).all()
        assert not skills[~explores, :2].any()
    assert len(skills.unique(dim=0)) == length // 50


def test_mosss_periods_fit_into_an_episode():
    quarters, whole = make("moss", periods=4.0), make("moss", periods=1.0)
    assert [quarters.controls_at(t) for t in (0, 249, 250, 499, 500, 750)] == [False, False, True, True, False, True]
    assert not any(whole.controls_at(t) for t in range(1000))
    with pytest.raises(ValueError, match="1001 periods do not fit into an episode of 1000 steps"):
        make("moss", periods=1001.0)


def test_metras_skills_last_an_episode_and_lie_on_a_sphere_or_are_one_hot_codes():
    metra, discrete = make("metra", skill_dim=3), make("metra", discrete=True, skill_dim=3)
    episodes = [torch.stack([metra.next_skill(t)[0].clone() for t in (0, 1, 50, 500, 999)]) for _ in range(20)]
    assert all((skills == skills[0]).all() for skills in episodes)
    drawn = torch.stack([skills[0] for skills in episodes])
    torch.testing.assert_close(drawn.norm(dim=1), torch.ones(20))
    assert len(drawn.unique(dim=0)) == 20
    codes = torch.stack([discrete.next_skill(0)[0].clone() for _ in range(60)])
    assert torch.equal(codes.sort(dim=1).values, torch.tensor([[0.0, 0.0, 1.0]]).expand(60, 3))
    assert (codes.sum(0) > 5).all()
