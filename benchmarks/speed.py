"""How fast the experiment is, as ratios: ``python -m benchmarks.speed``.

Every row compares things that are measured alternately in one process (where the row is about
processes, by one process that starts them), and is made of medians. ``docs/speed.md`` explains
the rows.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import logging
import os
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median

os.environ.setdefault("OMP_NUM_THREADS", "1")

import gymnasium
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torchrl.envs import ExplorationType, set_exploration_type
from tqdm import tqdm

from benchmarks.peers import against
from benchmarks.timing import Row, alternate, machine, to_markdown, to_text
from torchrl_l2c2.experiment import (
    PAPER_TASKS,
    EpisodeCollector,
    Experiment,
    ExperimentConfig,
    L2C2Config,
    MultiEpisodeCollector,
    NoRegularizerConfig,
    PPOConfig,
    PPORPEConfig,
    PrioritizedReplayConfig,
    SACConfig,
    TaskConfig,
    UniformReplayConfig,
    make_env,
)
from torchrl_l2c2.experiment.environments import quiet_output
from torchrl_l2c2.experiment.folder import MetricsLog
from torchrl_l2c2.experiment.update import ReplayUpdate, make_update
from torchrl_l2c2.modules import make_actor
from torchrl_l2c2.updaters import TSoftUpdate

ROOT = Path(__file__).parent.parent
REGULARIZERS = {"vanilla": NoRegularizerConfig(), "l2c2": L2C2Config()}


@dataclass(frozen=True)
class Effort:
    """How long to measure, whether anything is compiled, and the interpreter of the peers."""

    rounds: int = 15
    steps: int = 1000
    compile: bool = True
    peer_python: str = sys.executable


# Shows that everything runs; its numbers say nothing.
QUICK = Effort(rounds=1, steps=60, compile=False)


def update_rows(effort: Effort) -> Iterable[Row]:
    """The update of the paper's agent at its batch size, against three others."""
    small = partial(updates, effort, 32)
    l2c2 = small("l2c2", effort.compile)
    times = alternate(
        {
            "l2c2": l2c2,
            "vanilla": small("vanilla", effort.compile),
            "eager": small("l2c2", False),
            "products": matrix_products(small("l2c2", False)),
        },
        repeats=effort.rounds,
        calls=20,
        warm_up=5,
    )
    us = {name: 1e6 * seconds for name, seconds in times.items()}
    yield Row(
        "update",
        "eager update / compiled update, batch 32",
        us["eager"] / us["l2c2"],
        at_least=4.0,
        parts={"eager us": us["eager"], "compiled us": us["l2c2"]},
    )
    yield _smoothing_row("update", 32, us, 1.2)
    yield Row(
        "update",
        "compiled update / its matrix products alone, batch 32",
        us["l2c2"] / us["products"],
        at_most=3.0,
        parts={"compiled us": us["l2c2"], "products us": us["products"]},
    )


def ppo_update_rows(effort: Effort) -> Iterable[Row]:
    """PPO's update at batch 64, two layers of 64."""
    config = ExperimentConfig(
        task=TaskConfig(max_steps=effort.steps, episodes=1),
        algorithm=PPOConfig(),
        regularizer=NoRegularizerConfig(),
        compile=False,
    )
    actions = {}
    for name, compile in {"eager": False, "compiled": effort.compile}.items():
        experiment = Experiment(config)
        experiment.learner.remember(experiment.player.collector.rollout())
        update = ReplayUpdate(experiment.agent, experiment.learner.replay, compile=compile)
        draw = update.draw()
        actions[name] = partial(update.update, True, *draw)
    times = alternate(actions, repeats=effort.rounds, calls=20, warm_up=5)
    us = {f"{name} us": 1e6 * seconds for name, seconds in times.items()}
    yield Row(
        "ppo_update",
        "eager PPO update / compiled PPO update, batch 64",
        us["eager us"] / us["compiled us"],
        at_least=3.0,
        parts=us,
    )


def large_update_rows(effort: Effort) -> Iterable[Row]:
    """The price of the regularization where arithmetic, and no call's overhead, is what counts."""
    actions = {name: updates(effort, 4096, name, effort.compile) for name in REGULARIZERS}
    times = alternate(actions, repeats=effort.rounds, calls=2)
    us = {name: 1e6 * seconds for name, seconds in times.items()}
    yield _smoothing_row("update_4096", 4096, us, 1.9)


