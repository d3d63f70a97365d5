"""The front door: smooth() in training loops like those of TorchRL, its presets and its ramp."""

from __future__ import annotations

import copy
import math
import pickle
import re
import warnings
from types import SimpleNamespace

import pytest
import torch
from losses import (
    BOUNDS,
    CASES,
    batch_norm_qvalue,
    critic,
    deterministic_actor,
    gaussian_actor,
    heads_critic,
    mlp,
    on_policy,
    qvalue,
    transitions,
)
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import Actor, ValueOperator
from torchrl.objectives import (
    BCLoss,
    ClipPPOLoss,
    CQLLoss,
    CrossQLoss,
    DDPGLoss,
    DTLoss,
    GAILLoss,
    IQLLoss,
    LossModule,
    REDQLoss,
    SACLoss,
    TD3Loss,
)
from torchrl.objectives.value import GAE
from torchrl.trainers import DefaultOptimizationStepper

import torchrl_l2c2
from torchrl_l2c2 import (
    CATSLoss,
    Neighborhood,
    PPORPELoss,
    smooth,
)
from torchrl_l2c2.objectives import _watch
from torchrl_l2c2.presets import KINDS, METHODS, PRESETS

# Settings for losses without a preset.
GIVEN = {"policy_distance": "mean", "neighbors": "line", "lambda_min": 10.0, "lambda_max": 1000.0}


def seeded(make, *args, seed=0, **kwargs):
    torch.manual_seed(seed)
    return make(*args, **kwargs)


class OwnDDPG(LossModule):
    """In the form of TorchRL's tutorial, whose terms are reduced in forward."""

    def __init__(self, actor_network, value_network):
        super().__init__()
        self.convert_to_functional(actor_network, "actor_network", create_target_params=True)
        self.convert_to_functional(value_network, "value_network", create_target_params=True)

    def loss_actor(self, tensordict):
        tensordict = tensordict.select(*self.actor_network.in_keys)
        with self.actor_network_params.to_module(self.actor_network):
            tensordict = self.actor_network(tensordict)
        with self.value_network_params.detach().to_module(self.value_network):
            return -self.value_network(tensordict)["state_action_value"]

    def forward(self, tensordict):
        return TensorDict({"loss_actor": self.loss_actor(tensordict).mean()})


def own_ddpg():
    return OwnDDPG(deterministic_actor(), qvalue())


def updated(loss, loop, batch, loss_seed=2):
    """How a loop changes each parameter; the optimizers are SGD with a rate of 1."""
    before = {name: p.detach().clone() for name, p in loss.named_parameters()}
    torch.manual_seed(loss_seed)
    loop(loss, batch.copy())
    return {name: before[name] - p.detach() for name, p in loss.named_parameters()}


def equal(a, b):
    return bool((a == b).all())


def gradients(loss, value):
    names, parameters = zip(*loss.named_parameters(), strict=True)
    found = torch.autograd.grad(value, parameters, allow_unused=True)
    return {
        name: torch.zeros_like(p) if g is None else g
        for name, p, g in zip(names, parameters, found, strict=True)
    }


def step(parameters, value):
    """Differentiates with respect to all parameters; an optimizer moves some."""
    optimizer = torch.optim.SGD(list(parameters), lr=1.0)
    optimizer.zero_grad()
    value.mean().backward()  # Some methods return one number for each transition.
    optimizer.step()


def leaves(params):
    return list(params.flatten_keys().values())


# Training loops, in the forms of TorchRL's scripts. Each makes one update.


def sac_loop(loss, batch):
    """Named terms, and an optimizer for each network."""
    terms = loss(batch)
    actor = torch.optim.SGD(leaves(loss.actor_network_params), lr=1.0)
    values = torch.optim.SGD(leaves(loss.qvalue_network_params), lr=1.0)
    alpha = torch.optim.SGD([loss.log_alpha], lr=1.0)
    (terms["loss_actor"] + terms["loss_qvalue"] + terms["loss_alpha"]).backward()
    for optimizer in (actor, values, alpha):
        optimizer.step()
        optimizer.zero_grad()


def sac_parts_loop(loss, batch):
    """The methods of the loss, one after the other."""
    value, _ = loss.qvalue_v2_loss(batch)
    step(leaves(loss.qvalue_network_params), value)
    value, metadata = loss.actor_loss(batch)
    step(leaves(loss.actor_network_params), value)
    step([loss.log_alpha], loss.alpha_loss(log_prob=metadata["log_prob"]))


def ppo_loop(loss, batch):
    """Advantages, then three named terms and one optimizer."""
    with torch.no_grad():
        estimate = GAE(gamma=0.9, lmbda=0.9, value_network=loss.critic_network)
        estimate(batch, params=loss.critic_network_params)
    terms = loss(batch)
    value = terms["loss_critic"] + terms["loss_objective"] + terms["loss_entropy"]
    step(loss.parameters(), value)


def td3_loop(loss, batch):
    """The critics, then the delayed policy."""
    value, _ = loss.value_loss(batch)
    step(leaves(loss.qvalue_network_params), value)
    value, _ = loss.actor_loss(batch)
    step(leaves(loss.actor_network_params), value)


def ddpg_loop(loss, batch):
    value, _ = loss.loss_value(batch)
    step(leaves(loss.value_network_params), value)
    value, _ = loss.loss_actor(batch)
    step(leaves(loss.actor_network_params), value)


def cql_loop(loss, batch):
    """The critics' two terms, the actor, the temperature."""
    value, _ = loss.q_loss(batch)
    conservative, _ = loss.cql_loss(batch)
    step(leaves(loss.qvalue_network_params), value + conservative)
    value, metadata = loss.actor_loss(batch)
    step(leaves(loss.actor_network_params), value)
    step([loss.log_alpha], loss.alpha_loss(metadata)[0])


def cql_cloning_loop(loss, batch):
    """The first steps: the policy is cloned instead."""
    value, _ = loss.actor_bc_loss(batch)
    step(leaves(loss.actor_network_params), value)


def cql_named_loop(loss, batch, cloning=True):
    terms = loss(batch)
    policy = terms["loss_actor_bc"] if cloning else terms["loss_actor"]
    step(leaves(loss.actor_network_params), policy)


def iql_loop(loss, batch):
    value, _ = loss.value_loss(batch)
    step(leaves(loss.value_network_params), value)
    value, _ = loss.actor_loss(batch)
    step(leaves(loss.actor_network_params), value)
    value, _ = loss.qvalue_loss(batch)
    step(leaves(loss.qvalue_network_params), value)


def crossq_loop(loss, batch):
    value, _ = loss.qvalue_loss(batch)
    step(leaves(loss.qvalue_network_params), value)
    value, metadata = loss.actor_loss(batch)
    step(leaves(loss.actor_network_params), value)
    step([loss.log_alpha], loss.alpha_loss(log_prob=metadata["log_prob"]))


def trainer_loop(loss, batch):
    """TorchRL's own optimization step."""
    trainer = SimpleNamespace(
        compute_loss=loss,
        optimizer=torch.optim.SGD(loss.parameters(), lr=1.0),
        clip_grad_norm=False,
        clip_norm=None,
    )
    DefaultOptimizationStepper().step(trainer, batch)


def isaac_lab_loop(loss, batch):
    """Every loss_ key; then the divergence of the whole batch sets the learning rate."""
    batch = batch.set("advantage", batch["next", "reward"]).set("value_target", batch["advantage"])
    terms = loss(batch)
    value = sum(terms[key] for key in terms.keys() if key.startswith("loss_"))
    optimizer = torch.optim.SGD(loss.parameters(), lr=1.0)
    value.backward()
    optimizer.step()
    with torch.no_grad():
        divergence = loss(batch)["kl_approx"]
    assert divergence.isfinite()


def sac():
    return SACLoss(gaussian_actor(), qvalue(), action_spec=BOUNDS)


def ppo():
    return ClipPPOLoss(gaussian_actor(), critic(), entropy_coeff=0.01)


def td3():
    return TD3Loss(deterministic_actor(), qvalue(), action_spec=BOUNDS)


def ddpg():
    return DDPGLoss(deterministic_actor(), qvalue())


def cql():
    return CQLLoss(gaussian_actor(), qvalue(), action_spec=BOUNDS)


def iql():
    return IQLLoss(gaussian_actor(), qvalue(), critic())


def crossq():
    return CrossQLoss(gaussian_actor(), batch_norm_qvalue(), action_spec=BOUNDS)


def cloning():
    """The least costly loss with a policy."""
    return BCLoss(deterministic_actor())


