"""Training loops of other packages: a PPO loop in the form of Isaac Lab's, and mjlab itself."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.modules import (
    MLP,
    IndependentNormal,
    NormalParamExtractor,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
)
from torchrl.objectives import ClipPPOLoss, KLAdaptiveLR
from torchrl.objectives.value import GAE

from tests.test_docs import run_blocks
from torchrl_l2c2 import smooth

ROOT = Path(__file__).parents[1]
ENVS, STEPS, ITERATIONS, EPOCHS, MINIBATCHES = 32, 16, 6, 3, 4

# What an environment that resets within its step returns as the next observation at a done.
LAST, MISSING, RESET = "last", "missing", "reset"


class Points(EnvBase):
    """Points to be pushed to the origin, which reset themselves within the step, as robots do.

    Observations are two groups: the actor's, with noise, and the critic's. Episodes take 10 steps,
    and begin at different steps; a point beyond 3 is lost.
    """

    def __init__(self, at_done: str = LAST, bounded: bool = False) -> None:
        super().__init__(batch_size=[ENVS])
        self.at_done = at_done
        self.observation_spec = Composite(
            policy=Unbounded([ENVS, 3]), critic=Unbounded([ENVS, 2]), shape=[ENVS]
        )
        action = Unbounded([ENVS, 1])
        self.action_spec = Bounded(-1.0, 1.0, [ENVS, 1]) if bounded else action
        self.reward_spec = Unbounded([ENVS, 1])
        flags = {key: Binary(1, [ENVS, 1], dtype=torch.bool) for key in FLAGS}
        self.done_spec = Composite(flags, shape=[ENVS])

    def _set_seed(self, seed: int | None) -> None:
        torch.manual_seed(seed)

    def _observed(self) -> TensorDict:
        state = torch.cat([self.position, self.velocity], -1)
        noisy = torch.cat([state + 0.1 * torch.randn_like(state), self.last_action], -1)
        return TensorDict({"policy": noisy, "critic": state}, [ENVS])

    def _begin(self, rows: Tensor) -> None:
        count = int(rows.sum())
        self.position[rows] = torch.rand(count, 1) * 2 - 1
        self.velocity[rows], self.last_action[rows], self.age[rows] = 0.0, 0.0, 0

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDict:
        if tensordict is None or tensordict.get("_reset", None) is None:
            self.position = torch.zeros(ENVS, 1)
            self.velocity, self.last_action = torch.zeros(ENVS, 1), torch.zeros(ENVS, 1)
            self.age = torch.zeros(ENVS, dtype=torch.long)
            self._begin(torch.ones(ENVS, dtype=torch.bool))
            self.age = torch.arange(ENVS) % 10
            self.observed = self._observed()
        return self.observed.clone()  # These environments have reset themselves.

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self.last_action = tensordict["action"].clamp(-1, 1)
        self.velocity = 0.9 * self.velocity + 0.3 * self.last_action
        self.position = self.position + 0.3 * self.velocity
        self.age = self.age + 1
        lost, late = self.position.abs() > 3, self.age[:, None] >= 10
        done = lost | late
        reward = -self.position.abs()
        last = self._observed()
        self._begin(done[:, 0])
        self.observed = last.where(~done[:, 0], self._observed())
        if self.at_done == LAST:
            following = last
        elif self.at_done == MISSING:
            following = last.apply(lambda entry: entry.masked_fill(done, torch.nan))
        else:
            following = self.observed.clone()
        return following.update(
            {"reward": reward, "done": done, "terminated": lost, "truncated": late & ~lost}
        )


FLAGS = ("done", "terminated", "truncated")


class Trained(NamedTuple):
    """Rewards, learning rates and terms by iteration; the loss; the last rollout; warnings."""

    rewards: list[float]
    rates: list[float]
    logged: list[dict[str, float]]
    loss: ClipPPOLoss
    batch: TensorDictBase
    warned: list[str]


def make_loss(env: Points) -> tuple[ProbabilisticActor, GAE, ClipPPOLoss]:
    """Networks of Isaac Lab's form: a scale for each state, a critic with a group of its own."""
    torch.manual_seed(0)
    bounded = isinstance(env.action_spec, Bounded)
    layers = MLP(in_features=3, out_features=2, num_cells=[32, 32], activation_class=nn.ELU)
    actor = ProbabilisticActor(
        TensorDictModule(
            nn.Sequential(layers, NormalParamExtractor()), ["policy"], ["loc", "scale"]
        ),
        in_keys=["loc", "scale"],
        spec=env.action_spec,
        distribution_class=TanhNormal if bounded else IndependentNormal,
        distribution_kwargs={"low": -1.0, "high": 1.0} if bounded else {},
        return_log_prob=True,
    ).eval()
    values = MLP(in_features=2, out_features=1, num_cells=[32, 32], activation_class=nn.ELU)
    critic = ValueOperator(values, in_keys=["critic"]).eval()
    advantage = GAE(gamma=0.95, lmbda=0.95, value_network=critic, average_gae=True)
    # GAE of torchrl 0.14.1 keeps no values, which this needs, where next observations are NaN.
    clip = env.at_done != MISSING
    return actor, advantage, ClipPPOLoss(actor, critic, entropy_bonus=False, clip_value=clip)


