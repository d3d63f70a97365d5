"""Regularizers of recurrent policies: single steps from the recurrent states of the batch."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.modules import (
    GRUModule,
    LSTMModule,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
    set_recurrent_mode,
)
from torchrl.objectives import DDPGLoss, IQLLoss, PPOLoss, ReinforceLoss, SACLoss

from torchrl_l2c2 import (
    ASAPLoss,
    CAPSLoss,
    CATSLoss,
    GradCAPSLoss,
    L2C2Loss,
    LCPLoss,
    Neighborhood,
    PPORPELoss,
    SR2LLoss,
    smooth,
)

SEQUENCES, STEPS, OBSERVATION, WIDTH, ACTION = 4, 6, 3, 5, 2
NEAR = Neighborhood(lambda_min=1.0, lambda_max=100.0, neighbors="line")
MODULES = pytest.mark.parametrize("module", [LSTMModule, GRUModule])


def memory(module, **kwargs):
    return module(
        input_size=OBSERVATION, hidden_size=WIDTH, in_key="observation", out_key="embed", **kwargs
    )


class Agent:
    """A recurrent policy in its parts: memory, head, and the whole."""

    def __init__(self, module, gaussian=False, **layers):
        torch.manual_seed(0)
        self.memory = memory(module, **layers)
        self.depth = layers.get("num_layers", 1)
        self.layer = self.memory.lstm if module is LSTMModule else self.memory.gru
        self.states = [key for key in self.memory.in_keys[1:] if key != "is_init"]
        self.head = nn.Linear(WIDTH, ACTION)
        if not gaussian:
            head = TensorDictModule(self.head, ["embed"], ["action"])
            self.actor = TensorDictSequential(self.memory, head)
            return
        whole = nn.Sequential(self.head, AddScale())
        head = TensorDictModule(whole, ["embed"], ["loc", "scale"])
        self.actor = ProbabilisticActor(
            TensorDictSequential(self.memory, head),
            in_keys=["loc", "scale"],
            distribution_class=TanhNormal,
            return_log_prob=True,
        )

    def step(self, observation, states, first):
        """A step of the layers themselves: the memory, and the recurrent states after it.

        ``states``: ``[N, 1, WIDTH]`` each; ``first``: ``[N]``.
        """
        kept = [torch.where(first[:, None, None], 0.0, s).transpose(0, 1) for s in states]
        out, after = self.layer(observation[:, None], tuple(kept) if len(kept) == 2 else kept[0])
        after = after if isinstance(after, tuple) else (after,)
        return out[:, 0], [s.transpose(0, 1) for s in after]

    def at(self, batch, observation):
        """The memory at these observations, from the batch's recurrent states; all ``[N]``."""
        states = [batch[key] for key in self.states]
        return self.step(observation, states, batch["is_init"].squeeze(-1))[0]


def ddpg(agent):
    value = nn.Bilinear(OBSERVATION, ACTION, 1)
    return DDPGLoss(agent.actor, ValueOperator(value, in_keys=["observation", "action"]))


class AddScale(nn.Module):
    def forward(self, loc):
        return loc, torch.full_like(loc, 0.5)


def rollout(agent):
    """Sequences ``[SEQUENCES, STEPS]`` with recurrent states; an episode ends after three steps."""
    torch.manual_seed(1)
    observations = torch.randn(SEQUENCES, STEPS + 1, OBSERVATION)
    states = [torch.zeros(SEQUENCES, agent.depth, WIDTH) for _ in agent.states]
    steps = []
    for t in range(STEPS):
        first = torch.full([SEQUENCES], t in (0, 3))
        embed, after = agent.step(observations[:, t], states, first)
        step = {
            "observation": observations[:, t],
            "action": agent.head(embed),
            "is_init": first[:, None],
            "action_log_prob": torch.zeros(SEQUENCES),
            "advantage": torch.randn(SEQUENCES, 1),
            "value_target": torch.randn(SEQUENCES, 1),
        }
        ended = torch.full([SEQUENCES, 1], t == 2)
        step["next"] = {
            "observation": observations[:, t + 1],
            "reward": torch.randn(SEQUENCES, 1),
            "done": ended,
            "terminated": ended,
            "is_init": torch.zeros(SEQUENCES, 1, dtype=torch.bool),
            **dict(zip(agent.states, after, strict=True)),
        }
        step.update(zip(agent.states, states, strict=True))
        steps.append(TensorDict(step, [SEQUENCES]))
        states = after
    return torch.stack(steps, 1).detach()