LOOPS = {
    "SAC": (sac, transitions, sac_loop),
    "SAC by parts": (sac, transitions, sac_parts_loop),
    "PPO": (ppo, on_policy, ppo_loop),
    "TD3": (td3, transitions, td3_loop),
    "DDPG": (ddpg, transitions, ddpg_loop),
    "CQL": (cql, transitions, cql_loop),
    "CQL, cloning": (cql, transitions, cql_cloning_loop),
    "CQL, cloning by name": (cql, transitions, cql_named_loop),
    "IQL": (iql, transitions, iql_loop),
    "CrossQ": (crossq, transitions, crossq_loop),
    "Trainer with SAC": (sac, transitions, trainer_loop),
    "Trainer with TD3": (td3, transitions, trainer_loop),
    "Isaac Lab": (ppo, on_policy, isaac_lab_loop),
}
# The losses whose preset is relative to the action values, or that have none.
WITH_GIVEN_GAINS = ("TD3", "DDPG", "Trainer with TD3", "IQL")
# The loops that train no value function.
CLONING = ("CQL, cloning", "CQL, cloning by name")


@pytest.mark.filterwarnings("ignore:.*takes the preset of")
class TestLoops:
    """Loops that know nothing of a regularizer train with one."""

    @pytest.fixture(params=LOOPS)
    def name(self, request):
        return request.param

    def losses(self, name, **overrides):
        make, batch, loop = LOOPS[name]
        given = GIVEN | {"beta": 0.0, "relative": False} if name in WITH_GIVEN_GAINS else {}
        given = {**given, **overrides}
        base = seeded(make)
        folded, separate = (smooth(seeded(make), fold=fold, **given) for fold in (True, False))
        batch = seeded(batch, 12, seed=1)
        seeded(separate.neighbor_transform(), batch, seed=3)
        return base, folded, separate, batch, loop

    def test_the_policy_moves_by_its_loss_and_the_penalty(self, name):
        """The change is the baseline's plus the gradient of the separate term."""
        base, folded, separate, batch, loop = self.losses(name)
        term = separate.policy_regularizer(batch)["loss_l2c2_actor"]
        penalty = gradients(separate, term)
        expected, found = updated(base, loop, batch), updated(folded, loop, batch)
        assert expected.keys() == found.keys() == penalty.keys()
        for key in (key for key in expected if "actor" in key):
            torch.testing.assert_close(found[key], expected[key] + penalty[key])
        assert max(g.abs().max() for g in penalty.values()) > 1e-3

    def test_value_functions_move_as_without_a_regularizer(self, name):
        """Bit for bit: the presets have no value term."""
        base, folded, _, batch, loop = self.losses(name)
        expected, found = updated(base, loop, batch), updated(folded, loop, batch)
        keys = [key for key in expected if "actor" not in key]
        assert keys or name in CLONING
        for key in keys:
            assert torch.equal(found[key], expected[key])

    def test_value_functions_have_their_penalty_where_there_is_one(self, name):
        """With beta, each value function's own term includes its penalty."""
        if name in CLONING:
            pytest.skip("trains no value function")
        base, folded, separate, batch, loop = self.losses(name, beta=0.5)
        terms = separate.value_regularizer(batch)
        value = sum(terms[key] for key in separate.added_terms & set(terms.keys()))
        penalty = gradients(separate, value)
        expected, found = updated(base, loop, batch), updated(folded, loop, batch)
        moved = [key for key in expected if "actor" not in key and "alpha" not in key]
        for key in moved:
            if name == "IQL" and key.startswith("qvalue"):
                continue  # Its target is the value that has moved by then.
            torch.testing.assert_close(found[key], expected[key] + penalty[key])
        assert moved and max(penalty[key].abs().max() for key in moved) > 1e-3

    def test_other_methods_fold_alike(self, name):
        """With CAPS: two penalties in one term."""
        make, batch, loop = LOOPS[name]
        given = {"lambda_temporal": 1.0, "lambda_spatial": 5.0}
        base, batch = seeded(make), seeded(batch, 12, seed=1)
        folded = smooth(seeded(make), "caps", **given, sigma=1e-4)
        separate = smooth(seeded(make), "caps", **given, sigma=1e-4, fold=False)
        terms = separate.policy_regularizer(batch)
        penalty = gradients(separate, terms["loss_caps_temporal"])
        expected, found = updated(base, loop, batch), updated(folded, loop, batch)
        for key in (key for key in expected if "actor" in key):
            # The noise is so small that its term is about 0.
            torch.testing.assert_close(found[key], expected[key] + penalty[key], atol=1e-4, rtol=0)
        assert max(g.abs().max() for g in penalty.values()) > 1e-2


def test_without_gradients_the_penalty_costs_nothing():
    """Isaac Lab's loop calls the loss on the whole batch once more: networks run as often."""
    counts = {}
    batch = seeded(on_policy, 12)
    batch["advantage"], batch["value_target"] = torch.randn(12, 1), torch.randn(12, 1)
    for name, loss in (("base", ppo()), ("smooth", smooth(ppo()))):
        rows = counts.setdefault(name, [])
        for network in (loss.actor_network, loss.critic_network):
            network.register_forward_hook(lambda *of, rows=rows: rows.append(of[0]))
            inner = next(m for m in network.modules() if isinstance(m, nn.Linear))
            inner.register_forward_hook(lambda *of, rows=rows: rows.append(of[2].shape))
        with torch.no_grad():
            terms = loss(batch.copy())
    assert [r for r in counts["base"] if isinstance(r, torch.Size)] == [
        r for r in counts["smooth"] if isinstance(r, torch.Size)
    ]
    assert len(counts["base"]) == len(counts["smooth"]) > 1
    assert terms["penalty_l2c2_actor"].isnan() and terms["l2c2_gain"].isnan()


def test_without_gradients_the_terms_are_the_baselines():
    base, loss, batch = seeded(sac), smooth(seeded(sac)), seeded(transitions, 12, seed=1)
    with torch.no_grad():
        expected, found = seeded(base, batch.copy(), seed=2), seeded(loss, batch.copy(), seed=2)
        value, metadata = seeded(loss.actor_loss, batch.copy(), seed=2)
    for key, each in expected.items():
        assert torch.equal(each, found[key])
    assert value.shape == (12,) or value.ndim == 0
    assert not any("l2c2" in key for key in metadata)
    assert set(found.keys()) == set(loss.out_keys)


def test_a_summed_penalty_counts_once_in_unreduced_parts():
    """A loop sums what PPO's ``loss_critic`` returns, which has a value for each state."""
    base = ClipPPOLoss(gaussian_actor(), critic(), reduction="sum")
    separate = smooth(base, **GIVEN, beta=0.5, fold=False)
    batch = separate.neighbor_transform()(seeded(transitions, 12, seed=1))
    batch["value_target"] = torch.ones(12, 1)
    penalty = separate.value_regularizer(batch)["loss_l2c2_critic"]
    own, *_ = separate.loss_critic(batch.copy())
    value, *_ = separate.fold().loss_critic(batch.copy())
    assert value.shape == own.shape == (12, 1) and penalty > 0
    torch.testing.assert_close(value.sum() - own.sum(), penalty, rtol=1e-3, atol=1e-4)


# The penalties that each of the baseline's own terms has, by the network of the penalty.
FOLDED = {
    "PPO": {"loss_objective": ["actor"], "loss_critic": ["critic"]},
    "ClipPPO": {"loss_objective": ["actor"], "loss_critic": ["critic"]},
    "KLPENPPO": {"loss_objective": ["actor"], "loss_critic": ["critic"]},
    "PPO-composite": {"loss_objective": ["actor"], "loss_critic": ["critic"]},
    "MAPPO": {"loss_objective": ["actor"], "loss_critic": ["critic"]},
    "IPPO": {"loss_objective": ["actor"], "loss_critic": ["critic"]},
    "A2C": {"loss_objective": ["actor"], "loss_critic": ["critic"]},
    "Reinforce": {"loss_actor": ["actor"], "loss_value": ["critic"]},
    "PPORPE": {"loss_actor": ["actor"], "loss_critic": ["critic"]},
    "SAC": {"loss_actor": ["actor"], "loss_qvalue": ["qvalue"]},
    "SAC-v1": {"loss_actor": ["actor"], "loss_qvalue": ["qvalue"], "loss_value": ["value"]},
    "TQC": {"loss_actor": ["actor"], "loss_qvalue": ["qvalue"]},
    "DiscreteSAC": {"loss_actor": ["actor"], "loss_qvalue": ["qvalue"]},
    "DDPG": {"loss_actor": ["actor"], "loss_value": ["value"]},
    "TD3": {"loss_actor": ["actor"], "loss_qvalue": ["qvalue"]},
    "TD3BC": {"loss_actor": ["actor"], "loss_qvalue": ["qvalue"]},
    "REDQ": {"loss_actor": ["actor"], "loss_qvalue": ["qvalue"]},
    "IQL": {"loss_actor": ["actor"], "loss_qvalue": ["qvalue"], "loss_value": ["value"]},
    "DiscreteIQL": {"loss_actor": ["actor"], "loss_qvalue": ["qvalue"], "loss_value": ["value"]},
    "BC": {"loss_bc": ["actor"]},
    "deterministic BC": {"loss_bc": ["actor"]},
    "CQL": {"loss_actor": ["actor"], "loss_actor_bc": ["actor"], "loss_qvalue": ["qvalue"]},
    "DiscreteCQL": {"loss_qvalue": ["value"]},
    "CrossQ": {"loss_actor": ["actor"], "loss_qvalue": ["qvalue"]},
    "DQN": {"loss": ["value"]},
    "DistributionalDQN": {"loss": ["value"]},
    "QMixer": {"loss": ["local_value"]},
}
# Wide and strong, so that a penalty is well above the rounding of the loss's own term.
WIDE = {
    "sigma": 1.0,
    "lambda_min": 2.0,
    "lambda_max": 20.0,
    "beta": 0.5,
    "ramp": None,
    "relative": False,
}


