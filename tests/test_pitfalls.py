"""What regularizers leave out, refuse and warn of, where they would silently do nothing or harm."""

from __future__ import annotations

import copy
import itertools
import math
import warnings
from functools import partial

import pytest
import torch
from losses import (
    ACTION,
    BOUNDS,
    OBSERVATION,
    batch_norm_qvalue,
    critic,
    deterministic_actor,
    gaussian_actor,
    mlp,
    on_policy,
    qvalue,
    transitions,
)
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors.utils import split_trajectories
from torchrl.envs import GymEnv
from torchrl.modules import (
    Actor,
    BatchRenorm1d,
    IndependentNormal,
    NoisyLinear,
    NormalParamExtractor,
    ProbabilisticActor,
)
from torchrl.modules.models.exploration import gSDEModule
from torchrl.objectives import BCLoss, CrossQLoss, DDPGLoss, PPOLoss, SACLoss, TD3Loss

from torchrl_l2c2 import (
    ASAPLoss,
    CAPSLoss,
    CATSLoss,
    GradCAPSLoss,
    L2C2Loss,
    LCPLoss,
    Neighborhood,
    NeighborTransform,
    SR2LLoss,
    smooth,
)
from torchrl_l2c2.gains import gradient_shares
from torchrl_l2c2.policy_distances import mean_distance

NEAR = Neighborhood(sigma=1.0, lambda_min=2.0, lambda_max=20.0)
TD3_GAIN = {"lambda_min": 0.04, "relative": True}


def seeded(make, *args, seed=0, **kwargs):
    torch.manual_seed(seed)
    return make(*args, **kwargs)


def base_loss(**kwargs):
    return DDPGLoss(seeded(deterministic_actor), seeded(qvalue), **kwargs)


def batch_of(*shape, seed=1):
    batch = seeded(transitions, *shape, seed=seed)
    return batch.set("before", batch["observation"] + 0.1 * torch.randn(*shape, OBSERVATION))


def told_by(run):
    """The warnings of this package that a function gives."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        run()
    messages = [str(each.message) for each in told if issubclass(each.category, UserWarning)]
    of_torchrl = ("No target network updater", "The name target_")
    return [message for message in messages if not message.startswith(of_torchrl)]


def over_all_draws(monkeypatch, compute, size, drawn):
    """What is computed with each choice of rows, where every other number drawn is fixed."""
    found = []
    for rows in itertools.combinations(range(size), drawn):
        with monkeypatch.context() as patched:
            patched.setattr(torch, "randperm", lambda n, rows=rows, **_: torch.tensor(rows))
            patched.setattr(torch, "randn_like", torch.ones_like)
            patched.setattr(torch, "rand_like", lambda like: torch.full_like(like, 0.7))
            patched.setattr(torch, "randint_like", lambda like, high: torch.ones_like(like))
            found.append(compute())
    return torch.stack(found)


# The regularizers that read next observations, with their terms and the diagnostic of the share.
TEMPORAL = {
    "l2c2": (partial(L2C2Loss, neighborhood=NEAR), "loss_l2c2_actor", "l2c2_counted"),
    "caps": (partial(CAPSLoss, lambda_temporal=1.0), "loss_caps_temporal", "caps_counted"),
    "cats": (CATSLoss, "loss_cats", "cats_counted"),
    "grad_caps": (
        partial(GradCAPSLoss, previous_key="before"),
        "loss_grad_caps",
        "grad_caps_counted",
    ),
    "asap": (partial(ASAPLoss, previous_key="before"), "loss_grad_caps", "grad_caps_counted"),
}


@pytest.mark.parametrize("kind", TEMPORAL)
class TestUnknownNextObservations:
    """Rows whose next observation is NaN, or belongs to another episode, do not count."""

    KNOWN = torch.tensor([True, False, True, True, False, True, True, True])

    def values(self, kind, batch):
        """Of each transition, where all are known."""
        make, term, _ = TEMPORAL[kind]
        return seeded(make(base_loss(reduction="none")).policy_regularizer, batch)[term]

    def unknown(self, batch):
        batch = batch.clone()
        batch["next", "observation"][~self.KNOWN] = math.nan
        return batch

    @pytest.mark.filterwarnings("ignore:.*of the transitions in the batch")
    def test_the_term_is_the_mean_of_the_others(self, kind):
        make, term, counted = TEMPORAL[kind]
        batch = batch_of(8)
        values = self.values(kind, batch)
        found = seeded(make(base_loss()).policy_regularizer, self.unknown(batch))
        torch.testing.assert_close(found[term], values[self.KNOWN].mean())
        assert found[counted].item() == 0.75

    @pytest.mark.filterwarnings("ignore:.*of the transitions in the batch")
    def test_with_priority_weights(self, kind):
        make, term, counted = TEMPORAL[kind]
        batch = batch_of(8)
        values = self.values(kind, batch)
        batch["priority_weight"] = weights = torch.linspace(0.1, 1.0, 8)
        found = seeded(make(base_loss()).policy_regularizer, self.unknown(batch))
        expected = (weights * values)[self.KNOWN].sum() / weights[self.KNOWN].sum()
        torch.testing.assert_close(found[term], expected)
        assert found[counted].item() == 0.75  # Not weighted.

    @pytest.mark.filterwarnings("ignore:.*of the transitions in the batch")
    def test_with_masks(self, kind):
        make, term, counted = TEMPORAL[kind]
        batch = batch_of(8)
        values = self.values(kind, batch)
        mask = torch.tensor([True, True, True, False, False, False, True, True])
        batch["collector"] = TensorDict({"mask": mask.unsqueeze(-1)}, batch_size=[8])
        found = seeded(make(base_loss()).policy_regularizer, self.unknown(batch))
        torch.testing.assert_close(found[term], values[self.KNOWN & mask].mean())
        assert found[counted].item() == pytest.approx(4 / 5)

    @pytest.mark.filterwarnings("ignore:.*of the transitions in the batch")
    def test_with_a_fraction(self, kind, monkeypatch):
        """Of every choice of rows the mean over those that count; on average it is the whole's."""
        make, term, _ = TEMPORAL[kind]
        batch = batch_of(4)
        batch["next", "observation"][1] = math.nan
        seeded(L2C2Loss(base_loss(), NEAR).neighbor_transform(), batch)  # The same for all draws.
        expected = make(base_loss()).policy_regularizer(batch.clone())[term]
        loss = make(base_loss(), fraction=0.5)
        found = over_all_draws(
            monkeypatch, lambda: loss.policy_regularizer(batch.clone())[term], 4, 2
        )
        assert found.std() > 0
        torch.testing.assert_close(found.mean(), expected)

    def test_all_unknown_is_zero_and_told_once(self, kind):
        make, term, counted = TEMPORAL[kind]
        loss, batch = make(base_loss()), batch_of(8)
        batch["next", "observation"][:] = math.nan
        found = []
        messages = told_by(lambda: found.extend(loss.policy_regularizer(batch) for _ in range(3)))
        (message,) = [each for each in messages if "next observations" in each]
        assert message.startswith(
            "100.00% of the transitions in the batch have an observation or a next"
        )
        assert "keep the true next observations" in message
        for terms in found:
            assert terms[term] == 0 and terms[counted] == 0
            assert all(value.isfinite() for value in terms.values())
        total = sum(found[0][key] for key in found[0].keys() if key.startswith("loss_"))
        total.backward()
        assert all(p.grad is None or p.grad.isfinite().all() for p in loss.parameters())

    def test_known_ones_say_nothing(self, kind):
        make, _, counted = TEMPORAL[kind]
        loss = make(base_loss())
        found = []
        assert not told_by(lambda: found.append(loss.policy_regularizer(batch_of(8))))
        assert found[0][counted] == 1

    def test_a_row_with_one_unknown_coordinate_counts(self, kind):
        """As not having moved there."""
        make, term, counted = TEMPORAL[kind]
        batch = batch_of(8)
        batch["next", "observation"][:, 1] = batch["observation"][:, 1]
        expected = seeded(make(base_loss()).policy_regularizer, batch)
        batch["next", "observation"][:, 1] = math.nan
        found = seeded(make(base_loss()).policy_regularizer, batch)
        assert found[counted] == 1
        torch.testing.assert_close(found[term], expected[term])

    def test_ends_can_be_left_out(self, kind):
        """skip_ends: next is the reset state where an episode ends."""
        make, term, counted = TEMPORAL[kind]
        batch = batch_of(8)
        values = self.values(kind, batch)
        batch["next", "done"] = ~self.KNOWN.unsqueeze(-1)
        everything = seeded(make(base_loss()).policy_regularizer, batch.clone())
        torch.testing.assert_close(everything[term], values.mean())
        loss = make(base_loss(), skip_ends=True)
        found = []
        messages = told_by(lambda: found.append(seeded(loss.policy_regularizer, batch.clone())))
        assert not messages
        torch.testing.assert_close(found[0][term], values[self.KNOWN].mean())
        assert found[0][counted] == 0.75
        del batch["next", "done"]
        with pytest.raises(KeyError, match=r"skip_ends=True needs .*done"):
            loss.policy_regularizer(batch)
        assert "skip_ends=True" in repr(loss).split("actor_network_params")[0]


