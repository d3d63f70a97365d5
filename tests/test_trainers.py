"""The components inside TorchRL's own trainers."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from torch import nn
from torchrl.checkpoint import Checkpoint
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictPrioritizedReplayBuffer
from torchrl.envs import GymEnv
from torchrl.modules import MLP, Actor, ProbabilisticActor, QValueActor, ValueOperator
from torchrl.objectives import (
    ClipPPOLoss,
    CQLLoss,
    DQNLoss,
    LossModule,
    SACLoss,
    SoftUpdate,
    TD3Loss,
)
from torchrl.objectives.utils import TargetNetUpdater
from torchrl.record import CSVLogger
from torchrl.trainers import (
    ReplayBufferTrainer,
    TargetNetUpdaterHook,
    Trainer,
    UpdateWeights,
)
from torchrl.trainers.algorithms import (
    CQLTrainer,
    DQNTrainer,
    PPOTrainer,
    SACTrainer,
    TD3Trainer,
)
from torchrl.trainers.algorithms.td3 import TD3OptimizationStepper

from torchrl_l2c2 import (
    AdaTerm,
    L2C2Loss,
    Neighborhood,
    NeighborTransform,
    ProgressHook,
    TSoftUpdate,
    make_actor,
    smooth,
)

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*experimental/prototype:UserWarning"),
    pytest.mark.filterwarnings("ignore::FutureWarning"),
]

FRAMES, STEPS = 16, 2  # per collected batch
NEAR = Neighborhood(lambda_min=0.1)
TERMS = ["loss_l2c2_actor", "loss_l2c2_qvalue"]


def pendulum_actor() -> ProbabilisticActor:
    """A small policy for the pendulum."""
    return make_actor(3, GymEnv("Pendulum-v1").action_spec, hidden=(8,))


def qvalue() -> ValueOperator:
    """A small action-value function for the pendulum."""
    net = MLP(in_features=4, out_features=1, num_cells=[8])
    return ValueOperator(net, in_keys=["observation", "action"])


def sac(regularized: bool = True) -> LossModule:
    """SAC on the pendulum, with or without the regularization."""
    loss = SACLoss(pendulum_actor(), qvalue(), target_entropy=-1.0)
    # Made at the first batch otherwise, and so unknown to a loss that a file is loaded into.
    loss.make_value_estimator()
    return L2C2Loss(loss, NEAR, beta=0.5) if regularized else loss


def collector(policy: nn.Module, batches: int, name: str = "Pendulum-v1") -> Collector:
    """Collects so many batches from an environment."""
    env = GymEnv(name)
    env.set_seed(0)
    return Collector(env, policy, frames_per_batch=FRAMES, total_frames=batches * FRAMES)


def replay(seed: int = 0) -> TensorDictPrioritizedReplayBuffer:
    """A prioritized buffer whose batches come with neighbors."""
    return TensorDictPrioritizedReplayBuffer(
        alpha=1.0,
        beta=0.5,
        storage=LazyTensorStorage(100),
        batch_size=8,
        transform=NeighborTransform(NEAR, generator=torch.Generator().manual_seed(seed)),
        generator=torch.Generator().manual_seed(seed),
    )


def common(loss: LossModule, batches: int) -> dict:
    """The arguments that all trainers have."""
    return {
        "total_frames": batches * FRAMES,
        "frame_skip": 1,
        "optim_steps_per_batch": STEPS,
        "loss_module": loss,
        "progress_bar": False,
        "log_interval": 0,
    }


def sac_trainer(
    loss: LossModule, batches: int = 2, updater: type[TargetNetUpdater] = TSoftUpdate, **kwargs
) -> SACTrainer:
    """TorchRL's SAC trainer with the components in all the places they can take."""
    return SACTrainer(
        **common(loss, batches),
        collector=collector(loss.actor_network, batches),
        optimizer=AdaTerm(loss.parameters()),
        target_net_updater=updater(loss, tau=0.1),
        replay_buffer=replay(),
        enable_logging=False,
        **kwargs,
    )


def logged(logger: CSVLogger) -> dict[str, list[float]]:
    """The values logged under each name."""
    return {
        name: [float(value) for _, value in rows]
        for name, rows in logger.experiment.scalars.items()
    }


def snapshot(module: nn.Module) -> dict[str, torch.Tensor]:
    """A copy of a module's state."""
    return {
        name: value.clone()
        for name, value in module.state_dict().items()
        if isinstance(value, torch.Tensor)
    }