@pytest.mark.filterwarnings("ignore")
class TestFolding:
    @pytest.fixture(params=CASES, ids=str)
    def case(self, request):
        return request.param

    def losses(self, case, **kwargs):
        base, folded, separate = (seeded(case.make, **kwargs) for _ in range(3))
        folded = smooth(folded, **WIDE)
        return base, folded, smooth(separate, fold=False, **WIDE)

    def folded(self, case):
        """A new one: some losses keep what they have seen."""
        return smooth(seeded(case.make), **WIDE)

    def run(self, loss, case):
        return seeded(loss, seeded(case.batch, 6, seed=1), seed=2)

    def test_each_penalty_is_part_of_the_term_of_its_network(self, case):
        """Separate, it leaves the own terms bit for bit; folded, it is added and reported."""
        base, folded, separate = (self.run(each, case) for each in self.losses(case))
        assert all(equal(value, separate[key]) for key, value in base.items())
        targets = FOLDED[case.name]
        for key in base.keys():
            expected = base[key]
            for network in targets.get(key, ()):
                expected = expected + separate[f"loss_l2c2_{network}"]
            assert equal(folded[key], expected)
        for network in {name for names in targets.values() for name in names}:
            penalty = folded[f"penalty_l2c2_{network}"]
            assert torch.equal(penalty, separate[f"loss_l2c2_{network}"]) and penalty > 0
            assert not penalty.requires_grad
        losses = {key for key in folded.keys() if key.startswith("loss")}
        assert losses == {key for key in base.keys() if key.startswith("loss")}

    def test_no_strength_is_the_baseline_bit_for_bit(self, case):
        """Values and gradients, folded or not."""
        base = seeded(case.make)
        expected = self.run(base, case)
        keys = [key for key in expected.keys() if key.startswith("loss")]
        theirs = gradients(base, sum(expected[key] for key in keys))
        for fold in (True, False):
            loss = smooth(seeded(case.make), strength=0, fold=fold, **WIDE)
            found = self.run(loss, case)
            assert all(equal(value, found[key]) for key, value in expected.items())
            ours = gradients(loss, sum(found[key] for key in keys))
            assert all(torch.equal(gradient, ours[name]) for name, gradient in theirs.items())

    def test_unfolding_undoes_it(self, case):
        """Terms, values and out_keys are those of a loss that was never folded."""
        _, folded, separate = self.losses(case)
        assert folded.folded and not separate.folded
        assert list(folded.state_dict()) == list(seeded(case.make).state_dict())
        if case.declares_keys:
            assert not any(key.startswith("loss_l2c2") for key in folded.out_keys)
            assert {f"penalty_{term.removeprefix('loss_')}" for term in case.terms} <= set(
                folded.out_keys
            )
        folded.unfold()
        assert not folded.folded and folded.out_keys == separate.out_keys
        expected, found = self.run(separate, case), self.run(folded, case)
        assert set(expected.keys()) == set(found.keys())
        assert all(equal(value, found[key]) for key, value in expected.items())

    @pytest.mark.parametrize("reduction", ["sum", "none"])
    def test_with_other_reductions(self, case, reduction):
        """Penalties are reduced as the own terms, or it is said why they are not added."""
        if reduction not in case.reductions:
            pytest.skip("the baseline has no such reduction")
        base, folded, separate = self.losses(case, reduction=reduction)
        expected, penalties = self.run(base, case), self.run(separate, case)
        try:
            found = self.run(folded, case)
        except ValueError as error:
            assert reduction == "none" and "use a loss with reduction='mean', or fold=False" in str(
                error
            )
            return
        for key in (key for key in expected.keys() if key.startswith("loss")):
            value = expected[key]
            for network in FOLDED[case.name].get(key, ()):
                penalty = penalties[f"loss_l2c2_{network}"]
                assert value.numel() == penalty.numel() and (penalty.ndim > 0) == (
                    reduction == "none"
                )
                value = value + penalty.reshape(value.shape)
            assert equal(found[key], value)

    def test_copies_and_pickles_are_folded(self, case):
        if case.name == "CrossQ":
            pytest.skip("a copy of the baseline has other values, too")
        folded, expected = self.folded(case), self.run(self.folded(case), case)
        twins = [copy.deepcopy(folded)]
        try:
            pickle.dumps(seeded(case.make))
            twins.append(pickle.loads(pickle.dumps(folded)))
        except (AttributeError, pickle.PicklingError):
            pass  # The baseline does not pickle either.
        for twin in twins:
            assert type(twin) is type(folded) and twin.folded and twin.out_keys == folded.out_keys
            found = self.run(twin, case)
            assert all(equal(value, found[key]) for key, value in expected.items())

    def test_out_keys_can_be_selected_and_reset(self, case):
        if not (case.declares_keys and case.selects):
            pytest.skip("the baseline does not do so either")
        folded, expected = self.folded(case), self.run(self.folded(case), case)
        keys = list(folded.out_keys)
        network = case.terms[0].removeprefix("loss_")
        wanted = [next(iter(FOLDED[case.name])), f"penalty_{network}"]
        folded.select_out_keys(*wanted)
        found = self.run(folded, case)
        undeclared = set(expected.keys()) - set(keys)  # tensordict 0.15 keeps them.
        assert set(found.keys()) - undeclared == set(wanted) == set(folded.out_keys)
        assert all(torch.equal(found[key], expected[key]) for key in wanted)
        assert folded.unfold().fold().out_keys == wanted
        folded.reset_out_keys()
        assert folded.out_keys == keys
        assert set(keys) <= set(self.run(folded, case).keys())

    def test_a_selection_of_the_plain_losses_out_keys_stays(self, case):
        """On both losses; with the regularizer's own, until it is reset on each."""
        if not (case.declares_keys and case.selects):
            pytest.skip("the baseline does not do so either")
        base, keys = seeded(case.make), list(self.folded(case).out_keys)
        own = list(base.out_keys)
        wanted = [next(iter(FOLDED[case.name]))]
        base.select_out_keys(*wanted)
        folded = smooth(base, **WIDE)
        added = [key for key in keys if key not in own]
        for loss, expected in ((folded, [*wanted, *added]), (base, wanted)):
            assert loss.out_keys == expected
            assert set(self.run(loss, case).keys()) & {*keys} == {*expected}
        assert folded.reset_out_keys().out_keys == keys and base.out_keys == wanted
        assert base.reset_out_keys().out_keys == own

    def test_keys_can_be_renamed(self, case):
        if not case.values:
            pytest.skip("behavior cloning reads no rewards")
        folded, expected = self.folded(case), self.run(self.folded(case), case)
        keys = list(folded.out_keys)
        folded.set_keys(reward="other_reward")
        assert folded.out_keys == keys
        batch = seeded(case.batch, 6, seed=1)
        batch["next"].rename_key_("reward", "other_reward")
        found = seeded(folded, batch, seed=2)
        assert all(equal(value, found[key]) for key, value in expected.items())


def previous(batch, key="observation"):
    """With the observation before each state, which Grad-CAPS and ASAP read."""
    return batch.set("before", batch[key] + 0.1 * torch.randn_like(batch[key]))


def overrides_of(method):
    return {"previous_key": "before"} if method in ("grad_caps", "asap") else {}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("method", METHODS)