def _smoothing_row(group: str, size: int, us: dict[str, float], at_most: float) -> Row:
    return Row(
        group,
        f"L2C2 update / vanilla update, batch {size}",
        us["l2c2"] / us["vanilla"],
        at_most=at_most,
        parts={"l2c2 us": us["l2c2"], "vanilla us": us["vanilla"]},
    )


def collection_rows(effort: Effort) -> Iterable[Row]:
    """Frames with noise, stored as batches, against the simulator's with the same policy."""
    for name, task in PAPER_TASKS.items():
        task = dataclasses.replace(task, max_steps=min(task.max_steps, effort.steps))
        env = make_env(task, seed=0)
        actor = make_actor(env.observation_spec["observation"].shape[-1], env.action_spec)
        collector = EpisodeCollector(
            env,
            actor,
            frames_per_batch=min(250, effort.steps),
            stop_at_done=False,
            compile_policy=effort.compile,
        )
        times = alternate(
            {
                "collector": lambda collector=collector: collector.rollout().numel(),
                "simulator": _simulation(task, collector),
            },
            repeats=2 * effort.rounds,
        )
        fps = {what: 1.0 / seconds for what, seconds in times.items()}
        collector.shutdown()
        yield Row(
            "collection",
            f"collected frames / simulated frames, {name}",
            fps["collector"] / fps["simulator"],
            at_least=0.6,
            parts={"collected frames/s": fps["collector"], "simulated frames/s": fps["simulator"]},
        )


def worker_rows(effort: Effort) -> Iterable[Row]:
    """Episodes of two processes at once, against one after another in this process."""
    for name in ("swingup", "ant"):
        task = dataclasses.replace(PAPER_TASKS[name], max_steps=min(1000, effort.steps))
        env = make_env(task, seed=0)
        actor = make_actor(env.observation_spec["observation"].shape[-1], env.action_spec)
        one = EpisodeCollector(
            env, actor, frames_per_batch=task.max_steps, compile_policy=effort.compile
        )
        two = MultiEpisodeCollector(
            partial(make_env, task, 0),
            actor,
            num_workers=2,
            max_steps=task.max_steps,
            compile_policy=effort.compile,
        )
        times = alternate(
            {
                "one": lambda one=one: one.rollout().numel(),
                "two": lambda two=two: sum(episode.numel() for episode in two.rollout()),
            },
            repeats=effort.rounds,
        )
        fps = {what: 1.0 / seconds for what, seconds in times.items()}
        one.shutdown()
        two.shutdown()
        yield Row(
            "workers",
            f"frames of num_workers=2 / frames of num_workers=1, {name}",
            fps["two"] / fps["one"],
            parts={"two frames/s": fps["two"], "one frames/s": fps["one"]},
        )


def _simulation(task: TaskConfig, collector: EpisodeCollector) -> Callable[[], int]:
    """As many frames as the collector's batch has, by the collector's own compiled policy."""
    with quiet_output():
        simulator = gymnasium.make(task.env_id, max_episode_steps=task.max_steps)
        observation, _ = simulator.reset()

    @torch.no_grad()
    def simulate() -> int:
        nonlocal observation
        with set_exploration_type(ExplorationType.RANDOM):
            for _ in range(collector.frames_per_batch):
                acted = collector.act(torch.as_tensor(observation, dtype=torch.float32))
                observation, _, terminated, truncated, _ = simulator.step(acted.numpy())
                if terminated or truncated:
                    observation, _ = simulator.reset()
        return collector.frames_per_batch

    return simulate


