"""Regularized losses in several processes: by torch's own means, as any module."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing
from torch.nn.parallel import DistributedDataParallel
from torchrl.objectives import ClipPPOLoss

from tests.losses import critic, gaussian_actor, on_policy
from torchrl_l2c2 import L2C2Loss, Neighborhood, NeighborTransform

pytestmark = pytest.mark.slow  # Processes that import torch.

ROOT = Path(__file__).parents[1]
ROWS = 32


def gradients(place=lambda loss: loss, rows=slice(None)):
    """Of the sum of all terms, at some rows of a batch that has its neighbors."""
    torch.manual_seed(0)
    base = ClipPPOLoss(gaussian_actor(), critic(), entropy_bonus=False, normalize_advantage=False)
    loss, batch = L2C2Loss(base), on_policy(ROWS)
    batch["advantage"] = batch["value_target"] = torch.randn(ROWS, 1)
    batch = NeighborTransform(Neighborhood(), generator=torch.Generator().manual_seed(0))(batch)
    placed = place(loss)  # Kept: gradients are averaged as long as it is there.
    terms = placed(batch[rows])
    sum(term for key, term in terms.items() if key.startswith("loss")).backward()
    return [parameter.grad for parameter in loss.parameters()]


def work(rank, rendezvous, folder):
    """A process of two, with its half of the batch."""
    dist.init_process_group("gloo", init_method=rendezvous, rank=rank, world_size=2)
    half = slice(rank * ROWS // 2, (rank + 1) * ROWS // 2)
    torch.save(gradients(DistributedDataParallel, half), f"{folder}/{rank}.pt")
    dist.destroy_process_group()


def test_two_halves_have_the_gradients_of_the_whole(tmp_path):
    """Of both networks, on either process: means of as many rows are averaged."""
    rendezvous = f"file://{tmp_path}/rendezvous"
    torch.multiprocessing.spawn(work, (rendezvous, tmp_path), nprocs=2)
    for rank in range(2):
        torch.testing.assert_close(torch.load(tmp_path / f"{rank}.pt"), gradients())


def test_the_example_keeps_its_processes_together(tmp_path):
    """Each plays its own episodes, and all have the same parameters in the end."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node=2"]
    done = subprocess.run(
        [*command, f"--master-port={port}", ROOT / "examples" / "several_devices.py", "1000"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    told = re.findall(
        r"process (\d) of 2: return (\S+), action variation \S+, apart from the first (\S+)",
        done.stdout,
    )
    assert {process for process, _, _ in told} == {"0", "1"}
    assert all(-2000 < float(total) < 0 and float(apart) == 0 for _, total, apart in told)