def train(
    env: Points, wrap: Callable[[ClipPPOLoss], ClipPPOLoss], iterations: int = ITERATIONS
) -> Trained:
    """A loop of Isaac Lab's form: all ``loss_`` terms, and a learning rate that follows the KL."""
    actor, advantage, base = make_loss(env)
    loss = wrap(base)
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-3)
    scheduler = KLAdaptiveLR(optimizer, target_kl=0.01)
    frames = ENVS * STEPS
    collector = Collector(
        env,
        actor,
        frames_per_batch=frames,
        total_frames=frames * iterations,
        auto_register_policy_transforms=True,
    )
    rewards, rates, logged = [], [], []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for iteration, batch in enumerate(collector):
            if hasattr(loss, "set_progress"):
                loss.set_progress(iteration / iterations)
            for _ in range(EPOCHS):
                with torch.no_grad():
                    advantage(batch)
                rows = batch.reshape(-1)
                for chosen in torch.randperm(len(rows)).chunk(MINIBATCHES):
                    terms = loss(rows[chosen])
                    optimizer.zero_grad()
                    sum(term for key, term in terms.items() if key.startswith("loss_")).backward()
                    nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
                    optimizer.step()
                with torch.no_grad():
                    scheduler.step(loss(rows)["kl_approx"])
            rewards.append(batch["next", "reward"].mean().item())
            rates.append(optimizer.param_groups[0]["lr"])
            logged.append({key: term.item() for key, term in terms.items() if term.numel() == 1})
    collector.shutdown()
    warned = [str(warning.message) for warning in caught]
    return Trained(rewards, rates, logged, loss, batch, warned)


@pytest.fixture(scope="module", params=[LAST, MISSING, RESET])
def trained(request: pytest.FixtureRequest) -> Trained:
    """A training with the preset for each kind of environment."""
    ends = {"skip_ends": True} if request.param == RESET else {}
    return train(Points(request.param), lambda base: smooth(base, **ends))


def actor_gradients(loss: ClipPPOLoss, term: Tensor) -> list[Tensor]:
    parameters = list(loss.actor_network_params.parameters())
    return list(torch.autograd.grad(term, parameters))


def test_it_trains(trained: Trained) -> None:
    """The reward rises, the learning rate moves, the gain rises with the iterations."""
    assert trained.rewards[-1] > trained.rewards[0] + 0.05
    assert len(set(trained.rates)) > 1
    assert trained.loss.regularizer_gain.item() == pytest.approx((ITERATIONS - 1) / ITERATIONS)
    penalties = [logged["penalty_l2c2_actor"] for logged in trained.logged]
    assert penalties[0] == 0.0 and all(penalty > 0 for penalty in penalties[1:])