@pytest.mark.filterwarnings("ignore:.*of the transitions in the batch")
@pytest.mark.parametrize("kind", TEMPORAL)
def test_the_ends_of_the_drawn_rows_are_left_out(kind, monkeypatch):
    """skip_ends with a fraction: of the rows 1, 4 and 6 the second ends an episode."""
    make, _, counted = TEMPORAL[kind]
    batch = batch_of(8)
    batch["next", "done"] = (torch.arange(8) == 4).unsqueeze(-1)
    monkeypatch.setattr(
        torch, "randperm", lambda n, **_: torch.tensor([1, 4, 6, 0, 2, 3, 5, 7])[:n]
    )
    loss = make(base_loss(), skip_ends=True, fraction=3 / 8)
    assert loss.policy_regularizer(batch)[counted].item() == pytest.approx(2 / 3)
    batch["next", "done"] = (torch.arange(8) < 1).unsqueeze(-1)
    assert loss.policy_regularizer(batch)[counted] == 1


def test_all_observations_have_to_be_known():
    """Of two that the policy reads, one is unknown in one row."""
    actor = Actor(mlp(2 * OBSERVATION, ACTION), in_keys=["observation", "other"])
    batch = batch_of(8)
    batch["other"], batch["next", "other"] = (
        batch["observation"],
        batch["next", "observation"].clone(),
    )
    batch["next", "other"][0] = math.nan
    terms = CATSLoss(DDPGLoss(actor, qvalue())).policy_regularizer(batch)
    assert terms["cats_counted"] == 7 / 8 and terms["loss_cats"].isfinite()


def test_the_spatial_term_of_caps_keeps_all_rows():
    """It reads no next observation."""
    loss, batch = CAPSLoss(base_loss(), lambda_temporal=1.0), batch_of(8)
    expected = seeded(loss.policy_regularizer, batch)["loss_caps_spatial"]
    batch["next", "observation"][:3] = math.nan
    assert seeded(loss.policy_regularizer, batch)["loss_caps_spatial"] == expected


def test_value_terms_leave_the_same_rows_out():
    batch = batch_of(8)
    values = L2C2Loss(base_loss(reduction="none"), NEAR).value_regularizer
    values = seeded(values, batch)["loss_l2c2_value"]
    batch["next", "observation"][0] = math.nan
    found = seeded(L2C2Loss(base_loss(), NEAR).value_regularizer, batch)
    torch.testing.assert_close(found["loss_l2c2_value"], values[1:].mean())