@MODULES
class TestSingleSteps:
    def test_neighbors_are_evaluated_from_the_recurrent_state_of_the_step(self, module):
        agent = Agent(module)
        loss = L2C2Loss(ddpg(agent), NEAR, beta=0.0)
        batch = loss.neighbor_transform(torch.Generator().manual_seed(0))(rollout(agent))
        term = loss.policy_regularizer(batch)["loss_l2c2_actor"]
        flat = batch.flatten()
        there = agent.head(agent.at(flat, flat["neighbor", "observation"].squeeze(1)))
        gain = NEAR.gain(flat["neighbor", "distance"].squeeze(-1))
        difference = 0.5 * (flat["action"] - there).square().sum(-1)
        torch.testing.assert_close(term, (gain * difference).mean())

    def test_order_and_shape_of_the_batch_do_not_matter(self, module):
        """Single steps need no neighbors in time: a shuffled batch has the same term."""
        agent = Agent(module)
        loss = L2C2Loss(ddpg(agent), NEAR, beta=0.0)
        batch = loss.neighbor_transform(torch.Generator().manual_seed(0))(rollout(agent))
        shuffled = batch.flatten()[torch.randperm(batch.numel())]
        torch.testing.assert_close(
            loss.policy_regularizer(shuffled)["loss_l2c2_actor"],
            loss.policy_regularizer(batch)["loss_l2c2_actor"],
        )

    def test_only_the_observation_moves(self, module):
        loss = L2C2Loss(ddpg(Agent(module)), NEAR, beta=0.0)
        assert loss.neighbor_transform().in_keys == ["observation"]

    def test_a_critic_may_read_the_policys_recurrent_state(self, module):
        """It is no observation of the critic's either: neighbors keep it."""
        agent = Agent(module, gaussian=True)
        state = agent.states[0]
        value = TensorDictModule(
            lambda observation, memory: observation.sum(-1, True) + memory.sum((-2, -1))[..., None],
            in_keys=["observation", state],
            out_keys=["state_value"],
        )
        loss = L2C2Loss(PPOLoss(agent.actor, value), NEAR, beta=1.0)
        assert loss.neighbor_transform().in_keys == ["observation"]
        assert loss.value_regularizer(rollout(agent))["loss_l2c2_critic"] > 0

    def test_dropout_between_layers_is_off(self, module):
        """At a next state that equals the state, with the same memory, nothing changes."""
        agent = Agent(module, num_layers=2, dropout=0.5)
        batch = rollout(agent)
        for key in ("observation", *agent.states):
            batch["next", key] = batch[key].clone()
        batch["next", "is_init"] = batch["is_init"].clone()
        loss, training = CATSLoss(ddpg(agent)), []
        agent.layer.register_forward_pre_hook(lambda layer, _: training.append(layer.training))
        assert loss.policy_regularizer(batch)["loss_cats"] == 0
        assert agent.layer.training and agent.layer.dropout == 0.5
        assert all(training) and training  # cuDNN differentiates in no other mode.

    def test_the_next_action_is_the_one_that_was_taken(self, module):
        """CATS and CAPS: the rollout itself has the policy's next actions."""
        agent = Agent(module)
        batch = rollout(agent)
        inside = batch[:, :2]  # before the end of the episode
        change = (batch["action"][:, 1:3] - inside["action"]).square().sum(-1).mean()
        term = CATSLoss(ddpg(agent), 1.0).policy_regularizer(inside)["loss_cats"]
        torch.testing.assert_close(term, change)
        loss = CAPSLoss(ddpg(agent), lambda_temporal=1.0)
        term = loss.policy_regularizer(inside)["loss_caps_temporal"]
        torch.testing.assert_close(term, change / 2)

    def test_the_noise_of_caps_is_of_observations_only(self, module):
        agent = Agent(module)
        batch = rollout(agent)
        loss = CAPSLoss(ddpg(agent), sigma=1.0)
        assert loss.policy_regularizer(batch)["loss_caps_spatial"] > 0
        with torch.no_grad():
            agent.layer.weight_ih_l0.zero_()  # The recurrent state alone determines the action.
        assert loss.policy_regularizer(batch)["loss_caps_spatial"] == 0

    @pytest.mark.parametrize("make", [LCPLoss, SR2LLoss])
    def test_gradients_to_observations(self, module, make):
        agent = Agent(module, gaussian=True)
        batch = rollout(agent)
        loss = make(PPOLoss(agent.actor, critic()))
        terms = loss(batch)
        (term,) = (terms[key] for key in loss.policy_terms)
        assert term > 0
        term.backward()
        assert all(p.grad is not None for p in loss.actor_network_params.values(True, True))

    def test_a_share_of_the_rows(self, module):
        agent = Agent(module)
        loss = L2C2Loss(ddpg(agent), NEAR, beta=0.0, fraction=0.5)
        whole = L2C2Loss(ddpg(agent), NEAR, beta=0.0)
        batch = loss.neighbor_transform(torch.Generator().manual_seed(0))(rollout(agent))
        torch.manual_seed(0)
        drawn = [loss.policy_regularizer(batch)["loss_l2c2_actor"].item() for _ in range(400)]
        expected = whole.policy_regularizer(batch)["loss_l2c2_actor"].item()
        assert torch.tensor(drawn).mean().item() == pytest.approx(expected, rel=0.1)


