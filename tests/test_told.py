"""A run that cannot be a result says so: not finite, untrained, or hardly regularized."""

import json
import warnings
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from small import ALGORITHMS, replay_of
from tensordict import TensorDict
from torchrl.envs import GymEnv
from torchrl.modules import MLP, Actor, ValueOperator
from torchrl.objectives import DDPGLoss

from torchrl_l2c2 import L2C2Loss, Neighborhood, NeighborTransform
from torchrl_l2c2.experiment import (
    AdamConfig,
    ASAPConfig,
    CAPSConfig,
    Experiment,
    ExperimentConfig,
    L2C2Config,
    NoRegularizerConfig,
    SACConfig,
    TaskConfig,
    TD3Config,
)
from torchrl_l2c2.experiment.agents.build import make_algorithm
from torchrl_l2c2.experiment.run.schedules import _learn
from torchrl_l2c2.gains import gradient_shares

PENDULUM = TaskConfig("pendulum", "Pendulum-v1", episodes=2, max_steps=40)


def make(name, folder=None, **settings):
    values = {
        "task": replace(PENDULUM, name="task", env_id="Pendulum-v1"),
        "algorithm": ALGORITHMS[name],
        "replay": replay_of(name),
        "optimizer": AdamConfig(),
        "compile": False,
        "test_episodes": 1,
        **settings,
    }
    return Experiment(ExperimentConfig(**values), folder)


def warned(make_it):
    """The messages of what ``make_it`` warns of, those about results alone."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        make_it()
    parts = ("neighbors are drawn", "regularizer's terms", "untrained")
    return [str(w.message) for w in caught if any(part in str(w.message) for part in parts)]


@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_parameter_that_is_not_finite_stops_every_algorithm(tmp_path, monkeypatch, name):
    """With its name, the update and the last checkpoint, whatever the loss has made of it.

    Before a late test is played, which would blame the environment.
    """

    def blamed(number):
        pytest.fail("the environment was tested with it")

    settings = {"random_frames": 35} if name in ("sac", "td3") else {}
    few = {"algorithm": replace(ALGORITHMS[name], **settings)}  # updates, that is
    run = make(name, tmp_path, late_share=0.5, **few)
    run.train(1)
    if name != "ppo":  # which is tested before the update of the rollout
        monkeypatch.setattr(run._late_tests, "play", blamed)
    parameter_name, parameter = list(run.agent.loss.named_parameters())[-1]
    step = run.agent.optimizer.step

    def broken(*args, **kwargs):
        step(*args, **kwargs)
        # Overflown, as by a gradient of the last update: no loss has seen it yet.
        if run.learner.updates == last - 1:
            parameter.data.view(-1)[0] = float("inf")

    last = make(name, **few).train(2)[-1]["updates"]
    run.agent.optimizer.step = broken
    run.learner.rebuild_update()
    with pytest.raises(FloatingPointError, match=f"not finite after update {last}, ") as stopped:
        run.train(2)
    assert parameter_name in str(stopped.value)
    assert "Last good checkpoint: " in str(stopped.value) and "1.pt" in str(stopped.value)


@pytest.mark.parametrize("name", ["ppo_rpe", "sac", "td3", "ppo"])
def test_an_action_that_is_not_finite_stops_every_algorithm(name):
    """The policy's, with its frame."""
    run = make(name)
    for parameter in run.agent.policy.parameters():
        parameter.data.fill_(float("nan"))
    first = 11 if name in ("sac", "td3") else 1  # the first that is not random
    message = rf"action is not finite at frame {first}: \[nan\]. It comes from the policy"
    with pytest.raises(FloatingPointError, match=message):
        run.train()


def test_a_run_without_an_update_says_so(tmp_path):
    """At its end, in its metrics and beside its test episodes."""
    run = make("sac", tmp_path, algorithm=SACConfig(hidden=(8,), random_frames=81))
    (message,) = warned(run.train)
    assert message.startswith("no update was made in 80 frames, of which the first 81 were random")
    assert run.metrics[-1]["updates"] == 0
    run.finish(run.test())
    written = json.loads((tmp_path / "evaluation.json").read_text())["training"]
    assert written == {
        "episodes": len(run.metrics),
        "frames": 80,
        "updates": 0,
        "untrained": message,
    }