def run_rows(effort: Effort) -> Iterable[Row]:
    """A whole run of the paper's experiment, in frames, against what it is made of."""
    with tempfile.TemporaryDirectory() as folder:
        config = paper_config(effort)
        run, parts = Experiment(config, folder), Experiment(config, Path(folder) / "parts")
        parts_episode = play_episode(parts)
        parts_episode()
        learner, row = parts.learner.update, parts.metrics[-1]
        log = MetricsLog(Path(folder) / "parts")
        draw = learner.draw()
        priority = torch.rand(len(draw.rows))
        episode = parts.player.collector.rollout()
        frames = config.task.max_steps
        summed = {
            "collect": lambda: parts.player.collector.rollout().numel(),
            "store": lambda: parts.learner.remember(episode) or frames,
            "learn": partial(_repeat, lambda: learner(True), frames),
            "log": lambda: log.write(row) or frames,
            "checkpoint": lambda: parts.save() and frames,
        }
        # What learning is made of: shown, but a loop of one of them alone flatters it.
        detail = {
            "draw": partial(_repeat, learner.draw, frames),
            "update": partial(_repeat, lambda: learner.update(True, *draw), frames),
            "prioritize": partial(_repeat, lambda: learner.prioritize(draw.rows, priority), frames),
        }
        times = alternate(
            {"run": play_episode(run), **summed, **detail}, repeats=max(1, effort.rounds // 3)
        )
    yield Row(
        "run",
        "whole Swingup run / sum of its parts, per frame",
        times["run"] / sum(times[name] for name in summed),
        at_most=1.15,
        parts={f"{name} us": 1e6 * seconds for name, seconds in times.items()},
    )
    yield Row(
        "run",
        "drawing rows and setting priorities / update",
        (times["draw"] + times["prioritize"]) / times["update"],
        at_most=0.15,
        parts={f"{name} us": 1e6 * times[name] for name in detail},
    )


def start_rows(effort: Effort) -> Iterable[Row]:
    """How long a run waits for its first update, where one like it was compiled before."""
    command = [sys.executable, "-c", START, "" if effort.compile else "--quick"]

    def seconds() -> float:
        done = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT)
        return float(done.stdout.splitlines()[-1])

    first, later = seconds(), median(seconds() for _ in range(max(1, effort.rounds // 5)))
    yield Row(
        "start",
        "second run, from having imported torch to the first update",
        later,
        unit="s",
        at_most=8.0,
        # What was compiled on this machine before helps it, too.
        parts={"first run s": first, "second run s": later},
    )


START = """
import sys, time
import torch
start = time.perf_counter()
from benchmarks.speed import QUICK, Effort, paper_config
from torchrl_l2c2.experiment import Experiment
experiment = Experiment(paper_config(QUICK if sys.argv[1] else Effort(steps=100)))
experiment.learner.remember(experiment.player.collector.rollout())
experiment.learner.update(True)
print(time.perf_counter() - start)
"""


def peer_rows(effort: Effort) -> Iterable[Row]:
    """Whole training by other libraries, on the same task, networks and batches."""
    steps = min(512, effort.steps)
    settings = {
        "env_id": PAPER_TASKS["swingup"].env_id,
        "frames": steps,
        "turn": 4 * steps,
        "compile": effort.compile,
    }
    how = {"rounds": max(1, effort.rounds // 3), "python": effort.peer_python}
    for layer, batch in ((100, 32), (256, 256)):
        same = {**settings, "layers": [layer, layer], "batch": batch}
        what = f"SAC here / SBX SAC, layers of {layer}, batch {batch}"
        yield from against(what, "sac", "sbx sac", same, at_most=0.9, **how)
    same = {**settings, "layers": [64, 64], "batch": 64}
    what = "PPO here / Stable-Baselines3 PPO, layers of 64, batch 64"
    yield from against(what, "ppo", "sb3 ppo", same, at_most=0.4, **how)


def baseline_rows(effort: Effort) -> Iterable[Row]:
    """A whole run, and SAC's, against Stable-Baselines3's SAC on the same networks and batches."""
    names = {
        "paper": "whole run (L2C2) / Stable-Baselines3 SAC, frames/s",
        "sac": "whole run (SAC) / Stable-Baselines3 SAC, frames/s",
    }
    try:
        from stable_baselines3 import SAC
    except ModuleNotFoundError:
        note = "not measured: pip install 'torchrl-l2c2[benchmark]'"
        for kind, name in names.items():
            yield Row("sb3", name, at_least=4.0 if kind == "paper" else None, note=note)
        return
    config = dataclasses.replace(paper_config(effort), checkpoint_interval=1e9)
    sac = dataclasses.replace(
        config,
        algorithm=SACConfig(hidden=config.algorithm.hidden, random_frames=0),
        regularizer=NoRegularizerConfig(),
        replay=UniformReplayConfig(capacity=config.replay.capacity, batch_size=32),
        optimizer=None,
    )
    steps = config.task.max_steps
    baseline = SAC(
        "MlpPolicy",
        gymnasium.make(config.task.env_id, max_episode_steps=steps),
        policy_kwargs={"net_arch": list(config.algorithm.hidden)},
        buffer_size=config.replay.capacity,
        batch_size=config.replay.batch_size,
        learning_starts=config.replay.batch_size,
        train_freq=1,
        gradient_steps=1,
        device="cpu",
    )

    def learn() -> int:
        baseline.learn(steps, reset_num_timesteps=False, log_interval=None)
        return steps

    actions = {"paper": play_episode(Experiment(config)), "sac": play_episode(Experiment(sac))}
    times = alternate({**actions, "sb3": learn}, repeats=max(1, effort.rounds // 3))
    fps = {name: 1.0 / seconds for name, seconds in times.items()}
    for kind, name in names.items():
        yield Row(
            "sb3",
            name,
            fps[kind] / fps["sb3"],
            at_least=4.0 if kind == "paper" else None,
            parts={"ours frames/s": fps[kind], "Stable-Baselines3 frames/s": fps["sb3"]},
        )


def process_rows(effort: Effort) -> Iterable[Row]:
    """What the second core gives to a second run."""
    command = [sys.executable, "-m", "benchmarks.speed", "--worker"]
    command += [] if effort.compile else ["--quick"]
    pipe = subprocess.PIPE
    # One after the other: the second finds what the first has compiled.
    workers = []
    for _ in range(2):
        worker = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, cwd=ROOT)
        worker.stdout.readline()
        workers.append(worker)

    def play(*chosen: subprocess.Popen) -> int:
        for worker in chosen:
            print("go", file=worker.stdin, flush=True)
        return sum(int(worker.stdout.readline()) for worker in chosen)

    times = alternate(
        {
            "one": lambda: play(workers[0]) + play(workers[1]),
            "two": lambda: play(*workers),
        },
        repeats=max(1, effort.rounds // 3),
    )
    for worker in workers:
        worker.communicate()
    yield Row(
        "processes",
        "two runs side by side / one, frames/s",
        times["one"] / times["two"],
        at_least=1.8,
        parts={"one frames/s": 1.0 / times["one"], "two frames/s": 1.0 / times["two"]},
    )


def _work(effort: Effort) -> None:
    """What a process of ``process_rows`` does: an episode for every line that it is sent."""
    play = play_episode(Experiment(paper_config(effort)))
    play()
    print("ready", flush=True)
    for _ in sys.stdin:
        print(play(), flush=True)


def import_rows(effort: Effort) -> Iterable[Row]:
    """What importing this package adds to importing TorchRL."""
    # The parts of TorchRL that the package builds on; `import torchrl` alone loads them late.
    parts_of_torchrl = "torchrl.data, torchrl.envs, torchrl.modules, torchrl.objectives"
    statements = {
        "import torchrl_l2c2 s": ("import torchrl", "import torchrl_l2c2"),
        "every name of it beyond those of torchrl s": (
            f"import {parts_of_torchrl}",
            "from torchrl_l2c2 import *",
        ),
    }
    parts = {
        name: median(_import_seconds(*pair) for _ in range(max(1, effort.rounds // 3)))
        for name, pair in statements.items()
    }
    yield Row(
        "import",
        "import torchrl_l2c2 beyond import torchrl",
        parts["import torchrl_l2c2 s"],
        unit="s",
        at_most=0.2,
        parts=parts,
    )


def _import_seconds(before: str, statement: str) -> float:
    code = (
        f"import time; {before}; start = time.perf_counter()\n"
        f"{statement}; print(time.perf_counter() - start)"
    )
    command = [sys.executable, "-c", code]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def cuda_rows(effort: Effort) -> Iterable[Row]:
    """The update on a CUDA device: eager, and compiled into CUDA graphs."""
    for size in (32, 1024, 16384):
        name = f"eager update / compiled update with CUDA graphs, batch {size}"
        if not torch.cuda.is_available():
            yield Row("cuda", name, note="not measured: no CUDA device")
            continue
        actions = {
            "eager": updates(effort, size, "l2c2", False, "cuda"),
            "graphs": updates(effort, size, "l2c2", effort.compile, "cuda"),
        }
        waiting = {what: partial(_synchronized, action) for what, action in actions.items()}
        times = alternate(waiting, repeats=effort.rounds, warm_up=5)
        us = {f"{what} us": 1e6 * seconds / 20 for what, seconds in times.items()}
        yield Row("cuda", name, us["eager us"] / us["graphs us"], parts=us)


def _synchronized(action: Callable[[], object]) -> None:
    for _ in range(20):
        action()
    torch.cuda.synchronize()


ROWS: dict[str, Callable[[Effort], Iterable[Row]]] = {
    "import": import_rows,
    "update": update_rows,
    "ppo_update": ppo_update_rows,
    "update_4096": large_update_rows,
    "collection": collection_rows,
    "workers": worker_rows,
    "run": run_rows,
    "start": start_rows,
    "sb3": baseline_rows,
    "peers": peer_rows,
    "processes": process_rows,
    "cuda": cuda_rows,
}


def paper_config(effort: Effort) -> ExperimentConfig:
    """The paper's L2C2 on Swingup with one update a frame, for as long as one asks."""
    return ExperimentConfig(
        task=TaskConfig(max_steps=effort.steps, episodes=1),
        algorithm=PPORPEConfig(updates=effort.steps),
        compile=effort.compile,
    )


def play_episode(experiment: Experiment) -> Callable[[], int]:
    """Training of one more episode, as a function; returns its frames."""

    def play() -> int:
        before = experiment.player.frames
        experiment.train(len(experiment.metrics) + 1)
        return experiment.player.frames - before

    return play


def updates(
    effort: Effort, size: int, regularizer: str, compile: bool, device: str = "cpu"
) -> Callable[[], Tensor]:
    """Updates of a new agent with one batch."""
    config = dataclasses.replace(
        paper_config(effort),
        regularizer=REGULARIZERS[regularizer],
        replay=PrioritizedReplayConfig(capacity=max(10_000, size), batch_size=size),
        compile=False,
    )
    experiment = Experiment(config)
    learner, agent = experiment.learner, experiment.agent
    learner.remember(experiment.player.collector.rollout())
    if device == "cpu":
        update = ReplayUpdate(agent, learner.replay, compile=compile)
        draw = update.draw()
        return lambda: update.update(True, *draw)
    agent.loss.to(device)
    agent.optimizer = config.optimizer.make(agent.loss.parameters())
    agent.target_updater = TSoftUpdate(agent.loss)
    step = make_update(agent, compile=False)
    if compile:
        torch._dynamo.config.trace_autograd_ops = True
        step = torch.compile(step, fullgraph=True, mode="reduce-overhead")
    batch = learner.replay.sample().to(device)
    return lambda: step(True, batch)


def matrix_products(update: Callable[[], object]) -> partial[None]:
    """The matrix products that an eager update makes, forward and backward, and nothing else."""
    with _Recorder() as recorder:
        update()
    products = [
        (left, right, torch.empty(*left.shape[:-1], right.shape[-1]))
        for left, right in recorder.factors
    ]
    return partial(_multiply, products)


@torch.no_grad()
def _multiply(products: list[tuple[Tensor, Tensor, Tensor]]) -> None:
    for left, right, out in products:
        torch.matmul(left, right, out=out)


class _Recorder(TorchDispatchMode):
    """Keeps the factors of every matrix product, with the strides that they had."""

    def __init__(self) -> None:
        super().__init__()
        self.factors: list[tuple[Tensor, Tensor]] = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        aten = torch.ops.aten
        if func.overloadpacket in (aten.mm, aten.bmm, aten.addmm, aten.baddbmm):
            self.factors.append(tuple(factor.detach().clone() for factor in args[-2:]))
        return func(*args, **(kwargs or {}))


def _repeat(action: Callable[[], object], times: int) -> int:
    for _ in range(times):
        action()
    return times


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.speed", description=__doc__)
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=list(ROWS), help="default: all")
    parser.add_argument("--json", type=Path, help="file to write the rows to")
    parser.add_argument("--markdown", type=Path, help="file to write the table to")
    parser.add_argument(
        "--quick", action="store_true", help="one short uncompiled round: shows that it runs"
    )
    parser.add_argument(
        "--peer-python", default=sys.executable, help="interpreter that has SBX (default: this)"
    )
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> None:
    """Measures, prints and writes the rows."""
    options = _parse(arguments)
    for chatty in ("torchrl", "torch"):
        logging.getLogger(chatty).setLevel(logging.ERROR)
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    effort = dataclasses.replace(
        QUICK if options.quick else Effort(), peer_python=options.peer_python
    )
    if options.worker:
        _work(effort)
        return
    where, rows, started = machine(), [], time.monotonic()
    for group in tqdm(options.rows, disable=None):
        # Functions of one source share what was compiled for them: begin anew.
        torch.compiler.reset()
        for row in ROWS[group](effort):
            tqdm.write(to_text(row))
            rows.append(row)
    result = {
        "machine": where,
        "quick": options.quick,
        "minutes": (time.monotonic() - started) / 60,
        "rows": [row.to_dict() for row in rows],
    }
    if options.json:
        options.json.write_text(json.dumps(result, indent=2) + "\n")
    if options.markdown:
        given = sys.argv[1:] if arguments is None else arguments
        command = " ".join(("python -m benchmarks.speed", *given))
        options.markdown.write_text(to_markdown(rows, where, command))


if __name__ == "__main__":
    main()