class TestEveryMethod:
    def test_no_strength_is_the_baseline_bit_for_bit(self, method):
        """Values and gradients of the baseline's parameters, folded or not."""
        for fold in (True, False):
            base = seeded(sac)
            loss = smooth(seeded(sac), method, strength=0, fold=fold, **overrides_of(method))
            batch = previous(seeded(transitions, 12, seed=1))
            expected, found = (seeded(each, batch.copy(), seed=2) for each in (base, loss))
            keys = list(expected.keys())
            assert all(torch.equal(expected[key], found[key]) for key in keys)
            keys = [key for key in keys if key.startswith("loss")]
            totals = [sum(terms[key] for key in keys) for terms in (expected, found)]
            ours = gradients(loss, totals[1])
            for name, gradient in gradients(base, totals[0]).items():
                assert torch.equal(gradient, ours[name])

    def test_twice_the_strength_is_twice_the_penalty(self, method):
        batch = previous(seeded(transitions, 12, seed=1))
        once, twice = (
            smooth(seeded(sac), method, strength=strength, **overrides_of(method))
            for strength in (1, 2)
        )
        expected, found = (seeded(each, batch.copy(), seed=2) for each in (once, twice))
        penalties = [f"penalty_{key.removeprefix('loss_')}" for key in once.policy_terms]
        assert penalties
        for key in penalties:
            assert expected[key] > 0 or key == "penalty_asap_spatial"  # A copy predicts at first.
            torch.testing.assert_close(found[key], 2 * expected[key])

    def test_its_gradient_is_the_separate_terms(self, method):
        """For parameters of the regularizer's own, too."""
        batch = previous(seeded(transitions, 12, seed=1))
        folded, separate = (
            smooth(seeded(sac), method, fold=fold, **overrides_of(method)) for fold in (True, False)
        )
        torch.manual_seed(2)
        terms = separate(batch.copy())
        keys = [key for key in terms.keys() if key.startswith("loss_")]
        expected = gradients(separate, sum(terms[key] for key in keys))
        torch.manual_seed(2)
        terms = folded(batch.copy())
        value = terms["loss_actor"] + terms["loss_qvalue"] + terms["loss_alpha"]
        found = gradients(folded, value)
        for name, gradient in expected.items():
            torch.testing.assert_close(found[name], gradient)


class MySACLoss(SACLoss):
    """A user's own."""


EXACT = {
    "ppo": [ppo],
    "sac": [sac, lambda: MySACLoss(gaussian_actor(), qvalue(), action_spec=BOUNDS)],
    "td3": [td3],
    "ppo_rpe": [lambda: PPORPELoss(gaussian_actor(), heads_critic())],
}


class TestPresets:
    """Which settings a loss takes, and what is said of it."""

    SIMILAR = ("PPO", "A2C", "KLPENPPO", "MAPPO", "IPPO", "REDQ", "TQC", "CrossQ", "CQL", "DDPG")
    WITHOUT = ("Reinforce", "BC", "deterministic BC", "TD3BC", "IQL", "DiscreteIQL", "DiscreteSAC")

    @pytest.mark.parametrize("kind", EXACT)
    def test_the_losses_that_it_was_found_with_take_it_in_silence(self, kind):
        for make in EXACT[kind]:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                loss = smooth(make())
            settings = PRESETS["l2c2"][kind].settings
            near = loss.l2c2_neighborhood
            assert near.lambda_min == settings["lambda_min"]
            assert near.lambda_max == settings["lambda_max"]
            assert near.neighbors == settings.get("neighbors", "box")
            assert loss.l2c2_policy_distance == settings.get("policy_distance", "hellinger")
            assert loss.regularizer_gain.item() == 1.0

    def test_the_numbers(self):
        """As the pages of results have them."""
        shown = str(smooth(sac()))
        assert "lambda_min=10.0, lambda_max=1000.0" in shown and "ramp=(1.0, 1.0)" in shown
        assert "lambda_min=1.0, lambda_max=100.0" in str(smooth(ppo()))
        shown = str(smooth(td3()))
        assert "lambda_min=0.04, lambda_max=4.0" in shown and "ramp=None, relative=True" in shown
        loss = smooth(td3(), "caps")
        gains = [loss.caps_lambda_temporal, loss.caps_lambda_spatial]
        assert [gain.item() for gain in gains] == [1.0, 5.0] and loss.caps_sigma == 0.2
        assert smooth(ppo(), "cats").cats_lambda_temporal.item() == pytest.approx(0.1)

    @pytest.mark.parametrize("name", SIMILAR)
    def test_similar_losses_take_it_with_one_warning(self, name):
        (case,) = (case for case in CASES if case.name == name)
        with pytest.warns(UserWarning) as told:
            loss = smooth(case.make())
        (message,) = (str(each.message) for each in told)
        nearest = "TD3Loss" if name == "DDPG" else "SACLoss" if "Q" in name else "ClipPPOLoss"
        base = type(case.make()).__name__
        assert message.startswith(f"{base} takes the preset of {nearest}")
        assert f"not tried with {base}" in message
        assert told[0].filename == __file__
        assert loss.l2c2_neighborhood.lambda_max in (4.0, 100.0, 1000.0)

    def test_the_nearest_of_an_action_value_is_not_ppos(self):
        """A loss that grows with the action values, whatever their network is called."""
        with pytest.raises(TypeError, match=r"nearest is the preset of TD3Loss; .*relative=True"):
            smooth(own_ddpg())

    @pytest.mark.parametrize("method", METHODS)
    @pytest.mark.parametrize("name", WITHOUT)
    def test_the_error_of_others_shows_a_call_that_works(self, name, method):
        (case,) = (case for case in CASES if case.name == name)
        base = case.make()
        with pytest.raises(TypeError, match=f"{type(base).__name__} has no preset") as error:
            smooth(base, method)
        nearest, call = re.search(
            r"The nearest is the preset of (\w+); .*: (smooth\(.*\))\.$", str(error.value)
        ).groups()
        kind = {"TD3BC": "td3", "DiscreteSAC": "sac"}.get(name, "ppo")
        assert nearest == KINDS[kind][0][0]
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            loss = eval(call, {"smooth": smooth, "loss": base})
        assert isinstance(loss, getattr(torchrl_l2c2, METHODS[method]))
        expected = PRESETS[method][kind]
        assert (loss._ramp is None) == (expected.ramp is None)
        if method == "l2c2":
            assert loss.l2c2_neighborhood.lambda_min == expected.settings["lambda_min"]

    @pytest.mark.parametrize("name", ["DQN", "QMixer", "DiscreteCQL", "DistributionalDQN"])
    def test_losses_without_a_policy_are_told_what_smooths_values(self, name):
        (case,) = (case for case in CASES if case.name == name)
        base = case.make()
        with pytest.raises(TypeError, match="has no preset") as error:
            smooth(base)
        call = re.search(r"smooth\(.*\)", str(error.value)).group()
        with pytest.warns(UserWarning, match="leaves out the policy term"):
            loss = eval(call, {"smooth": smooth, "loss": base})
        assert loss.added_terms == {f"loss_l2c2_{case.values[0]}"}
        with pytest.raises(TypeError, match=r"caps needs a policy: \w+ has none"):
            smooth(base, "caps")

    @pytest.mark.parametrize("method", ["grad_caps", "asap", "lcp", "sr2l"])
    def test_methods_without_runs_say_so_and_what_they_take(self, method):
        with pytest.warns(UserWarning, match="takes settings that were not tuned, ") as told:
            smooth(sac(), method)
        (message,) = (str(each.message) for each in told)
        for name, value in PRESETS[method]["sac"].settings.items():
            assert f"{name}={value!r}" in message

    def test_settings_without_runs_are_not_said_to_be_found_with_a_similar_loss(self):
        """With a gain of the user's own, there is nothing to warn of."""
        (case,) = (case for case in CASES if case.name == "REDQ")
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            smooth(case.make(), "lcp", coeff=0.01)

    def test_without_a_preset_single_settings_replace_those_of_the_nearest(self):
        """As they replace a preset's; the others are told."""
        (case,) = (case for case in CASES if case.name == "IQL")
        with pytest.warns(
            UserWarning, match=r"of ClipPPOLoss, the nearest: policy_dist.*ramp=1\.0\.$"
        ):
            loss = smooth(case.make(), lambda_min=20.0)
        near = loss.l2c2_neighborhood
        assert (near.lambda_min, near.lambda_max, near.neighbors) == (20.0, 100.0, "line")
        assert loss.l2c2_policy_distance == "mse" and loss._ramp == (1.0, 1.0)
        with pytest.warns(UserWarning, match="has no preset") as told:
            loss = smooth(case.make(), neighborhood=Neighborhood(0.3, 2.0, 5.0))
        assert "lambda_max" not in str(told[0].message)
        assert loss.l2c2_neighborhood.lambda_max == 5.0

    def test_overrides_replace_single_settings(self):
        loss = smooth(sac(), lambda_min=3.0, sigma=0.5, fraction=0.5, beta=0.2)
        near = loss.l2c2_neighborhood
        assert (near.lambda_min, near.lambda_max, near.sigma) == (3.0, 1000.0, 0.5)
        assert loss.l2c2_fraction == 0.5 and loss.l2c2_beta.item() == pytest.approx(0.2)
        near = Neighborhood(sigma=0.3, lambda_min=2.0, lambda_max=5.0)
        assert smooth(sac(), neighborhood=near).l2c2_neighborhood is near
        assert smooth(ppo(), ramp=None)._ramp is None
        assert smooth(sac(), ramp=0.5)._ramp == (1.0, 0.5)
        batch = seeded(transitions, 12, seed=1)
        plain = seeded(smooth(seeded(sac), fold=False), batch.copy(), seed=2)
        relative = seeded(smooth(seeded(sac), fold=False, relative=True), batch.copy(), seed=2)
        assert relative["loss_l2c2_actor"] < plain["loss_l2c2_actor"]  # The values are small.

    @pytest.mark.parametrize(
        ("arguments", "error", "message"),
        [
            (
                {"lamda_min": 1.0},
                TypeError,
                r"settings of l2c2, .*'lambda_min'.*got \['lamda_min'\]\. .* mean 'lambda_min'",
            ),
            ({"strenght": 1.0}, TypeError, "Did you mean 'strength'"),
            ({"method": 2.0}, ValueError, "got 2.0. For a strength: strength=2.0"),
            ({"method": "caps", "beta": 0.1}, TypeError, r"settings of caps, .*got \['beta'\]"),
            (
                {"method": "caps", "neighbors": "line"},
                TypeError,
                r"settings of caps, .*got \['neighbors'\]",
            ),
            ({"method": "l2c3"}, ValueError, r"one of \['l2c2', .*got 'l2c3'"),
            ({"method": ["l2c2"]}, ValueError, r"got \['l2c2'\]"),
            ({"fold": "no"}, TypeError, "fold must be True or False, got 'no'"),
            ({"skip_ends": "false"}, TypeError, "skip_ends must be True or False"),
            (
                {"neighborhood": Neighborhood(), "sigma": 1.0},
                TypeError,
                r"a neighborhood or its fields, got both it and \['sigma'\]",
            ),
            ({"strength": -1.0}, ValueError, "strength must be .*at least 0"),
            ({"strength": "2"}, TypeError, "strength must be a real number"),
            ({"relative": 1}, TypeError, "relative must be True or False, got 1"),
            ({"ramp": 2.0}, ValueError, r"ramp must be in \(0, 1\], got 2.0"),
        ],
    )
    def test_wrong_settings_are_refused(self, arguments, error, message):
        with pytest.raises(error, match=message):
            smooth(sac(), **arguments)

    def test_what_cannot_be_regularized_is_refused_with_the_reason(self):
        """Not with settings to pass."""
        with pytest.raises(TypeError, match=r"a loss without a regularizer, got a L2C2Loss\[SAC"):
            smooth(smooth(sac()), "cats")
        with pytest.raises(TypeError, match=r"Regularize the loss, such as SACLoss.*before it is"):
            smooth(torch.compile(sac(), backend="eager"))
        with pytest.raises(TypeError, match=r"Regularize the loss, such as SACLoss.*\)\.$"):
            smooth(sac().actor_network)
        with pytest.raises(ValueError, match=r"got 'L2C2'\. Did you mean 'l2c2'\?$"):
            smooth(sac(), "L2C2")
        with pytest.raises(
            TypeError, match=r"the class SACLoss: make the loss first, SACLoss\(\.\."
        ):
            smooth(SACLoss)
        with pytest.raises(TypeError, match=r"LossModule, got a int\.$"):
            smooth(3)
        with pytest.raises(TypeError, match="got a Linear"):
            smooth(nn.Linear(1, 1))
        with pytest.raises(TypeError, match="sequences"):
            smooth(DTLoss(gaussian_actor()))
        discriminator = ValueOperator(mlp(5, 1), in_keys=["expert_action", "expert_observation"])
        for method in ("l2c2", "caps"):
            with pytest.raises(TypeError, match=r"nothing to regularize: GAILLoss has no"):
                smooth(GAILLoss(discriminator), method)

    def test_a_folded_loss_takes_no_further_regularizer(self):
        with pytest.raises(TypeError, match=r"call fold\(\) on the outermost"):
            CATSLoss(smooth(sac()))
        both = CATSLoss(smooth(sac(), fold=False)).fold()
        terms = both(seeded(transitions, 12))
        assert terms["penalty_cats"] > 0 and terms["penalty_l2c2_actor"] > 0
        assert {key for key in terms.keys() if key.startswith("loss")} == {
            "loss_actor",
            "loss_qvalue",
            "loss_alpha",
        }