# Every regularizer, with its terms; and how many rows a pass evaluates for each row compared.
ALL = {
    "l2c2": (partial(L2C2Loss, neighborhood=NEAR), ["loss_l2c2_actor", "loss_l2c2_value"]),
    "caps": (
        partial(CAPSLoss, sigma=1.0),
        ["loss_caps_temporal", "loss_caps_spatial"],
    ),
    "cats": (CATSLoss, ["loss_cats"]),
    "grad_caps": (partial(GradCAPSLoss, previous_key="before"), ["loss_grad_caps"]),
    "asap": (
        partial(ASAPLoss, previous_key="before"),
        ["loss_grad_caps", "loss_asap_spatial", "loss_asap_temporal"],
    ),
    "lcp": (partial(LCPLoss, of="mean"), ["loss_lcp"]),
    "sr2l": (partial(SR2LLoss, steps=1, policy_distance="mean"), ["loss_sr2l"]),
}


@pytest.mark.parametrize("kind", ALL)
class TestFractions:
    """A share of the rows is evaluated, and every term's expectation stays."""

    def terms(self, loss, batch):
        found = loss.policy_regularizer(batch).update(loss.value_regularizer(batch))
        return torch.stack([found[key].detach() for key in ALL[loss.kind][1]])

    def made(self, kind, **kwargs):
        loss = ALL[kind][0](base_loss(), **kwargs)
        loss.kind = kind
        if kind == "asap":  # Another policy's, so that there is something to predict.
            with torch.no_grad():
                for parameter in loss.asap_predictor.parameters():
                    parameter.add_(0.3)
        return loss

    def test_the_expectation_stays(self, kind, monkeypatch):
        """Over every choice of rows, with priority weights and without."""
        batch = batch_of(4)
        seeded(L2C2Loss(base_loss(), NEAR).neighbor_transform(), batch)  # The same for all draws.
        for weights in (None, torch.linspace(0.1, 1.0, 4)):
            if weights is not None:
                batch["priority_weight"] = weights
            whole, part = self.made(kind), self.made(kind, fraction=0.5)
            expected = over_all_draws(monkeypatch, partial(self.terms, whole, batch), 4, 4)[0]
            found = over_all_draws(monkeypatch, partial(self.terms, part, batch), 4, 2)
            assert (expected > 0).all() and (found.std(0) > 0).all()
            torch.testing.assert_close(found.mean(0), expected)

    def test_fewer_rows_are_evaluated(self, kind):
        """A quarter of those of the whole batch."""
        counts = []
        for fraction in (1.0, 0.25):
            loss, batch, rows = self.made(kind, fraction=fraction), batch_of(32), []
            loss.policy_regularizer(batch)  # The first call looks for random numbers.
            inner = next(m for m in loss.actor_network.modules() if isinstance(m, nn.Linear))
            inner.register_forward_hook(lambda *of, rows=rows: rows.append(of[2][..., 0].numel()))
            loss.policy_regularizer(batch)
            counts.append(sum(rows))
        assert counts[1] == counts[0] / 4 and counts[1] > 0

    @pytest.mark.parametrize("fraction", [0.0, 1.5, math.nan])
    def test_other_shares_are_refused(self, kind, fraction):
        with pytest.raises(ValueError, match=r"fraction must be in \(0, 1\], got"):
            ALL[kind][0](base_loss(), fraction=fraction)


class Trembling(nn.Module):
    """Draws random numbers whenever it is called."""

    def __init__(self):
        super().__init__()
        self.net = mlp(OBSERVATION, 2)

    def forward(self, observation):
        return self.net(observation) + 0.3 * torch.randn(2)


def noisy_layers():
    return DDPGLoss(Actor(nn.Sequential(NoisyLinear(OBSERVATION, 2), nn.Tanh())), qvalue())


def batch_norm():
    net = nn.Sequential(nn.Linear(OBSERVATION, 8), BatchRenorm1d(8), nn.Tanh(), nn.Linear(8, 2))
    return DDPGLoss(Actor(net), qvalue())


def torchs_batch_norm():
    net = nn.Sequential(nn.Linear(OBSERVATION, 8), nn.BatchNorm1d(8), nn.Tanh(), nn.Linear(8, 2))
    return DDPGLoss(Actor(net), qvalue())


def dropout(p=0.5):
    torch.manual_seed(0)
    net = nn.Sequential(mlp(OBSERVATION, 8), nn.Dropout(p), nn.Tanh(), nn.Linear(8, 2))
    return DDPGLoss(Actor(net), seeded(qvalue))


def crossq():
    return CrossQLoss(gaussian_actor(), batch_norm_qvalue(), action_spec=BOUNDS)


def explorative():
    """State-dependent exploration, whose noise the policy makes or reads."""
    return PPOLoss(
        ProbabilisticActor(
            TensorDictSequential(
                TensorDictModule(mlp(OBSERVATION, 2), ["observation"], ["action_mean"]),
                TensorDictModule(
                    gSDEModule(2, OBSERVATION),
                    ["action_mean", "observation", "_eps_gSDE"],
                    ["loc", "scale", "action", "_eps_gSDE"],
                ),
            ),
            in_keys=["loc", "scale"],
            distribution_class=IndependentNormal,
        ),
        critic(),
    )