def test_a_hook_sets_the_progress():
    """Before the first batch, and after each."""
    loss, seen = smooth(sac(regularized=False)), []
    trainer = sac_trainer(loss, batches=4)
    ProgressHook().register(trainer)
    assert loss.regularizer_gain.item() == 0.0
    trainer.register_op("post_steps", lambda: seen.append(loss.regularizer_gain.item()))
    trainer.train()
    assert seen == [0.25, 0.5, 0.75, 1.0]
    with pytest.raises(TypeError, match=r"the trainer's SACLoss has none: wrap it, smooth\(loss\)"):
        ProgressHook().register(sac_trainer(sac(regularized=False)))


@pytest.mark.parametrize("updater", [TSoftUpdate, SoftUpdate])
def test_base_trainer_trains(updater, tmp_path):
    """In a plain Trainer the new terms are logged, priorities are set and targets follow."""
    torch.manual_seed(0)
    loss, buffer, logger = sac(), replay(), CSVLogger("run", log_dir=str(tmp_path))
    before = snapshot(loss)
    trainer = Trainer(
        **common(loss, 3),
        collector=collector(loss.actor_network, 3),
        optimizer=torch.optim.Adam(loss.parameters()),
        logger=logger,
    )
    ReplayBufferTrainer(buffer, flatten_tensordicts=True).register(trainer)
    trainer.register_op("post_optim", TargetNetUpdaterHook(updater(loss, tau=0.1)))
    UpdateWeights(trainer.collector, 1).register(trainer)
    trainer.train()

    values = logged(logger)
    for term in TERMS:
        assert len(values[term]) == 3
        assert all(0.0 < value < float("inf") for value in values[term])
    assert {"l2c2_gain", "l2c2_distance", "l2c2_hellinger", "l2c2_value_distance"} <= set(values)
    after = snapshot(loss)
    changed = [name for name, value in before.items() if not torch.equal(value, after[name])]
    assert any(name.startswith("target_qvalue_network") for name in changed)
    assert any(name.startswith("actor_network") for name in changed)
    assert len(set(buffer.sampler._sum_tree[range(len(buffer))].tolist())) > 2


def test_the_terms_train():
    """Only the regularization's gain differs between two runs, and so do their policies."""

    def trained(coeff):
        torch.manual_seed(0)
        loss = sac()
        loss.l2c2_coeff = coeff
        trainer = sac_trainer(loss, batches=1)
        trainer.train()
        return torch.cat([p.detach().flatten() for p in loss.parameters()])

    assert torch.equal(trained(1.0), trained(1.0))
    assert not torch.equal(trained(1.0), trained(0.0))


def test_sac_trainer_trains(tmp_path):
    """In TorchRL's SACTrainer, with every component of ours in its place."""
    loss, logger = sac(), CSVLogger("run", log_dir=str(tmp_path))
    sac_trainer(loss, logger=logger).train()
    values = logged(logger)
    assert all(len(values[term]) == 2 for term in [*TERMS, "loss_actor", "loss_qvalue"])
    assert all(0.1 <= gain <= 1.0 for gain in values["l2c2_gain"])


def test_dqn_trainer_trains(tmp_path):
    """In TorchRL's DQNTrainer, where there is a value function alone."""
    env, logger = GymEnv("CartPole-v1"), CSVLogger("run", log_dir=str(tmp_path))
    net = MLP(in_features=4, out_features=2, num_cells=[8])
    value = QValueActor(net, in_keys=["observation"], spec=env.action_spec)
    with pytest.warns(UserWarning, match="no policy network"):
        loss = L2C2Loss(DQNLoss(value, delay_value=True, action_space=env.action_spec), NEAR)
    trainer = DQNTrainer(
        **common(loss, 2),
        collector=collector(value, 2, "CartPole-v1"),
        optimizer=torch.optim.Adam(loss.parameters()),
        target_net_updater=TSoftUpdate(loss),
        replay_buffer=replay(),
        enable_logging=False,
        logger=logger,
    )
    trainer.train()
    assert len(logged(logger)["loss_l2c2_value"]) == 2


def test_ppo_trainer_trains(tmp_path):
    """In TorchRL's PPOTrainer, on policy and without a transform, the loss draws neighbors."""
    logger = CSVLogger("run", log_dir=str(tmp_path))
    critic = ValueOperator(MLP(in_features=3, out_features=1, num_cells=[8]))
    loss = L2C2Loss(ClipPPOLoss(pendulum_actor(), critic), NEAR)
    trainer = PPOTrainer(
        **{**common(loss, 2), "optim_steps_per_batch": 1},
        collector=collector(loss.actor_network, 2),
        optimizer=torch.optim.Adam(loss.parameters()),
        enable_logging=False,
        logger=logger,
        num_epochs=1,
    )
    trainer.train()
    values = logged(logger)
    assert len(values["loss_l2c2_actor"]) == len(values["loss_l2c2_critic"]) == 2