def test_learning_begins_with_the_last_random_frame():
    """Of ten random frames the tenth is followed by an update."""

    class Memory(list):
        batch_size = 2

    asked = []
    learner = SimpleNamespace(replay=Memory(range(20)), learn=asked.append)
    for frame in (9, 10):
        _learn(learner, ALGORITHMS["sac"], 1, frame)
    assert asked == [1]


def test_one_term_with_a_gradient_is_enough():
    """The largest share counts, as a value term may be small by choice."""
    learner = make("sac").learner
    learner.update = SimpleNamespace(example=lambda: None)
    learner.shares = lambda batch: {"loss_a": 1e-6, "loss_b": 0.5}
    assert not warned(learner._warn_weak_regularizer)
    learner.shares = lambda batch: {"loss_a": 1e-6, "loss_b": 1e-6}
    (message,) = warned(learner._warn_weak_regularizer)
    assert "loss_a: 1e-06, loss_b: 1e-06" in message


def test_a_run_of_random_actions_alone_says_so(tmp_path):
    """Updates without a frame of the policy's own; one that has both says nothing."""
    run = make("sac", algorithm=SACConfig(hidden=(8,), random_frames=80))
    (message,) = warned(run.train)
    assert message.startswith("the policy never acted in 80 frames")
    trained = make("sac", tmp_path, algorithm=SACConfig(hidden=(8,), random_frames=60))
    assert not warned(trained.train)
    trained.finish(trained.test())
    assert json.loads((tmp_path / "evaluation.json").read_text())["training"]["untrained"] is None


def ddpg():
    torch.manual_seed(0)
    value = ValueOperator(MLP(in_features=4, out_features=1), in_keys=["observation", "action"])
    return DDPGLoss(Actor(torch.nn.Linear(3, 1)), value)


def ddpg_batch():
    return TensorDict(
        {
            "observation": torch.randn(6, 3),
            "action": torch.randn(6, 1),
            "next": {
                "observation": torch.randn(6, 3),
                "reward": torch.randn(6, 1),
                "done": torch.zeros(6, 1, dtype=torch.bool),
                "terminated": torch.zeros(6, 1, dtype=torch.bool),
            },
        },
        [6],
    )


def test_actions_of_several_ranges_are_told_of_td3s_noise():
    """Which has one deviation for all of them."""
    env = GymEnv("LunarLanderContinuous-v3")
    space = env.action_spec.space
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make_td3(env)
    space.high[1], space.low[1] = 0.1, -0.1
    with pytest.warns(UserWarning, match=r"half ranges \[1.0, 0.1.*RescaleAction"):
        make_td3(env)


def make_td3(env):
    return make_algorithm(TD3Config(hidden=(8,)), env, NoRegularizerConfig(), AdamConfig())


def test_gradient_shares_are_the_quotients_of_the_norms():
    """By hand, in the parameters of each term; they are proportional to the gain."""
    loss, batch = L2C2Loss(ddpg(), beta=0.1), NeighborTransform(Neighborhood())(ddpg_batch())
    expected = {}
    for added, own, network in (
        ("loss_l2c2_actor", "loss_actor", "actor_network_params"),
        ("loss_l2c2_value", "loss_value", "value_network_params"),
    ):
        parameters = list(getattr(loss, network).values(True, True))
        terms = loss(batch.copy())
        norms = [
            torch.cat([g.flatten() for g in torch.autograd.grad(terms[key], parameters, **KEEP)])
            for key in (added, own)
        ]
        expected[added] = (norms[0].norm() / norms[1].norm()).item()
    assert gradient_shares(loss, batch) == pytest.approx(expected, rel=1e-5)
    loss.l2c2_coeff = 0.5
    halves = {key: share / 2 for key, share in expected.items()}
    assert gradient_shares(loss, batch) == pytest.approx(halves, rel=1e-5)
    with pytest.raises(TypeError, match=r"this DDPGLoss has none: .*loss = smooth\(loss\)"):
        gradient_shares(ddpg(), batch)