class TestRandomNumbers:
    """A distance of two evaluations must not measure what was drawn in between."""

    @pytest.mark.parametrize("kind", ALL)
    def test_a_policy_that_draws_is_refused(self, kind):
        """With the reason, and again if it is tried again."""
        loss = ALL[kind][0](DDPGLoss(Actor(Trembling()), qvalue()))
        for _ in range(2):
            with pytest.raises(TypeError, match=r"actor_network gives two .* it draws"):
                loss.policy_regularizer(batch_of(8))

    def test_so_is_a_value_function(self):
        class Value(Trembling):
            def forward(self, observation, action):
                return super().forward(observation).sum(-1, keepdim=True)

        value = TensorDictModule(Value(), ["observation", "action"], ["state_action_value"])
        with pytest.raises(TypeError, match="value_network gives two different outputs"):
            L2C2Loss(DDPGLoss(deterministic_actor(), value), NEAR).value_regularizer(batch_of(8))

    @pytest.mark.parametrize(
        "make", [noisy_layers, batch_norm, torchs_batch_norm, dropout, crossq, explorative]
    )
    def test_others_are_not(self, make):
        """And the check draws no number of the global generator."""
        loss = L2C2Loss(seeded(make), NEAR)
        batch = batch_of(8)
        batch["advantage"], batch["action_log_prob"] = torch.randn(8, 1), torch.zeros(8)
        batch["value_target"] = torch.randn(8, 1)
        batch["_eps_gSDE"] = torch.zeros(8, 2, OBSERVATION)
        first, second = (seeded(loss.policy_regularizer, batch.clone()) for _ in range(2))
        assert torch.equal(first["loss_l2c2_actor"], second["loss_l2c2_actor"])
        assert first["loss_l2c2_actor"] > 0

    @pytest.mark.parametrize("kind", ["l2c2", "caps", "cats"])
    def test_dropout_is_off(self, kind):
        """The terms are those without it: 0 where s' = s. The loss itself keeps it."""
        make, terms = ALL[kind]
        batch = batch_of(8)
        seeded(L2C2Loss(base_loss(), NEAR).neighbor_transform(), batch)
        dropped, undropped = (make(dropout(p)) for p in (0.5, 0.0))
        found, expected = (
            seeded(each.policy_regularizer, batch.clone()) for each in (dropped, undropped)
        )
        for key in found.keys():
            assert torch.equal(found[key], expected[key])
        found, expected = (seeded(each, batch.clone()) for each in (dropped, undropped))
        assert torch.equal(found[terms[0]], expected[terms[0]])
        assert found["loss_actor"] != expected["loss_actor"]
        assert all(m.training for m in dropped.modules())
        batch = batch.exclude("neighbor")
        batch["next", "observation"] = batch["observation"].clone()
        assert dropped.policy_regularizer(batch)[terms[0]] == 0


@pytest.mark.parametrize("per_action", [False, True])
def test_padding_of_cloned_trajectories_is_not_regularized(per_action):
    """BCLoss's pad_mask, of states or of the actions of each state."""
    loss = CATSLoss(BCLoss(seeded(gaussian_actor)))
    loss.set_keys(pad_mask="pad")
    batch, pad = batch_of(6), torch.tensor([False, False, True, True, False, False])
    expected = loss.policy_regularizer(batch[~pad])["loss_cats"]
    batch["pad"] = pad.unsqueeze(-1).expand(-1, 3) if per_action else pad
    torch.testing.assert_close(loss.policy_regularizer(batch)["loss_cats"], expected)


@pytest.mark.parametrize("policy_distance", ["mse", "hellinger"])
def test_padding_has_no_part_in_gradients_with_neighbors_of_the_batch(policy_distance):
    """Of trajectories of three and five steps, split and padded with zeros."""
    loss = L2C2Loss(
        PPOLoss(seeded(gaussian_actor), seeded(critic)), NEAR, policy_distance=policy_distance
    )
    batch = NeighborTransform(NEAR)(seeded(on_policy, 8))
    batch["next", "done"][[2, 7]] = True
    batch["collector"] = TensorDict({"traj_ids": (torch.arange(8) > 2).long()}, [8])
    padded = split_trajectories(batch)
    assert padded.shape == (2, 5) and (padded["neighbor", "distance"] == 0).any()

    def gradients(rows):
        terms = loss(rows)
        total = sum(term for key, term in terms.items() if key.startswith("loss_l2c2"))
        return torch.autograd.grad(total, list(loss.parameters()))

    torch.testing.assert_close(gradients(padded), gradients(batch))


class Timed(nn.Module):
    """Reads an observation and the time, which has no dimension of features."""

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Linear(OBSERVATION + 1, ACTION)

    def forward(self, observation, time):
        return self.net(torch.cat((observation, time.unsqueeze(-1)), -1))


@pytest.mark.parametrize("make", [CATSLoss, CAPSLoss, partial(LCPLoss, of="mean")])
def test_entries_without_a_dimension_of_features(make):
    """The same as with a dimension of size 1."""
    flat = Actor(seeded(Timed), in_keys=["observation", "time"])
    deep = copy.deepcopy(flat)
    deep.module.forward = lambda o, t: flat.module(o, t.squeeze(-1))
    batch = batch_of(6)
    batch["time"], batch["next", "time"] = torch.rand(2, 6)
    found = seeded(make(BCLoss(flat)).policy_regularizer, batch)
    for key in ("time", ("next", "time")):
        batch[key] = batch[key].unsqueeze(-1)
    expected = seeded(make(BCLoss(deep)).policy_regularizer, batch)
    for key in found.keys():
        torch.testing.assert_close(found[key], expected[key])


@pytest.mark.parametrize("kind", ["l2c2", "cats"])
@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_where_no_transition_counts_the_gradient_is_zero(kind, weight):
    """All end an episode, but one whose priority weight may be 0."""
    make, term, _ = TEMPORAL[kind]
    loss, batch = make(base_loss(), skip_ends=True), batch_of(6)
    batch["next", "done"] = torch.ones(6, 1, dtype=torch.bool)
    batch["next", "done"][0] = weight != 0.0
    batch["priority_weight"] = torch.tensor([weight, *[1.0] * 5])
    with torch.autograd.detect_anomaly(check_nan=True):
        seeded(loss.policy_regularizer, batch)[term].backward()
    gradients = [p.grad for p in loss.parameters() if p.grad is not None]
    assert gradients and all((each == 0).all() for each in gradients)


