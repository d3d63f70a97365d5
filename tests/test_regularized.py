"""How a loss is wrapped: the class that is made for it, what is refused, odd networks."""

from __future__ import annotations

import copy
import gc
import math
import pickle
import threading
import warnings

import pytest
import torch
from losses import (
    ACTION,
    ACTIONS,
    OBSERVATION,
    action_values,
    batch_norm_qvalue,
    composite_actor,
    composite_batch,
    critic,
    deterministic_actor,
    gaussian_actor,
    make_composite_ppo,
    mlp,
    on_policy,
    one_hot_batch,
    qvalue,
    transitions,
)
from tensordict import TensorDict
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictSequential,
    set_composite_lp_aggregate,
)
from torch import nn
from torchrl.data import Bounded
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.modules import (
    Actor,
    BatchRenorm1d,
    MaskedCategorical,
    NormalParamExtractor,
    ProbabilisticActor,
    QValueModule,
    TanhNormal,
    ValueOperator,
)
from torchrl.objectives import (
    A2CLoss,
    ClipPPOLoss,
    CrossQLoss,
    DDPGLoss,
    DQNLoss,
    DreamerActorLoss,
    DreamerValueLoss,
    DTLoss,
    IQLLoss,
    LossModule,
    OnlineDTLoss,
    PPOLoss,
    ReinforceLoss,
    SACLoss,
    TD3Loss,
)
from torchrl.objectives.llm import DAPO, DistillationLoss, GRPOLoss, SFTLoss

from torchrl_l2c2 import (
    CAPSLoss,
    CATSLoss,
    L2C2Loss,
    LCPLoss,
    Neighborhood,
    NeighborTransform,
    PPORPELoss,
    RegularizedLoss,
    SR2LLoss,
    make_actor,
    make_critic,
)
from torchrl_l2c2.objectives import _evaluation
from torchrl_l2c2.objectives._evaluation import SharedEvaluation

NEAR = Neighborhood(sigma=1.0, lambda_min=0.1, lambda_max=1.0)

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:torchrl")


def ddpg(**kwargs) -> DDPGLoss:
    return DDPGLoss(deterministic_actor(), qvalue(), **kwargs)


