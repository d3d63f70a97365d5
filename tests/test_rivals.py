"""Rivals: by hand, around every loss that can be regularized, and in a run."""

from __future__ import annotations

import copy
import math
import pickle
import warnings
from functools import partial

import pytest
import torch
from losses import (
    CASES,
    action_values,
    agents_batch,
    deterministic_actor,
    gaussian_actor,
    make_mappo,
    on_policy,
    qvalue,
    transitions,
)
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import Bounded
from torchrl.envs import CatFrames, GymEnv, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import (
    Actor,
    AdditiveGaussianModule,
    IndependentNormal,
    NormalParamExtractor,
    ProbabilisticActor,
    TanhDelta,
    ValueOperator,
)
from torchrl.objectives import BCLoss, DDPGLoss, DQNLoss, PPOLoss, SACLoss

from torchrl_l2c2 import ASAPLoss, CAPSLoss, CATSLoss, GradCAPSLoss, L2C2Loss, LCPLoss, SR2LLoss
from torchrl_l2c2.experiment import (
    AdamConfig,
    ASAPConfig,
    CATSConfig,
    Experiment,
    ExperimentConfig,
    GradCAPSConfig,
    LCPConfig,
    PPOConfig,
    PPORPEConfig,
    RolloutReplayConfig,
    SR2LConfig,
    TaskConfig,
    UniformReplayConfig,
)
from torchrl_l2c2.experiment.learn.compilation import compiler_available
from torchrl_l2c2.gains import gradient_shares
from torchrl_l2c2.objectives.cats import cats_term
from torchrl_l2c2.objectives.grad_caps import grad_caps_term
from torchrl_l2c2.objectives.lcp import lcp_term
from torchrl_l2c2.objectives.sr2l import ascend, jeffreys_divergence

pytestmark = pytest.mark.filterwarnings("ignore")

WEIGHT = torch.tensor([[1.0, -2.0, 0.5], [0.0, 1.0, 1.0]])


class TwoHeads(nn.Module):
    """An action, and behind it something else."""

    def __init__(self) -> None:
        super().__init__()
        self.act, self.hide = nn.Linear(3, 2), nn.Linear(3, 2)

    def forward(self, observation):
        return self.act(observation), self.hide(observation)


def linear_base() -> DDPGLoss:
    """A deterministic policy W s."""
    net = nn.Linear(3, 2, bias=False)
    net.weight.data = WEIGHT.clone()
    return DDPGLoss(Actor(net), qvalue())


