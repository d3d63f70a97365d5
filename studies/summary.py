"""The summary over all benchmarks of L2C2's presets and of the paper's settings.

It has the README's table and the tables of ``docs/results.md``; ``studies.forest`` draws it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import pandas as pd

from studies import rsl_rl, td3
from studies.field import TEST
from studies.files import ROOT, records
from torchrl_l2c2.experiment.analysis.reports.groups import Group, group_records
from torchrl_l2c2.experiment.analysis.reports.table import (
    COMPARED,
    improvement,
    improvement_cell,
    pipe_table,
)

OURS = "L2C2, mse 1, ramp"
"""PPO's preset, in tables."""

OF_SAC = "L2C2, means 10, ramp"
"""SAC's preset, in tables."""

MILLION = "1000000 frames"
RSL_RL = ROOT / "results" / "rsl_rl.csv"
Pair = tuple[Group, Group]
"""The runs with L2C2, and the baseline's runs with the same seeds."""


class Benchmark(NamedTuple):
    """Task, algorithm and records of a row.

    Attributes:
        task (str): Name of the task in tables.
        algorithm (str): Name of the algorithm in tables.
        file (str): Records, below ``results/``.
        recorded (str): Name of the task in the records.
        method (str): Name of L2C2's settings in tables.
        length (str): Length of training in the records.
        cats (str): Name of CATS with its preset in tables.
    """

    task: str
    algorithm: str
    file: str
    recorded: str
    method: str
    length: str
    cats: str = "CATS"


BENCHMARKS = (
    Benchmark("Pendulum", "SAC", "sac_pendulum", "pendulum", OF_SAC, "30000 frames"),
    Benchmark("LunarLander", "SAC", "sac_lunarlander", "lunarlander", OF_SAC, "100000 frames"),
    Benchmark("Hopper", "SAC", "sac_hopper", "hopper_v5", OF_SAC, "200000 frames"),
    Benchmark("Pendulum", "PPO", "field", "pendulum", OURS, "500000 frames"),
    Benchmark("LunarLander", "PPO", "field", "lunarlander", OURS, "500000 frames"),
    Benchmark("Hopper", "PPO", "hopper", "hopper_v5", OURS, MILLION),
    Benchmark("Walker2d", "PPO", "walker2d", "walker2d_v5", OURS, MILLION),
    Benchmark("Ant", "PPO", "new_tasks", "Ant-v5", OURS, MILLION),
    Benchmark("BipedalWalker", "PPO", "new_tasks", "BipedalWalker-v3", OURS, MILLION),
    Benchmark("HalfCheetah", "PPO", "new_tasks", "HalfCheetah-v5", OURS, MILLION),
    Benchmark("Reacher", "PPO", "new_tasks", "Reacher-v5", OURS, MILLION),
    Benchmark("Swimmer", "PPO", "new_tasks", "Swimmer-v5", OURS, MILLION),
    Benchmark(
        "InvertedDoublePendulum",
        "TD3",
        "td3_mujoco",
        "InvertedDoublePendulum-v5",
        "L2C2, means 0.04, relative",
        "50000 frames",
        "CATS, relative, lambda_temporal=0.04",
    ),
    Benchmark("noisy Swingup", "PPO-RPE", "runs", "swingup", "L2C2", "350 episodes"),
    Benchmark("noisy Reacher", "PPO-RPE", "runs", "reacher", "L2C2", "4500 episodes"),
    Benchmark("noisy Hopper", "PPO-RPE", "runs", "hopper", "L2C2", "750 episodes"),
    Benchmark("noisy Ant", "PPO-RPE", "runs", "ant", "L2C2", "750 episodes"),
)
"""Every benchmark with at least three seeds: of the presets of PPO, SAC and TD3, and of the paper's
algorithm and settings on its noisy tasks. TD3 and rsl_rl are added to them, from their records."""


@functools.cache
def benchmarks() -> dict[tuple[str, str], Pair]:
    """The runs of every benchmark by task and algorithm, the roughest baseline first."""
    found = {(each.task, each.algorithm): _groups(each) for each in BENCHMARKS}
    for name, task in (("HalfCheetah", "HalfCheetah-v5"), ("noisy points", "points")):
        found[name, "PPO of rsl_rl"] = rsl_rl.recorded(RSL_RL, task)
    of_td3 = td3.by_setting(records("td3").query("seed < 10"))
    found["Pendulum", "TD3"] = of_td3[td3.PRESETS["L2C2"]], of_td3[td3.BASELINE]

    def roughness(names: tuple[str, str]) -> float:
        _, baseline = found[names]
        return float(baseline.scores(TEST, "action_variation").mean())

    return {names: found[names] for names in sorted(found, key=roughness, reverse=True)}


def with_cats() -> list[Pair]:
    """The runs with CATS and with L2C2, of each benchmark that has both at their presets."""
    found = []
    for each in BENCHMARKS:
        named = {group.name: group for group in group_records(_records(each))}
        if each.cats in named:
            found.append((named[each.cats], named[each.method]))
    of_td3 = td3.by_setting(records("td3").query("seed < 10"))
    cats, ours = (of_td3[td3.PRESETS[method]] for method in ("CATS", "L2C2"))
    return [*found, (cats, ours)]