class AliasSAC(SACLoss):
    """The name that DDPG has for this part."""

    def loss_actor(self, tensordict):
        return self.actor_loss(tensordict)


class AliasDDPG(DDPGLoss):
    """The name that TD3 has for this part."""

    def actor_loss(self, tensordict):
        return self.loss_actor(tensordict)


class ClonesFirst(CQLLoss):
    def actor_loss(self, tensordict):
        return self.actor_bc_loss(tensordict)


class OtherNames(SACLoss):
    def actor_loss(self, batch):
        return super().actor_loss(batch)


class DelayedTD3(TD3Loss):
    """Leaves out its policy's term in its first call."""

    calls = 0

    def forward(self, tensordict):
        self.calls += 1
        terms = super().forward(tensordict)
        return terms.exclude("loss_actor") if self.calls == 1 else terms


class Nameless(LossModule):
    """A loss of one's own that lists no ``out_keys``."""

    term = "loss_objective"

    def __init__(self):
        super().__init__()
        self.convert_to_functional(deterministic_actor(), "actor_network")
        self.convert_to_functional(qvalue(), "qvalue_network")

    def _forward_value_estimator_keys(self, **kwargs):
        pass

    def forward(self, tensordict):
        with self.actor_network_params.to_module(self.actor_network):
            batch = self.actor_network(tensordict.select("observation"))
        with self.qvalue_network_params.data.to_module(self.qvalue_network):
            value = self.qvalue_network(batch)["state_action_value"]
        return TensorDict({self.term: -value.mean()})


class TestSubclasses:
    """Losses of one's own, whose parts call each other or are missing in some calls."""

    @pytest.mark.parametrize(
        ("make", "part", "other"),
        [
            (lambda: AliasSAC(gaussian_actor(), qvalue()), "loss_actor", "actor_loss"),
            (lambda: AliasDDPG(deterministic_actor(), qvalue()), "actor_loss", "loss_actor"),
            (
                lambda: ClonesFirst(gaussian_actor(), qvalue(), action_spec=BOUNDS),
                "actor_loss",
                "actor_bc_loss",
            ),
        ],
        ids=["SAC", "DDPG", "CQL"],
    )
    def test_a_part_that_calls_another_has_the_penalty_once(self, make, part, other):
        batch = seeded(transitions, 12, seed=1)
        base = seeded(make)
        relative = isinstance(base, DDPGLoss)
        loss = smooth(base, "cats", lambda_temporal=1.0, ramp=None, relative=relative)
        own, _ = seeded(getattr(base, other), batch.copy(), seed=2)
        value, metadata = seeded(getattr(loss, part), batch.copy(), seed=2)
        assert metadata["penalty_cats"] > 0
        torch.testing.assert_close(value, own + metadata["penalty_cats"])
        _, inner = seeded(getattr(loss, other), batch.copy(), seed=2)
        assert metadata["penalty_cats"] == inner["penalty_cats"]

    def test_the_batch_may_be_given_by_the_parts_own_name(self):
        batch = seeded(transitions, 12, seed=1)
        loss = smooth(seeded(lambda: OtherNames(gaussian_actor(), qvalue())), ramp=None)
        batch = loss.neighbor_transform()(batch)
        value, _ = seeded(loss.actor_loss, batch=batch.copy(), seed=2)
        assert value == seeded(loss.actor_loss, batch.copy(), seed=2)[0]
        with pytest.raises(TypeError, match=r"^actor_loss takes a batch as 'batch'"):
            loss.actor_loss()

    @pytest.mark.parametrize("fold", [False, True])
    @pytest.mark.parametrize("relative", [False, True])
    def test_without_the_policys_term_there_is_no_penalty(self, fold, relative):
        """Delayed updates of the policy: the penalty does not train it in between."""
        batch = seeded(transitions, 12, seed=1)
        base = seeded(lambda: DelayedTD3(deterministic_actor(), qvalue(), bounds=(-1, 1)))
        plain = set(base(batch.copy()).keys())
        base.calls = 0
        loss = smooth(base, "cats", lambda_temporal=1.0, ramp=None, fold=fold, relative=relative)
        assert set(loss(batch.copy()).keys()) == plain
        terms = loss(batch.copy())
        assert terms["penalty_cats" if fold else "loss_cats"] > 0

    @pytest.mark.parametrize("fold", [False, True])
    def test_relative_to_the_term_of_a_loss_of_ones_own(self, fold):
        """Its size is that of its mean, as it is not reduced by TorchRL."""
        batch, base = seeded(transitions, 12, seed=1), seeded(Nameless)
        size = base(batch.copy())["loss_objective"].detach().abs()
        plain = smooth(base, "cats", lambda_temporal=1.0, relative=False, fold=fold)
        loss = smooth(base, "cats", lambda_temporal=1.0, relative=True, fold=fold)
        key = "penalty_cats" if fold else "loss_cats"
        torch.testing.assert_close(loss(batch.copy())[key], size * plain(batch.copy())[key])

    def test_a_loss_without_a_known_term_cannot_be_relative(self):
        base = seeded(Nameless)
        base.term = "loss_policy"
        loss = smooth(base, "cats", lambda_temporal=1.0, relative=True, fold=False)
        with pytest.raises(RuntimeError, match=r"relative to loss_actor, .* returns none of these"):
            loss(seeded(transitions, 12, seed=1))


