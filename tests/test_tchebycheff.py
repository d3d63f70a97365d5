"""Smooth Tchebycheff scalarization: by hand, at its limits, and as the gradient of a loss."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from losses import deterministic_actor, gaussian_actor, on_policy, qvalue, transitions
from torchrl.objectives import ClipPPOLoss, DDPGLoss

from torchrl_l2c2 import ASAPLoss, CAPSLoss, CATSLoss, L2C2Loss
from torchrl_l2c2.experiment import (
    AdamConfig,
    Experiment,
    ExperimentConfig,
    L2C2Config,
    PPORPEConfig,
    TaskConfig,
    UniformReplayConfig,
)
from torchrl_l2c2.experiment.settings.fields import SettingError
from torchrl_l2c2.objectives.tchebycheff import (
    TchebycheffLoss,
    smooth_tchebycheff,
    tchebycheff_shares,
)

pytestmark = pytest.mark.filterwarnings("ignore")

VALUES, IDEAL = torch.tensor([3.0, 1.5]), (1.0, -1.0)  # 2 and 2.5 above what is hoped for


class TestByHand:
    def test_the_value(self):
        """With mu = 1/2: ln(e^4 + e^5) / 2."""
        expected = 0.5 * math.log(math.exp(4.0) + math.exp(5.0))
        assert smooth_tchebycheff(VALUES, IDEAL, 0.5).item() == pytest.approx(expected)

    def test_a_small_mu_gives_the_maximum(self):
        """And all of the weight to it; no overflow."""
        assert smooth_tchebycheff(VALUES, IDEAL, 1e-4).item() == pytest.approx(2.5)
        assert tchebycheff_shares(VALUES, IDEAL, 1e-4).tolist() == [0.0, 1.0]

    def test_a_large_mu_gives_the_mean_and_a_constant(self):
        """(2 + 2.5) / 2 + mu ln 2."""
        values = VALUES.double()
        found = smooth_tchebycheff(values, IDEAL, 1e4).item() - 1e4 * math.log(2.0)
        assert found == pytest.approx(2.25, abs=1e-4)
        assert tchebycheff_shares(values, IDEAL, 1e4).tolist() == pytest.approx(
            [0.5, 0.5], abs=1e-4
        )

    def test_the_shares_are_the_derivative(self):
        """1 / (1 + e) and the rest, for a difference of mu."""
        values = VALUES.clone().requires_grad_()
        (found,) = torch.autograd.grad(smooth_tchebycheff(values, IDEAL, 0.5), values)
        torch.testing.assert_close(found, tchebycheff_shares(VALUES, IDEAL, 0.5))
        assert found[0].item() == pytest.approx(1.0 / (1.0 + math.e))


def cats(gain=3.0):
    torch.manual_seed(0)
    return CATSLoss(DDPGLoss(deterministic_actor(), qvalue()), gain)


def unread():
    loss = cats()
    loss.select_out_keys("loss_actor", "loss_value")
    return loss


def gradient(loss, value):
    return torch.autograd.grad(value, list(loss.parameters()), allow_unused=True)


def total(terms):
    return sum(value for key, value in terms.items() if key.startswith("loss_"))


class TestAroundALoss:
    def test_the_policy_descends_the_smooth_maximum(self):
        """The gradient of g(f1, f2) through the plain terms; values are trained as before."""
        plain, batch, ideal = cats(), transitions(8), (-0.3, 0.1)
        terms = plain(batch.copy())
        values = torch.stack((terms["loss_actor"], terms["loss_cats"]))
        expected = smooth_tchebycheff(values, ideal, 0.2) + terms["loss_value"]
        loss = TchebycheffLoss(plain, 0.2, ideal)
        found = loss(batch.copy())
        for ours, theirs in zip(
            gradient(loss, total(found)), gradient(plain, expected), strict=True
        ):
            torch.testing.assert_close(ours, theirs)
        assert found["loss_value"].equal(terms["loss_value"])
        assert found["tchebycheff"].item() == pytest.approx(
            smooth_tchebycheff(values, ideal, 0.2).item()
        )
        assert not found["tchebycheff_share"].requires_grad

    def test_the_rougher_the_policy_the_more_it_counts(self):
        """By the share in the log, which the gain moves; with a small mu it is all or nothing."""
        loss, batch = TchebycheffLoss(cats(), 0.5), transitions(8)
        shares = []
        for gain in (0.0, 1.0, 10.0, 1e4):
            loss.cats_lambda_temporal = gain
            shares.append(loss(batch.copy())["tchebycheff_share"].item())
        assert shares == sorted(shares) and shares[-1] == 1.0
        assert loss(batch.copy())["loss_actor"].item() == 0.0

    def test_of_ppo_the_entropy_is_a_part_of_the_objective(self):
        """Both get the share that the regularizer leaves."""
        torch.manual_seed(0)
        base = L2C2Loss(ClipPPOLoss(gaussian_actor(), None, critic_coeff=None))
        loss, batch = TchebycheffLoss(base, 0.1, (-1.0, 0.0)), on_policy(8)
        batch["advantage"] = torch.randn(8, 1)
        torch.manual_seed(1)
        plain = base(batch.copy())
        torch.manual_seed(1)
        found = loss(batch.copy())
        rest = 1.0 - found["tchebycheff_share"]
        for key in ("loss_objective", "loss_entropy"):
            torch.testing.assert_close(found[key], rest * plain[key])

    def test_it_stays_a_loss(self):
        """Copies give the same, and the state's keys are the plain loss's."""
        loss, batch = TchebycheffLoss(cats(), 0.2), transitions(4)
        assert isinstance(loss, CATSLoss) and list(loss.state_dict()) == list(cats().state_dict())
        expected = loss(batch.copy())["tchebycheff"]
        assert copy.deepcopy(loss)(batch.copy())["tchebycheff"].equal(expected)

    def test_it_compiles_into_one_graph(self):
        """Around PPO's loss without values, the quickest to compile."""
        torch._dynamo.reset()
        torch.manual_seed(0)
        base = ClipPPOLoss(gaussian_actor(), None, entropy_bonus=False, critic_coeff=None)
        loss, batch = TchebycheffLoss(CATSLoss(base, 3.0), 0.2), on_policy(4)
        batch["advantage"] = torch.randn(4, 1)
        expected = loss(batch.copy())["tchebycheff"]
        compiled = torch.compile(loss, fullgraph=True, backend="eager")
        torch.testing.assert_close(compiled(batch.copy())["tchebycheff"], expected)

    def test_a_regularizer_around_it_leaves_it_as_it_was(self):
        """The term of the one outside is added; the shares are those without it."""
        torch.manual_seed(0)
        inner = TchebycheffLoss(CAPSLoss(DDPGLoss(deterministic_actor(), qvalue())), 0.2)
        outer, batch = CATSLoss(inner, 3.0), transitions(8)
        torch.manual_seed(1)  # CAPS draws the states that it compares
        plain = inner(batch.copy())
        torch.manual_seed(1)
        found = outer(batch.copy())
        assert set(outer.out_keys) <= set(found.keys())
        for key in plain.keys():
            torch.testing.assert_close(found[key], plain[key])
        assert found["loss_cats"] > 0 and found["tchebycheff_share"] > 0

    def test_keys_that_are_set_on_it_are_its_own(self):
        """The loss that it was put around goes on reading what it did."""
        inner, batch = L2C2Loss(DDPGLoss(deterministic_actor(), qvalue())), transitions(4)
        torch.manual_seed(1)
        expected = inner.value_regularizer(batch.copy())["loss_l2c2_value"]
        TchebycheffLoss(inner, 0.2).set_keys(state_action_value="another")
        torch.manual_seed(1)
        assert inner.value_regularizer(batch.copy())["loss_l2c2_value"] == expected

    def test_a_network_of_the_regularizers_own_is_not_the_policys(self):
        """The predictor of ASAP is trained as it was, whatever the policy's share."""
        torch.manual_seed(0)
        base = ASAPLoss(DDPGLoss(deterministic_actor(), qvalue()), previous_key="before")
        batch = transitions(8)
        batch["before"] = torch.randn_like(batch["observation"])
        terms, found = base(batch.copy()), TchebycheffLoss(base, 0.2)(batch.copy())
        assert found["loss_asap_temporal"].equal(terms["loss_asap_temporal"])
        of_policy = terms["loss_asap_spatial"] + terms["loss_grad_caps"]
        share = torch.softmax(torch.stack([terms["loss_actor"], of_policy]) / 0.2, 0)[1]
        torch.testing.assert_close(found["tchebycheff_share"], share.detach())

    @pytest.mark.parametrize(
        ("make", "error", "message"),
        [
            (
                lambda: TchebycheffLoss(DDPGLoss(deterministic_actor(), qvalue())),
                TypeError,
                "DDPGLoss has none among its out_keys: put L2C2Loss",
            ),
            (lambda: TchebycheffLoss(cats(), 0.0), ValueError, "mu must be finite and greater"),
            (lambda: TchebycheffLoss(cats(), ideal=0.0), TypeError, "ideal must be two numbers"),
            (lambda: TchebycheffLoss(cats(), ideal=(0.0,)), TypeError, "ideal must be two numbers"),
            (
                lambda: TchebycheffLoss(cats(), objectives="loss_pi"),
                ValueError,
                r"objectives must name .*'loss_actor'.* got \['loss_pi'\]",
            ),
            (
                lambda: TchebycheffLoss(cats(), objectives=("loss_actor", "loss_cats")),
                ValueError,
                "which are the loss's own, got .*loss_cats",
            ),
            *(
                (
                    lambda names=names: TchebycheffLoss(cats(), objectives=names),
                    ValueError,
                    r"must name what trains the policy among \['loss_actor', 'loss_value'\], which",
                )
                for names in ("pred_value", ["loss_actor", "typo"])  # a diagnostic; and no entry
            ),
            (
                lambda: TchebycheffLoss(cats(), ideal=(math.nan, 0.0)),
                ValueError,
                r"ideal\[0\] must be finite, got nan",
            ),
            (lambda: TchebycheffLoss(unread()), TypeError, "has none among its out_keys"),
            (
                lambda: TchebycheffLoss(
                    CATSLoss(DDPGLoss(deterministic_actor(), qvalue(), reduction="none"))
                )(transitions(4)),
                ValueError,
                "make the loss with reduction='mean'",
            ),
        ],
    )
    def test_what_cannot_be_is_refused(self, make, error, message):
        """With what to do."""
        with pytest.raises(error, match=message):
            make()


class TestInARun:
    def test_a_run_logs_the_share(self):
        """All of it, where the objective is far better than was hoped for."""
        regularizer = L2C2Config(tchebycheff_mu=0.1, tchebycheff_ideal=1e3)
        config = ExperimentConfig(
            task=TaskConfig("pendulum", "Pendulum-v1", episodes=2, max_steps=40),
            algorithm=PPORPEConfig(hidden=(8,), replay_ratio=1.0),
            regularizer=regularizer,
            replay=UniformReplayConfig(batch_size=8),
            optimizer=AdamConfig(),
            compile=False,
        )
        row = Experiment(config).train()[-1]
        assert row["tchebycheff_share"] == 1.0 and row["loss_actor"] == 0.0

    def test_the_ideal_is_of_the_scalarization(self):
        """Alone it would do nothing."""
        with pytest.raises(SettingError, match="tchebycheff_ideal works only with tchebycheff_mu"):
            L2C2Config(tchebycheff_ideal=1.0)