def test_the_actors_gradient_contains_the_penaltys(trained: Trained) -> None:
    """What the loop differentiates is the base loss's gradient and the penalty's."""
    loss, rows = trained.loss, trained.batch.reshape(-1)

    def gradients(*keys: str) -> list[Tensor]:
        torch.manual_seed(3)
        terms = loss(rows)
        return actor_gradients(loss, sum(terms[key] for key in keys))

    folded = gradients("loss_objective")
    loss.unfold()
    try:
        own, penalty = gradients("loss_objective"), gradients("loss_l2c2_actor")
    finally:
        loss.fold()
    torch.testing.assert_close(folded, [a + b for a, b in zip(own, penalty, strict=True)])
    assert all(each.isfinite().all() for each in folded)
    assert sum(each.norm() for each in penalty) > 1e-3 * sum(each.norm() for each in own)


@contextmanager
def rows_seen(network: nn.Module) -> Iterator[list[int]]:
    """The number of states in each call of a network."""
    seen: list[int] = []
    layer = next(part for part in network.modules() if isinstance(part, nn.Linear))
    handle = layer.register_forward_hook(lambda _, inputs, __: seen.append(inputs[0].numel() // 3))
    try:
        yield seen
    finally:
        handle.remove()


def test_the_call_without_gradients_evaluates_no_neighbors(trained: Trained) -> None:
    """The whole batch, for the learning rate, costs what it costs without a regularizer."""
    loss, rows = trained.loss, trained.batch.reshape(-1)
    with rows_seen(loss.actor_network) as seen, torch.no_grad():
        terms = loss(rows)
    assert seen == [ENVS * STEPS]
    assert terms["penalty_l2c2_actor"].isnan() and terms["kl_approx"].isfinite()
    with rows_seen(loss.actor_network) as seen:
        loss(rows)
    assert sum(seen) > ENVS * STEPS


def test_the_share_that_counts_leaves_out_the_ends_without_a_next_observation(
    trained: Trained, request: pytest.FixtureRequest
) -> None:
    """All rows where the last observation is there, otherwise all but the ends."""
    rows = trained.batch.reshape(-1)
    ends = rows["next", "done"].float().mean().item()
    assert 0.05 < ends < 0.2
    known = request.node.callspec.params["trained"] == LAST
    counted = trained.loss(rows)["l2c2_counted"].item()
    assert counted == pytest.approx(1.0 if known else 1.0 - ends)


def test_only_missing_next_observations_are_warned_of(
    trained: Trained, request: pytest.FixtureRequest
) -> None:
    """Once; the reset state looks like any other."""
    missing = request.node.callspec.params["trained"] == MISSING
    assert sum("without a finite entry" in message for message in trained.warned) == missing


def test_the_page_tells_the_next_observations_apart(
    trained: Trained, request: pytest.FixtureRequest
) -> None:
    """The function of the page, on each kind of environment; and its measure of smoothness."""
    page = run_blocks(ROOT / "docs" / "isaac_lab.md")
    told = {LAST: "last observation", MISSING: "NaN", RESET: "reset state"}
    assert page["next_at_ends"](trained.batch) == told[request.node.callspec.params["trained"]]
    changes = [
        (batch["loc"][step + 1] - batch["loc"][step]).abs().item()
        for batch in trained.batch
        for step in range(STEPS - 1)
        if not batch["next", "done"][step]
    ]
    assert page["mean_action_variation"](trained.batch).item() == pytest.approx(
        sum(changes) / len(changes)
    )


def test_with_skip_ends_the_reset_state_does_not_matter() -> None:
    """Without it, the reset state is taken for the next observation, and nothing tells."""
    env = Points(RESET)
    actor, advantage, base = make_loss(env)
    batch = env.rollout(STEPS, actor, break_when_any_done=False).detach()
    with torch.no_grad():
        advantage(batch)
    moved = batch.clone()
    moved["next", "policy"][batch["next", "done"][..., 0]] += 100.0

    def penalty(batch: TensorDictBase, skip_ends: bool) -> tuple[float, float]:
        torch.manual_seed(0)
        terms = smooth(base, skip_ends=skip_ends)(batch.reshape(-1))
        return terms["penalty_l2c2_actor"].item(), terms["l2c2_counted"].item()

    assert penalty(batch, True) == penalty(moved, True)
    assert penalty(batch, False)[0] != penalty(moved, False)[0]
    assert penalty(batch, False)[1] == 1.0


def test_bounded_actions() -> None:
    """Isaac Lab has a squashed normal for them; the distance is that of the means before."""
    trained = train(Points(bounded=True), smooth, iterations=2)
    assert trained.logged[-1]["penalty_l2c2_actor"] > 0


MJLAB = ["--agent.logger", "tensorboard", "--agent.save-interval", "1"]


def run_mjlab(folder: Path, *command: str) -> str:
    """Trains on the CPU in a process of its own; returns its log."""
    env = os.environ | {"CUDA_VISIBLE_DEVICES": "", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, *command, *MJLAB], cwd=folder, env=env, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def last_actor(folder: Path) -> dict[str, Tensor]:
    """The actor's weights in the last checkpoint."""
    path = max(folder.rglob("model_*.pt"), key=lambda path: path.stat().st_mtime)
    return torch.load(path, weights_only=False)["actor_state_dict"]


def gains(log: str) -> list[float]:
    """The mean gain of each iteration."""
    return [float(gain) for gain in re.findall(r"l2c2_gain loss: (\S+)", log)]


@pytest.mark.slow
def test_mjlab_trains_its_cartpole_with_and_without(tmp_path: Path) -> None:
    """By the example, whose command sets the strength; checkpoints have the baseline's networks."""
    pytest.importorskip("mjlab")
    actors = {}
    for task in ("Mjlab-Cartpole-Balance", "Mjlab-Cartpole-Balance-L2C2"):
        (tmp_path / task).mkdir()
        small = ["--env.scene.num-envs", "64", "--agent.max-iterations", "3"]
        with_l2c2 = task.endswith("L2C2")
        strength = ["--agent.algorithm.regularizer-cfg.strength", "2"] if with_l2c2 else []
        example = str(ROOT / "examples" / "mjlab_cartpole.py")
        log = run_mjlab(tmp_path / task, example, task, *small, *strength)
        assert ("strength=2.0. The gain rises over 3 updates." in log) == with_l2c2
        assert len(gains(log)) == (3 if with_l2c2 else 0)
        if with_l2c2:
            first, *later = gains(log)
            assert first == 0.0 and later == sorted(later) and later[0] > 0
        actors[task] = {key: weight.shape for key, weight in last_actor(tmp_path / task).items()}
    baseline, regularized = actors.values()
    assert baseline == regularized


@pytest.mark.slow
def test_mjlab_trains_a_walking_robot_by_the_class_name(tmp_path: Path) -> None:
    """Two iterations of 16 robots: the command of the page, with the preset's settings."""
    pytest.importorskip("mjlab")
    robot = "Mjlab-Velocity-Flat-Unitree-Go1"
    small = ["--env.scene.num-envs", "16", "--agent.max-iterations", "2"]
    name = ["--agent.algorithm.class-name", "torchrl_l2c2.rsl_rl:L2C2PPO"]
    log = run_mjlab(tmp_path, "-m", "mjlab.scripts.train", robot, *small, *name)
    assert "there is no regularizer_cfg). The gain rises over 2 updates." in log
    assert gains(log)[0] == 0.0 < gains(log)[1]
    assert all(weight.isfinite().all() for weight in last_actor(tmp_path).values())