def test_a_hook_schedules_a_coefficient(tmp_path):
    """A hook that assigns ``l2c2_coeff`` after each batch scales the terms of the next."""
    loss, logger = sac(), CSVLogger("run", log_dir=str(tmp_path))
    trainer = sac_trainer(loss, batches=3, logger=logger)

    def switch_off():
        loss.l2c2_coeff = 1.0 if trainer.collected_frames < 2 * FRAMES else 0.0

    trainer.register_op("post_steps", switch_off)
    trainer.train()
    first, second, third = logged(logger)["loss_l2c2_actor"]
    assert first > 0.0
    assert second > 0.0
    assert third == 0.0


@pytest.mark.parametrize("regularized", [True, False])
def test_trainer_file_round_trip(regularized, tmp_path):
    """A trainer's own file restores the loss and the optimizer, regularized or not."""
    file = tmp_path / "trainer.pt"
    trainer = sac_trainer(sac(regularized), save_trainer_file=file)
    trainer.train()
    other = sac_trainer(sac(regularized))
    other.load_from_file(file)
    assert other.collected_frames == 2 * FRAMES
    expected = snapshot(trainer.loss_module)
    for name, value in snapshot(other.loss_module).items():
        assert torch.equal(value, expected[name]), name
    saved, loaded = trainer.optimizer.state_dict(), other.optimizer.state_dict()
    for index, state in saved["state"].items():
        for name, value in state.items():
            assert torch.equal(loaded["state"][index][name], value), name


def test_files_are_exchanged_with_the_plain_loss(tmp_path):
    """What was trained plainly goes on regularized, and the other way round."""
    plain, ours = sac_trainer(sac(False)), sac_trainer(sac(True))
    plain.save_trainer_file, ours.save_trainer_file = tmp_path / "plain.pt", tmp_path / "ours.pt"
    for trainer in (plain, ours):
        trainer.save_trainer(force_save=True)
    expected = snapshot(plain.loss_module), snapshot(ours.loss_module)
    assert any(not torch.equal(value, expected[1][name]) for name, value in expected[0].items())
    plain.load_from_file(tmp_path / "ours.pt")
    ours.load_from_file(tmp_path / "plain.pt")
    for trainer, state in zip((ours, plain), expected, strict=True):
        for name, value in snapshot(trainer.loss_module).items():
            assert torch.equal(value, state[name]), name


def test_checkpoint_restores_updater_and_neighbors(tmp_path):
    """``torchrl.checkpoint`` holds the t-soft statistics and the transform's generator, too."""
    path = tmp_path / "checkpoint"

    def make():
        return sac_trainer(sac(), checkpoint=Checkpoint(format="archive"), save_trainer_file=path)

    trainer = make()
    trainer.train()
    other = make()
    other.load_from_file(path)

    saved, loaded = (t.target_net_updater.state_dict() for t in (trainer, other))
    assert any(value != 1e-8 for value in saved["scale"].values())
    assert saved == loaded
    batches = [t.replay_buffer.sample() for t in (trainer, other)]
    for key in [("neighbor", "observation"), ("neighbor", "distance"), "priority_weight", "index"]:
        assert torch.equal(*(batch[key] for batch in batches)), key


def test_documentation_runs():
    """The page's Python trains, and its hook is called; the logged penalty rises from 0."""
    page = (Path(__file__).parents[1] / "docs" / "trainers.md").read_text()
    names: dict[str, Any] = {}
    for block in re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL):
        exec(block, names)
        if "loss" in names and "moved" not in names:
            names["moved"] = mock = Mock(wraps=names["loss"].set_progress)
            object.__setattr__(names["loss"], "set_progress", mock)
    assert [call.args[0] for call in names["moved"].call_args_list] == [0.0, 0.64, 1.28]
    first, second = names["trainer"]._log_dict["penalty_l2c2_actor"]
    assert first == 0.0 and second > 0.0