def sharing_a_trunk() -> tuple[TensorDictModule, ProbabilisticActor, ValueOperator]:
    """A trunk, and a policy and a critic that read its hidden output."""
    trunk = TensorDictModule(mlp(OBSERVATION, 8), ["observation"], ["hidden"])
    head = nn.Sequential(mlp(8, 2 * ACTION), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictSequential(trunk, TensorDictModule(head, ["hidden"], ["loc", "scale"])),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    return trunk, actor, ValueOperator(mlp(8, 1), in_keys=["hidden"])


def with_neighbors(batch: TensorDict, **kwargs) -> TensorDict:
    return NeighborTransform(NEAR, **kwargs)(batch)


class Stillness(RegularizedLoss):
    """The shortest regularizer: mean squared actions."""

    def __init__(self, base_loss: LossModule, coeff: float = 1.0) -> None:
        self.register_coefficient("stillness_coeff", coeff)
        self.declare_networks(["actor_network"])
        self.declare_terms(policy=["loss_stillness"])

    def policy_regularizer(self, tensordict):
        terms = super().policy_regularizer(tensordict)
        _, action = self.policies_at(tensordict, tensordict.select("observation")[None])
        cost = self.reduce_term(action[0].square().sum(-1), tensordict)
        return terms.set("loss_stillness", self.stillness_coeff * cost)


class Declaring(RegularizedLoss):
    """Declares terms, and has none."""

    def __init__(self, base_loss: LossModule, **kinds: list[str]) -> None:
        self.declare_terms(**kinds)


class Misspelled(Stillness):
    """Returns another key than it declares, or both."""

    def __init__(self, base_loss: LossModule, also: bool) -> None:
        super().__init__(base_loss)
        self.also = also

    def policy_regularizer(self, tensordict):
        terms = super().policy_regularizer(tensordict)
        terms["loss_stilness"] = terms["loss_stillness"]
        return terms if self.also else terms.exclude("loss_stillness")


class Undeclared(Stillness):
    """Declares no networks."""

    def __init__(self, base_loss: LossModule) -> None:
        self.register_coefficient("stillness_coeff", 1.0)
        self.declare_terms(policy=["loss_stillness"])


class Silent(Stillness):
    """Forgets to return its terms."""

    def policy_regularizer(self, tensordict):
        super().policy_regularizer(tensordict)


class Flat(Stillness):
    """Gives states without their first dimension."""

    def policy_regularizer(self, tensordict):
        self.policies_at(tensordict, tensordict.select("observation"))


class Doubled(Stillness):
    """A regularizer with a forward of its own."""

    def forward(self, tensordict):
        terms = super().forward(tensordict)
        return terms.set("loss_stillness", 2.0 * terms["loss_stillness"])


class TestTheClass:
    def test_it_is_made_once_for_each_pair(self):
        """Two losses of one class have one regularized class, and it can be named."""
        first, second = L2C2Loss(ddpg()), L2C2Loss(ddpg())
        assert type(first) is type(second) is L2C2Loss[DDPGLoss]
        assert type(L2C2Loss[DDPGLoss](ddpg())) is L2C2Loss[DDPGLoss]
        assert issubclass(L2C2Loss[DDPGLoss], L2C2Loss)
        assert issubclass(L2C2Loss[DDPGLoss], DDPGLoss)

    def test_a_new_regularizer_is_one_short_class(self):
        """A subclass with __init__ and one method works as those of the package do."""
        torch.manual_seed(0)
        base, batch = ddpg(), transitions(4)
        loss = Stillness(base, coeff=0.5)
        assert loss.out_keys == [*base.out_keys, "loss_stillness"]
        action = base.actor_network(batch.copy())["action"]
        expected = 0.5 * action.square().sum(-1).mean()
        torch.testing.assert_close(loss(batch.copy())["loss_stillness"], expected)
        # With a forward of its own, which a regularizer around it does not hide.
        doubled = L2C2Loss(Doubled(base, coeff=0.5))(batch.copy())
        torch.testing.assert_close(doubled["loss_stillness"], 2.0 * expected)
        assert "loss_l2c2_actor" in doubled
        loss.stillness_coeff = 0.0
        assert copy.deepcopy(L2C2Loss(loss))(batch)["loss_stillness"] == 0

    @pytest.mark.parametrize("arguments", [(), ("base_loss",)])
    def test_super_init_may_be_called(self, arguments):
        """Most people write it; the loss's own constructor would fail or start anew."""

        class Polite(Stillness):
            def __init__(self, base_loss, coeff=1.0):
                super(Stillness, self).__init__(*[base_loss for _ in arguments])
                super().__init__(base_loss, coeff)

        batch, base = transitions(4), ddpg()
        assert (
            Polite(base)(batch.copy())["loss_stillness"] == Stillness(base)(batch)["loss_stillness"]
        )
        with pytest.raises(TypeError, match="unexpected keyword argument 'typo'"):
            RegularizedLoss(base, typo=1.0)

    def test_chains_pickle(self):
        """Also a class made of a class that was made is found again."""
        chain = CAPSLoss(Stillness(L2C2Loss(ddpg())))
        twin = pickle.loads(pickle.dumps(chain))
        assert type(twin) is type(chain)
        assert type(twin).__name__ == "CAPSLoss[Stillness[L2C2Loss[DDPGLoss]]]"

    def test_it_can_be_subclassed(self):
        """A named subclass of a made class keeps its type when copied."""

        class SmoothDDPG(L2C2Loss[DDPGLoss]):
            pass

        loss = SmoothDDPG(ddpg())
        assert type(loss) is type(copy.deepcopy(loss)) is SmoothDDPG

    def test_what_it_is_made_for_is_checked(self):
        """Classes and objects that cannot be combined are refused with their names."""
        with pytest.raises(TypeError, match="LossModule, got a Linear"):
            L2C2Loss(nn.Linear(1, 1))
        with pytest.raises(TypeError, match="the class DDPGLoss: make the loss first"):
            L2C2Loss(DDPGLoss)
        with pytest.raises(TypeError, match="takes a class of losses"):
            L2C2Loss[nn.Linear]
        with pytest.raises(TypeError, match=r"L2C2Loss\[SACLoss\] cannot wrap a DDPGLoss"):
            L2C2Loss[SACLoss](ddpg())
        with pytest.raises(TypeError, match="made for one class of losses already"):
            L2C2Loss[SACLoss][DDPGLoss]

    def test_the_same_regularizer_is_not_applied_twice(self):
        """Neither directly nor with another one in between."""
        with pytest.raises(TypeError, match="has the terms of L2C2Loss already: wrap"):
            L2C2Loss(L2C2Loss(ddpg()))
        with pytest.raises(TypeError, match="has the terms of L2C2Loss already: wrap"):
            L2C2Loss(CAPSLoss(L2C2Loss(ddpg())))

    @pytest.mark.parametrize(
        ("declare", "error", "message"),
        [
            (lambda s: s.declare_networks("actor_network"), TypeError, r"\['actor_network'\] is"),
            (lambda s: s.declare_networks(["policy"]), ValueError, "no network 'policy'"),
            (lambda s: s.declare_terms(policy="loss_d"), TypeError, r"\['loss_d'\] is one"),
            (lambda s: s.declare_terms(policy=["loss_actor"]), ValueError, "has .* already"),
        ],
    )
    def test_wrong_declarations_are_told(self, declare, error, message):
        """Where they are made."""

        class Regularizer(RegularizedLoss):
            def __init__(self, base_loss):
                declare(self)

        with pytest.raises(error, match=message):
            Regularizer(ddpg())

    def test_two_threads_have_a_forward_pass_each(self):
        """What one has evaluated is not taken for the other's."""
        # A functional loss writes into its networks, which two threads cannot do at once.
        loss = L2C2Loss(PPOLoss(gaussian_actor(), critic(), functional=False), NEAR)
        batches = [NeighborTransform(NEAR)(on_policy(32)) for _ in range(2)]
        expected, wrong = [loss(batch)["loss_l2c2_actor"].item() for batch in batches], []

        def ask(i):
            for _ in range(60):
                if loss(batches[i])["loss_l2c2_actor"].item() != expected[i]:
                    wrong.append(i)

        threads = [threading.Thread(target=ask, args=(i,)) for i in range(2)]
        # TorchRL has one exploration type for all threads: they may leave each other's behind.
        with set_exploration_type(ExplorationType.RANDOM):
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
        assert expected[0] != expected[1] and not wrong

    def test_a_loss_may_call_itself(self):
        """As for parts of a batch: the mean over both halves is that over all."""

        class Halved(DDPGLoss):
            def forward(self, tensordict):
                if len(tensordict) <= 4:
                    return super().forward(tensordict)
                return torch.stack([self(part) for part in tensordict.split(4)]).mean(0)

        base, batch = ddpg(), NeighborTransform(NEAR)(transitions(8))
        loss = L2C2Loss(Halved(base.actor_network, base.value_network))
        loss.load_state_dict(L2C2Loss(base).state_dict())
        expected, found = L2C2Loss(base)(batch), loss(batch)
        for key in ("loss_actor", "loss_l2c2_actor"):
            torch.testing.assert_close(found[key], expected[key])

    def test_the_gain_may_be_a_tensor_when_it_is_made_too(self):
        """As where it is assigned to."""
        assert L2C2Loss(ddpg(), coeff=torch.tensor(0.25)).l2c2_coeff == 0.25

    def test_noise_that_the_policy_reads_is_no_state(self):
        """TorchRL's own entries, such as the matrix of gSDE: it does not move with the state."""
        policy = TensorDictModule(
            nn.Bilinear(OBSERVATION, 2, ACTION), ["observation", "_eps_gSDE"], ["action"]
        )
        batch = transitions(4)
        batch["_eps_gSDE"] = batch["next", "_eps_gSDE"] = torch.ones(4, 2)
        near = Neighborhood(lambda_min=0.1, lambda_max=1.0)
        torch.manual_seed(0)
        found = L2C2Loss(DDPGLoss(policy, qvalue()), near, beta=0.0).policy_regularizer(batch)
        torch.manual_seed(0)
        expected = L2C2Loss(
            DDPGLoss(policy, qvalue()), near, beta=0.0, moved_keys="observation"
        ).policy_regularizer(batch)
        assert found["l2c2_distance"] == expected["l2c2_distance"]

    def test_terms_are_declared_with_what_they_train(self):
        """They follow the loss's own in out_keys; those of all regularizers are policy_terms."""
        base = ddpg()
        loss = Declaring(base, diagnostics=["size"], value=["loss_b"], policy=["loss_c", "loss_a"])
        assert loss.out_keys == [*base.out_keys, "loss_c", "loss_a", "loss_b", "size"]
        assert loss.policy_terms == {"loss_c", "loss_a"}
        chain = Stillness(L2C2Loss(loss))
        expected = {"loss_c", "loss_a", "loss_l2c2_actor", "loss_stillness"}
        assert chain.policy_terms == pickle.loads(pickle.dumps(chain)).policy_terms == expected
        assert loss.policy_terms == {"loss_c", "loss_a"}

    def test_names_tell_terms_from_diagnostics(self):
        """A term that is not summed, and a diagnostic that is, are refused where declared."""
        for kind in ("policy", "value"):
            with pytest.raises(ValueError, match="a term must start with 'loss_', got 'size'"):
                Declaring(ddpg(), **{kind: ["size"]})
        with pytest.raises(ValueError, match="a diagnostic must not start with 'loss_'"):
            Declaring(ddpg(), diagnostics=["loss_size"])

    @pytest.mark.parametrize("fold", [False, True])
    @pytest.mark.parametrize("also", [False, True])
    def test_terms_that_were_not_declared_are_told(self, fold, also):
        """A folded term of another name would be reported, and not trained."""
        loss = Misspelled(L2C2Loss(ddpg(), NEAR), also)
        loss = loss.fold() if fold else loss
        message = r"declared terms \['loss_l2c2_actor', .*, 'loss_stillness'\] of .*stilness'\]\."
        with pytest.raises(ValueError, match=message):
            loss(with_neighbors(transitions(4)))

    @pytest.mark.parametrize(
        ("regularizer", "error", "message"),
        [
            (Undeclared, TypeError, r"call self.declare_networks\(\['actor_network'\]\) in"),
            (Silent, TypeError, "policy_regularizer of Silent.* must return .*, got None"),
            (Flat, ValueError, r"the shape \[K, \*B\] with the batch's \[4\], got \[4\]: states"),
        ],
    )
    @pytest.mark.parametrize("method", ["forward", "loss_actor"])
    def test_beginners_mistakes_are_told(self, regularizer, error, message, method):
        loss = regularizer(ddpg()).fold()
        with pytest.raises(error, match=message):
            getattr(loss, method)(transitions(4))

    def test_methods_are_not_hidden_by_chance(self):
        """A loss whose own method has the name of one of ours would break: it is refused."""

        class Clashing(DDPGLoss):
            def policies_at(self):
                return None

        with pytest.raises(TypeError, match=r"both define \['policies_at'\]"):
            L2C2Loss(Clashing(deterministic_actor(), qvalue()))

    @pytest.mark.parametrize("name", ["forward", "policy_at", "policy_terms", "_evaluation"])
    def test_nor_are_ours_by_an_attribute_of_the_loss(self, name):
        """Whatever it is, it would be found first, or be lost."""
        loss = ddpg()
        setattr(loss, name, nn.Linear(1, 1))
        with pytest.raises(TypeError, match=rf"has \['{name}'\], which this DDPGLoss has as attr"):
            L2C2Loss(loss)

    def test_around_a_compiled_loss_the_terms_are_there(self):
        """The call that was compiled is the plain loss's."""
        base = ddpg()
        base.compile(backend="eager")
        assert "loss_l2c2_actor" in L2C2Loss(base)(transitions(4)).keys()

    def test_a_hook_is_overridden_only_where_it_was_declared(self):
        """A loss that calls a method as the hook of SharedEvaluation is called, by chance."""

        class Unaware(DDPGLoss):
            def evaluate_at_batch(self):
                return None

        with pytest.raises(TypeError, match=r"both define \['evaluate_at_batch'\]"):
            L2C2Loss(Unaware(deterministic_actor(), qvalue()))

        class Aware(SharedEvaluation, Unaware):
            pass

        assert L2C2Loss(Aware(deterministic_actor(), qvalue()))


class TestAttributes:
    @pytest.mark.parametrize("wrap", [L2C2Loss, CAPSLoss, CATSLoss])
    def test_what_has_no_last_dimension_is_refused(self, wrap):
        """Its differences would be summed over the batch, and count as often as it is large."""
        actor = TensorDictModule(lambda s: s.sum(-1).tanh(), ["observation"], ["action"])
        value = TensorDictModule(
            lambda s, a: s.sum(-1) + a, ["observation", "action"], ["state_action_value"]
        )
        batch = with_neighbors(on_policy(4))
        batch["action"] = batch["action"][:, 0]
        message = r"each of the \((1, )?4,?\) states by itself, got differences of shape"
        with pytest.raises(ValueError, match=message):
            wrap(DDPGLoss(actor, value)).policy_regularizer(batch)

    def test_the_losss_own_settings_can_be_assigned(self):
        """Writes reach the one object: scheduled buffers, plain attributes, train and eval."""
        loss = L2C2Loss(ClipPPOLoss(gaussian_actor(), critic(), clip_epsilon=0.2))
        buffer = loss.clip_epsilon
        loss.clip_epsilon = 0.1
        assert buffer == pytest.approx(0.1)
        loss.reduction = "sum"
        batch = with_neighbors(on_policy(4))
        summed = loss(batch.copy())["loss_l2c2_actor"]
        loss.reduction = "mean"
        torch.testing.assert_close(summed, 4 * loss(batch.copy())["loss_l2c2_actor"])
        loss.eval()
        assert not loss.training
        assert not any(module.training for module in loss.children())

    @pytest.mark.parametrize("value", [-0.1, float("nan"), float("inf")])
    def test_gains_are_checked_whenever_they_are_set(self, value):
        """At construction and when assigned to later."""
        for name in ("coeff", "beta"):
            with pytest.raises(ValueError, match=f"l2c2_{name} must be finite and at least 0"):
                L2C2Loss(ddpg(), **{name: value})
        loss = L2C2Loss(ddpg())
        with pytest.raises(ValueError, match="l2c2_beta must be finite and at least 0"):
            loss.l2c2_beta = value

    @pytest.mark.parametrize("value", ["0.1", None, True])
    def test_gains_are_numbers(self, value):
        """Anything else is a TypeError, at construction and later."""
        with pytest.raises(TypeError, match="l2c2_coeff must be a real number"):
            L2C2Loss(ddpg(), coeff=value)
        loss = L2C2Loss(ddpg())
        with pytest.raises(TypeError, match="l2c2_coeff must be a real number"):
            loss.l2c2_coeff = value

    def test_a_gain_may_be_a_tensor_of_one_number(self):
        """Which is checked as a number is; the buffer stays, and inner losses see it."""
        inner = L2C2Loss(ddpg(), beta=0.0)
        outer = Stillness(inner)
        outer.l2c2_coeff = torch.tensor([0.5])
        assert inner.l2c2_coeff.item() == outer.l2c2_coeff.item() == 0.5
        assert inner.l2c2_coeff.shape == ()
        for value in (torch.tensor(-1.0), torch.tensor(math.nan)):
            with pytest.raises(ValueError, match="l2c2_coeff must be finite and at least 0"):
                outer.l2c2_coeff = value
        with pytest.raises(TypeError, match=r"a single number, .* got \(3,\)"):
            outer.l2c2_coeff = torch.ones(3)
        with pytest.raises(TypeError, match="detach it"):
            outer.l2c2_coeff = nn.Parameter(torch.tensor(1.0))
        with pytest.raises(ValueError, match="has nothing to scale"):
            inner.l2c2_beta = torch.tensor(0.1)

    def test_a_gain_that_was_refused_is_not_kept(self):
        """Also of ``-=``, which writes before it assigns, and around another regularizer."""
        inner = L2C2Loss(ddpg())
        outer = Stillness(inner)
        outer.l2c2_coeff = 0.5
        outer.l2c2_coeff += 0.25
        twin = copy.deepcopy(outer)
        for loss in (inner, outer, twin):
            with pytest.raises(ValueError, match="l2c2_coeff must be finite and at least 0"):
                loss.l2c2_coeff -= 5.0
            with pytest.raises(TypeError, match="detach it"):
                loss.l2c2_coeff *= nn.Parameter(torch.tensor(2.0))
            assert loss.l2c2_coeff.item() == 0.75
            assert not loss.l2c2_coeff.requires_grad

    @pytest.mark.parametrize("name", ["entropy_coeff", "cats_lambda_temporal", "gamma"])
    def test_a_gain_takes_no_others_name(self, name):
        """Neither of the loss nor of a regularizer within it."""

        class Further(RegularizedLoss):
            def __init__(self, base_loss, coeff):
                self.register_coefficient(name, coeff)

        base = CATSLoss(SACLoss(gaussian_actor(), qvalue())) if name != "entropy_coeff" else None
        if name == "gamma":
            base.register_buffer("gamma", torch.tensor(0.9))
        with pytest.raises(ValueError, match=f"has '{name}' already"):
            Further(base or PPOLoss(gaussian_actor(), critic()), 1.0)

    def test_a_gain_by_its_constructors_name_is_told(self):
        """Which would be an attribute like any other, and scale nothing."""
        loss = CATSLoss(ddpg(), lambda_temporal=0.1)
        with pytest.warns(UserWarning, match="scales nothing .* is 'cats_lambda_temporal'"):
            loss.lambda_temporal = 5.0
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            loss.cats_lambda_temporal = 5.0
            loss.anything = 5.0

    def test_a_setting_of_another_method_is_told(self):
        loss, other = CATSLoss(ddpg()), CATSLoss(ddpg())
        with pytest.warns(
            UserWarning, match="'l2c2_coeff' has no effect .* it is a setting of L2C2Loss"
        ):
            loss.l2c2_coeff = 0.0
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            other.cats_lambda_temporal = 0.0

    def test_load_hooks_outlive_the_wrapped_loss(self):
        """Hooks of the plain loss that name their module work when only the new one is left."""
        loss = L2C2Loss(IQLLoss(gaussian_actor(), qvalue(), critic(), num_qvalue_nets=1))
        gc.collect()
        loss.load_state_dict(loss.state_dict())


class TestWhatIsRefused:
    def test_losses_without_transitions(self):
        """Sequence models have no next state: the message says so."""
        actor = TensorDictModule(
            mlp(OBSERVATION + ACTION + 1, ACTION),
            ["observation", "action", "return_to_go"],
            ["action"],
        )
        for loss in (
            DTLoss(actor),
            OnlineDTLoss(gaussian_actor(), alpha_init=1.0, target_entropy=-1.0),
        ):
            for regularizer in (L2C2Loss, CAPSLoss, SR2LLoss):
                with pytest.raises(TypeError, match="is not trained on transitions"):
                    regularizer(loss)

    def test_losses_of_ones_own_without_successors(self):
        """They have no neighborhood of a transition; what needs none takes them."""

        class Imitation(LossModule):
            def __init__(self, actor):
                super().__init__()
                self.in_keys, self.out_keys = ["observation", "action"], ["loss_imitation"]
                self.convert_to_functional(actor, "actor_network")

            def forward(self, tensordict):
                with self.actor_network_params.to_module(self.actor_network):
                    policy = self.actor_network.get_dist(tensordict)
                return TensorDict(loss_imitation=-policy.log_prob(tensordict["action"]).mean())

        loss, batch = Imitation(gaussian_actor()), transitions(4).exclude("next")
        assert LCPLoss(loss)(batch)["loss_lcp"] > 0
        assert SR2LLoss(loss)(batch)["loss_sr2l"] > 0
        for within in (loss, LCPLoss(loss)):
            with pytest.raises(TypeError, match=r"^Imitation is not trained on transitions"):
                L2C2Loss(within, beta=0.0)

    @pytest.mark.parametrize("inside", [nn.GRUCell(OBSERVATION, 1), nn.LSTM(OBSERVATION, 1)])
    def test_recurrent_policies_of_torchs_own_layers(self, inside):
        """Which TorchRL's modules are not around."""
        actor = Actor(nn.Sequential(nn.Linear(OBSERVATION, OBSERVATION), inside))
        with pytest.raises(TypeError, match="actor_network is recurrent"):
            L2C2Loss(DDPGLoss(actor, qvalue()))

    def test_policies_that_hand_a_state_on(self):
        """What they write for the next step, they read in it."""
        step = TensorDictModule(
            nn.Bilinear(OBSERVATION, 2, 2), ["observation", "memory"], [("next", "memory")]
        )
        act = TensorDictModule(nn.Linear(2, ACTION), [("next", "memory")], ["action"])
        with pytest.raises(TypeError, match="actor_network is recurrent"):
            L2C2Loss(DDPGLoss(TensorDictSequential(step, act), qvalue()))

    def test_observations_that_are_integers(self):
        """There is nothing between two labels: the key and its type are named."""
        loss = L2C2Loss(ddpg())
        batch = transitions(4)
        batch["observation"] = batch["observation"].long()
        message = r"actor_network needs a floating-point.*'observation'.*int64"
        with pytest.raises(TypeError, match=message):
            loss.policy_regularizer(batch)

    def test_observations_that_are_a_tensordict(self):
        """Its entries are the states, and a network has to name them."""

        class Net(nn.Linear):
            def forward(self, state):
                return super().forward(state["position"])

        actor = TensorDictModule(Net(OBSERVATION, ACTION), ["state"], ["action"])
        batch = transitions(4)
        for root in (batch, batch["next"]):
            root["state"] = TensorDict({"position": torch.randn(4, OBSERVATION)}, [4])
        message = r"actor_network, got the TensorDict 'state'.*\('state', 'position'\)\]\."
        with pytest.raises(TypeError, match=message):
            CATSLoss(DDPGLoss(actor, qvalue())).policy_regularizer(batch)

    def test_a_name_of_torchrls_own_is_told_to_be_the_reason(self):
        """An observation that begins with an underscore has the right type."""
        hidden = Actor(mlp(OBSERVATION, ACTION), in_keys=["_observation"])
        base, batch = DDPGLoss(hidden, qvalue()), transitions(4)
        with pytest.raises(TypeError, match=r"reads no observation .*'_'"):
            L2C2Loss(base).policy_regularizer(batch)
        with pytest.raises(ValueError, match=r"names \['_observation'\].* begins with '_'"):
            L2C2Loss(base, moved_keys="_observation")

    @pytest.mark.parametrize("pixels", ["actor_network", "qvalue_network"])
    def test_each_network_needs_a_state_of_its_own(self, pixels):
        """The one that reads integers alone is named, where the other's states would do."""
        keys = {"actor_network": "observation", "qvalue_network": "observation", pixels: "pixels"}
        actor = Actor(mlp(OBSERVATION, ACTION), in_keys=[keys["actor_network"]])
        value = ValueOperator(
            mlp(OBSERVATION + ACTION, 1), in_keys=[keys["qvalue_network"], "action"]
        )
        spec = Bounded(-1, 1, (ACTION,))
        loss = L2C2Loss(TD3Loss(actor, value, action_spec=spec))
        batch = transitions(4)
        batch["pixels"] = torch.zeros(4, OBSERVATION, dtype=torch.uint8)
        batch["next", "pixels"] = batch["pixels"]
        message = rf"^{pixels} needs a floating-point observation.*'pixels'.*uint8"
        with pytest.raises(TypeError, match=message):
            loss.value_regularizer(batch)
        batch["pixels"] = batch["pixels"].float()
        del batch["next", "pixels"]
        with pytest.raises(KeyError, match=rf"{pixels} needs the next observation.*'pixels'"):
            loss.value_regularizer(batch)

    @pytest.mark.parametrize("regularizer", [L2C2Loss, CAPSLoss])
    def test_losses_of_language_models(self, regularizer):
        """Known when they are made: between two texts there is nothing."""
        actor = TensorDictModule(nn.Identity(), ["tokens"], ["logits"])
        tokenizer = object()
        losses = [
            GRPOLoss(actor),
            DAPO(actor),
            SFTLoss(actor, tokenizer=tokenizer, kl_to_ref_coeff=0.1),
            DistillationLoss(actor, tokenizer=tokenizer),
        ]
        for loss in losses:
            name = type(loss).__name__
            with pytest.raises(TypeError, match=f"^{name} trains a language model"):
                regularizer(loss)

    @pytest.mark.parametrize("regularizer", [L2C2Loss, CAPSLoss])
    def test_losses_in_imagination(self, regularizer):
        """Dreamer has a policy, and a value function, but evaluates them on no single state."""
        actor, value = gaussian_actor(), critic()
        losses = DreamerActorLoss(actor, value, None), DreamerValueLoss(value)
        for loss in losses:
            message = f"{type(loss).__name__} evaluates its networks along trajectories that a"
            with pytest.raises(TypeError, match=message):
                regularizer(loss)

    def test_neighbors_of_other_entries(self):
        """A network none of whose inputs was moved is named with what was."""
        loss = L2C2Loss(ddpg())
        batch = transitions(4)
        batch["other"] = batch["next", "other"] = torch.randn(4, 2)
        with_neighbors(batch, in_keys=["other"])
        message = r"inputs of actor_network.*'other'.*in_keys.*another neighbor_key"
        with pytest.raises(KeyError, match=message):
            loss(batch)
        batch = L2C2Loss(ddpg(), neighbor_key="own").neighbor_transform()(batch)
        assert L2C2Loss(ddpg(), neighbor_key="own")(batch)["loss_l2c2_actor"] > 0

    @pytest.mark.parametrize("call", ["forward", "loss_actor", "policy_regularizer"])
    def test_a_batch_without_a_batch_size(self, call):
        """It would be one state; a single transition is one."""
        batch = transitions(4)
        batch.batch_size = []
        loss = L2C2Loss(ddpg(), NEAR).fold()
        message = r"size \[\], and \('next', 'reward'\) has the shape \[4, 1\]: .* batch_size=\[4\]"
        with pytest.raises(ValueError, match=message):
            getattr(loss, call)(batch)
        with torch.no_grad():
            loss(batch)
        assert loss(transitions(4)[0])["penalty_l2c2_actor"] > 0

    def test_neighbors_without_distances(self):
        """An entry that NeighborTransform did not write."""
        batch = transitions(4)
        batch["neighbor"] = TensorDict({"observation": torch.zeros(4, 1, 3)}, batch_size=[4])
        with pytest.raises(KeyError, match="no 'distance'"):
            L2C2Loss(ddpg())(batch)

    def test_policies_that_sample_from_their_own_samples(self):
        """Several distributions in a row have no distance; one composite distribution has."""
        heads = [
            ProbabilisticTensorDictModule(
                in_keys=["loc", "scale"],
                out_keys=[name],
                distribution_class=TanhNormal,
                return_log_prob=True,
            )
            for name in ("first", "action")
        ]
        both = ProbabilisticTensorDictSequential(gaussian_actor().module[0], *heads)
        loss = PPOLoss(both, critic())
        with pytest.raises(TypeError, match="join several heads in one CompositeDistribution"):
            L2C2Loss(loss)
        assert L2C2Loss(PPOLoss(composite_actor(), critic()))

    def test_a_loss_whose_keys_cannot_be_read_is_told_what_to_do(self):
        """A2C takes the actions of a composite policy as a list, which TorchRL hashes."""
        with set_composite_lp_aggregate(False):
            base = A2CLoss(composite_actor(), critic(), entropy_bonus=False)
            with pytest.raises(TypeError, match=r"in_keys of A2CLoss cannot be read .*set_keys"):
                L2C2Loss(base)
            base.set_keys(action="move", sample_log_prob="move_log_prob")
            assert L2C2Loss(base)


class TestNetworks:
    @pytest.mark.parametrize("loss_class", [PPOLoss, A2CLoss, ReinforceLoss])
    def test_losses_on_the_users_own_modules_give_the_same_terms(self, loss_class):
        """functional=False: the modules themselves are evaluated, and trained."""
        torch.manual_seed(0)
        actor, value = gaussian_actor(), critic()
        batch = with_neighbors(on_policy(6))
        terms = []
        for functional in (True, False):
            loss = L2C2Loss(loss_class(actor, value, functional=functional), NEAR)
            out = loss.policy_regularizer(batch).update(loss.value_regularizer(batch))
            terms.append(out)
            (out["loss_l2c2_actor"] + out["loss_l2c2_critic"]).backward()
        for key in ("loss_l2c2_actor", "loss_l2c2_critic"):
            torch.testing.assert_close(terms[0][key], terms[1][key])
        assert all(p.grad is not None for p in (*actor.parameters(), *value.parameters()))

    def test_a_regularizer_of_values_alone_evaluates_a_shared_trunk(self):
        """It need not regularize the policy whose hidden output the critic reads."""

        class SmallValues(RegularizedLoss):
            def __init__(self, base_loss):
                self.declare_networks(self.value_networks())

            def value_regularizer(self, tensordict):
                states = tensordict.select("observation")[None]
                value, _ = self.values_at("critic_network", tensordict, states)
                return TensorDict(loss_small=value.square().mean())

        trunk = TensorDictModule(mlp(OBSERVATION, 2 * ACTION), ["observation"], ["hidden"])
        extract = TensorDictModule(NormalParamExtractor(), ["hidden"], ["loc", "scale"])
        actor = ProbabilisticActor(
            TensorDictSequential(trunk, extract),
            in_keys=["loc", "scale"],
            distribution_class=TanhNormal,
            return_log_prob=True,
        )
        value = ValueOperator(mlp(2 * ACTION, 1), in_keys=["hidden"])
        loss, batch = SmallValues(PPOLoss(actor, value)), on_policy(4)
        expected = value.module(trunk.module(batch["observation"])).square().mean()
        torch.testing.assert_close(loss.value_regularizer(batch)["loss_small"], expected)

    @pytest.mark.parametrize("separate", [False, True])
    def test_a_critic_cut_off_a_shared_trunk_reads_the_policys_hidden_output(self, separate):
        """The value term trains the trunk as the plain loss does: not with separate_losses."""
        torch.manual_seed(0)
        trunk, actor, value = sharing_a_trunk()
        loss = L2C2Loss(PPOLoss(actor, value, separate_losses=separate), NEAR)
        batch = with_neighbors(on_policy(6))
        terms = loss.value_regularizer(batch)
        here, there = batch["observation"], batch["neighbor", "observation"].squeeze(1)
        values = [value.module(trunk.module(states)) for states in (here, there)]
        gain = NEAR.gain(batch["neighbor", "distance"])
        expected = 0.1 * (gain * 0.5 * (values[0] - values[1]).square()).mean()
        torch.testing.assert_close(terms["loss_l2c2_critic"], expected, rtol=1e-4, atol=0.0)
        weight = loss.actor_network_params["module", "0", "module", "0", "module", "0", "weight"]
        found = torch.autograd.grad(terms["loss_l2c2_critic"], weight, allow_unused=True)[0]
        assert (found is None) == separate
        assert ("next", "observation") in loss.in_keys and ("next", "hidden") not in loss.in_keys

    @pytest.mark.parametrize(
        ("make", "network"),
        [
            (lambda actor, v, q: PPOLoss(actor, v, separate_losses=False), "critic"),
            (lambda actor, v, q: PPOLoss(actor, v, separate_losses=True), "critic"),
            (lambda actor, v, q: ClipPPOLoss(actor, v), "critic"),
            (lambda actor, v, q: A2CLoss(actor, v, separate_losses=False), "critic"),
            (lambda actor, v, q: ReinforceLoss(actor, v), "critic"),
            (lambda actor, v, q: PPORPELoss(actor, v), "critic"),
            (lambda actor, v, q: SACLoss(actor, q, target_entropy=-2.0), "qvalue"),
            (lambda actor, v, q: IQLLoss(actor, qvalue(), value_network=v), "value"),
        ],
    )
    def test_a_value_trains_a_trunk_where_the_plain_loss_does(self, make, network):
        """Those of SAC, A2C and others read the trunk's output from the batch, and train none."""
        torch.manual_seed(0)
        trunk, actor, value = sharing_a_trunk()
        of_actions = ValueOperator(mlp(8 + ACTION, 1), in_keys=["hidden", "action"])
        batch = on_policy(6)
        batch["hidden"] = trunk.module(batch["observation"]).detach()
        batch["next", "hidden"] = trunk.module(batch["next", "observation"]).detach()
        loss = L2C2Loss(make(actor, value, of_actions), NEAR)
        weight = loss.actor_network_params["module", "0", "module", "0", "module", "0", "weight"]
        terms = loss(batch)
        if "loss_critic" not in terms.keys() and network == "critic":
            terms["loss_critic"] = terms["loss_value"]  # REINFORCE's name for it
        own, added = (
            torch.autograd.grad(terms[key], weight, allow_unused=True, retain_graph=True)[0]
            for key in (f"loss_{network}", f"loss_l2c2_{network}")
        )
        assert (added is None) == (own is None)

    @pytest.mark.parametrize("given", ["scaled", "hidden"])
    def test_the_action_is_what_a_policy_acts_with(self, given):
        """And not what else it writes for the value function, which DDPG does not tell apart."""
        torch.manual_seed(0)
        before = TensorDictModule(nn.Linear(OBSERVATION, OBSERVATION), ["observation"], [given])
        actor = TensorDictSequential(before, TensorDictModule(mlp(3, ACTION), [given], ["action"]))
        value = ValueOperator(mlp(OBSERVATION + ACTION, 1), in_keys=[given, "action"])
        batch = transitions(6)
        steps = (batch["observation"], batch["next", "observation"])
        acts = [actor(TensorDict(observation=state))["action"].detach() for state in steps]
        loss = CATSLoss(DDPGLoss(actor, value), 1.0)
        found = loss.policy_regularizer(batch)["loss_cats"]
        torch.testing.assert_close(found, (acts[1] - acts[0]).square().sum(-1).mean())

    def test_running_statistics_are_the_losss_own(self):
        """Evaluating neighbors does not count as another batch in normalization layers."""
        torch.manual_seed(0)
        loss = L2C2Loss(
            CrossQLoss(gaussian_actor(), batch_norm_qvalue(), action_spec=Bounded(-1, 1, (ACTION,)))
        )
        before = {name: value.clone() for name, value in loss.state_dict().items()}
        loss.value_regularizer(transitions(6))
        assert all(torch.equal(value, before[name]) for name, value in loss.state_dict().items())
        loss(transitions(6))
        assert not all(
            torch.equal(value, before[name]) for name, value in loss.state_dict().items()
        )

    def test_inputs_that_are_not_states_stay(self):
        """A goal without a successor and a mask are read as they are at every neighbor."""
        torch.manual_seed(0)
        actor = Actor(mlp(OBSERVATION + 2, ACTION), in_keys=["observation", "goal"])
        loss = L2C2Loss(DDPGLoss(actor, qvalue()), NEAR)
        batch = transitions(6)
        batch["goal"] = torch.randn(6, 2)
        with_neighbors(batch)
        found = loss.policy_regularizer(batch)["l2c2_action_distance"]
        there = batch["neighbor", "observation"].squeeze(1)
        here = actor.module(batch["observation"], batch["goal"])
        there = actor.module(there, batch["goal"])
        torch.testing.assert_close(found, 0.5 * (here - there).square().sum(-1).mean().detach())
        torch.manual_seed(1)
        drawn = loss.policy_regularizer(batch.exclude("neighbor"))
        assert drawn["loss_l2c2_actor"] > 0

    @pytest.mark.parametrize("regularizer", [L2C2Loss, CAPSLoss, CATSLoss])
    @pytest.mark.parametrize(
        ("successor", "error", "message"),
        [
            (torch.zeros(6, OBSERVATION, dtype=torch.int64), TypeError, r"point.*got torch\.int64"),
            (torch.zeros(6, 1), ValueError, rf"'observation', \(6, {OBSERVATION}\), got \(6, 1\)"),
        ],
    )
    def test_a_successor_is_of_its_states_kind(self, regularizer, successor, error, message):
        """By whichever regularizer, with its key, instead of a broadcast or torch's own error."""
        loss, batch = regularizer(DDPGLoss(deterministic_actor(), qvalue())), transitions(6)
        batch["next", "observation"] = successor
        with pytest.raises(error, match=rf"\('next', 'observation'\) must .*{message}"):
            loss.policy_regularizer(batch)

    def test_parameters_of_the_heads_are_no_state(self):
        """A composite policy reads them as one TensorDict, after it has written them."""
        loss = L2C2Loss(make_composite_ppo(), NEAR)
        assert loss.networks["actor_network"].states == ("observation",)
        batch = loss.neighbor_transform()(composite_batch(4))
        assert list(batch["neighbor"].keys()) == ["observation", "distance"]

    def test_inputs_that_the_policy_overwrites_are_states(self):
        """A policy may write its normalized observation where it was."""
        torch.manual_seed(0)
        normalize = TensorDictModule(torch.tanh, ["observation"], ["observation"])
        actor = TensorDictSequential(normalize, deterministic_actor())
        loss = L2C2Loss(DDPGLoss(actor, qvalue()), NEAR)
        batch = with_neighbors(transitions(6))
        found = loss.policy_regularizer(batch)["l2c2_action_distance"]
        here, there = batch["observation"], batch["neighbor", "observation"].squeeze(1)
        actions = [actor[1].module(states.tanh()) for states in (here, there)]
        expected = 0.5 * (actions[0] - actions[1]).square().sum(-1).mean()
        torch.testing.assert_close(found, expected.detach())

    def test_action_values_are_taken_at_the_batchs_action(self):
        """Also where the loss has no key of its own for the action."""
        torch.manual_seed(0)
        value = qvalue()
        loss = L2C2Loss(DDPGLoss(gaussian_actor(), value), NEAR)
        batch = with_neighbors(transitions(6))
        here, there = batch["observation"], batch["neighbor", "observation"].squeeze(1)
        values = [value.module(states, batch["action"]) for states in (here, there)]
        expected = 0.5 * (values[0] - values[1]).square().mean()
        found = loss.value_regularizer(batch)["l2c2_value_distance"]
        torch.testing.assert_close(found, expected.detach())

    def test_a_critic_with_a_state_of_its_own(self):
        """A centralized critic's state has neighbors too, and its successor is an input."""
        loss = L2C2Loss(PPOLoss(gaussian_actor(), ValueOperator(mlp(4, 1), in_keys=["state"])))
        assert ("next", "state") in loss.in_keys
        loss.set_keys(reward="other_reward")
        assert ("next", "state") in loss.in_keys
        batch = on_policy(6)
        batch["state"], batch["next", "state"] = torch.randn(6, 4), torch.randn(6, 4)
        assert loss.value_regularizer(batch)["loss_l2c2_critic"] > 0

    def test_the_value_can_be_renamed(self):
        """set_keys tells which of a critic's outputs is its value, before wrapping and after."""
        torch.manual_seed(0)
        heads = TensorDictModule(
            lambda observation: (observation[..., :1], 2 * observation[..., :1]),
            ["observation"],
            ["state_value", "other_value"],
        )
        loss = L2C2Loss(PPOLoss(gaussian_actor(), heads), NEAR)
        batch = with_neighbors(on_policy(6))
        before = loss.value_regularizer(batch)["loss_l2c2_critic"]
        loss.set_keys(value="other_value")
        torch.testing.assert_close(loss.value_regularizer(batch)["loss_l2c2_critic"], 4 * before)
        heads = TensorDictModule(mlp(OBSERVATION, 1), ["observation"], ["v"])
        loss = L2C2Loss(PPOLoss(gaussian_actor(), heads), NEAR)
        with pytest.raises(
            ValueError, match=r"critic_network writes \['v'\].*name it with set_keys"
        ):
            loss.value_regularizer(batch)
        loss.set_keys(value="v")
        assert loss.value_regularizer(batch)["loss_l2c2_critic"] > 0

    @pytest.mark.parametrize("regularizer", [L2C2Loss, CAPSLoss])
    def test_a_batch_that_hangs_on_the_policy_trains_it_no_further(self, regularizer):
        """Terms on values do not reach the policy that made the batch's actions."""
        torch.manual_seed(0)
        actor, value = deterministic_actor(), qvalue()
        batch = actor(transitions(6))
        assert batch["action"].requires_grad
        encoder = nn.Linear(OBSERVATION, OBSERVATION)
        batch["observation"] = encoder(batch["observation"])
        terms = regularizer(DDPGLoss(actor, value))(batch)
        for key in (key for key in terms.keys() if "l2c2" in key or "caps" in key):
            if not terms[key].requires_grad:
                continue
            found = torch.autograd.grad(
                terms[key],
                [*encoder.parameters(), *actor.parameters()],
                retain_graph=True,
                allow_unused=True,
            )
            reached = [gradient is not None for gradient in found]
            trains_policy = key == "loss_l2c2_actor" or key.startswith("loss_caps")
            assert reached == [False, False] + [trains_policy] * (len(reached) - 2), key

    def test_networks_have_to_declare_their_keys(self):
        """Otherwise it is not known what to evaluate them at."""

        class Plain(nn.Module):
            pass

        loss = DDPGLoss(deterministic_actor(), qvalue())
        loss.__dict__["actor_network"] = Plain()
        with pytest.raises(TypeError, match="actor_network is a Plain, which declares no keys"):
            L2C2Loss(loss)

    def test_masked_actions(self):
        """A mask of allowed actions is an input of the policy like any other."""
        module = TensorDictModule(mlp(OBSERVATION, ACTIONS), ["observation"], ["logits"])
        actor = ProbabilisticActor(
            module,
            in_keys={"logits": "logits", "mask": "mask"},
            distribution_class=MaskedCategorical,
            return_log_prob=True,
        )
        batch = transitions(6, action=torch.zeros(6, dtype=torch.long))
        batch["mask"] = torch.tensor([True, True, False, True]).expand(6, 4)
        terms = L2C2Loss(PPOLoss(actor, critic()), NEAR).policy_regularizer(batch)
        assert terms["loss_l2c2_actor"].isfinite() and terms["loss_l2c2_actor"] > 0

    def test_action_masks_of_value_based_losses(self):
        """Boolean inputs of a Q-network are not taken for states."""
        select = QValueModule(action_space="one-hot", action_mask_key="mask")
        actor = TensorDictSequential(action_values(), select)
        with pytest.warns(UserWarning, match="leaves out the policy term"):
            loss = L2C2Loss(DQNLoss(actor, action_space="one-hot"), NEAR)
        batch = one_hot_batch(4)
        batch["mask"] = batch["next", "mask"] = torch.tensor([True, True, False, True]).expand(4, 4)
        term = loss(batch)["loss_l2c2_value"]
        assert term.isfinite() and term > 0

    def test_batches_with_named_dimensions(self):
        """Collectors name the time dimension; the terms do not mind."""
        loss = L2C2Loss(ddpg(), NEAR)
        batch = transitions(2, 3)
        torch.manual_seed(0)
        expected = loss.policy_regularizer(batch)
        batch.names = [None, "time"]
        torch.manual_seed(0)
        found = loss.policy_regularizer(batch)
        torch.testing.assert_close(found["loss_l2c2_actor"], expected["loss_l2c2_actor"])

    def test_single_transitions(self):
        """A batch without batch dimensions."""
        torch.manual_seed(0)
        loss, batch = L2C2Loss(ddpg(), NEAR), with_neighbors(transitions())
        expected = loss.policy_regularizer(batch.unsqueeze(0))["loss_l2c2_actor"]
        torch.testing.assert_close(loss.policy_regularizer(batch)["loss_l2c2_actor"], expected)


class Cooperating(DDPGLoss, SharedEvaluation):
    """Evaluates its value network through the method that regularizers listen to."""

    def evaluate_at_batch(self, network, tensordict):
        with self.value_network_params.to_module(self.value_network):
            return self.value_network(tensordict.select(*self.value_network.in_keys))

    def loss_value(self, tensordict):
        value = self.evaluate_at_batch("value_network", tensordict)["state_action_value"]
        return value.square().mean(), {}


class TestEvaluationsThatAreSpared:
    @pytest.fixture
    def losses(self):
        torch.manual_seed(0)
        networks = deterministic_actor(), qvalue()
        return L2C2Loss(Cooperating(*networks), NEAR), L2C2Loss(DDPGLoss(*networks), NEAR)

    def test_states_that_the_loss_has_evaluated_are_not_evaluated_again(self, losses):
        """The terms are the same, from the neighbors' rows alone."""
        batch = with_neighbors(transitions(6))
        terms, gradients = [], []
        for loss in losses:
            rows = []
            handle = loss.value_network.register_forward_pre_hook(
                lambda _, inputs, rows=rows: rows.append(inputs[0].shape[0])
            )
            terms.append(loss(batch.copy()))
            handle.remove()
            assert rows[-1] == (6 if isinstance(loss, Cooperating) else 12)
            terms[-1]["loss_l2c2_value"].backward()
            weight = next(loss.value_network_params.parameters())
            gradients.append(weight.grad.clone())
            weight.grad = None
        torch.testing.assert_close(terms[0]["loss_l2c2_value"], terms[1]["loss_l2c2_value"])
        torch.testing.assert_close(*gradients)

    def test_nothing_is_kept_beyond_the_forward_pass(self, losses):
        """After forward, or after an error in it, another batch is evaluated anew."""
        loss, plain = losses
        batch, other = with_neighbors(transitions(6)), with_neighbors(transitions(6))
        expected = plain.value_regularizer(other)["loss_l2c2_value"]
        loss(batch.copy())
        torch.testing.assert_close(loss.value_regularizer(other)["loss_l2c2_value"], expected)
        with pytest.raises(KeyError):
            loss(batch.exclude("neighbor", ("next", "observation")))
        torch.testing.assert_close(loss.value_regularizer(other)["loss_l2c2_value"], expected)

    def test_a_hidden_output_of_an_older_policy_is_not_compared(self):
        """Both values are of the present trunk: 0 where s' = s, whatever the batch has stored."""
        torch.manual_seed(0)
        _, actor, value = sharing_a_trunk()
        batch = on_policy(6)
        batch["next", "observation"] = batch["observation"].clone()
        batch["hidden"], batch["next", "hidden"] = torch.randn(2, 6, 8)
        assert L2C2Loss(PPORPELoss(actor, value), NEAR)(batch)["loss_l2c2_critic"] == 0

    @pytest.mark.parametrize("layer", [nn.BatchNorm1d, BatchRenorm1d])
    def test_both_sides_of_a_comparison_are_normalized_alike(self, layer):
        """Normalized separately, all states would be the same as all next states."""
        torch.manual_seed(0)
        net = nn.Sequential(layer(OBSERVATION), mlp(OBSERVATION, 2 * ACTION))
        module = nn.Sequential(net, NormalParamExtractor())
        actor = ProbabilisticActor(
            TensorDictModule(module, ["observation"], ["loc", "scale"]),
            in_keys=["loc", "scale"],
            distribution_class=TanhNormal,
        )
        batch = on_policy(64)
        batch["next", "observation"] = batch["observation"] + 0.3
        both = torch.cat((batch["observation"], batch["next", "observation"]))
        here, there = copy.deepcopy(net)(both)[:, :ACTION].chunk(2)
        loss = CATSLoss(PPORPELoss(actor, make_critic(OBSERVATION)), lambda_temporal=1.0)
        expected = (here - there).square().sum(-1).mean()
        torch.testing.assert_close(loss(batch)["loss_cats"], expected)


def replayed(size: int) -> TensorDict:
    """Transitions for PPO-RPE, with neighbors."""
    batch = transitions(size).set("action_log_prob", torch.zeros(size))
    return with_neighbors(batch)


def ppo_rpe(*layers: nn.Module) -> PPORPELoss:
    """PPO-RPE with the paper's networks; further layers end the actor's body."""
    actor, critic = make_actor(OBSERVATION, ACTION, hidden=(8,)), make_critic(OBSERVATION)
    body = actor[0].module.body
    body[-1] = nn.Sequential(body[-1], *layers)
    return PPORPELoss(actor, critic)


class TestOnePass:
    """Compiled, small batches and their neighbors share a pass over each network."""

    def both(self, loss, batch, monkeypatch):
        """Rows of every pass where it believes it is compiled; the terms there and else."""
        rows = []
        for network in (loss.actor_network[0], loss.critic_network):
            network.register_forward_pre_hook(lambda _, inputs: rows.append(len(inputs[0])))
        found = []
        for compiling in (False, True):
            rows.clear()
            monkeypatch.setattr(_evaluation, "is_compiling", lambda c=compiling: c)
            torch.manual_seed(0)
            # The adaptive threshold is a state that every forward pass moves.
            loss.delta.fill_(0.5)
            found.append(loss(batch.copy()))
        return rows, *found

    @pytest.mark.parametrize(
        "size, passes", [(256, [512, 256, 512]), (257, [257] * 5)], ids=["small", "large"]
    )
    def test_up_to_a_size(self, size, passes, monkeypatch):
        """Critic, its target at the next states, actor; above, two of them at the neighbors."""
        torch.manual_seed(0)
        rows, *terms = self.both(L2C2Loss(ppo_rpe(), NEAR), replayed(size), monkeypatch)
        assert rows == passes
        for key in terms[0].keys():
            torch.testing.assert_close(terms[1][key], terms[0][key])

    def test_gradients_are_the_same(self, monkeypatch):
        """Of the plain terms and of the regularizer's, from both sides."""
        torch.manual_seed(0)
        loss = L2C2Loss(ppo_rpe(), NEAR)
        _, *terms = self.both(loss, replayed(32), monkeypatch)
        parameters = list(loss.parameters())
        for key in (key for key in terms[0].keys() if key.startswith("loss_")):
            gradients = [
                torch.autograd.grad(t[key], parameters, retain_graph=True, allow_unused=True)
                for t in terms
            ]
            torch.testing.assert_close(*gradients)

    def test_another_regularizer_has_states_of_its_own(self, monkeypatch):
        """CAPS around L2C2 compares with the next states, not with the neighbors."""
        torch.manual_seed(0)
        loss = CAPSLoss(L2C2Loss(ppo_rpe(), NEAR), sigma=0.1)
        _, *terms = self.both(loss, replayed(32), monkeypatch)
        for key in terms[0].keys():
            torch.testing.assert_close(terms[1][key], terms[0][key])

    @pytest.mark.parametrize(
        "case", ["drawn by the loss", "batch statistics", "running ones", "dropout"]
    )
    def test_not_where_more_than_rounding_would_differ(self, case, monkeypatch):
        """Neighbors that are drawn later, statistics over both, dropout."""
        torch.manual_seed(0)
        layers = {
            "batch statistics": [nn.BatchNorm1d(2 * ACTION, track_running_stats=False)],
            "running ones": [nn.BatchNorm1d(2 * ACTION)],
            "dropout": [nn.Dropout(0.5)],
        }
        loss, batch = L2C2Loss(ppo_rpe(*layers.get(case, [])), NEAR), replayed(32)
        if case == "drawn by the loss":
            del batch["neighbor"]
        rows, *terms = self.both(loss, batch, monkeypatch)
        # With such a layer the batch is evaluated again, next to its neighbors.
        assert rows[-2:] == ([32, 32] if case == "drawn by the loss" else [32, 64])
        for key in ("loss_actor", "loss_l2c2_actor", "loss_l2c2_critic"):
            assert torch.equal(terms[1][key], terms[0][key])

    def test_not_where_it_would_cut_a_gradient(self, monkeypatch):
        """The action that a value is of may be the policy's own."""
        torch.manual_seed(0)
        monkeypatch.setattr(_evaluation, "is_compiling", lambda: True)
        loss = L2C2Loss(Cooperating(deterministic_actor(), qvalue()), NEAR)
        batch = with_neighbors(transitions(6))
        batch["action"].requires_grad_()
        assert torch.autograd.grad(loss(batch)["loss_value"], batch["action"])[0].any()
