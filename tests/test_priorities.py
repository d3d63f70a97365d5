"""Drawing by priority and setting priorities: what TorchRL's sampler does, to the bit."""

import logging

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictPrioritizedReplayBuffer

from torchrl_l2c2.experiment.priorities import draw_by_priority, leave_out, set_priorities
from torchrl_l2c2.experiment.replay import replay_state

logging.getLogger("torchrl").setLevel(logging.ERROR)


def filled(stored, capacity=50, alpha=0.7):
    """A buffer with so many rows, whose priorities are set."""
    buffer = TensorDictPrioritizedReplayBuffer(
        alpha=alpha,
        beta=0.5,
        priority_key="td_error",
        storage=LazyTensorStorage(capacity),
        batch_size=16,
        generator=torch.Generator().manual_seed(3),
    )
    buffer.extend(TensorDict({"row": torch.arange(stored)}, [stored]))
    generator = torch.Generator().manual_seed(1)
    buffer.update_priority(torch.arange(stored), torch.rand(stored, generator=generator) ** 4)
    return buffer


@pytest.mark.parametrize("alpha", [1.0, 0.7, 0.0])
def test_rows_weights_and_state_are_the_samplers_own(alpha):
    """Over rounds in which priorities are set, one of them higher than any before."""
    ours, theirs = filled(40, alpha=alpha), filled(40, alpha=alpha)
    for number in range(20):
        rows, weight = draw_by_priority(ours.sampler, 40, 16)
        expected, info = theirs.sampler.sample(theirs.storage, 16)
        assert torch.equal(rows, expected) and torch.equal(weight, info["priority_weight"])
        priority = torch.rand(16, generator=torch.Generator().manual_seed(number)) * (1 + number)
        set_priorities(ours.sampler, rows, priority)
        theirs.sampler.update_priority(expected, priority)
        assert ours.sampler._max_priority == theirs.sampler._max_priority
    state, other = replay_state(ours)["_sampler"], replay_state(theirs)["_sampler"]
    assert torch.equal(state["_sum_tree"], other["_sum_tree"])
    assert torch.equal(state["_min_tree"], other["_min_tree"])
    # What the buffer gives by itself then, and the priority of what is new.
    assert torch.equal(ours.sample()["row"], theirs.sample()["row"])
    assert ours.sampler.default_priority == theirs.sampler.default_priority


class Misled:
    """A tree whose search ends at this row, of which rows 20 to 29 have no priority."""

    def __init__(self, tree, row):
        self.query, self._tree, self._row = tree.query, tree, row
        tree[torch.arange(20, 30)] = 0.0

    def __getitem__(self, rows):
        return self._tree[rows]

    def scan_lower_bound(self, mass):
        return self._tree.scan_lower_bound(mass) * 0 + self._row


@pytest.mark.parametrize(("found", "drawn"), [(25, 19), (40, 39)])
def test_a_row_that_cannot_be_drawn_gives_way_to_the_one_before(found, drawn):
    """As in TorchRL, where rounding leads to one without priority, or beyond those stored."""
    buffer = filled(40)
    buffer.sampler._sum_tree = Misled(buffer.sampler._sum_tree, found)
    rows, weight = draw_by_priority(buffer.sampler, 40, 16)
    expected, info = buffer.sampler.sample(buffer.storage, 16)
    assert torch.equal(rows, expected) and (rows == drawn).all()
    assert torch.equal(weight, info["priority_weight"])


def test_priorities_that_are_not_positive_are_refused():
    """A weight would be a division by nothing."""
    buffer = filled(40)
    buffer.sampler._min_tree[3] = 0.0
    with pytest.raises(FloatingPointError, match="positive"):
        draw_by_priority(buffer.sampler, 40, 16)


def test_a_row_that_is_left_out_is_drawn_no_more_and_weighs_on_no_other():
    """As if it were not there; until something else is stored in its place."""
    buffer = filled(40)
    least = int(torch.from_numpy(buffer.sampler._sum_tree[torch.arange(40).numpy()]).argmin())
    leave_out(buffer.sampler, torch.tensor([least, 7]))
    drawn, weights = zip(
        *(draw_by_priority(buffer.sampler, 40, 16) for _ in range(500)), strict=True
    )
    rows = torch.cat(drawn)
    assert not {least, 7} & {*rows.tolist()}
    others = torch.tensor([row for row in range(40) if row not in (least, 7)])
    known = torch.from_numpy(buffer.sampler._sum_tree[others.numpy()])
    expected = (torch.from_numpy(buffer.sampler._sum_tree[rows.numpy()]) / known.min()) ** -0.5
    assert torch.allclose(torch.cat(weights), expected)
    buffer.extend(TensorDict({"row": torch.arange(50)}, [50]))  # the capacity
    assert draw_by_priority(buffer.sampler, 50, 16) and buffer.sampler._sum_tree[7] > 0
    assert buffer.sampler._min_tree[7] == buffer.sampler._sum_tree[7]


def test_the_first_row_may_be_left_out():
    """Where a draw of exactly 0 leads to it, there is none before."""
    buffer = filled(40)
    leave_out(buffer.sampler, torch.arange(3))
    buffer.sampler._sum_tree = Misled(buffer.sampler._sum_tree, 1)
    rows, _ = draw_by_priority(buffer.sampler, 40, 16)
    assert (rows == 3).all()