def test_a_hook_moves_the_ramp(tmp_path):
    """In TorchRL's PPOTrainer, with the page's hook: no penalty at first, all of it in the end."""
    logger = CSVLogger("run", log_dir=str(tmp_path))
    critic = ValueOperator(MLP(in_features=3, out_features=1, num_cells=[8]))
    loss = smooth(ClipPPOLoss(pendulum_actor(), critic), strength=2.0)
    trainer = PPOTrainer(
        **{**common(loss, 4), "optim_steps_per_batch": 1},
        collector=collector(loss.actor_network, 4),
        optimizer=torch.optim.Adam(loss.parameters()),
        enable_logging=False,
        logger=logger,
        num_epochs=1,
    )
    seen = []

    def set_progress():
        loss.set_progress(trainer.collected_frames / trainer.total_frames)
        seen.append(loss.regularizer_gain.item())

    loss.set_progress(0.0)
    trainer.register_op("post_steps", set_progress)
    trainer.train()
    assert seen == [0.5, 1.0, 1.5, 2.0]
    penalties = logged(logger)["penalty_l2c2_actor"]
    assert penalties[0] == 0.0 and all(penalty > 0.0 for penalty in penalties[1:])


def td3_trained(strength: float) -> list[torch.Tensor]:
    """Parameters of actor and critic after one step of TorchRL's TD3Trainer as it stands."""
    torch.manual_seed(0)
    actor = Actor(MLP(in_features=3, out_features=1, num_cells=[8]))
    base = TD3Loss(actor, qvalue(), action_spec=GymEnv("Pendulum-v1").action_spec)
    loss = smooth(base, strength=strength)
    groups = [
        list(params.values(True, True))
        for params in (loss.actor_network_params, loss.qvalue_network_params)
    ]
    stepper = TD3OptimizationStepper(
        optimizer_actor=torch.optim.SGD(groups[0], lr=1.0),
        optimizer_critic=torch.optim.SGD(groups[1], lr=1.0),
        policy_update_delay=1,
    )
    TD3Trainer(
        **{**common(loss, 1), "optim_steps_per_batch": 1},
        collector=collector(loss.actor_network, 1),
        optimization_stepper=stepper,
        target_net_updater=TSoftUpdate(loss),
        replay_buffer=replay(),
        enable_logging=False,
    ).train()
    return [torch.cat([p.detach().flatten() for p in group]) for group in groups]


def test_td3_trainer_trains_with_the_penalty():
    """The actor's gradient has the penalty's, by its strength; the critic's has not."""
    (plain, critic), (once, same), (twice, _) = map(td3_trained, (0.0, 10.0, 20.0))
    assert torch.equal(critic, same)
    assert (once - plain).norm() > 1e-3
    torch.testing.assert_close(twice - plain, 2 * (once - plain), rtol=1e-3, atol=1e-6)


def test_cql_trainer_trains_with_the_penalty():
    """CQLTrainer sums the terms that it names, and the penalty is part of one of them."""

    def trained(strength):
        torch.manual_seed(0)
        spec = GymEnv("Pendulum-v1").action_spec
        base = CQLLoss(pendulum_actor(), qvalue(), action_spec=spec, num_random=2)
        with pytest.warns(UserWarning, match="CQLLoss takes the preset of SACLoss"):
            loss = smooth(base, strength=strength)
        trainer = CQLTrainer(
            **common(loss, 1),
            collector=collector(loss.actor_network, 1),
            optimizer=torch.optim.SGD(loss.parameters(), lr=0.1),
            target_net_updater=TSoftUpdate(loss),
            replay_buffer=replay(),
            enable_logging=False,
        )
        trainer.train()
        return torch.cat([p.detach().flatten() for p in loss.parameters()])

    assert torch.equal(trained(0.0), trained(0.0))
    assert not torch.equal(trained(0.0), trained(1.0))


@pytest.mark.parametrize("damage", [lambda content: content[:-7], None], ids=["cut", "changed"])
def test_a_damaged_archive_is_refused(damage, tmp_path):
    """The format that the page recommends notices what the default does not."""
    network, path = nn.Linear(3, 2), tmp_path / "checkpoint"
    Checkpoint(format="archive", network=network).save(path)
    content = path.read_bytes()
    if damage is None:
        at = content.index(network.weight.detach().numpy().tobytes())
        content = content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :]
    else:
        content = damage(content)
    path.write_bytes(content)
    other = nn.Linear(3, 2)
    before = snapshot(other)
    with pytest.raises(Exception, match=r"CRC-32|not a TorchRL checkpoint"):
        Checkpoint(network=other).load(path)
    assert all(torch.equal(value, before[name]) for name, value in snapshot(other).items())