def cloning():
    return BCLoss(seeded(deterministic_actor))


class TestTermsThatAreLeftOut:
    """A loop that does not add the separate term is told so."""

    def loop(self, loss, keys, steps=60):
        batch = batch_of(4)
        for _ in range(steps):
            terms = loss(batch.clone())
            sum(terms[key] for key in keys).backward()

    def test_a_term_that_is_never_differentiated_is_told_once(self):
        loss = CATSLoss(cloning())
        (message,) = told_by(lambda: self.loop(loss, ["loss_bc"], 120))
        assert message.startswith("['loss_cats'] of CATSLoss[BCLoss] were not differentiated in 50")
        assert "loss.fold()" in message

    @pytest.mark.parametrize("steps", [49, 120])
    def test_a_loop_that_adds_it_is_not(self, steps):
        loss = CATSLoss(cloning())
        keys = ["loss_bc", "loss_cats"] if steps > 49 else ["loss_bc"]
        assert not told_by(lambda: self.loop(loss, keys, steps))
        assert not told_by(lambda: self.loop(CATSLoss(cloning()).fold(), ["loss_bc"]))

    def test_nor_one_with_autograd_grad(self):
        loss, batch = CATSLoss(cloning()), batch_of(4)

        def loop():
            for _ in range(60):
                terms = loss(batch.clone())
                total = terms["loss_bc"] + terms["loss_cats"]
                torch.autograd.grad(total, [p for p in loss.parameters() if p.requires_grad])

        assert not told_by(loop)

    def test_nor_evaluations(self):
        """Without gradients, or in eval mode."""
        loss, batch = CATSLoss(cloning()), batch_of(4)

        def evaluate():
            with torch.no_grad():
                for _ in range(60):
                    loss(batch.clone())
            loss.eval()
            for _ in range(60):
                loss(batch.clone())

        assert not told_by(evaluate)

    def test_of_several_terms_the_missing_one_is_named(self):
        loss = CAPSLoss(cloning())
        (message,) = told_by(lambda: self.loop(loss, ["loss_bc", "loss_caps_spatial"]))
        assert message.startswith("['loss_caps_temporal'] of")

    def test_gradient_shares_say_so(self):
        """Which differentiate the terms themselves."""
        loss, batch = CATSLoss(base_loss()), batch_of(4)
        self.loop(loss, ["loss_actor", "loss_value"], 20)
        with pytest.warns(UserWarning, match=r"\['loss_cats'\] were never differentiated"):
            shares = gradient_shares(loss, batch)
        assert shares["loss_cats"] > 0
        loss = CATSLoss(base_loss())
        self.loop(loss, ["loss_actor", "loss_value", "loss_cats"], 20)
        assert not told_by(lambda: gradient_shares(loss, batch))

    def parts(self, loss, separately=(), steps=60, delay=2):
        batch = batch_of(4)
        for i in range(steps):
            if delay > 1:
                loss.value_loss(batch)
                if "value" in separately:
                    loss.value_regularizer(batch)
            if not i % delay:
                loss.actor_loss(batch)
                if "policy" in separately:
                    loss.policy_regularizer(batch)

    def td3(self):
        return TD3Loss(deterministic_actor(), qvalue(), action_spec=BOUNDS, num_qvalue_nets=1)

    def test_parts_without_the_regularizer_are_told(self):
        (message,) = told_by(lambda: self.parts(L2C2Loss(self.td3(), NEAR)))
        assert message.startswith("actor_loss and value_loss of L2C2Loss[TD3Loss] were called 50")
        (message,) = told_by(lambda: self.parts(L2C2Loss(self.td3(), NEAR, beta=0), delay=1))
        assert "policy_regularizer(batch)" in message

    def test_parts_with_it_are_not(self):
        assert not told_by(lambda: self.parts(L2C2Loss(self.td3(), NEAR), ("policy", "value")))
        loss = L2C2Loss(self.td3(), NEAR, beta=0)
        assert not told_by(lambda: self.parts(loss, ("policy",), delay=1))
        assert not told_by(lambda: self.parts(smooth(self.td3()), delay=1))

    def test_loops_that_call_parts_get_the_warnings_of_other_loops(self):
        """Once each: a ramp without progress, n-step returns, a changed base loss."""
        base, batch = self.td3(), batch_of(4)
        batch["steps_to_next_obs"] = torch.full((4,), 3)
        loss = smooth(base, ramp=1.0)
        base.make_value_estimator(gamma=0.5)

        def loop(steps):
            for _ in range(steps):
                loss.value_loss(batch)
                loss.actor_loss(batch)

        several, changed = told_by(lambda: loop(49))
        assert "n-step returns" in several and changed.startswith("make_value_estimator")
        (ramp,) = told_by(lambda: loop(71))
        assert "set_progress was not called in 50 updates" in ramp

    def test_parts_within_a_forward_are_not_counted_again(self):
        """TD3's forward calls both."""
        loss, batch = smooth(self.td3(), ramp=1.0), batch_of(4)
        assert not told_by(lambda: [loss(batch) for _ in range(49)])
        assert len(told_by(lambda: loss(batch))) == 1

    def test_nor_are_critics_that_are_trained_first(self):
        loss, batch = L2C2Loss(self.td3(), NEAR), batch_of(4)

        def warm_up():
            for _ in range(60):
                loss.value_loss(batch)
                loss.value_regularizer(batch)

        assert not told_by(warm_up)