def critic():
    return ValueOperator(nn.Linear(OBSERVATION, 1), in_keys=["observation"])


def others(base):
    """The value functions of a loss, and its other arguments."""
    action_value = ValueOperator(
        nn.Bilinear(OBSERVATION, ACTION, 1), in_keys=["observation", "action"]
    )
    if base is SACLoss:
        return {"qvalue_network": action_value, "target_entropy": -ACTION}
    if base is IQLLoss:
        return {"qvalue_network": action_value, "value_network": critic()}
    return {"critic_network": critic()}


@MODULES
class TestLosses:
    def test_the_losss_own_terms_are_of_sequences(self, module):
        """The loss evaluates the sequences as before; only the regularizer takes single steps."""
        agent = Agent(module, gaussian=True)
        batch, value = rollout(agent), critic()
        own = PPOLoss(agent.actor, value)(batch.copy())
        loss = smooth(PPOLoss(agent.actor, value), fold=False, ramp=None)
        batch = loss.neighbor_transform()(batch)
        terms = loss(batch.copy())
        for key in ("loss_objective", "loss_critic"):
            assert terms[key] == own[key]
        assert terms["loss_l2c2_actor"] == loss.policy_regularizer(batch)["loss_l2c2_actor"] > 0

    @pytest.mark.parametrize(
        "base", [SACLoss, IQLLoss, ReinforceLoss, PPOLoss], ids=lambda base: base.__name__
    )
    @pytest.mark.parametrize(("make", "term"), [(CATSLoss, "cats"), (CAPSLoss, "caps_temporal")])
    def test_the_next_recurrent_states_are_those_of_the_batch(self, module, base, make, term):
        """In sequences, the policy of some losses writes zeros over most of them."""
        agent = Agent(module, gaussian=True)
        batch = rollout(agent)
        loss = make(base(agent.actor, **others(base)), lambda_temporal=1.0)
        expected = loss.policy_regularizer(batch.copy())[f"loss_{term}"]
        with set_recurrent_mode(True):
            assert loss(batch.copy())[f"loss_{term}"] == expected > 0
            if hasattr(loss, "actor_loss"):
                loss.fold()
                _, metadata = loss.actor_loss(batch.copy())
                assert metadata[f"penalty_{term}"] == expected

    def test_a_loss_that_shares_its_evaluation(self, module):
        """An evaluation of sequences is not one of single steps: it is not shared."""
        agent = Agent(module, gaussian=True)
        loss = L2C2Loss(PPORPELoss(agent.actor, critic()), NEAR, beta=0.0)
        batch = loss.neighbor_transform()(rollout(agent))
        with torch.no_grad():
            for parameter in agent.layer.parameters():
                parameter.add_(0.3)  # The states in the batch are of an older policy.
        terms = loss(batch.copy())
        assert terms["loss_l2c2_actor"] == loss.policy_regularizer(batch)["loss_l2c2_actor"] > 0

    def test_training_lowers_the_slope(self, module):
        agent = Agent(module)
        batch = rollout(agent)
        loss = L2C2Loss(ddpg(agent), NEAR, beta=0.0)
        optimizer = torch.optim.Adam(loss.actor_network_params.values(True, True), lr=0.02)

        def penalty():
            torch.manual_seed(2)
            return loss.policy_regularizer(batch)["loss_l2c2_actor"]

        before = penalty().item()
        for _ in range(30):
            optimizer.zero_grad()
            loss.policy_regularizer(batch)["loss_l2c2_actor"].backward()
            optimizer.step()
        assert penalty().item() < 0.1 * before

    def test_a_critic_that_reads_the_policys_memory(self, module):
        """The value at a neighbor is that of the memory after a step with this neighbor."""
        agent = Agent(module, gaussian=True)
        head = ValueOperator(nn.Linear(WIDTH, 1), in_keys=["embed"])
        batch = rollout(agent)
        batch["embed"] = torch.zeros(SEQUENCES, STEPS, WIDTH)  # overwritten
        loss = L2C2Loss(PPOLoss(agent.actor, head), NEAR, beta=1.0)
        batch = loss.neighbor_transform(torch.Generator().manual_seed(0))(batch)
        term = loss.value_regularizer(batch)["loss_l2c2_critic"]
        flat = batch.flatten()
        here, there = (
            head.module(agent.at(flat, observation))
            for observation in (flat["observation"], flat["neighbor", "observation"].squeeze(1))
        )
        gain = NEAR.gain(flat["neighbor", "distance"].squeeze(-1))
        expected = (gain * 0.5 * (here - there).square().sum(-1)).mean()
        torch.testing.assert_close(term, expected)


class TestErrors:
    def test_a_batch_without_recurrent_states(self):
        agent = Agent(LSTMModule)
        batch = rollout(agent).exclude("recurrent_state_c")
        loss = L2C2Loss(ddpg(agent), NEAR, beta=0.0)
        with pytest.raises(KeyError, match=r"the batch has no \['recurrent_state_c'\]: keep the"):
            loss.policy_regularizer(batch)

    @pytest.mark.parametrize("make", [CATSLoss, CAPSLoss])
    def test_next_actions_need_the_next_recurrent_state(self, make):
        """With the state of the step before, another action would be compared."""
        agent = Agent(GRUModule)
        batch = rollout(agent).exclude(("next", "recurrent_state"))
        with pytest.raises(KeyError, match=r"needs \[\('next', 'recurrent_state'\)\]"):
            make(ddpg(agent)).policy_regularizer(batch)

    @pytest.mark.parametrize("make", [GradCAPSLoss, ASAPLoss])
    def test_actions_before_cannot_be_known(self, make):
        with pytest.raises(TypeError, match=f"^{make.__name__} compares .* the action before"):
            make(ddpg(Agent(GRUModule)))
