"""Running statistics of observations and rewards, against Gymnasium's."""

import numpy as np
import pytest
import torch
from gymnasium.wrappers.utils import RunningMeanStd
from tensordict import TensorDict

from torchrl_l2c2.experiment.agents.normalization import Moments, Normalization


def rollout(steps, ends=(), seed=0):
    generator = torch.Generator().manual_seed(seed)
    seen = 5.0 + 3.0 * torch.randn(steps + 1, 2, generator=generator)
    done = torch.zeros(steps, 1, dtype=torch.bool)
    done[list(ends)] = True
    reward = torch.randn(steps, 1, generator=generator) + 1.0
    following = {"observation": seen[1:], "reward": reward, "done": done}
    return TensorDict({"observation": seen[:-1], "next": following}, [steps])


def test_moments_are_those_of_all_values():
    """Counted in parts of any size."""
    values, ours = np.random.default_rng(0).normal(3.0, 2.0, (100, 2)), Moments(2)
    theirs = RunningMeanStd(shape=(2,), epsilon=1e-4)
    for part in (values[:1], values[1:40], values[40:]):
        ours.update(torch.from_numpy(part))
        theirs.update(part)
    np.testing.assert_allclose(ours.mean, theirs.mean)
    np.testing.assert_allclose(ours.var, theirs.var)
    np.testing.assert_allclose(ours.mean, values.mean(0), rtol=1e-4)


def make(**settings):
    chosen = {"observations": True, "rewards": True, "gamma": 0.9, "streams": 2, **settings}
    return Normalization(2, **chosen)


def test_a_rollout_has_the_statistics_that_acted():
    """Also for the next observations; what it shows counts from the next rollout on."""
    norm, frames = make(), [rollout(30), rollout(30, seed=1)]
    first = norm(frames)
    for given, played in zip(first, frames, strict=True):
        assert given["observation"].equal(played["observation"].clamp(-10, 10))
    norm.apply_statistics()
    all_seen = torch.cat([each["observation"] for each in frames])
    mean, deviation = all_seen.mean(0), all_seen.std(0, unbiased=False)
    second = norm(frames)
    for key in ("observation", ("next", "observation")):
        expected = (frames[0][key] - mean) / deviation
        torch.testing.assert_close(second[0][key], expected, rtol=1e-4, atol=1e-4)


def test_rewards_are_divided_by_the_deviation_of_their_discounted_sum():
    """A sum for each simulator, which ends with an episode and goes on over rollouts."""
    norm, total, sums = make(streams=1), 0.0, []
    for part in (rollout(20, ends=(4, 12)), rollout(20, seed=1)):
        (given,) = norm([part])
        ends = part["next", "done"].flatten().tolist()
        for reward, done in zip(part["next", "reward"].flatten().tolist(), ends, strict=True):
            total = 0.9 * total + reward
            sums.append(total)
            total = 0.0 if done else total
        expected = part["next", "reward"] / np.std(sums)
        torch.testing.assert_close(given["next", "reward"], expected, rtol=1e-4, atol=0.0)


def test_what_is_far_out_is_clipped():
    """At ten deviations."""
    norm, frames = make(), [rollout(30), rollout(30, seed=1)]
    norm(frames)
    norm.apply_statistics()
    assert norm.normalize(torch.tensor([1e6, -1e6])).tolist() == [10.0, -10.0]
    frames[0]["next", "reward"][3] = 1e6
    assert norm.normalized(frames[0])["next", "reward"].max() == 10.0


def test_what_never_changes_is_divided_by_a_ten_thousandth():
    """As in Stable-Baselines3, and not by 0."""
    moments = Moments(1)
    moments.var.zero_()
    assert moments.scale.item() == pytest.approx(1e-4)


@pytest.mark.parametrize("kind", ["observations", "rewards"])
def test_either_is_left_as_it_is_where_it_is_not_normalized(kind):
    norm, frames = make(**{kind: False}), [rollout(30), rollout(30, seed=1)]
    norm(frames)
    norm.apply_statistics()
    given = norm(frames)[0]
    same = given["next", "observation"].equal(frames[0]["next", "observation"])
    assert same == (kind == "observations")
    same = given["next", "reward"].equal(frames[0]["next", "reward"])
    assert same == (kind == "rewards")