class TestChangesOfTheWrappedLoss:
    """Keys and value estimators of the loss that was wrapped no longer reach the result."""

    def test_new_keys_are_told_at_the_next_call(self):
        base = base_loss()
        loss = smooth(base, **{"lambda_min": 1.0, "lambda_max": 10.0})
        base.set_keys(reward="other")
        (message,) = told_by(lambda: [loss(batch_of(4)) for _ in range(3)])
        assert message.startswith("set_keys of the DDPGLoss was called after it was wrapped")
        assert "call it on the wrapped loss, or before wrapping" in message

    @pytest.mark.parametrize("called_before", [False, True])
    def test_a_new_estimator_is_told_at_the_next_call(self, called_before):
        base = base_loss()
        if called_before:
            base(batch_of(4))
        loss = CATSLoss(base)
        base.make_value_estimator(gamma=0.5)
        (message,) = told_by(lambda: [loss(batch_of(4)) for _ in range(3)])
        assert message.startswith("make_value_estimator of the DDPGLoss was called after")

    def test_around_another_regularizer(self):
        base = base_loss()
        loss = CATSLoss(L2C2Loss(base, NEAR))
        base.make_value_estimator(gamma=0.5)
        (message,) = told_by(lambda: [loss(batch_of(4)) for _ in range(3)])
        assert message.startswith("make_value_estimator of the DDPGLoss was called after")

    def test_nothing_is_said_otherwise(self):
        def use():
            base = base_loss()
            base.set_keys(reward="reward")
            base.make_value_estimator(gamma=0.5)
            loss = CATSLoss(base)
            loss(batch_of(4))
            base(batch_of(4))
            loss(batch_of(4))
            loss.make_value_estimator(gamma=0.9)
            loss.set_keys(reward="other")
            batch = batch_of(4)
            batch["next", "other"] = batch["next", "reward"]
            loss(batch)
            copy.deepcopy(loss)(batch)
            del base
            loss(batch)

        assert not told_by(use)

    def test_nor_when_the_base_makes_its_usual_one(self):
        def use():
            base = base_loss()
            loss = CATSLoss(base)
            loss.make_value_estimator(gamma=0.5)
            base(batch_of(4))  # For comparison; makes its estimator.
            loss(batch_of(4))

        assert not told_by(use)


@pytest.mark.parametrize("kind", ALL)
def test_print_starts_with_the_settings(kind):
    """Then the gains, then what TorchRL prints."""
    loss = ALL[kind][0](base_loss())
    lines = str(loss).splitlines()
    assert lines[0] == f"{type(loss).__name__}("
    assert lines[1].startswith(f"    {type(loss).__name__.split('[')[0]}: ")
    assert lines[2].startswith("    regularizer_gain=1, ") and len(lines[2]) < 150
    assert lines[3] == "    folded=False, skip_ends=False, ramp=None, relative=False"
    assert lines[4].startswith("    actor_network_params=")
    assert str(loss).count("skip_ends") == 1
    if kind == "l2c2":
        assert "Neighborhood(sigma=1.0, lambda_min=2.0, lambda_max=20.0" in lines[1]


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("strenght", "the strength is 'strength'"),
        ("Strength", "the strength is 'strength'"),
        ("progress", r"set_progress\(\.\.\.\)"),
    ],
)
def test_a_typo_in_the_name_of_a_knob_is_told(name, hint):
    loss = L2C2Loss(base_loss(), NEAR)
    with pytest.warns(UserWarning, match=f"'{name}' has no effect on a L2C2.*{hint}") as told:
        setattr(loss, name, 0.5)
    assert told[0].filename == __file__


@pytest.mark.parametrize(
    ("name", "gain"),
    [
        ("l2c2_coef", "l2c2_coeff"),
        ("l2c2_betta", "l2c2_beta"),
        ("coeff", "l2c2_coeff"),
        ("beta", "l2c2_beta"),
        ("regulariser_gain", "regularizer_gain"),
        ("gain", "regularizer_gain"),
    ],
)
def test_a_typo_in_a_gains_name_is_told(name, gain):
    loss = L2C2Loss(base_loss(), NEAR)
    with pytest.warns(UserWarning, match=f"'{name}' scales nothing .* the gain is '{gain}'"):
        setattr(loss, name, 5.0)

    def others():
        setattr(loss, gain, 5.0)
        loss.note, loss.delay_actor, loss.gamma = "", True, 0.9

    assert not told_by(others)


@pytest.mark.parametrize(
    "name", ["sigma", "lambda_min", "l2c2_lambda_min", "method", "fraction", "neighbors"]
)
def test_a_setting_that_is_assigned_too_late_is_told(name):
    loss = L2C2Loss(base_loss(), NEAR)
    setting = name.removeprefix("l2c2_")
    with pytest.warns(UserWarning, match=f"assigning to it has no effect.* with {setting}=0.5"):
        setattr(loss, name, 0.5)


def test_a_method_is_not_replaced_by_a_value():
    loss = L2C2Loss(base_loss(), NEAR)
    with pytest.raises(TypeError, match=r"ramp is a method: call loss\.ramp\("):
        loss.ramp = 0.5
    assert loss.ramp(0.5) is loss


def test_another_distance_needs_another_loss():
    """The function was chosen when the loss was made."""
    loss = L2C2Loss(base_loss(), NEAR, policy_distance="mean")
    with pytest.raises(AttributeError, match=r"l2c2_policy_distance.* has no setter"):
        loss.l2c2_policy_distance = "kl"
    assert loss.l2c2_policy_distance == "mean"


def test_returns_of_several_steps_are_told_once():
    """The neighborhoods are then larger; with one step nothing is told."""
    for steps, count in ((3, 1), (1, 0)):
        loss, batch = smooth(base_loss()), batch_of(8)
        batch["steps_to_next_obs"] = torch.full((8,), steps)
        messages = told_by(lambda loss=loss, batch=batch: [loss(batch) for _ in range(3)])
        found = [each for each in messages if "n-step returns" in each]
        assert len(found) == count
        assert all(
            each.startswith("the next observations") and "up to 3 steps" in each for each in found
        )


