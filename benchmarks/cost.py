"""Time and memory of each regularizer with PPO: ``python -m benchmarks.cost --json FILE``.

A step is TorchRL's ``ClipPPOLoss`` and its gradients on one minibatch, without the optimizer, with
networks of the size that robots are trained with. Each variant takes turns with the loss without a
regularizer, and the times of a round are divided by one another, so other load on the machine
affects both. The table has the medians of these ratios; the first row divides the baseline by
itself. Times on the CPU are processor times of one thread.

Memory on CUDA is the peak that torch.cuda.max_memory_allocated reports for one step, without the
memory allocated before it. On the CPU it is the largest total size of the tensors that are saved
for the backward pass at one time (torch.autograd.graph.saved_tensors_hooks), without parameters and
the minibatch. Both grow with the number of states.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.modules import (
    MLP,
    IndependentNormal,
    NormalParamExtractor,
    ProbabilisticActor,
    ValueOperator,
)
from torchrl.objectives import ClipPPOLoss, LossModule

from benchmarks.timing import machine, take_turns
from torchrl_l2c2 import smooth

OBSERVATIONS, ACTIONS, LAYERS = 48, 12, [512, 256, 128]
BASELINE = "baseline"
PREVIOUS: dict[str, Any] = {"previous_key": "previous_observation"}
VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    "L2C2": ("l2c2", {}),
    "L2C2 as in the paper": (
        "l2c2",
        {"policy_distance": "hellinger", "neighbors": "box", "beta": 0.1},
    ),
    "CATS": ("cats", {}),
    "LCP": ("lcp", {}),
    "CAPS": ("caps", {}),
    "Grad-CAPS": ("grad_caps", PREVIOUS),
    "ASAP": ("asap", PREVIOUS),
    "SR2L": ("sr2l", {}),
}
"""Method and settings that replace the preset, by the name in the table."""

MEASURES = {
    "cuda": "peak of torch.cuda.max_memory_allocated in a step, less the memory before it",
    "cpu": "largest size of the tensors saved for the backward pass, without parameters and batch",
}
"""Measure of the memory, by kind of device."""


@dataclass
class Cost:
    """A line of the table.

    Attributes:
        method: the name in the table.
        fraction: share of the states that the regularizer uses.
        states: number of states in the minibatch.
        time: time divided by the time of the baseline, median over the rounds.
        time_low: first quartile of these ratios.
        time_high: third quartile of these ratios.
        milliseconds: median time of a step.
        memory: memory divided by the memory of the baseline.
        memory_mib: memory of a step, in MiB.
    """

    method: str
    fraction: float
    states: int
    time: float
    time_low: float
    time_high: float
    milliseconds: float
    memory: float
    memory_mib: float


def make_loss(device: str) -> ClipPPOLoss:
    """PPO with an actor and a critic of the size that Isaac Lab uses for walking robots."""

    def layers(outputs: int) -> MLP:
        return MLP(
            in_features=OBSERVATIONS,
            out_features=outputs,
            num_cells=LAYERS,
            activation_class=nn.ELU,
            device=device,
        )

    actor = ProbabilisticActor(
        TensorDictModule(
            nn.Sequential(layers(2 * ACTIONS), NormalParamExtractor()),
            ["observation"],
            ["loc", "scale"],
        ),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    critic = ValueOperator(layers(1), in_keys=["observation"])
    return ClipPPOLoss(actor, critic)


def make_batch(loss: LossModule, states: int, device: str) -> TensorDict:
    """A minibatch of random transitions with the actions of the actor."""
    observation = torch.randn(states, OBSERVATIONS, device=device)
    change = 0.1 * torch.randn_like(observation)
    column = torch.randn(states, 1, device=device)
    batch = TensorDict(
        {
            "observation": observation,
            "previous_observation": observation - change,
            "next": {
                "observation": observation + change,
                "done": torch.zeros_like(column, dtype=torch.bool),
            },
            "advantage": column,
            "value_target": column.clone(),
        },
        [states],
    )
    with torch.no_grad(), loss.actor_network_params.to_module(loss.actor_network):
        loss.actor_network(batch)
    return batch


def make_step(loss: LossModule, batch: TensorDict) -> Callable[[], None]:
    """The loss and its gradients, which are dropped."""

    def step() -> None:
        terms = loss(batch)
        total = sum(term for key, term in terms.items() if key.startswith("loss_"))
        assert isinstance(total, Tensor)
        total.backward()
        loss.zero_grad(set_to_none=True)

    return step


class SavedTensors:
    """The size of the tensors that are saved for the backward pass, while it is entered.

    A storage counts once, from the time when a tensor of it is saved until the last of these
    tensors is freed.

    Args:
        ignored: tensors whose storages do not count.

    Examples:
        >>> import torch
        >>> x = torch.randn(256, 1024, requires_grad=True)
        >>> with SavedTensors() as saved:
        ...     x.exp().exp().sum().backward()  # saves two results, 1 MiB each
        >>> saved.peak / 2**20
        2.0
    """

    def __init__(self, ignored: list[Tensor] | None = None) -> None:
        self.peak = self._size = 0
        self._counts: dict[int, int] = {}
        self._ignored = {each.untyped_storage().data_ptr() for each in ignored or []}
        self._hooks = torch.autograd.graph.saved_tensors_hooks(self._pack, lambda kept: kept.tensor)

    def __enter__(self) -> SavedTensors:
        self._hooks.__enter__()
        return self

    def __exit__(self, *raised: object) -> None:
        self._hooks.__exit__(*raised)

    def _pack(self, tensor: Tensor) -> _Kept:
        storage = tensor.untyped_storage()
        place = storage.data_ptr()
        if place in self._ignored:
            return _Kept(tensor, lambda: None)
        self._counts[place] = self._counts.get(place, 0) + 1
        if self._counts[place] == 1:
            self._size += storage.nbytes()
            self.peak = max(self.peak, self._size)
        size = storage.nbytes()

        def free() -> None:
            self._counts[place] -= 1
            if not self._counts[place]:
                self._size -= size

        return _Kept(tensor, free)


class _Kept:
    """A saved tensor that reports when it is freed."""

    def __init__(self, tensor: Tensor, free: Callable[[], None]) -> None:
        self.tensor, self._free = tensor, free

    def __del__(self) -> None:
        self._free()


def memory_of(step: Callable[[], None], loss: LossModule, batch: TensorDict) -> int:
    """The memory of a step in bytes, as described at the top of this file."""
    if batch.device is None and not batch["observation"].is_cuda:
        known = [*loss.parameters(), *loss.buffers(), *batch.values(True, True)]
        with SavedTensors(known) as saved:
            step()
        return saved.peak
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    step()
    torch.cuda.synchronize()
    return torch.cuda.max_memory_allocated() - before


def costs(states: int, device: str, rounds: int, calls: int, fractions: list[float]) -> list[Cost]:
    """The lines of the table for one size of minibatch, the baseline first.

    Args:
        states: number of states in the minibatch.
        device: a device of torch.
        rounds: rounds of each variant and the baseline.
        calls: steps in a turn.
        fractions: shares of the states that the regularizers use.
    """
    torch.manual_seed(0)
    base = make_loss(device)
    batch = make_batch(base, states, device)
    losses: dict[tuple[str, float], LossModule] = {(BASELINE, 1.0): base}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Presets without recorded runs.
        for fraction in fractions:
            for name, (method, settings) in VARIANTS.items():
                losses[name, fraction] = smooth(base, method, fraction=fraction, **settings)
    steps = {key: make_step(loss, batch) for key, loss in losses.items()}
    memory = {}
    for key, step in steps.items():
        step()  # The first call allocates more.
        memory[key] = memory_of(step, losses[key], batch)

    def turn(step: Callable[[], None]) -> Callable[[], int]:
        def steps_of_a_turn() -> int:
            for _ in range(calls):
                step()
            if device.startswith("cuda"):
                torch.cuda.synchronize()
            return calls

        return steps_of_a_turn

    # On the CPU other processes do not count, as they would by the clock on the wall.
    clock = time.perf_counter if device.startswith("cuda") else time.process_time
    plain, plain_memory = turn(steps[BASELINE, 1.0]), memory[BASELINE, 1.0]
    rows = []
    for key, step in steps.items():
        pair = {"plain": plain, "own": turn(step)}
        seconds = take_turns(pair, repeats=rounds, warm_up=0, clock=clock)
        ratios = [own / base for own, base in zip(seconds["own"], seconds["plain"], strict=True)]
        low, middle, high = quartiles(ratios)
        rows.append(
            Cost(
                *key,
                states,
                time=middle,
                time_low=low,
                time_high=high,
                milliseconds=1e3 * statistics.median(seconds["own"]),
                memory=memory[key] / plain_memory,
                memory_mib=memory[key] / 2**20,
            )
        )
    return rows


def quartiles(values: list[float]) -> tuple[float, float, float]:
    """First quartile, median and third quartile.

    Examples:
        >>> quartiles([1.0, 2.0, 3.0, 4.0, 5.0])
        (2.0, 3.0, 4.0)
    """
    if len(values) == 1:
        return values[0], values[0], values[0]
    low, middle, high = statistics.quantiles(values, n=4, method="inclusive")
    return low, middle, high


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cost", description=__doc__)
    parser.add_argument("--device", default="cpu", help="cpu (default) or cuda")
    parser.add_argument(
        "--states",
        type=int,
        nargs="+",
        default=[4096, 24576],
        help="states in a minibatch (default: 4096 24576)",
    )
    parser.add_argument(
        "--fractions", type=float, nargs="+", default=[1.0, 0.25], help="default: 1 0.25"
    )
    parser.add_argument("--rounds", type=int, default=9, help="rounds of turns (default: 9)")
    parser.add_argument("--calls", type=int, help="steps in a turn (default: 1; on CUDA 20)")
    parser.add_argument(
        "--quick", action="store_true", help="64 states, one round: shows that it runs"
    )
    parser.add_argument("--json", type=Path, help="file to write the result to")
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> None:
    """Measures, prints and writes the table."""
    options = _parse(arguments)
    given = sys.argv[1:] if arguments is None else arguments
    # Folders of this machine are nobody else's.
    given = [Path(each).name if Path(each).is_absolute() else each for each in given]
    kind = options.device.split(":")[0]
    if kind not in MEASURES:
        raise SystemExit(f"Expected --device cpu or cuda, got {options.device!r}.")
    if kind == "cuda" and not torch.cuda.is_available():
        raise SystemExit("Expected a CUDA device, got none. Use --device cpu.")
    if kind == "cpu":
        torch.set_num_threads(1)
    # A host's name says nothing about its speed.
    where = machine()
    sizes, rounds = ([64], 1) if options.quick else (options.states, options.rounds)
    calls = options.calls or (20 if kind == "cuda" and not options.quick else 1)
    rows = []
    for states in sizes:
        for row in costs(states, options.device, rounds, calls, options.fractions):
            print(
                f"{row.states} states, {row.method}, fraction {row.fraction:g}: "
                f"time {row.time:.2f} ({row.time_low:.2f} to {row.time_high:.2f}), "
                f"memory {row.memory:.2f}",
                flush=True,
            )
            rows.append(row)
    result = {
        "command": " ".join(("python -m benchmarks.cost", *given)),
        "machine": where,
        "quick": options.quick,
        "device": kind,
        "memory": MEASURES[kind],
        "networks": {"observations": OBSERVATIONS, "actions": ACTIONS, "layers": LAYERS},
        "rounds": rounds,
        "calls": calls,
        "rows": [asdict(row) for row in rows],
    }
    if options.json:
        options.json.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