KEEP = {"retain_graph": True}


def test_frozen_parameters_have_no_part_in_a_share():
    """As with an encoder that is not trained; of a network that is wholly frozen the share is 0."""
    loss, batch = L2C2Loss(ddpg(), beta=0.1), NeighborTransform(Neighborhood())(ddpg_batch())
    policy, *others = loss.actor_network_params.values(True, True)
    before = gradient_shares(loss, batch)
    for parameter in others:
        parameter.requires_grad_(False)
    terms = loss(batch.copy())
    norms = [
        torch.autograd.grad(terms[key], policy, **KEEP)[0].norm()
        for key in ("loss_l2c2_actor", "loss_actor")
    ]
    share = (norms[0] / norms[1]).item()
    expected = {"loss_l2c2_actor": share, "loss_l2c2_value": before["loss_l2c2_value"]}
    assert gradient_shares(loss, batch) == pytest.approx(expected, rel=1e-5)
    policy.requires_grad_(False)
    assert gradient_shares(loss, batch)["loss_l2c2_actor"] == 0.0


@pytest.fixture
def measured_soon(monkeypatch):
    """After 15 updates, not 100, it is told which regularizer is faint."""
    monkeypatch.setattr("torchrl_l2c2.experiment.learn.learner.MEASURE_AFTER", 15)


def many_updates(name, regularizer, updates=20):
    """In three episodes; with at least so many."""
    task = replace(PENDULUM, episodes=3)
    few = {
        "ppo_rpe": {"updates": -(-updates // 2), "replay_ratio": None},
        "ppo": {"epochs": -(-updates // 8)},  # of eight batches in four rollouts
    }
    algorithm = replace(ALGORITHMS[name], **few.get(name, {"random_frames": 120 - updates}))
    return make(name, task=task, algorithm=algorithm, regularizer=regularizer)


def test_a_regularizer_is_measured_after_a_hundred_updates():
    """Tests with fewer have it told sooner."""
    faint = CAPSConfig(lambda_temporal=1e-9, lambda_spatial=1e-9)
    (message,) = warned(many_updates("sac", faint, updates=105).train)
    assert message.startswith("after 100 updates")


@pytest.mark.parametrize("name", ["ppo_rpe", "sac", "td3", "ppo"])
def test_a_faint_regularizer_is_told_once_with_what_to_change(name, measured_soon):
    """Of every algorithm; a strong one is not."""
    faint, strong = (
        CAPSConfig(lambda_temporal=1e-9, lambda_spatial=1e-9),
        CAPSConfig(lambda_temporal=1.0, lambda_spatial=1.0),
    )
    (message,) = warned(many_updates(name, faint).train)
    assert message.startswith("after 15 updates") and "loss_caps_spatial" in message
    assert "raise the gains of the regularizer" in message
    assert not warned(many_updates(name, strong).train)


def test_a_predictor_beside_the_policy_hides_no_faint_regularizer(measured_soon):
    """ASAP's, which the loss's own terms do not train: its share is infinite."""
    faint = ASAPConfig(lambda_spatial=1e-12, lambda_grad=1e-12)
    (message,) = warned(many_updates("sac", faint).train)
    assert "loss_asap_spatial" in message and "loss_asap_temporal" not in message


@pytest.mark.parametrize(
    "name", ["ppo", *(pytest.param(name, marks=pytest.mark.slow) for name in ("ppo_rpe", "sac"))]
)
def test_looking_for_a_faint_regularizer_changes_no_number(monkeypatch, measured_soon, name):
    """Nor any random stream: every parameter is what it is without."""

    def parameters():
        run = many_updates(name, L2C2Config())
        run.train()
        assert run.learner.updates > 15
        return torch.cat([p.detach().flatten() for p in run.agent.loss.state_dict().values()])

    looked = parameters()
    monkeypatch.setattr("torchrl_l2c2.experiment.learn.learner.MEASURE_AFTER", 10**9)
    assert torch.equal(looked, parameters())