class TestTermsThatTrainNothing:
    """A distance of one's own without a gradient, or with negative numbers."""

    def told(self, distance, fold=True, freeze=False):
        base = PPOLoss(seeded(gaussian_actor), seeded(critic))
        loss = smooth(base, lambda_min=1.0, lambda_max=9.0, policy_distance=distance, ramp=None)
        if not fold:
            loss.unfold()
        if freeze:
            for parameter in loss.actor_network_params.values(True, True):
                parameter.requires_grad_(False)
        batch = seeded(on_policy, 8)

        def train():
            for _ in range(60):
                terms = loss(batch.copy())
                sum(v for k, v in terms.items() if k.startswith("loss_")).backward()

        return [each for each in told_by(train) if "preset" not in each]

    @pytest.mark.parametrize("fold", [True, False])
    def test_no_gradient_is_told_once(self, fold):
        (message,) = self.told(lambda p, q: mean_distance(p, q).detach(), fold)
        assert message.startswith("['loss_l2c2_actor'] of L2C2Loss[PPOLoss] has no gradient")
        assert not self.told(mean_distance, fold)
        assert not self.told(mean_distance, freeze=True)

    def test_a_term_of_the_loss_without_gradient_is_told_once(self):
        """In the loss and in its parts: the penalty alone would flatten the policy."""

        class Cut(DDPGLoss):
            def loss_actor(self, tensordict):
                value, metadata = super().loss_actor(tensordict)
                return value.detach(), metadata

        networks, batch = (seeded(deterministic_actor), seeded(qvalue)), batch_of(8)
        for part in ("forward", "loss_actor"):
            loss = smooth(Cut(*networks), **TD3_GAIN)
            messages = told_by(
                lambda loss=loss, part=part: [getattr(loss, part)(batch.copy()) for _ in range(3)]
            )
            (message,) = (each for each in messages if "gradient" in each)
            assert message.startswith("the policy's own term of L2C2Loss[Cut] has no gradient")
        for parameter in loss.actor_network_params.values(True, True):
            parameter.requires_grad_(False)
        loss = smooth(Cut(*networks), **TD3_GAIN)
        assert not [each for each in told_by(lambda: loss(batch.copy())) if "gradient" in each]

    def test_a_part_without_gradient_is_told(self):
        def still(p, q):
            return mean_distance(p, q).detach()

        base = SACLoss(seeded(gaussian_actor), seeded(qvalue), target_entropy=-1.0)
        loss = smooth(base, lambda_min=1.0, lambda_max=9.0, policy_distance=still, ramp=None)
        messages = told_by(lambda: [loss.actor_loss(batch_of(8)) for _ in range(3)])
        (message,) = (each for each in messages if "gradient" in each)
        assert message.startswith("['loss_l2c2_actor'] of L2C2Loss[SACLoss] has no gradient")

    def test_negative_numbers_are_told_once(self):
        (message,) = self.told(lambda p, q: -mean_distance(p, q))
        assert message.startswith("policy_distance returned -") and "at least 0" in message


class TestEndsWithoutObservation:
    """TorchRL's GymEnv of several environments stores 0 as the next observation of an end."""

    def warned(self, batch):
        loss = smooth(base_loss())
        messages = told_by(lambda: [loss(batch.copy()) for _ in range(3)])
        return [each for each in messages if "ends of episodes" in each]

    def batch(self):
        batch = batch_of(8)
        batch["next", "done"][[2, 5]] = True
        batch["next", "observation"][[2, 5]] = 0.0
        return batch

    def test_is_told_once(self):
        (message,) = self.warned(self.batch())
        assert message.startswith("the next observation is 0 at all 2 ends of episodes until now")

    def test_ends_of_several_batches_are_counted(self):
        """Minibatches rarely hold two."""
        batch = self.batch()
        batch["next", "done"][2] = False
        assert self.warned(batch)
        batch["next", "observation"][5, 0] = 0.1
        assert not self.warned(batch)

    def test_ends_that_are_left_out_are_not_told(self):
        loss = smooth(base_loss(), skip_ends=True)
        assert not [each for each in told_by(lambda: loss(self.batch())) if "ends of" in each]

    def test_an_entry_that_ends_at_0_is_not_told(self):
        """Such as the time that is left, next to the observation."""
        keys = ["observation", "time_left"]
        actor = Actor(nn.Bilinear(OBSERVATION, 1, ACTION), in_keys=keys)
        for moves in (True, False):
            batch = self.batch()
            if moves:
                batch["next", "observation"][[2, 5]] = 1.0
            batch["time_left"], batch["next", "time_left"] = torch.ones(8, 1), torch.ones(8, 1)
            batch["next", "time_left"][[2, 5]] = 0.0
            loss = CATSLoss(DDPGLoss(actor, qvalue()), 1.0)
            told = told_by(lambda loss=loss, batch=batch: loss(batch))
            assert any("ends of episodes" in each for each in told) != moves

    def test_other_zeros_are_not(self):
        """Of some ends, of rows that do not end, of states that are 0."""
        changes = {
            "some": lambda batch: batch["next", "observation"][5, 0].fill_(0.1),
            "within": lambda batch: batch["next", "done"].fill_(False),
            "still": lambda batch: batch["observation"][2].fill_(0.0),
        }
        for change in changes.values():
            change(batch := self.batch())
            assert not self.warned(batch)

    @pytest.mark.filterwarnings("ignore")
    def test_is_what_torchrl_stores(self):
        """If this fails, TorchRL stores the last observation: the warning can go."""
        env = GymEnv("CartPole-v1", num_envs=2)
        try:
            rollout = env.rollout(60, break_when_any_done=False)
        finally:
            env.close()
        ends = rollout["next", "done"].squeeze(-1)
        assert ends.sum() > 1 and not rollout["next", "observation"][ends].any()