def short_table() -> str:
    """The README's table."""
    return _table(
        {
            "action change per step: baseline": lambda *pair: _mean(pair[1], "action_variation"),
            "with L2C2": lambda *pair: _mean(pair[0], "action_variation"),
            "change": _bold_change,
            "return: baseline": lambda *pair: _mean(pair[1], "return"),
            "with L2C2 ": lambda *pair: _mean(pair[0], "return"),
        }
    )


def long_table() -> str:
    """The table of results: means, probabilities, and counts of seeds with a lower return."""
    rows = _table(
        {
            "action variation: baseline": lambda *pair: _mean(pair[1], "action_variation"),
            "with L2C2": lambda *pair: _mean(pair[0], "action_variation"),
            "P(smoother)": lambda *pair: _better([pair], "action_variation"),
            "return: baseline": lambda *pair: _mean(pair[1], "return"),
            "with L2C2 ": lambda *pair: _mean(pair[0], "return"),
            "P(returns more)": lambda *pair: _better([pair], "return"),
            "lower return": _lower,
        }
    )
    pairs = list(benchmarks().values())
    over_all = [_better(pairs, quantity) for quantity in ("action_variation", "return")]
    return f"{rows}\n| mean of the {len(pairs)} rows | | | | {over_all[0]} | | | {over_all[1]} | |"


def sm_table() -> str:
    """The table of Sm, for the benchmarks with this measure."""
    return _table(
        {
            "Sm: baseline": lambda *pair: _mean(pair[1], "sm_asap"),
            "with L2C2": lambda *pair: _mean(pair[0], "sm_asap"),
            "change": lambda *pair: f"{_change(pair, 'sm_asap'):+.0%}",
            "P(smaller Sm)": lambda *pair: _better([pair], "sm_asap"),
        },
        {
            names: pair
            for names, pair in benchmarks().items()
            if all(len(side.scores(TEST, "sm_asap")) for side in pair)
        },
    )


def cats_table() -> str:
    """CATS against L2C2, over the benchmarks that have both."""
    pairs = with_cats()
    rows = [["measure", "P(CATS is better)", "benchmarks with a better mean of CATS"]]
    for quantity, (name, _) in COMPARED.items():
        means = [[side.scores(TEST, quantity).mean() for side in pair] for pair in pairs]
        better = sum(cats > ours if quantity == "return" else cats < ours for cats, ours in means)
        rows.append([name, _better(pairs, quantity), f"{better} of {len(pairs)}"])
    return pipe_table(rows)


def _records(benchmark: Benchmark) -> pd.DataFrame:
    found = records(benchmark.file)
    found = found[(found["task"] == benchmark.recorded) & (found["length"] == benchmark.length)]
    if benchmark.file == "runs":  # Those with another tau are another study.
        found = found[~found["differences"].str.contains("algorithm.tau", regex=False)]
    # Seeds of 100 and above chose the gains.
    return found[found["seed"] < 100]


def _groups(benchmark: Benchmark) -> Pair:
    found = _records(benchmark)
    (ours,) = (group for group in group_records(found) if group.name == benchmark.method)
    same = found[(found["method"] == "none") & found["seed"].isin(ours.seeds)]
    (baseline,) = group_records(same)
    assert baseline.seeds == ours.seeds and baseline.setup == ours.setup
    return ours, baseline


def _table(
    columns: Mapping[str, Callable[[Group, Group], str]],
    pairs: Mapping[tuple[str, str], Pair] | None = None,
) -> str:
    names = ["task", "algorithm (seeds)", *(name.strip() for name in columns)]
    rows = [names]
    for (task, algorithm), pair in (benchmarks() if pairs is None else pairs).items():
        cells = [cell(*pair) for cell in columns.values()]
        rows.append([task, f"{algorithm} ({len(pair[0].seeds)})", *cells])
    return pipe_table(rows)


def _mean(group: Group, quantity: str) -> str:
    mean = group.scores(TEST, quantity).mean()
    if quantity != "return":
        return f"{mean:.3f}"
    return f"{mean:.{0 if abs(mean) >= 100 else 1}f}"


def _change(pair: Pair, quantity: str) -> float:
    after, before = (side.scores(TEST, quantity).mean() for side in pair)
    return float(after / before - 1)


def _bold_change(*pair: Group) -> str:
    """The change of the action variation, in bold if it is beyond seed noise."""
    ours, baseline = pair
    found = improvement([ours], [baseline], TEST, "action_variation")
    assert found is not None and found.interval is not None
    low, high = found.interval
    change = _change((ours, baseline), "action_variation")
    text = f"{change:+.0%}" if change >= -0.995 else f"{change:+.1%}"
    return text if low <= 0.5 <= high else f"**{text}**"


def _better(pairs: Sequence[Pair], quantity: str) -> str:
    ours, baselines = zip(*pairs, strict=True)
    return improvement_cell(ours, baselines, TEST, quantity)


def _lower(ours: Group, baseline: Group) -> str:
    """The number of seeds on which L2C2 returns less."""
    after, before = (side.by_seed(TEST, "return") for side in (ours, baseline))
    return f"{sum(after[seed] < before[seed] for seed in after)} of {len(after)}"