def by_value():
    """The losses that train a policy by an action value."""
    names = ("SAC", "SAC-v1", "TQC", "DiscreteSAC", "DDPG", "TD3", "TD3BC", "REDQ", "CQL", "CrossQ")
    return [case for case in CASES if case.name in names]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("case", by_value(), ids=str)
class TestRelative:
    """Penalties relative to the size of the action values."""

    def run(self, loss, case, seed=2):
        return seeded(loss, seeded(case.batch, 6, seed=1), seed=seed)

    def size(self, case, reduction="mean"):
        """The absolute value of the baseline's own term, per value or, of a sum, per transition."""
        own = self.run(seeded(case.make, reduction="none"), case)["loss_actor"].abs()
        return own.mean() if reduction == "mean" else own.sum() / 6

    @pytest.mark.parametrize("reduction", ["mean", "sum"])
    def test_the_penalty_of_the_policy_is_multiplied_by_the_size(self, case, reduction):
        if reduction not in case.reductions:
            pytest.skip("the baseline has no such reduction")
        separate, plain = (
            smooth(seeded(case.make, reduction=reduction), fold=False, **WIDE) for _ in range(2)
        )
        separate.relative()
        found, expected = self.run(separate, case), self.run(plain, case)
        size = self.size(case, reduction)
        assert 0 < size != 1
        for key, value in expected.items():
            factor = size if key in separate.policy_terms else 1.0
            torch.testing.assert_close(found[key], value * factor)

    def test_it_is_folded(self, case):
        """The own term is the baseline's plus the penalty that is reported."""
        folded = self.run(smooth(seeded(case.make), **WIDE).relative(), case)
        separate = self.run(smooth(seeded(case.make), fold=False, **WIDE).relative(), case)
        penalty = separate["loss_l2c2_actor"]
        assert torch.equal(folded["penalty_l2c2_actor"], penalty)
        assert torch.equal(folded["loss_actor"], separate["loss_actor"] + penalty)

    def test_the_size_has_no_gradient(self, case):
        """The penalty's gradient is the plain penalty's, as often as the size."""
        relative, plain = (smooth(seeded(case.make), fold=False, **WIDE) for _ in range(2))
        size = self.size(case)
        ours = gradients(relative, self.run(relative.relative(), case)["loss_l2c2_actor"])
        theirs = gradients(plain, self.run(plain, case)["loss_l2c2_actor"])
        for name, gradient in theirs.items():
            torch.testing.assert_close(ours[name], gradient * size, rtol=1e-4, atol=1e-6)


class BreaksGraphs(nn.Linear):
    """A network at whose condition on values ``torch.compile`` breaks the graph."""

    def __init__(self):
        super().__init__(3, 2)

    def forward(self, states):
        return super().forward(2 * states if states.abs().max() > 1e6 else states)