def test_a_limit_that_leaves_out_everything_is_told_once():
    """Such as one in other units than the observations."""
    for limit, count in ((1e-9, 1), (0.5, 0)):
        loss = L2C2Loss(base_loss(), Neighborhood(max_step=limit))
        messages = told_by(lambda loss=loss: [loss(batch_of(64)) for _ in range(3)])
        assert sum("longer than max_step=1e-09" in each for each in messages) == count


class Curved(nn.Module):
    """A mean whose Jacobian depends on the state."""

    def __init__(self, outputs=3):
        super().__init__()
        self.net = nn.Sequential(nn.Linear(OBSERVATION, 6), nn.Tanh(), nn.Linear(6, outputs))

    def forward(self, observation):
        return self.net(observation)


class TestLCPOfTheMean:
    def made(self, stochastic, **kwargs):
        torch.manual_seed(0)
        net = Curved(6 if stochastic else 3)
        if not stochastic:
            return net, LCPLoss(BCLoss(Actor(net)), 1.0, of="mean", **kwargs)
        module = nn.Sequential(net, NormalParamExtractor())
        actor = ProbabilisticActor(
            TensorDictModule(module, ["observation"], ["loc", "scale"]),
            in_keys=["loc", "scale"],
            distribution_class=IndependentNormal,
        )
        return net, LCPLoss(PPOLoss(actor, None), 1.0, of="mean", **kwargs)

    @pytest.mark.parametrize("stochastic", [False, True])
    def test_its_expectation_is_the_jacobians_squared_norm(self, stochastic, monkeypatch):
        """Over all eight vectors of signs, exactly."""
        net, loss = self.made(stochastic)
        batch = seeded(transitions, 5)
        jacobian = torch.func.vmap(torch.func.jacrev(lambda s: net(s)[:3]))(batch["observation"])
        expected = jacobian.square().sum((-2, -1)).mean()
        found, one = [], torch.randint_like
        for number in range(8):
            bits = torch.tensor([float(number >> i & 1) for i in range(3)])
            monkeypatch.setattr(
                torch, "randint_like", lambda like, high, bits=bits: bits.expand_as(like)
            )
            found.append(loss.policy_regularizer(batch)["loss_lcp"])
        monkeypatch.setattr(torch, "randint_like", one)
        torch.testing.assert_close(torch.stack(found).mean(), expected)
        torch.manual_seed(0)
        draws = torch.stack([loss.policy_regularizer(batch)["loss_lcp"] for _ in range(200)])
        assert draws.std() > 0
        assert (draws.mean() - expected).abs() < 4 * draws.std() / 200**0.5

    def test_its_gradient_is_the_norms(self, monkeypatch):
        """For an action of one dimension a sign does not matter."""
        torch.manual_seed(0)
        net = Curved(1)
        loss = LCPLoss(BCLoss(Actor(net)), 1.0, of="mean")
        batch = seeded(transitions, 5)
        norms = torch.func.vmap(torch.func.jacrev(net))(batch["observation"]).square()
        parameters = list(net.parameters())
        expected = torch.autograd.grad(norms.sum((-2, -1)).mean(), parameters, allow_unused=True)
        ours = [p for p in loss.parameters() if p.requires_grad]
        term = loss.policy_regularizer(batch)["loss_lcp"]
        found = torch.autograd.grad(term, ours, allow_unused=True)
        assert [p.shape for p in ours] == [p.shape for p in parameters]
        for a, b in zip(found, expected, strict=True):
            assert (a is None) == (b is None)
            if a is not None:
                torch.testing.assert_close(a, b)

    def test_it_does_not_depend_on_the_scale(self):
        """The likelihood's gradient does."""
        batch, found = seeded(on_policy, 5), {"mean": [], "log_prob": []}
        for of, terms in found.items():
            for shift in (0.0, 1.0):
                _, loss = self.made(True)
                loss.lcp_of = of
                with torch.no_grad():
                    bias = next(p for n, p in loss.named_parameters() if n.endswith("2.bias"))
                    bias[3:] += shift
                terms.append(
                    seeded(
                        loss.policy_regularizer,
                        batch.select("observation").set("action", torch.zeros(5, 3)),
                    )["loss_lcp"].item()
                )
        assert found["mean"][0] == pytest.approx(found["mean"][1])
        assert found["log_prob"][0] != pytest.approx(found["log_prob"][1], rel=0.1)


def test_a_warning_points_to_the_loop():
    """Not into TorchRL, whose wrapper of forward calls the loss."""
    loss, batch = L2C2Loss(base_loss(), NEAR), batch_of(8)
    batch["next", "observation"][0] = math.nan
    with pytest.warns(UserWarning, match="without a finite entry") as told:
        loss(batch)
    assert [each.filename for each in told if "finite" in str(each.message)] == [__file__]


class TestImagesOfWholeNumbers:
    """They stay still in L2C2's neighborhood, also if the policy reads a vector, too."""

    class Policy(nn.Module):
        def forward(self, pixels, observation):
            return (observation + pixels.flatten(-2).float().mean(-1, keepdim=True))[..., :ACTION]

    def told(self, method="l2c2", dtype=torch.uint8, changes=True, **settings):
        module = TensorDictModule(self.Policy(), ["pixels", "observation"], ["action"])
        loss = smooth(DDPGLoss(module, qvalue()), method, **settings)
        batch = batch_of(4)
        batch["pixels"] = torch.zeros(4, 3, 3, dtype=dtype)
        batch["next", "pixels"] = torch.full((4, 3, 3), int(changes), dtype=dtype)
        return [each for each in told_by(lambda: loss(batch)) if "pixels" in each]

    def test_it_is_told(self):
        (message,) = self.told()
        assert message.startswith("'pixels' is torch.uint8, and stays the same in all neighbors")

    def test_what_moves_or_is_meant_to_stay_is_not(self):
        assert not self.told(dtype=torch.float32) and not self.told(changes=False)
        assert not self.told(moved_keys=["observation"]) and not self.told("cats")
