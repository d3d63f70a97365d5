"""Storing row after row: what TorchRL's ``extend`` leaves behind, to the bit."""

import logging

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import (
    LazyTensorStorage,
    TensorDictPrioritizedReplayBuffer,
    TensorDictReplayBuffer,
)

from torchrl_l2c2.experiment.replay import load_replay_state, replay_state
from torchrl_l2c2.experiment.row_writer import RowWriter

logging.getLogger("torchrl").setLevel(logging.ERROR)
CAPACITY = 6


def uniform():
    return TensorDictReplayBuffer(
        storage=LazyTensorStorage(CAPACITY),
        batch_size=4,
        generator=torch.Generator().manual_seed(3),
    )


def prioritized():
    return TensorDictPrioritizedReplayBuffer(
        alpha=0.7,
        beta=0.5,
        priority_key="td_error",
        storage=LazyTensorStorage(CAPACITY),
        batch_size=4,
        generator=torch.Generator().manual_seed(3),
    )


def rows(first, count):
    return [
        {"observation": torch.full((3,), float(number)), ("next", "done"): torch.tensor([True])}
        for number in range(first, first + count)
    ]


def extend(buffer, row):
    batch = TensorDict(batch_size=[1])
    for key, value in row.items():
        batch.set(key, value.unsqueeze(0))
    buffer.extend(batch)


def same(ours, theirs):
    """What is stored, where, how often, with which priorities, and what is drawn of it."""
    assert len(ours) == len(theirs) and ours.write_count == theirs.write_count
    assert ours.writer.state_dict() == theirs.writer.state_dict()
    assert ours.storage._mutation_revision == theirs.storage._mutation_revision
    assert torch.equal(ours.storage._last_cursor, theirs.storage._last_cursor)
    stored, expected = ours[:], theirs[:]
    assert set(stored.keys(True, True)) == set(expected.keys(True, True))
    assert all(torch.equal(stored[key], expected[key]) for key in expected.keys(True, True))
    one, other = replay_state(ours)["_sampler"], replay_state(theirs)["_sampler"]
    for tree in [key for key in other if key.endswith("_tree")]:
        assert torch.equal(one[tree], other[tree])
    # Twice, as what is drawn next depends on the generator.
    for _ in range(2):
        drawn, expected = ours.sample(), theirs.sample()
        assert all(torch.equal(drawn[key], expected[key]) for key in expected.keys(True, True))


@pytest.mark.parametrize("make", [uniform, prioritized])
def test_the_buffer_is_that_of_extend(make):
    """From the first row on, while it fills, when it is full and begins anew; with priorities."""
    ours, theirs = make(), make()
    writer = RowWriter(ours)
    for number, row in enumerate(rows(0, 2 * CAPACITY + 2)):
        writer.write({**row, "not read": torch.zeros(1)} if number else row)
        extend(theirs, row)
        if make is prioritized and number == 3:
            for buffer in (ours, theirs):
                buffer.update_priority(torch.tensor([0, 2]), torch.tensor([5.0, 0.1]))
        same(ours, theirs)


def test_what_was_loaded_is_written_to():
    """A loaded state has tensors of its own; the writer of before goes on in them."""
    ours, theirs, saved = uniform(), uniform(), uniform()
    writer = RowWriter(ours)
    for row in rows(0, 3):
        writer.write(row)
        extend(theirs, row)
        extend(saved, row)
    state = replay_state(saved)
    load_replay_state(ours, state)
    load_replay_state(theirs, state)
    for row in rows(10, 5):
        writer.write(row)
        extend(theirs, row)
    same(ours, theirs)