def linear_normal(scale: float = 0.5) -> PPOLoss:
    """A normal policy with the mean W s."""

    class Linear(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.weight = nn.Parameter(WEIGHT.clone())

        def forward(self, observation):
            loc = observation @ self.weight.T
            return loc, torch.full_like(loc, scale)

    actor = ProbabilisticActor(
        TensorDictModule(Linear(), ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    return PPOLoss(actor, None)


class Contact(nn.Module):
    """Acts by what is touched: 1 in the first dimension, and what is observed in the second."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(1))

    def forward(self, observation, contact):
        return self.weight * torch.cat((contact.to(observation.dtype), observation), -1)


class TestLabels:
    """What the policy reads beside its observation is that of the state that it acts in."""

    def terms(self, kind, **settings):
        actor = Actor(Contact(), in_keys=["observation", "contact"])
        loss = kind(DDPGLoss(actor, qvalue()), **settings)
        still = {"observation": torch.zeros(4, 1)}
        touched = torch.tensor([[False], [True], [True], [False]])
        later = {**still, "contact": torch.tensor([[True], [False], [True], [False]])}
        batch = TensorDict({**still, "contact": touched, "before": torch.zeros(4, 1)}, [4])
        batch["next"] = TensorDict(later, [4])
        return {key: term.item() for key, term in loss.policy_regularizer(batch).items()}

    def test_a_next_state_has_its_own(self):
        """Of four states two begin or end to touch: each is a change of 1."""
        assert self.terms(CATSLoss, lambda_temporal=1.0)["loss_cats"] == pytest.approx(2 / 4)

    def test_a_noisy_one_has_those_of_the_state(self):
        settings = {"lambda_temporal": 1.0, "lambda_spatial": 1.0, "sigma": 1e-4}
        terms = self.terms(CAPSLoss, **settings)
        assert terms["loss_caps_temporal"] == pytest.approx(0.5 * 2 / 4)
        assert terms["loss_caps_spatial"] < 1e-6

    def test_one_before_is_taken_to_have_those_of_the_state(self):
        """The two changes are 0 and 1: ((1 - 0) / (tanh 1 + .5)) ^ 2."""
        settings = {"lambda_temporal": 1.0, "epsilon": 0.5, "previous_key": "before"}
        expected = 2 / 4 / (math.tanh(1.0) + 0.5) ** 2
        assert self.terms(GradCAPSLoss, **settings)["loss_grad_caps"] == pytest.approx(expected)


@pytest.mark.parametrize("kind", [CAPSLoss, CATSLoss, SR2LLoss, LCPLoss, L2C2Loss])
def test_dimensions_of_a_plain_normal_are_those_of_one_action(kind):
    """As of TorchRL's IndependentNormal, and not policies of their own, which would be averaged."""
    net = nn.Sequential(nn.Linear(3, 4), NormalParamExtractor())
    batch, terms = transitions(8), []
    for distribution in (IndependentNormal, torch.distributions.Normal):
        actor = ProbabilisticActor(
            TensorDictModule(net, ["observation"], ["loc", "scale"]),
            in_keys=["loc", "scale"],
            distribution_class=distribution,
        )
        torch.manual_seed(0)
        terms.append(kind(BCLoss(actor)).policy_regularizer(batch))
    for key, expected in terms[0].items():
        torch.testing.assert_close(terms[1][key], expected)


class Widest(TanhDelta):
    """A distribution of one's own."""


class TestDeterministicPolicies:
    """Written as a distribution, in whatever way."""

    @pytest.fixture(params=[TanhDelta, Widest, partial(TanhDelta, low=-1.0, high=1.0)])
    def base(self, request):
        actor = ProbabilisticActor(
            TensorDictModule(nn.Linear(3, 2), ["observation"], ["param"]),
            in_keys=["param"],
            distribution_class=request.param,
        )
        return DDPGLoss(actor, qvalue())

    def test_actions_are_compared(self, base):
        terms = L2C2Loss(base).policy_regularizer(transitions(4))
        assert terms["l2c2_action_distance"] > 0

    def test_what_needs_a_density_is_refused_when_it_is_made(self, base):
        with pytest.raises(TypeError, match="stochastic"):
            LCPLoss(base)


@pytest.mark.parametrize("kind", [CAPSLoss, CATSLoss, GradCAPSLoss, ASAPLoss, SR2LLoss, LCPLoss])
def test_a_gain_may_be_set_before_the_backward_pass(kind):
    """As by a ramp while gradients of several batches are gathered."""
    batch = transitions(4)
    batch["frames"] = torch.cat((batch["observation"], batch["observation"]), -1)
    loss = kind(PPOLoss(gaussian_actor(), None))
    parameters = [p for p in loss.parameters() if p.requires_grad]
    gradients = []
    for factor in (1.0, 0.0):
        torch.manual_seed(0)
        terms = loss.policy_regularizer(batch.copy())
        before = {name: getattr(loss, name).item() for name in loss._coefficients}
        for name, value in before.items():
            setattr(loss, name, factor * value)
        total = sum(terms[key] for key in loss.added_terms)
        gradients.append(torch.autograd.grad(total, parameters, allow_unused=True))
        for name, value in before.items():
            setattr(loss, name, value)
    for expected, found in zip(*gradients, strict=True):
        assert (found is None and expected is None) or torch.equal(found, expected)


@pytest.mark.parametrize("kind", [LCPLoss, SR2LLoss])
def test_no_successor_is_asked_for_that_is_not_read(kind):
    """A batch of the in_keys alone will do, also of demonstrations that have none."""
    loss = kind(BCLoss(gaussian_actor()))
    batch = transitions(5).exclude("next")
    asked = batch.select(*loss.in_keys)
    assert loss(asked)["loss_bc"].equal(loss(batch)["loss_bc"])
    assert ("next", "observation") in CATSLoss(loss).in_keys


class TestCATS:
    def test_the_term_is_the_squared_distance_of_means(self):
        """Not half of it: 3^2 + 4^2."""
        assert cats_term(torch.zeros(1, 2), torch.tensor([[3.0, 4.0]])).tolist() == [25.0]

    def test_of_a_linear_policy(self):
        """lambda times the mean of |W (s' - s)|^2; where s' is not finite, it has not moved."""
        batch = transitions(2)
        batch["observation"] = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
        batch["next", "observation"] = torch.tensor([[1.0, 0.0, 0.0], [math.nan, 2.0, 2.0]])
        loss = CATSLoss(linear_base(), 0.3)
        found = loss.policy_regularizer(batch)["loss_cats"]
        assert found.item() == pytest.approx(0.3 * (1.0 + (1.5**2 + 2.0**2)) / 2)
        loss.cats_lambda_temporal = 0.6
        assert loss.policy_regularizer(batch)["loss_cats"].item() == pytest.approx(2 * found.item())

    def test_it_is_twice_the_temporal_term_of_caps(self):
        """On the same side of the squashing."""
        batch = transitions(4)
        for mean in ("loc", "action"):
            base = PPOLoss(gaussian_actor(), None)
            caps = CAPSLoss(base, lambda_temporal=1.0, mean=mean)
            expected = 2 * caps.policy_regularizer(batch)["loss_caps_temporal"]
            found = CATSLoss(base, 1.0, mean=mean).policy_regularizer(batch)["loss_cats"]
            torch.testing.assert_close(found, expected)


class TestMovedKeys:
    """Commands stay as they are in the state, and the rest is taken from the next state."""

    def loss(self, make, **kwargs):
        """A policy x + 10 c of an observation x and a command c."""

        class Policy(nn.Module):
            def forward(self, observation, command):
                return observation + 10.0 * command

        module = TensorDictModule(Policy(), ["observation", "command"], ["action"])
        value = ValueOperator(nn.Bilinear(1, 1, 1), in_keys=["observation", "action"])
        return make(DDPGLoss(module, value), **kwargs)

    def batch(self):
        zero, one = torch.zeros(4, 1), torch.ones(4, 1)
        later = {"observation": 3.0 * one, "command": one}
        return TensorDict({"observation": zero, "command": zero, "next": later}, [4])

    def test_of_cats(self):
        """3 without the change of the command, which adds 10."""
        loss = self.loss(CATSLoss, lambda_temporal=1.0)
        assert loss.policy_regularizer(self.batch())["loss_cats"].item() == 169.0
        loss = self.loss(CATSLoss, lambda_temporal=1.0, moved_keys=["observation"])
        assert loss.policy_regularizer(self.batch())["loss_cats"].item() == 9.0
        batch = self.batch()
        batch["next", "command"][:] = math.nan  # Not read.
        assert loss.policy_regularizer(batch)["cats_counted"].item() == 1.0
        assert "cats_moved_keys=['observation']" in str(loss)

    def test_of_caps(self, monkeypatch):
        """Neither do commands get noise."""
        monkeypatch.setattr(torch, "randn_like", torch.ones_like)
        settings = {"sigma": 2.0, "lambda_temporal": 1.0, "lambda_spatial": 1.0}
        terms = ("loss_caps_temporal", "loss_caps_spatial")
        for keys, expected in ((None, [169 / 2, 22.0**2 / 2]), ("observation", [9 / 2, 2.0])):
            found = self.loss(CAPSLoss, moved_keys=keys, **settings).policy_regularizer(
                self.batch()
            )
            assert [found[term].item() for term in terms] == expected

    @pytest.mark.parametrize("make", [CATSLoss, CAPSLoss])
    def test_wrong_names_are_refused(self, make):
        with pytest.raises(ValueError, match=r"moved_keys names \['speed'\]"):
            self.loss(make, moved_keys=["speed"])
        loss, batch = self.loss(make, moved_keys=["command"]), self.batch()
        batch["command"], batch["next", "command"] = torch.ones(2, 4, 1, dtype=torch.long)
        with pytest.raises(TypeError, match="no floating-point observation with a successor"):
            loss.policy_regularizer(batch)


class TestGradCAPS:
    def batch(self) -> TensorDict:
        """Two transitions with the states before: along a line, and back and forth."""
        batch = transitions(2)
        state = torch.tensor([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
        batch["observation"] = state
        batch["next", "observation"] = torch.tensor([[2.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
        batch["frames"] = torch.cat((torch.zeros(2, 3), state), -1)
        return batch

    def test_a_steady_motion_is_free_and_a_zigzag_is_not(self):
        """0 for the line; (-2 / 0.1)^2 for there and back."""
        loss = GradCAPSLoss(linear_base(), 0.3, epsilon=0.1)
        found = loss.policy_regularizer(self.batch())["loss_grad_caps"]
        assert found.item() == pytest.approx(0.3 * (0.0 + 400.0) / 2, rel=1e-4)

    def test_what_the_action_moved_over_both_steps_is_what_counts(self):
        """(1 - 0) / (tanh 1 + .5) for actions 0, 0, 1, and for 1, 0, 0: either way."""
        still, moved = torch.zeros(1, 1), torch.ones(1, 1)
        for before, later in ((still, moved), (moved, still)):
            term = grad_caps_term(before, torch.zeros(1, 1), later, 0.5)
            assert term.item() == pytest.approx((1.0 / (math.tanh(1.0) + 0.5)) ** 2)

    @pytest.mark.parametrize("kind", [GradCAPSLoss, ASAPLoss])
    def test_frames_that_are_not_of_the_state(self, kind):
        """As from before a normalization: told at the first batch."""
        batch = self.batch()
        batch["frames"] = 2.0 * batch["frames"]
        with pytest.raises(ValueError, match="second half of 'frames' is not 'observation'"):
            kind(linear_base()).policy_regularizer(batch)

    def test_states_that_are_not_a_step_apart(self):
        """Behind a multi-step transform the line would be a zigzag."""
        batch = self.batch()
        batch["steps_to_next_obs"] = torch.tensor([[3], [1]])
        with pytest.raises(ValueError, match=r"up to 3 steps away.*leave MultiStepTransform out"):
            GradCAPSLoss(linear_base()).policy_regularizer(batch)

    def test_catframes_gives_what_it_needs(self):
        """The state before, and the state itself in the first step of an episode."""
        frames = CatFrames(N=2, dim=-1, in_keys=["observation"], out_keys=["frames"])
        played = TransformedEnv(GymEnv("Pendulum-v1"), frames).rollout(5)
        states = played["observation"]
        torch.testing.assert_close(played["frames"][1:, :3], states[:-1])
        torch.testing.assert_close(played["frames"][0, :3], states[0])
        net = nn.Linear(3, 1, bias=False)
        loss = GradCAPSLoss(DDPGLoss(Actor(net), qvalue()), 1.0)
        found = loss.policy_regularizer(played)["loss_grad_caps"]
        with torch.no_grad():
            actions = net(torch.cat((states[:1], states, played["next", "observation"][-1:])))
            expected = grad_caps_term(actions[:-2], actions[1:-1], actions[2:], 0.1).mean()
        torch.testing.assert_close(found.detach(), expected)

    def test_the_observation_before_may_be_an_entry_of_its_own(self):
        """The same as of frames; the loss asks for it."""
        batch, base = self.batch(), linear_base()
        expected = GradCAPSLoss(base, 0.3).policy_regularizer(batch)["loss_grad_caps"]
        loss = GradCAPSLoss(base, 0.3, previous_key="before")
        batch["before"] = batch.pop("frames")[:, :3]
        assert loss.policy_regularizer(batch)["loss_grad_caps"].equal(expected)
        assert "before" in loss.in_keys
        loss.set_keys(reward="rew")
        assert "before" in loss.in_keys and "frames" not in loss.in_keys
        with pytest.raises(ValueError, match=r"of shape \(2, 3\), got \(2, 2\)"):
            loss.policy_regularizer(batch.set("before", batch["before"][:, :2]))
        with pytest.raises(KeyError, match="no 'before', which previous_key names"):
            loss.policy_regularizer(batch.exclude("before"))

    def test_what_it_asks_for_is_all_that_it_reads(self):
        """A batch of the in_keys alone will do: frames are among them."""
        loss = GradCAPSLoss(linear_base())
        asked = self.batch().select(*loss.in_keys, strict=False)
        expected = loss.policy_regularizer(self.batch())["loss_grad_caps"]
        assert loss.policy_regularizer(asked)["loss_grad_caps"].equal(expected)

    def test_other_batches_are_refused_with_what_to_do(self):
        """Without frames, or with three."""
        loss, batch = GradCAPSLoss(linear_base()), self.batch()
        frames = batch.pop("frames")
        with pytest.raises(KeyError, match=r"no 'frames': append CatFrames\(N=2, dim=-1"):
            loss.policy_regularizer(batch)
        batch["frames"] = torch.cat((frames, frames[:, :3]), -1)
        with pytest.raises(ValueError, match=r"of shape \(2, 6\), got \(2, 9\)"):
            loss.policy_regularizer(batch)

    @pytest.mark.parametrize("kind", [GradCAPSLoss, ASAPLoss])
    @pytest.mark.parametrize("name", ["frames_key", "previous_key"])
    def test_names_are_checked_when_the_loss_is_made(self, kind, name):
        """Not with the first batch."""
        with pytest.raises(TypeError, match=rf"^{name} must be a string or a tuple .* got 3"):
            kind(linear_base(), **{name: 3})

    def test_a_loss_without_a_policy_is_refused(self):
        """As for the others."""
        base = DQNLoss(action_values(), action_space="one-hot")
        with pytest.raises(TypeError, match="GradCAPSLoss needs a policy: DQNLoss has none"):
            GradCAPSLoss(base)


class TestASAP:
    PREDICTOR = torch.tensor([[0.5, 0.0, 0.0], [0.0, 0.0, 2.0]])

    def loss(self, *args) -> ASAPLoss:
        loss = ASAPLoss(linear_base(), *args, previous_key="before")
        loss.asap_predictor.module.weight.data = self.PREDICTOR.clone()
        return loss

    def batch(self) -> TensorDict:
        batch = transitions(2)
        batch["observation"] = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
        batch["before"] = torch.tensor([[2.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
        batch["next", "observation"] = batch["observation"]
        return batch

    def test_the_terms_by_hand(self):
        """Actions (1, 0) and (-2, 1); predicted (1, 2) and (0, 2): squared distances 4 and 5."""
        terms = self.loss(0.3, 2.0).policy_regularizer(self.batch())
        assert terms["loss_asap_spatial"].item() == pytest.approx(0.3 * 4.5)
        assert terms["loss_asap_temporal"].item() == pytest.approx(2.0 * 4.5)

    def test_the_spatial_term_trains_the_policy_and_the_temporal_one_the_predictor(self):
        """2 (W s - P b) s' and 2 (P b - W s) b', means over the batch; nothing else."""
        loss, batch = self.loss(1.0, 1.0), self.batch()
        terms = loss.policy_regularizer(batch)
        policy = [p for name, p in loss.named_parameters() if name.startswith("actor_network")]
        parameters = [*policy, *loss.asap_predictor.parameters()]
        off = batch["observation"] @ WEIGHT.T - batch["before"] @ self.PREDICTOR.T
        for kind, seen, sign in (("spatial", "observation", 1), ("temporal", "before", -1)):
            term = terms[f"loss_asap_{kind}"]
            found = torch.autograd.grad(term, parameters, allow_unused=True, retain_graph=True)
            expected = sign * 2.0 * off.T @ batch[seen] / 2.0
            trained, other = found if kind == "spatial" else reversed(found)
            assert other is None
            torch.testing.assert_close(trained, expected)

    def test_what_else_the_policy_writes_is_no_action(self):
        """The predictor's action is compared, wherever among its entries it stands."""
        net = TensorDictModule(TwoHeads(), ["observation"], ["action", "hidden"])
        loss, batch = ASAPLoss(DDPGLoss(net, qvalue()), previous_key="before"), self.batch()
        batch["before"] = batch["observation"]
        terms = loss.policy_regularizer(batch)
        assert terms["loss_asap_spatial"] == terms["loss_asap_temporal"] == 0
        terms["loss_grad_caps"].backward()
        parameters = dict(loss.actor_network_params.flatten_keys(".").items())
        assert parameters["module.act.weight"].grad is not None
        assert parameters["module.hide.weight"].grad is None

    def test_grad_caps_is_the_third(self):
        """With its own numbers."""
        found = self.loss(0.3, 2.0, 0.7, 0.2).policy_regularizer(self.batch())["loss_grad_caps"]
        alone = GradCAPSLoss(linear_base(), 0.7, 0.2, previous_key="before")
        assert found.equal(alone.policy_regularizer(self.batch())["loss_grad_caps"])

    @pytest.mark.parametrize("make", [linear_normal, linear_base])
    def test_the_predictor_begins_as_a_copy_of_the_policy(self, make):
        """Where nothing moved it predicts what is done; later it has numbers of its own."""
        loss, batch = ASAPLoss(make(), previous_key="before"), self.batch()
        batch["before"] = batch["observation"]
        assert loss.policy_regularizer(batch)["loss_asap_spatial"].item() == 0.0
        for name, parameter in loss.named_parameters():
            if name.startswith("actor_network"):
                parameter.data.mul_(2.0)
        assert loss.policy_regularizer(batch)["loss_asap_spatial"].item() > 0.0

    @pytest.mark.parametrize("make", [linear_normal, linear_base])
    def test_the_predictor_has_what_a_copied_loss_has_learned(self, make):
        """The networks of a copy do not follow the parameters that the copy keeps beside them."""
        base, batch = copy.deepcopy(make()), self.batch()
        for parameter in base.actor_network_params.values(True, True):
            parameter.data.mul_(2.0)
        loss = ASAPLoss(base, previous_key="before")
        batch["before"] = batch["observation"]
        assert loss.policy_regularizer(batch)["loss_asap_spatial"].item() == 0.0

    def test_the_predictor_belongs_to_the_loss(self):
        """Optimizers, checkpoints and copies have it."""
        loss = self.loss()
        assert any(p is q for p in loss.parameters() for q in loss.asap_predictor.parameters())
        again = ASAPLoss(linear_base(), previous_key="before")
        again.load_state_dict(loss.state_dict())
        assert again.asap_predictor.module.weight.equal(self.PREDICTOR)
        twin = copy.deepcopy(loss)
        twin.asap_predictor.module.weight.data.zero_()
        assert loss.asap_predictor.module.weight.equal(self.PREDICTOR)

    def test_layers_without_a_size_have_no_copy(self):
        """The first batch would give the predictor other numbers than the policy."""
        net = nn.Sequential(nn.LazyLinear(4), NormalParamExtractor())
        actor = ProbabilisticActor(
            TensorDictModule(net, ["observation"], ["loc", "scale"]),
            in_keys=["loc", "scale"],
            distribution_class=IndependentNormal,
        )
        base = PPOLoss(actor, None)
        with pytest.raises(ValueError, match="layers have no size yet: call the policy"):
            ASAPLoss(base)
        actor(self.batch())
        ASAPLoss(base)

    @pytest.mark.parametrize("part", ["forward", "loss_actor"])
    def test_an_optimizer_without_the_predictor_is_told(self, part):
        """As of TorchRL's SAC and TD3 scripts, which take the networks' parameters by name."""
        for names in (["actor_network_params"], ["actor_network_params", "asap_predictor"]):
            base = DDPGLoss(Actor(nn.Linear(3, 2)), qvalue())
            base.make_value_estimator(gamma=0.9)
            loss = ASAPLoss(base, previous_key="before").fold()
            parameters = [p for name in names for p in getattr(loss, name).parameters()]
            optimizer, batch = torch.optim.SGD(parameters, 0.01), self.batch()
            with warnings.catch_warnings(record=True) as told:
                warnings.simplefilter("always")
                for _ in range(60):
                    if part == "forward":
                        term = loss(batch)["loss_actor"]
                    else:
                        term = loss.loss_actor(batch)[0]
                    optimizer.zero_grad()
                    term.backward()
                    optimizer.step()
            told = [str(each.message) for each in told if "the predictor of" in str(each.message)]
            assert len(told) == (len(names) == 1), told

    def test_a_policy_that_explores_is_compared_without_its_noise(self):
        """Also outside of the loss's own forward: a copy predicts for the same state."""
        noise = AdditiveGaussianModule(Bounded(-9.0, 9.0, (2,)), sigma_init=1.0, sigma_end=1.0)
        policy = TensorDictSequential(Actor(nn.Linear(3, 2)), noise)
        batch = self.batch()
        batch["before"] = batch["observation"]
        loss = ASAPLoss(DDPGLoss(policy, qvalue()), previous_key="before")
        assert loss.policy_regularizer(batch)["loss_asap_spatial"].item() == 0.0

    def test_what_grad_caps_refuses_is_refused(self):
        """By its own name."""
        base = DQNLoss(action_values(), action_space="one-hot")
        with pytest.raises(TypeError, match="ASAPLoss needs a policy: DQNLoss has none"):
            ASAPLoss(base)
        with pytest.raises(KeyError, match=r"no 'frames': append CatFrames\(N=2, dim=-1"):
            ASAPLoss(linear_base()).policy_regularizer(self.batch())


@pytest.mark.parametrize(
    "make", [lambda: SR2LLoss(linear_base()), lambda: LCPLoss(linear_normal())]
)
def test_what_takes_gradients_says_so_in_inference_mode(make):
    """Torch keeps none there; under no_grad it does."""
    loss, batch = make(), transitions(4)
    with torch.no_grad():
        assert not loss.policy_regularizer(batch).is_empty()
    with torch.inference_mode(), pytest.raises(RuntimeError, match="validate under"):
        loss.policy_regularizer(batch)


def test_shares_of_gradients_are_never_zero_by_the_mode_or_the_precision():
    """Which would say that nothing is trained: refused in the one, told in the other."""
    loss, batch = CATSLoss(linear_base(), lambda_temporal=1e-5), transitions(4)
    with torch.inference_mode(), pytest.raises(RuntimeError, match="gradient_shares takes grad"):
        gradient_shares(loss, batch)
    share = gradient_shares(loss, batch)["loss_cats"]
    half = batch.apply(lambda entry: entry.half() if entry.is_floating_point() else entry)
    halved = gradient_shares(loss.half(), half)["loss_cats"]
    assert share > 0 and halved == pytest.approx(share, rel=0.1)


@pytest.mark.parametrize("kind", [CAPSLoss, CATSLoss, GradCAPSLoss, ASAPLoss])
def test_observations_around_may_be_of_another_precision(kind):
    """They are compared in that of the state, which the policy takes."""
    loss, batch = kind(linear_base()), transitions(4)
    batch["frames"] = torch.cat((batch["observation"], batch["observation"]), -1)
    around = ["frames", ("next", "observation")]
    wider = batch.copy().update(batch.select(*around).double())
    terms = []
    for each in (batch, wider):
        torch.manual_seed(0)
        terms.append(loss.policy_regularizer(each))
    torch.testing.assert_close(*terms, rtol=0.0, atol=0.0)


class TestSR2L:
    def test_of_a_linear_policy_the_worst_state_is_a_corner(self):
        """1/2 max |W d|^2 over the corners of the box."""
        corners = torch.cartesian_prod(*[torch.tensor([-0.1, 0.1])] * 3)
        expected = 0.5 * (corners @ WEIGHT.T).square().sum(-1).max()
        loss = SR2LLoss(linear_base(), epsilon=0.1, coeff=0.3)
        found = loss.policy_regularizer(transitions(64))["loss_sr2l"]
        # Some starts end in another corner, which is a local maximum.
        assert 0.8 * expected < found / 0.3 <= 1.0001 * expected

    def test_of_a_normal_policy_by_jeffreys_divergence(self):
        """|W d|^2 / (2 s^2), the same either way."""
        corners = torch.cartesian_prod(*[torch.tensor([-0.1, 0.1])] * 3)
        expected = ((corners @ WEIGHT.T).square().sum(-1) / (2 * 0.5**2)).max()
        loss = SR2LLoss(linear_normal(), epsilon=0.1, coeff=1.0)
        found = loss.policy_regularizer(transitions(64))["loss_sr2l"]
        assert 0.8 * expected < found <= 1.0001 * expected

    def test_jeffreys_divergence_is_symmetric(self):
        """The mean of both: of two normals of scale 1 and 2 at one place (ln terms cancel)."""
        p, q = (torch.distributions.Normal(torch.zeros(1), s) for s in (1.0, 2.0))
        assert jeffreys_divergence(p, q).item() == pytest.approx(0.5 * (1 / 8 + 4 / 2 - 1))
        assert jeffreys_divergence(p, q) == jeffreys_divergence(q, p)

    def test_the_ascent_stays_in_the_box_and_finds_more_than_chance(self):
        """Of a smooth function of two parts of a state."""
        torch.manual_seed(0)
        states = {"a": torch.randn(100, 2), "b": torch.randn(100, 1)}

        def distance(moved):
            return sum((3.0 * (moved[k] - states[k])).sin().square().sum(-1) for k in states)

        chance = {k: s + 0.2 * (2 * torch.rand_like(s) - 1) for k, s in states.items()}
        found = ascend(distance, states, 0.2, 10)
        for key, state in states.items():
            assert ((found[key] - state).abs() <= 0.2 + 1e-6).all()
            assert not found[key].requires_grad
        assert distance(found).mean() > 2 * distance(chance).mean()

    def test_the_search_starts_on_both_sides_and_crosses_the_box(self, monkeypatch):
        """Without a slope it stays where it starts; one step reaches from end to end."""
        states = {"s": torch.zeros(99, 1)}
        start = ascend(lambda moved: 0.0 * moved["s"].sum(-1), states, 0.1, 1)["s"]
        assert start.min() < 0.0 < start.max()
        monkeypatch.setattr(torch, "rand_like", torch.zeros_like)
        assert ascend(lambda moved: moved["s"].sum(-1), states, 0.1, 1)["s"].unique() == 0.1

    def test_other_distances_can_be_chosen(self):
        """Half the squared distance of means in the place of the divergence."""
        loss = SR2LLoss(linear_normal(), epsilon=0.1, coeff=1.0, policy_distance="mean")
        corners = torch.cartesian_prod(*[torch.tensor([-0.1, 0.1])] * 3)
        expected = 0.5 * (corners @ WEIGHT.T).square().sum(-1).max()
        found = loss.policy_regularizer(transitions(64))["loss_sr2l"]
        assert 0.8 * expected < found <= 1.0001 * expected
        with pytest.raises(TypeError, match="deterministic policy"):
            SR2LLoss(linear_base(), policy_distance="kl")

    @pytest.mark.parametrize("settings", [{"epsilon": 0.0}, {"steps": 0}, {"coeff": -1.0}])
    def test_wrong_settings_are_refused(self, settings):
        """At construction."""
        with pytest.raises(ValueError, match=f"{next(iter(settings))} must be"):
            SR2LLoss(linear_base(), **settings)


class TestLCP:
    def test_the_term_is_the_squared_gradient(self):
        """Of s^2 and of 3 t, parts of one state: (2 s)^2 + 9."""
        s = torch.tensor([[1.0, 2.0]], requires_grad=True)
        t = torch.tensor([[5.0]], requires_grad=True)
        value = s.square().sum(-1) + 3.0 * t.squeeze(-1)
        assert lcp_term(value, [s, t], 1).tolist() == [4.0 + 16.0 + 9.0]

    @pytest.mark.parametrize("features", [2, 3])
    def test_one_state_of_three_agents(self, features):
        """Is no state of each agent, also where it has as many features as there are agents."""
        state = torch.ones(5, features, requires_grad=True)
        log_prob = state.sum(-1, keepdim=True).expand(5, 3)
        assert lcp_term(log_prob, [state], 1).tolist() == [9.0 * features] * 5

    def test_of_a_linear_normal_policy(self):
        """The gradient of ln pi is W^T (a - W s) / s^2."""
        batch = transitions(8)
        error = batch["action"] - batch["observation"] @ WEIGHT.T
        expected = (error @ WEIGHT / 0.5**2).square().sum(-1).mean()
        found = LCPLoss(linear_normal(), 0.002).policy_regularizer(batch)["loss_lcp"]
        torch.testing.assert_close(found, 0.002 * expected)

    def test_actions_that_hang_on_the_policy_are_what_was_done(self):
        """A rollout that keeps gradients trains the policy as one that does not."""
        torch.manual_seed(0)
        actor = gaussian_actor()
        loss, batch = LCPLoss(SACLoss(actor, qvalue(), target_entropy=-2.0)), transitions(8)
        with set_exploration_type(ExplorationType.RANDOM):
            batch.update(actor(batch.select("observation")).select("action"))
        assert batch["action"].requires_grad
        weights = [p for p in loss.actor_network_params.values(True, True) if p.requires_grad]
        found, expected = (
            torch.autograd.grad(
                loss.policy_regularizer(each)["loss_lcp"],
                weights,
                allow_unused=True,
                retain_graph=True,
            )
            for each in (batch, batch.detach())
        )
        torch.testing.assert_close(found, expected)

    @pytest.mark.parametrize("regularizer", [LCPLoss, lambda base: SR2LLoss(base, steps=1)])
    def test_successors_do_not_matter(self, regularizer):
        """Goals count whether a successor of theirs is stored or not; none need be."""
        torch.manual_seed(0)
        net = nn.Sequential(nn.Linear(4, 4), NormalParamExtractor())
        joint = TensorDictModule(
            lambda s, goal: net(torch.cat((s, goal), -1)), ["observation", "goal"], ["loc", "scale"]
        )
        actor = ProbabilisticActor(
            joint, in_keys=["loc", "scale"], distribution_class=IndependentNormal
        )
        loss, batch = regularizer(PPOLoss(actor, None)), transitions(8)
        batch["goal"] = torch.randn(8, 1)
        found = []
        for successors in ([], ["observation"], ["observation", "goal"]):
            batch["next"] = batch.select(*successors)
            torch.manual_seed(1)
            found += loss.policy_regularizer(batch).values()
        assert found[0] > 0 and found[0] == found[1] == found[2]

    @pytest.mark.parametrize("regularizer", [LCPLoss, lambda base: SR2LLoss(base, steps=2)])
    def test_a_part_of_the_state_that_the_policy_does_not_use_does_not_matter(self, regularizer):
        """It has no gradient, which is one of zero."""
        torch.manual_seed(0)
        net = nn.Sequential(nn.Linear(3, 4), NormalParamExtractor())
        batch, terms = transitions(8).set("goal", torch.ones(8, 1)), []
        for keys in (["observation"], ["observation", "goal"]):
            module = TensorDictModule(lambda s, *_: net(s), keys, ["loc", "scale"])
            actor = ProbabilisticActor(
                module, in_keys=["loc", "scale"], distribution_class=IndependentNormal
            )
            loss = regularizer(PPOLoss(actor, None))
            torch.manual_seed(1)
            terms += loss.policy_regularizer(batch).values()
        assert terms[0] > 0
        torch.testing.assert_close(terms[0], terms[1])

    def test_of_the_mean_of_one_action_it_has_no_variance(self):
        """With one action the random sign drops out: |W|^2 in every call."""
        net = nn.Linear(3, 1, bias=False)
        net.weight.data = WEIGHT[:1].clone()
        loss = LCPLoss(DDPGLoss(Actor(net), qvalue()), coeff=1.0, of="mean")
        for _ in range(8):
            found = loss.policy_regularizer(transitions(8))["loss_lcp"].item()
            assert found == pytest.approx(WEIGHT[:1].square().sum().item())

    def test_its_gradient_is_that_of_the_penalty(self):
        """A second derivative, against differences."""
        batch, base = transitions(8), linear_normal()
        loss, weight = LCPLoss(base, 1.0).double(), base.actor_network.module[0].module.weight
        batch = batch.apply(lambda x: x.double() if x.is_floating_point() else x)
        (found,) = torch.autograd.grad(
            loss.policy_regularizer(batch)["loss_lcp"],
            [p for n, p in loss.named_parameters() if "actor" in n],
        )
        (parameter,) = (p for n, p in loss.named_parameters() if "actor" in n)
        assert weight.shape == parameter.shape
        values = []
        for shift in (1e-5, -1e-5):
            with torch.no_grad():
                parameter[0, 0] += shift
            values.append(loss.policy_regularizer(batch)["loss_lcp"].item())
            with torch.no_grad():
                parameter[0, 0] -= shift
        assert found[0, 0].item() == pytest.approx((values[0] - values[1]) / 2e-5, rel=1e-6)

    def test_agents_are_as_the_rows_of_a_batch(self):
        """The same networks at the same states: a team's term is the mean over its agents."""
        torch.manual_seed(0)
        team, batch = make_mappo(), agents_batch(4)
        single = PPOLoss(gaussian_actor(), None)
        single.actor_network_params.update_(team.actor_network_params)
        rows = batch["agents"].flatten(0, 1)
        expected = LCPLoss(single, 1.0).policy_regularizer(rows)["loss_lcp"]
        found = LCPLoss(team, 1.0).policy_regularizer(batch)["loss_lcp"]
        torch.testing.assert_close(found, expected)

    @pytest.mark.parametrize(
        ("regularizer", "passes"),
        [(LCPLoss, 1), (lambda base: SR2LLoss(base, steps=3), 1 + 3 + 1)],
    )
    def test_the_policy_is_evaluated_where_it_is_needed(self, regularizer, passes):
        """Of LCP at the states; of SR2L there once, at each step of the search, and at its end."""
        rows = []
        base = PPOLoss(gaussian_actor(), None)
        loss, batch = regularizer(base), transitions(8)
        loss.policy_regularizer(batch)  # The first call looks for random numbers.
        net = loss.actor_network.module[0].module
        net.register_forward_hook(lambda *of: rows.append(of[1][0].shape[:-1].numel()))
        loss.policy_regularizer(batch)
        assert rows == [8] * passes

    def test_a_deterministic_policy_is_refused(self):
        """With what takes it."""
        with pytest.raises(TypeError, match=r"DDPGLoss has no likelihood. Use of='mean'"):
            LCPLoss(linear_base())


RIVALS = {
    "cats": (lambda base: CATSLoss(base), "loss_cats", "cats_lambda_temporal"),
    "grad_caps": (
        lambda base: GradCAPSLoss(base, previous_key="before"),
        "loss_grad_caps",
        "grad_caps_lambda_temporal",
    ),
    "sr2l": (lambda base: SR2LLoss(base, steps=2), "loss_sr2l", "sr2l_coeff"),
    "lcp": (lambda base: LCPLoss(base), "loss_lcp", "lcp_coeff"),
}


def has_likelihood(case) -> bool:
    return case.policy == "l2c2_hellinger"


COMMON = ("PPO", "SAC", "TD3", "DQN")
# The common losses with every method, and every other loss with one of them.
PAIRS = [
    pytest.param((method, case), id=f"{method}-{case}")
    for place, case in enumerate(CASES)
    for number, method in enumerate(RIVALS)
    if case.name in COMMON or place % len(RIVALS) == number
]


@pytest.fixture(params=PAIRS)
def pair(request):
    return request.param


@pytest.fixture
def rival(pair):
    return RIVALS[pair[0]]


@pytest.fixture
def case(pair):
    return pair[1]


def plain(case, **kwargs):
    torch.manual_seed(0)
    return case.make(**kwargs)


def batch_of(case, *shape):
    """The state before, which some of them read, is a third one."""
    torch.manual_seed(1)
    batch = case.batch(*(shape or (6,)))
    return batch.set("before", batch[case.observation] + 0.1)


def run(loss, batch):
    torch.manual_seed(2)
    return loss(batch)


@pytest.fixture
def wrapped(case, rival):
    """The regularized loss; refusals are tested first."""
    make, term, coefficient = rival
    if case.policy is None:
        with pytest.raises(TypeError, match=r"needs a policy: \w+ has none"):
            make(plain(case))
        pytest.skip("refused")
    if term == "loss_lcp" and not has_likelihood(case):
        with pytest.raises(TypeError, match="needs a stochastic policy"):
            make(plain(case))
        pytest.skip("refused")
    return make, term, coefficient


class TestAroundEveryLoss:
    """What holds of L2C2 in test_loss_contract.py holds of them."""

    def test_one_term_is_added_and_the_rest_is_the_plain_losss(self, case, wrapped):
        """Bit for bit; the term is finite, positive and among out_keys and policy_terms."""
        make, term, _ = wrapped
        loss = make(plain(case))
        expected, found = run(plain(case), batch_of(case)), run(loss, batch_of(case))
        counted = {f"{term.removeprefix('loss_')}_counted"} & set(loss.out_keys)
        assert counted or term in ("loss_lcp", "loss_sr2l")
        assert set(found.keys()) - set(expected.keys()) == {term, *counted}
        assert all(bool((value == found[key]).all()) for key, value in expected.items())
        assert found[term].isfinite() and found[term] > 0
        assert term in loss.out_keys and term in loss.policy_terms

    def test_the_policy_alone_is_trained(self, case, wrapped):
        """With finite gradients; and not at all at a gain of 0."""
        make, term, coefficient = wrapped
        loss = make(plain(case))
        names, parameters = zip(*loss.named_parameters(), strict=True)
        gradients = torch.autograd.grad(
            run(loss, batch_of(case))[term], parameters, allow_unused=True
        )
        touched = {
            name.split("_network_params")[0]
            for name, gradient in zip(names, gradients, strict=True)
            if gradient is not None and gradient.abs().sum() > 0
        }
        assert touched == {"actor"}
        assert all(g is None or g.isfinite().all() for g in gradients)
        setattr(loss, coefficient, 0.0)
        assert run(loss, batch_of(case))[term] == 0

    def test_it_alone_gives_what_forward_gives(self, case, wrapped):
        """For loops that call actor_loss themselves, also in batches [B, T]."""
        make, term, _ = wrapped
        loss, batch = make(plain(case)), batch_of(case)
        torch.manual_seed(3)
        alone = loss.policy_regularizer(batch)[term]
        rows = batch.reshape(2, 3) if case.trajectories else batch
        torch.manual_seed(3)
        torch.testing.assert_close(loss.policy_regularizer(rows)[term], alone, rtol=1e-4, atol=0.0)

    def test_reductions_and_masks_are_the_losss(self, case, wrapped):
        """Mean and sum are those of the unreduced values; masked ones do not count."""
        if "none" not in case.reductions:
            pytest.skip("the plain loss has no choice of reductions")
        make, term, _ = wrapped
        found, batch = {}, batch_of(case)
        for reduction in case.reductions:
            torch.manual_seed(3)
            loss = make(plain(case, reduction=reduction))
            found[reduction] = loss.policy_regularizer(batch)[term]
        assert found["none"].shape[:1] == batch.shape
        torch.testing.assert_close(found["mean"], found["none"].mean(), rtol=1e-4, atol=0.0)
        torch.testing.assert_close(found["sum"], found["none"].sum(), rtol=1e-4, atol=0.0)
        mask = torch.tensor([True, False, True, True, False, False])
        batch["collector"] = TensorDict({"mask": mask.unsqueeze(-1)}, batch_size=[6])
        torch.manual_seed(3)
        masked = make(plain(case)).policy_regularizer(batch)[term]
        torch.testing.assert_close(masked, found["none"][mask].mean(), rtol=1e-4, atol=0.0)

    def test_checkpoints_copies_and_pickles(self, case, wrapped):
        """state_dict has the plain loss's keys; copies give the same."""
        make, term, _ = wrapped
        base, loss = plain(case), make(plain(case))
        assert list(loss.state_dict()) == list(base.state_dict())
        twins = [copy.deepcopy(loss)]
        try:
            pickle.dumps(base)
        except (AttributeError, pickle.PicklingError):
            pass
        else:
            twins.append(pickle.loads(pickle.dumps(loss)))
        for twin in twins:
            assert type(twin) is type(loss)
            assert run(twin, batch_of(case))[term] == run(loss, batch_of(case))[term]


def test_rivals_combine_with_l2c2(rival):
    """Each adds its term; a second of the same kind is refused."""
    make, term, _ = rival
    loss = make(L2C2Loss(PPOLoss(gaussian_actor(), None), beta=0))
    assert {"loss_l2c2_actor", term} <= set(loss.out_keys)
    with pytest.raises(TypeError, match=r"has the terms of .* already"):
        make(loss)


def test_cats_compiles_into_one_graph():
    """With the eager numbers, whatever its gain."""
    torch._dynamo.reset()
    loss, batch = CATSLoss(DDPGLoss(deterministic_actor(), qvalue())), transitions(4)
    compiled = torch.compile(loss.policy_regularizer, fullgraph=True, backend="eager")
    for gain in (0.1, 0.2):
        loss.cats_lambda_temporal = gain
        expected = loss.policy_regularizer(batch)["loss_cats"]
        torch.testing.assert_close(compiled(batch)["loss_cats"], expected)


def test_lcp_runs_uncompiled_in_a_compiled_loop():
    """With the eager numbers and gradients, where Dynamo would fail."""
    loss, batch = LCPLoss(DDPGLoss(deterministic_actor(), qvalue()), of="mean"), transitions(8)
    weights = [p for p in loss.actor_network_params.values(True, True) if p.ndim == 2]

    def gradients():
        torch.manual_seed(0)
        return torch.autograd.grad(loss.policy_regularizer(batch)["loss_lcp"], weights)

    def compute(values):
        return loss.policy_regularizer(values)["loss_lcp"]

    torch._dynamo.reset()
    torch.manual_seed(0)
    found = torch.autograd.grad(torch.compile(compute, backend="eager")(batch), weights)
    torch.testing.assert_close(found, gradients())


RUNNING = [CATSConfig(), GradCAPSConfig(), ASAPConfig(), SR2LConfig(steps=2), LCPConfig()]


def small_run(regularizer, compile=False):
    config = ExperimentConfig(
        task=TaskConfig("pendulum", "Pendulum-v1", episodes=2, max_steps=40),
        algorithm=PPORPEConfig(hidden=(8,), replay_ratio=1.0),
        regularizer=regularizer,
        replay=UniformReplayConfig(batch_size=8),
        optimizer=AdamConfig(),
        compile=compile,
    )
    return Experiment(config)


@pytest.mark.parametrize("regularizer", RUNNING, ids=lambda value: value.name)
def test_they_run(regularizer):
    """With their terms in the log."""
    run = small_run(regularizer)
    first, second = run.train()
    term = {"asap": "loss_asap_spatial"}.get(regularizer.name, f"loss_{regularizer.name}")
    assert math.isfinite(second[term])
    if regularizer.name == "cats":
        assert (first["gain"], second["gain"]) == (0.0, 0.5)
        assert run.agent.loss.regularizer_gain.item() == pytest.approx(1.0)


def test_the_predictor_of_asap_is_trained_and_continued(tmp_path):
    """On rollouts, with a gain that follows a measure; from a checkpoint as in one go."""
    config = ExperimentConfig(
        task=TaskConfig("pendulum", "Pendulum-v1", episodes=8, max_steps=40),
        algorithm=PPOConfig(hidden=(8,), frames=100, num_envs=2, epochs=2),
        regularizer=ASAPConfig(gain="target", gain_target=0.001),
        replay=RolloutReplayConfig(batch_size=16),
        optimizer=AdamConfig(),
        compile=False,
        late_share=0.0,
        checkpoint_interval=0.0,
    )
    whole = Experiment(config, tmp_path / "whole")
    first = {k: v.clone() for k, v in whole.agent.loss.asap_predictor.state_dict().items()}
    rows = whole.train()
    last = whole.agent.loss.asap_predictor.state_dict()
    assert all((last[name] != value).any() for name, value in first.items())
    assert math.isfinite(rows[-1]["gain"]) and rows[-1]["gain"] != 1.0
    part = Experiment(config, tmp_path / "parts")
    part.train(4)
    part.close()
    again = Experiment(config, tmp_path / "parts")
    assert 4 <= len(again.metrics) < 8
    again.train()
    state = again.agent.loss.state_dict()
    assert all((state[k] == v).all() for k, v in whole.agent.loss.state_dict().items())


def test_asap_compiles_into_one_graph():
    """With the eager numbers."""
    torch._dynamo.reset()
    loss, batch = ASAPLoss(linear_normal(), previous_key="before"), on_policy(4)
    batch["before"] = batch["observation"] + 0.5
    compiled = torch.compile(loss.policy_regularizer, fullgraph=True, backend="eager")
    expected, found = loss.policy_regularizer(batch.copy()), compiled(batch.copy())
    for key, value in expected.items():
        torch.testing.assert_close(found[key], value)


@pytest.mark.parametrize("case", CASES, ids=str)
def test_asap_goes_around_every_loss_with_a_policy(case):
    """Whose own terms stay as they are, to the bit."""
    if case.policy is None:
        pytest.skip("refused")
    batch = batch_of(case)
    batch["before"] = batch[case.observation].clone()
    expected = run(plain(case), batch.copy())
    found = run(ASAPLoss(plain(case), previous_key="before"), batch.copy())
    assert all(bool((value == found[key]).all()) for key, value in expected.items())
    assert found["loss_asap_spatial"].abs() < 1e-10 and found["loss_grad_caps"] > 0


@pytest.mark.skipif(not compiler_available(), reason="no C++ compiler")
@pytest.mark.slow
@pytest.mark.parametrize(
    "regularizer",
    [LCPConfig(), SR2LConfig(steps=2), ASAPConfig()],
    ids=lambda v: v.name,
)
def test_with_gradients_of_their_own_their_update_is_one_graph_too(regularizer):
    """With the numbers of the one that is not compiled; or with other networks, or weights."""
    found = []
    for compile in (True, False):
        run = small_run(regularizer, compile)
        torch.manual_seed(0)
        run.learner.remember(run.player.collector.rollout())
        draw = run.learner.update.draw()
        found.append([run.learner.update.update(True, *draw)[0] for _ in range(2)])
    torch.testing.assert_close(*found, rtol=1e-4, atol=1e-5)


def test_on_policy_actions_are_scored():
    """LCP reads the action that the loss reads, under its name."""
    base = PPOLoss(gaussian_actor(), None)
    batch = on_policy(4)
    expected = LCPLoss(base).policy_regularizer(batch)["loss_lcp"]
    base.set_keys(action="taken")
    found = LCPLoss(base).policy_regularizer(batch.rename_key_("action", "taken"))["loss_lcp"]
    torch.testing.assert_close(found, expected)
