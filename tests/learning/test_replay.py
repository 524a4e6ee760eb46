"""k-step sampling: windows stay inside their episode, starts are uniform, members draw alone."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cudc_bench.learning.networks import MemberRandom
from cudc_bench.learning.replay import Episodes


def coded(lengths, seeds=(1,), sources=1, source_of_member=None):
    """Episodes whose numbers say where they come from: observation (source, episode, t), action (source, episode, t)."""
    episodes = Episodes(sources, len(lengths) + 2, sum(lengths) + 7, 3, 3, MemberRandom(seeds, "replay"), source_of_member)
    for source in range(sources):
        for index, length in enumerate(lengths):
            rows = torch.tensor([[source, index, t] for t in range(length + 1)], dtype=torch.float32)
            episodes.add(source, rows, rows[:-1])
    return episodes


@settings(max_examples=60, deadline=None)
@given(lengths=st.lists(st.integers(6, 12), min_size=1, max_size=5), horizon=st.integers(1, 6), seed=st.integers(0, 99))
def test_windows_never_leave_their_episode(lengths, horizon, seed):
    episodes = coded(lengths, seeds=(seed,))
    batch = episodes.sample(64, torch.tensor([horizon]))
    assert torch.equal(batch.observation, batch.action)
    assert torch.equal(batch.observation[..., :2], batch.next_observation[..., :2])
    assert torch.equal(batch.next_observation[..., 2] - batch.observation[..., 2], torch.full((1, 64), float(horizon)))
    limit = torch.tensor(lengths)[batch.observation[0, :, 1].long()]
    assert (batch.next_observation[0, :, 2] <= limit).all()
    assert batch.reward is None


@settings(max_examples=40, deadline=None)
@given(lengths=st.lists(st.integers(8, 12), min_size=1, max_size=4), horizons=st.tuples(*[st.integers(3, 8)] * 2), seed=st.integers(0, 99))
def test_second_ends_lie_on_the_way(lengths, horizons, seed):
    episodes = coded(lengths, seeds=(seed, seed + 1), source_of_member=[0, 0])
    batch = episodes.sample(64, torch.tensor(horizons), min_horizon=3)
    assert torch.equal(batch.nearer_observation[..., :2], batch.observation[..., :2])
    assert torch.equal(batch.nearer_observation[..., 2] - batch.observation[..., 2], batch.nearer_horizon.float())
    assert batch.nearer_horizon.min() >= 3
    for member, horizon in enumerate(horizons):
        assert batch.nearer_horizon[member].max() <= horizon


def test_second_ends_are_uniform_and_change_nothing_else():
    horizon = torch.tensor([6])
    batch = coded([20]).sample(40_000, horizon, min_horizon=3)
    share = torch.bincount(batch.nearer_horizon[0])[3:] / 40_000
    torch.testing.assert_close(share, torch.full((4,), 0.25), atol=0.01, rtol=0)
    plain = coded([20]).sample(40_000, horizon)
    assert torch.equal(plain.observation, batch.observation)
    assert torch.equal(plain.next_observation, batch.next_observation)
    assert plain.nearer_observation is plain.nearer_horizon is None


def test_episodes_then_starts_are_uniform_including_both_ends():
    episodes = coded([5, 10])
    batch = episodes.sample(60_000, torch.tensor([3]))
    where = batch.observation[0]
    for index, starts in ((0, 3), (1, 8)):
        own = where[where[:, 1] == index][:, 2].long()
        assert len(own) / 60_000 == pytest.approx(0.5, abs=0.01)
        share = torch.bincount(own, minlength=starts) / len(own)
        assert len(share) == starts
        torch.testing.assert_close(share, torch.full((starts,), 1 / starts), atol=0.01, rtol=0)


def test_only_finished_episodes_are_drawn():
    episodes = coded([6])
    assert episodes.episodes() == 1
    assert (episodes.sample(500, torch.tensor([1])).observation[..., 1] == 0).all()
    episodes.add(0, torch.full((7, 3), 9.0), torch.full((6, 3), 9.0))
    assert (episodes.sample(500, torch.tensor([1])).observation[..., 1] == 9).any()


def test_each_member_has_its_own_horizon_source_and_draws():
    together = coded([9, 11], seeds=(5, 6), sources=2)
    batch = together.sample(32, torch.tensor([1, 4]))
    steps = batch.next_observation[..., 2] - batch.observation[..., 2]
    assert (steps[0] == 1).all()
    assert (steps[1] == 4).all()
    assert (batch.observation[0, :, 0] == 0).all()
    assert (batch.observation[1, :, 0] == 1).all()
    alone = coded([9, 11], seeds=(6,)).sample(32, torch.tensor([4]))
    assert torch.equal(batch.observation[1, :, 1:], alone.observation[0, :, 1:])


def test_members_that_share_a_source_get_their_own_rewards():
    episodes = coded([4, 4], seeds=(1, 1), source_of_member=[0, 0])
    episodes.rewards = torch.stack([torch.arange(15.0), -torch.arange(15.0)])
    batch = episodes.sample(40, torch.tensor([1, 1]))
    row = batch.observation[0, :, 1] * 4 + batch.observation[0, :, 2]
    assert torch.equal(batch.observation[0], batch.observation[1])
    assert torch.equal(batch.reward[0], row)
    assert torch.equal(batch.reward[1], -row)


@settings(max_examples=40, deadline=None)
@given(
    lengths=st.lists(st.integers(2, 9), min_size=1, max_size=4), next_action=st.booleans(), seed=st.integers(0, 99),
    future=st.sampled_from(["last", "within"]),
)  # fmt: skip
def test_future_states_come_later_in_the_same_episode(lengths, next_action, seed, future):
    batch = coded(lengths, seeds=(seed, seed + 1), source_of_member=[0, 0]).sample(
        64, torch.ones(2, dtype=torch.int64), next_action=next_action, future=future
    )
    assert torch.equal(batch.future_observation[..., :2], batch.observation[..., :2])
    limit = torch.tensor(lengths)[batch.observation[..., 1].long()]
    later = batch.future_observation[..., 2]
    assert (later > batch.observation[..., 2]).all()
    assert (later <= limit).all()
    any_limit = torch.tensor(lengths)[batch.other_observation[..., 1].long()]
    assert (batch.other_observation[..., 2] <= any_limit).all()


def test_future_states_are_geometric_up_to_the_end_and_other_states_uniform():
    count, one = 40_000, torch.tensor([1])
    batch = coded([300, 300]).sample(count, one, future="last")
    start, later = batch.observation[0, :, 2], batch.future_observation[0, :, 2]
    early = start < 150
    steps = (later - start)[early].long()
    share = torch.bincount(steps, minlength=152)[:150] / len(steps)
    assert share[0] == 0
    torch.testing.assert_close(share[1:31].sum(), torch.tensor(1 - 0.99**30), atol=0.01, rtol=0)
    torch.testing.assert_close(share[1:].sum(), torch.tensor(1 - 0.99**149), atol=0.01, rtol=0)
    # At the last start the end is all that is left; all the probability of what lies beyond it is there.
    assert (later[start == 299] == 300).all()
    left = 300 - start
    ended = (later == 300).double().mean()
    torch.testing.assert_close(ended, (0.99 ** (left.double() - 1)).mean(), atol=0.01, rtol=0)
    other = batch.other_observation[0]
    torch.testing.assert_close(
        torch.bincount((other[:, 1] * 7 + other[:, 2] // 43).long()) / count, torch.full((14,), 1 / 14), atol=0.01, rtol=0
    )
    assert other[:, 2].max() == 300
    assert other[:, 2].min() == 0
    plain = coded([300, 300]).sample(count, one)
    assert torch.equal(plain.observation, batch.observation)
    assert plain.future_observation is plain.other_observation is None


def test_future_states_within_an_episode_are_geometric_as_far_as_it_lasts():
    """P(Δ = j) of those j that end before the episode does."""
    batch = coded([20]).sample(200_000, torch.tensor([1]), future="within")
    start, later = (part[0, :, 2].long() for part in (batch.observation, batch.future_observation))
    for t in (0, 12, 17, 19):
        left = 20 - t
        weights = torch.tensor([0.99**j for j in range(1, left + 1)])
        share = torch.bincount((later - start)[start == t], minlength=left + 1) / (start == t).sum()
        assert len(share) == left + 1
        torch.testing.assert_close(share[1:], weights / weights.sum(), atol=0.02, rtol=0)


def test_members_draw_their_own_future_and_other_states():
    together = coded([9, 11], seeds=(5, 6), sources=2).sample(32, torch.tensor([1, 1]), future="last")
    alone = coded([9, 11], seeds=(6,)).sample(32, torch.tensor([1]), future="last")
    for name in ("future_observation", "other_observation"):
        assert torch.equal(getattr(together, name)[1, :, 1:], getattr(alone, name)[0, :, 1:])
        assert (getattr(together, name)[1, :, 0] == 1).all()