class TestRelativeParts:
    @pytest.mark.parametrize(("make", "method"), [(td3, "actor_loss"), (ddpg, "loss_actor")])
    def test_methods_of_the_loss_have_it(self, make, method):
        """Loops that call ``actor_loss`` train with the penalty of ``forward``."""
        batch = seeded(transitions, 12, seed=1)
        loss = smooth(seeded(make), **GIVEN).relative()
        batch = loss.neighbor_transform()(batch)
        whole = seeded(loss, batch.copy(), seed=2)
        value, metadata = seeded(getattr(loss, method), batch.copy(), seed=2)
        torch.testing.assert_close(value, whole["loss_actor"])
        torch.testing.assert_close(metadata["penalty_l2c2_actor"], whole["penalty_l2c2_actor"])
        plain = smooth(seeded(make), **GIVEN, fold=False, relative=False)
        plain = seeded(plain, batch.copy(), seed=2)
        assert metadata["penalty_l2c2_actor"] != plain["loss_l2c2_actor"]

    def test_an_own_loss_has_the_same_in_both(self):
        """The mean of absolute values, also where the loss reduces them without TorchRL."""
        loss = smooth(seeded(own_ddpg), **GIVEN, ramp=None, relative=True)
        batch = loss.neighbor_transform()(seeded(transitions, 12, seed=1))
        values = loss.loss_actor(batch.copy())
        penalty = loss(batch.copy())["penalty_l2c2_actor"]
        assert values.shape == (12, 1)
        with torch.no_grad():
            own = loss.loss_actor(batch.copy())
        torch.testing.assert_close(values - own, penalty.expand(12, 1))
        loss._relative = False
        plain = loss(batch.copy())["penalty_l2c2_actor"]
        torch.testing.assert_close(penalty, plain * own.abs().mean())
        assert own.abs().mean() > 1.1 * own.mean().abs()

    def test_a_loss_that_reduces_its_terms_together(self):
        """REDQ: values of both signs do not cancel in the size."""

        class BothSigns(nn.Module):
            def __init__(self):
                super().__init__()
                self.scale = nn.Parameter(torch.ones(1))

            def forward(self, observation, action):
                return self.scale * (100 * observation[..., :1].sign() + 0 * action[..., :1])

        value = ValueOperator(BothSigns(), in_keys=["observation", "action"])
        base = seeded(
            lambda: REDQLoss(
                gaussian_actor(), value, action_spec=BOUNDS, fixed_alpha=True, alpha_init=1e-6
            )
        )
        batch = seeded(transitions, 12, seed=1)
        batch["observation"][:, 0] = torch.tensor([1.0, -1.0]).repeat(6)
        plain, relative = CATSLoss(base), CATSLoss(base).relative()
        plain, relative = (seeded(loss, batch.copy(), seed=2) for loss in (plain, relative))
        expected = 100 * plain["loss_cats"]
        torch.testing.assert_close(relative["loss_cats"], expected, rtol=1e-3, atol=0.0)

    @pytest.mark.parametrize("agents", [1, 4])
    def test_several_agents_are_no_ensemble(self, agents):
        """A sum over agents has as many penalties as action values: their ratio is a mean's."""
        keys = [("agents", name) for name in ("observation", "action", "state_action_value")]
        batch, ended = seeded(transitions, 12, seed=1), torch.zeros(12, agents, 1, dtype=torch.bool)
        there = {"observation": torch.randn(12, agents, 3), "reward": torch.zeros(12, agents, 1)}
        there |= {"done": ended, "terminated": ended}
        here = {"observation": torch.randn(12, agents, 3), "action": torch.randn(12, agents, 1)}
        batch = TensorDict({"agents": here, "next": {"agents": there}}, [12])
        found = []
        for reduction in ("mean", "sum"):
            torch.manual_seed(0)
            actor = TensorDictModule(nn.Linear(3, 1), keys[:1], keys[1:2])
            value = ValueOperator(nn.Bilinear(3, 1, 1), in_keys=keys[:2], out_keys=keys[2:])
            base = DDPGLoss(actor, value, reduction=reduction)
            names = {name: ("agents", name) for name in ("reward", "done", "terminated")}
            base.set_keys(state_action_value=keys[2], **names)
            terms = CATSLoss(base, 0.04).relative()(batch.copy())
            found.append(terms["loss_cats"] / terms["loss_actor"])
        torch.testing.assert_close(*found)

    def test_a_term_that_is_reduced_already_has_its_size_per_row(self):
        class Reducing(DDPGLoss):
            def loss_actor(self, tensordict):
                value, metadata = super().loss_actor(tensordict)
                return self._reduce_loss(value, tensordict), metadata

        batch, found = seeded(transitions, 12, seed=1), []
        for kind in (DDPGLoss, Reducing):
            base = seeded(lambda kind=kind: kind(deterministic_actor(), qvalue(), reduction="sum"))
            found.append(seeded(CATSLoss(base).relative(), batch.copy(), seed=2)["loss_cats"])
        torch.testing.assert_close(*found)

    @pytest.mark.parametrize("first", [True, False])
    def test_a_subclass_with_a_term_of_its_own(self, first):
        """Before or after the action values: the size is the values', not that term's."""

        class Sparing(TD3Loss):
            def effort(self, tensordict):
                with self.actor_network_params.to_module(self.actor_network):
                    action = self.actor_network(tensordict.select("observation"))["action"]
                return self._reduce_loss(action.square().sum(-1), tensordict)

            def actor_loss(self, tensordict):
                before = self.effort(tensordict) if first else 0.0
                value, metadata = super().actor_loss(tensordict)
                after = 0.0 if first else self.effort(tensordict)
                return value + before + after, metadata

        batch = seeded(transitions, 12, seed=1)
        found = []
        for kind in (TD3Loss, Sparing):
            base = seeded(lambda kind=kind: kind(deterministic_actor(), qvalue(), bounds=(-1, 1)))
            with torch.no_grad():
                base.qvalue_network_params.apply(lambda p: p.mul_(10), inplace=False)
            found.append(seeded(smooth(base), batch.copy(), seed=2)["penalty_l2c2_actor"])
        torch.testing.assert_close(*found)

    def test_losses_without_an_action_value_in_the_policys_term(self):
        with pytest.raises(TypeError, match="a penalty can be relative to action values"):
            CATSLoss(iql()).relative()
        loss = CATSLoss(cql()).relative().fold()
        with pytest.raises(RuntimeError, match="actor_bc_loss has no action values"):
            loss.actor_bc_loss(seeded(transitions, 12, seed=1))

    def test_separate_penalties_need_forward(self):
        """A loop of methods would add the penalty without its size."""
        loss = smooth(td3(), **GIVEN, fold=False).relative()
        batch = seeded(transitions, 12, seed=1)
        loss(batch.copy())
        with pytest.raises(RuntimeError, match=r"actor_loss leaves out .* call loss\.fold\(\)"):
            loss.actor_loss(batch.copy())

        with pytest.raises(RuntimeError, match=r"actor_loss leaves out"):
            torch.compile(loss.actor_loss, backend="eager")(batch.copy())

    def test_terms_without_their_size_are_named(self):
        """Loops without ``forward`` would add them as they are."""
        loss, batch = smooth(td3()), seeded(transitions, 12, seed=1)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.filterwarnings("ignore", "No target network updater")
            loss(batch.copy())
            loss.actor_loss(batch.copy())
            loss.value_regularizer(batch.copy())
            smooth(sac()).policy_regularizer(batch.copy())
        with pytest.warns(UserWarning, match="does not know the size of the action values"):
            loss.policy_regularizer(batch.copy())

    @pytest.mark.parametrize("relative", [pytest.param(False, marks=pytest.mark.slow), True])
    def test_a_break_of_the_graph_changes_nothing(self, relative):
        """The penalty is added once, and has its size, where compiled code calls eager code."""
        torch._dynamo.reset()
        base = seeded(lambda: TD3Loss(Actor(BreaksGraphs()), qvalue(), bounds=(-1, 1)))
        loss = smooth(base, "cats", lambda_temporal=1.0, ramp=None, relative=relative)
        batch = seeded(transitions, 12, seed=1)
        expected = seeded(loss, batch.copy(), seed=2)
        found = seeded(torch.compile(loss, backend="eager"), batch.copy(), seed=2)
        for key in ("loss_actor", "penalty_cats"):
            torch.testing.assert_close(found[key], expected[key])
        part = torch.compile(loss.actor_loss, backend="eager")
        value, metadata = seeded(part, batch.copy(), seed=2)
        torch.testing.assert_close(value, expected["loss_actor"])
        torch.testing.assert_close(metadata["penalty_cats"], expected["penalty_cats"])

    def test_small_relative_gains_are_not_said_to_have_no_effect(self):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            smooth(td3(), lambda_min=0.01, lambda_max=1.0)
        with pytest.warns(UserWarning, match="no measurable effect"):
            smooth(td3(), lambda_min=0.01, lambda_max=1.0, relative=False)

    @pytest.mark.parametrize(
        ("method", "given"),
        [
            ("l2c2", {"lambda_min": 3.0, "lambda_max": 300.0}),
            (
                "l2c2",
                {"neighborhood": Neighborhood(lambda_min=3.0, lambda_max=300.0, neighbors="line")},
            ),
            ("cats", {"lambda_temporal": 3.0}),
        ],
    )
    def test_a_gain_of_an_absolute_penalty_is_named(self, method, given):
        """A gain from before the presets were relative would be 75 times the preset's."""
        with pytest.warns(UserWarning, match=r"=3 is 75 times the preset's gain, .* give both"):
            smooth(td3(), method, **given)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            smooth(td3(), method, **given, relative=False)
            smooth(sac(), method, **given)

    @pytest.mark.parametrize(
        ("make", "relative", "unit"),
        [(td3, False, "relative to the action values"), (sac, True, "not relative")],
    )
    def test_relative_alone_needs_a_gain(self, make, relative, unit):
        """The preset's gain has the other unit: it would do nothing, or far too much."""
        with pytest.warns(UserWarning, match=f"is the preset's gain, which is {unit}: give both"):
            smooth(make(), relative=relative)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            smooth(make(), relative=relative, lambda_min=0.5, lambda_max=50.0)

    @pytest.mark.parametrize("given", [{"policy_distance": "hellinger"}, {"neighbors": "box"}])
    def test_a_distance_of_another_kind_needs_a_gain(self, given):
        """Distances differ in size, and so do the mean gains of a box and a line."""
        with pytest.warns(UserWarning, match=r"lambda_min=10\.0, .*: give lambda_min, too"):
            smooth(sac(), **given)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            smooth(sac(), **given, lambda_min=20.0, lambda_max=2000.0)
            smooth(sac(), policy_distance="mean", neighbors="line")
            smooth(sac(), "cats")

    @pytest.mark.parametrize(
        ("given", "named"),
        [({"policy_distance": "menn"}, "policy_distance"), ({"neighbors": "lin"}, "neighbors")],
    )
    def test_an_unknown_name_is_an_error_without_advice_on_gains(self, given, named):
        with warnings.catch_warnings(), pytest.raises(ValueError, match=named):
            warnings.simplefilter("error")
            smooth(sac(), **given)

    def test_a_neighborhood_of_other_neighbors_than_the_presets(self):
        with pytest.warns(UserWarning, match="neighbors='box' .* replaces the preset's 'line'"):
            smooth(sac(), neighborhood=Neighborhood(lambda_min=3.0, lambda_max=300.0))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            near = Neighborhood(lambda_min=3.0, lambda_max=300.0, neighbors="line")
            smooth(sac(), neighborhood=near)

    # Compiling each takes ten seconds.
    @pytest.mark.parametrize(
        "make", [td3, *(pytest.param(make, marks=pytest.mark.slow) for make in (sac, ddpg))]
    )
    def test_it_compiles_into_one_graph(self, make):
        torch._dynamo.reset()
        loss = smooth(seeded(make), **GIVEN).relative()
        batch = loss.neighbor_transform()(seeded(transitions, 12, seed=1))
        expected = seeded(loss, batch.copy(), seed=2)
        compiled = torch.compile(loss, fullgraph=True, backend=lambda graph, _: graph)
        found = seeded(compiled, batch.copy(), seed=2)
        torch.testing.assert_close(found["penalty_l2c2_actor"], expected["penalty_l2c2_actor"])

    def test_the_strength_suits_rewards_of_any_size(self):
        """Values and rewards ten times as large: ten times the penalty's gradient, too."""
        found = []
        for scale in (1.0, 10.0):
            loss = smooth(seeded(ddpg), **GIVEN, fold=False).relative()
            with torch.no_grad():
                for parameter in loss.value_network_params.flatten_keys().values():
                    last = parameter.shape[0] == 1  # the output's weight and bias
                    parameter.mul_(scale if last else 1.0)
            batch = loss.neighbor_transform(torch.Generator().manual_seed(0))(
                seeded(transitions, 12, seed=1)
            )
            terms = loss(batch)
            ratio = terms["loss_l2c2_actor"] / terms["loss_actor"]
            found.append(ratio.detach())
        torch.testing.assert_close(*found)

    @pytest.mark.parametrize("make", [ppo, lambda: PPORPELoss(gaussian_actor(), heads_critic())])
    def test_it_needs_an_action_value(self, make):
        with pytest.raises(TypeError, match=r"in SAC, TD3 and DDPG, and L2C2Loss\[.* leave rel"):
            smooth(make()).relative()


class TestProgress:
    """The gain of a ramp follows set_progress."""

    def test_the_ramp_by_hand(self):
        """Full before the first call; then linear over its length."""
        loss = smooth(sac(), strength=2.0, ramp=0.5)
        assert loss.regularizer_gain.item() == 2.0
        for progress, gain in ((0.0, 0.0), (0.125, 0.5), (0.25, 1.0), (0.5, 2.0), (1.3, 2.0)):
            loss.set_progress(progress)
            assert loss.regularizer_gain.item() == gain

    @pytest.mark.parametrize("strength", [0.0, 3.0])
    def test_it_ends_at_the_strength(self, strength):
        loss = smooth(td3(), strength=strength).ramp(0.5)
        assert loss.strength == loss.regularizer_gain.item() == strength
        loss.set_progress(0.25)
        assert loss.regularizer_gain.item() == strength / 2
        assert loss.ramp(1.0).strength == strength

    def test_the_penalty_follows(self):
        batch = seeded(on_policy, 12)
        batch["advantage"], batch["value_target"] = torch.randn(12, 1), torch.randn(12, 1)
        loss = smooth(seeded(ppo))
        full = seeded(loss, batch.copy())
        loss.set_progress(0.25)
        quarter = seeded(loss, batch.copy())
        torch.testing.assert_close(quarter["penalty_l2c2_actor"], full["penalty_l2c2_actor"] / 4)
        added = full["loss_objective"] - quarter["loss_objective"]
        torch.testing.assert_close(added, 0.75 * full["penalty_l2c2_actor"], rtol=1e-3, atol=1e-6)

    def test_a_checkpoint_has_it(self):
        """Saved and restored, also in another module; of a fresh loss, the gain is full."""
        loss = smooth(ppo())
        fresh = copy.deepcopy(loss.state_dict())
        loss.set_progress(0.25)
        other = smooth(ppo())
        other.load_state_dict(loss.state_dict())
        assert other.regularizer_gain.item() == 0.25
        other.load_state_dict(fresh)
        assert other.regularizer_gain.item() == 1.0
        holder, loaded = nn.ModuleDict({"loss": loss}), nn.ModuleDict({"loss": smooth(ppo())})
        loaded.load_state_dict(holder.state_dict())
        assert loaded["loss"].regularizer_gain.item() == 0.25
        twin = pickle.loads(pickle.dumps(loss))
        twin.set_progress(0.5)
        assert (twin.regularizer_gain.item(), loss.regularizer_gain.item()) == (0.5, 0.25)

    def test_a_checkpoint_with_a_ramp_loads_without_one(self):
        """Also as a part of another module; the gain is the new loss's own."""
        loss, constant = smooth(ppo()), smooth(ppo(), ramp=None, strength=2.0)
        loss.set_progress(0.25)
        saved = nn.ModuleDict({"loss": loss}).state_dict()
        nn.ModuleDict({"loss": constant}).load_state_dict(saved)
        assert constant.regularizer_gain.item() == 2.0 and "loss.regularizer_progress" in saved

    def test_a_checkpoint_of_the_baseline_loads(self):
        """The progress stays."""
        base, loss = seeded(ppo, seed=3), smooth(seeded(ppo))
        loss.set_progress(0.25)
        loss.load_state_dict(base.state_dict())
        assert loss.regularizer_gain.item() == 0.25
        for name, value in base.named_parameters():
            assert torch.equal(value, dict(loss.named_parameters())[name])

    def test_between_calls_of_a_compiled_loss(self):
        """Without compiling again."""
        torch._dynamo.reset()
        loss = smooth(seeded(cloning), "cats", lambda_temporal=1.0, ramp=1.0)
        batch = seeded(transitions, 12)
        loss(batch.copy())  # Some losses make attributes in their first call.
        graphs = []

        def backend(graph, inputs):
            graphs.append(graph)
            return graph

        compiled = torch.compile(loss, backend=backend, fullgraph=True)
        for progress in (0.25, 0.5, 1.0):
            compiled.set_progress(progress)
            found, expected = (seeded(each, batch.copy()) for each in (compiled, loss))
            for key in ("loss_bc", "penalty_cats"):
                torch.testing.assert_close(found[key], expected[key])
            assert loss.regularizer_gain.item() == progress
        assert len(graphs) == 1

    def test_the_strength_can_be_changed_later(self):
        """Of a ramp it is the final gain, and the progress stays."""
        loss = smooth(sac(), strength=3.0)
        loss.strength = 1.5
        assert loss.regularizer_gain.item() == 1.5 == loss.strength
        loss = smooth(ppo(), strength=2.0)
        loss.set_progress(0.25)
        loss.strength *= 0.5
        assert loss.regularizer_gain.item() == 0.25
        loss.set_progress(0.5)
        assert loss.regularizer_gain.item() == 0.5
        assert loss.strength == 1.0
        for wrong in (-1.0, math.nan, "2"):
            with pytest.raises((ValueError, TypeError), match="strength must be"):
                loss.strength = wrong
        assert loss.regularizer_gain.item() == 0.5

    def test_progress_that_stays_at_zero_is_told_once(self, monkeypatch):
        """As from frames // total_frames."""
        monkeypatch.setattr(_watch, "STANDSTILL", 100)
        loss, batch = smooth(cloning(), **GIVEN, ramp=1.0, beta=0.0), seeded(transitions, 4)
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            for _ in range(210):
                loss.set_progress(0)
                loss(batch)
        (message,) = (str(each.message) for each in told if "progress" in str(each.message))
        assert "still 0 after 100 updates" in message
        assert "loss.set_progress(frames / total_frames)" in message

    def test_many_updates_on_the_first_rollout_are_no_standstill(self, monkeypatch):
        """Its progress is 0, and may have been set before training, too."""
        monkeypatch.setattr(_watch, "STANDSTILL", 100)
        loss, batch = smooth(cloning(), **GIVEN, ramp=1.0, beta=0.0), seeded(transitions, 4)
        loss.set_progress(0)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            for progress in (0, 0.01):
                loss.set_progress(progress)
                for _ in range(110):
                    loss(batch)

    def test_progress_that_is_set_once_is_told_at_last(self, monkeypatch):
        monkeypatch.setattr(_watch, "STANDSTILL", 100)
        monkeypatch.setattr(_watch, "LONGEST_ROLLOUT", 200)
        loss, batch = smooth(cloning(), **GIVEN, ramp=1.0, beta=0.0), seeded(transitions, 4)
        loss.set_progress(0)
        with pytest.warns(UserWarning, match="still 0 after 200 updates"):
            for _ in range(200):
                loss(batch)

    def test_at_strength_0_a_standstill_is_meant(self, monkeypatch):
        monkeypatch.setattr(_watch, "STANDSTILL", 100)
        loss, batch = smooth(cloning(), **GIVEN, ramp=1.0, beta=0.0), seeded(transitions, 4)
        loss.strength = 0.0
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            for _ in range(210):
                loss.set_progress(0)
                loss(batch)

    def test_presets_with_a_constant_gain_ignore_it(self):
        loss = smooth(td3())
        loss.set_progress(0.1)
        assert loss.regularizer_gain.item() == 1.0
        assert "regularizer_progress" not in loss.state_dict()

    @pytest.mark.parametrize("make", [sac, ppo])
    def test_a_number_of_frames_is_no_progress(self, make):
        loss = smooth(make())
        for wrong in (-0.1, 2.5, 10_000, math.nan):
            with pytest.raises(ValueError, match=r"progress must be .*frames / total_frames"):
                loss.set_progress(wrong)
        with pytest.raises(TypeError):
            loss.set_progress("half")
        loss.set_progress(torch.tensor(0.5))

    @pytest.mark.parametrize("make", [sac, td3])
    def test_it_never_stops_a_training(self, make):
        """Frames in another unit than their total: told once, at the second value above 1."""
        loss, resumed = smooth(make()), smooth(make())
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            for progress in (0.0, 0.8, 1.6, 1.6):
                loss.set_progress(progress)
            assert not told
            resumed.load_state_dict(loss.state_dict())
            for progress in (2.4, 3.2):
                loss.set_progress(progress)
        assert loss.regularizer_gain.item() == 1.0
        messages = [str(each.message) for each in told]
        assert len(messages) == (make is sac)
        if make is sac:
            assert "is 2.4, and still rises: the gain of L2C2Loss[SACLoss]" in messages[0]
            resumed.set_progress(2.4)
            assert resumed.regularizer_gain.item() == 1.0

    def train(self, loss, updates=60):
        batch = seeded(transitions, 4)
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            for _ in range(updates):
                loss(batch.copy())
        return [str(each.message) for each in told if "set_progress" in str(each.message)]

    def test_a_ramp_that_is_never_moved_is_told_once(self):
        loss = smooth(cloning(), **GIVEN, ramp=1.0)
        (message,) = self.train(loss)
        assert "not called in 50 updates: it stays at 1." in message
        assert "loss.set_progress(frames / total_frames)" in message
        assert not self.train(loss)

    def test_a_ramp_that_is_moved_is_not(self):
        loss = smooth(cloning(), **GIVEN, ramp=1.0)
        loss.set_progress(0.0)
        assert not self.train(loss)
        assert not self.train(smooth(cloning(), **GIVEN, ramp=None))
        assert not self.train(smooth(cloning(), **GIVEN, ramp=1.0), updates=40)
