"""Gains that set themselves: by hand, in closed loops, and in a run that is continued."""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
import statistics
import warnings
from copy import deepcopy

import pytest
import torch
from losses import CASES
from small import ALGORITHMS

from torchrl_l2c2 import (
    CAPSLoss,
    L2C2Loss,
    Neighborhood,
    NeighborTransform,
    PPORPELoss,
    make_actor,
    make_critic,
)
from torchrl_l2c2.experiment import (
    AdamConfig,
    CAPSConfig,
    DQNConfig,
    Experiment,
    ExperimentConfig,
    L2C2Config,
    PPOConfig,
    PPORPEConfig,
    RolloutReplayConfig,
    SACConfig,
    TaskConfig,
    TD3Config,
    UniformReplayConfig,
)
from torchrl_l2c2.experiment.settings import SettingError
from torchrl_l2c2.gains import (
    ConstantGain,
    GradientGain,
    RampGain,
    TargetGain,
    gradient_shares,
)


class TestByHand:
    def test_a_constant_stays(self):
        """Whatever is measured."""
        gain = ConstantGain(2.0)
        assert [gain.step(), gain.step(7.0)] == [2.0, 2.0]

    @pytest.mark.parametrize("make", [RampGain, GradientGain, TargetGain])
    def test_what_was_measured_may_be_a_tensor(self, make):
        """Of one number; gain and state are plain numbers, as a file has them."""
        gain, like = (make(2.0) for _ in range(2))
        assert gain.step(torch.tensor([0.5])) == like.step(0.5)
        assert all(type(value) in (int, float) for value in gain.state_dict().values())
        with pytest.raises(TypeError, match=r"measured must be a single number, .*\(2,\)"):
            gain.step(torch.ones(2))
        assert gain.state_dict() == like.state_dict()

    def test_a_ramp_rises_linearly_and_stays_at_its_end(self):
        """Half of 3 where a quarter of training is over and it is to rise over half."""
        ramp = RampGain(3.0, length=0.5)
        assert ramp.value == 0.0
        assert [ramp.step(k) for k in (0.0, 0.25, 0.5, 1.0, 1.1)] == [0.0, 1.5, 3.0, 3.0, 3.0]

    def test_the_first_measurement_of_a_gradient_sets_the_gain(self):
        """A share of 5e-6 at the gain 1 is .1 at 20 thousand, whatever the rate."""
        assert GradientGain(0.1, rate=0.1).step(5e-6) == pytest.approx(2e4)

    def test_cloning_that_takes_the_actors_place_is_none_of_its_gradient(self):
        """CQL's two terms of the policy are descended one after the other, and never summed."""
        torch.manual_seed(0)
        case = next(case for case in CASES if case.name == "CQL")
        loss, batch = L2C2Loss(case.make(), Neighborhood()), case.batch(8)
        batch = NeighborTransform(Neighborhood())(batch)
        with torch.random.fork_rng():
            terms = loss(batch.copy())
        parameters = list(loss.actor_network_params.values(True, True))
        norms = {}
        for key in ("loss_actor", "loss_l2c2_actor"):
            gradients = torch.autograd.grad(terms[key], parameters, retain_graph=True)
            norms[key] = torch.cat([g.flatten() for g in gradients]).norm().item()
        share = gradient_shares(loss, batch)["loss_l2c2_actor"]
        assert share == pytest.approx(norms["loss_l2c2_actor"] / norms["loss_actor"], rel=1e-4)

    def test_measuring_changes_nothing(self):
        """Neither the loss, which keeps a threshold, nor the batch, nor the global generator."""
        torch.manual_seed(0)
        loss = CAPSLoss(PPORPELoss(make_actor(3, 1), make_critic(3)))
        batch = next(case for case in CASES if case.name == "PPO").batch(8)
        batch = batch.select("observation", "next").set("action", torch.zeros(8, 1))
        batch.set("action_log_prob", torch.full((8,), -3.0))
        seen, kept, state = batch.clone(), deepcopy(loss.state_dict()), torch.get_rng_state()
        assert gradient_shares(loss, batch)["loss_caps_spatial"] > 0.0
        assert torch.get_rng_state().equal(state)
        assert all(value.equal(kept[name]) for name, value in loss.state_dict().items())
        assert set(batch.keys(True, True)) == set(seen.keys(True, True))
        assert (batch == seen).all()

    def test_a_gradients_share_is_met_at_once_with_rate_1(self):
        """Also by later measurements: .02 at the gain 3 is .1 at 15."""
        gain = GradientGain(0.1, rate=1.0)
        gain.step(0.1 / 3.0)
        assert gain.step(0.02) == pytest.approx(15.0)

    def test_gradients_are_averaged_on_the_logarithm(self):
        """Shares per gain of .1 * 4^-n: their geometric mean, then a moving one of the rate 1/4."""
        gain, units = GradientGain(0.1, rate=0.25), [0.05, 0.2, 0.4, 0.1, 0.8, 0.05]
        wanted, value = [math.log(0.1 / unit) for unit in units], 1.0
        for k, unit in enumerate(units):
            value = gain.step(value * unit)
            if k < 4:
                expected = sum(wanted[: k + 1]) / (k + 1)
            else:
                expected = 0.75 * expected + 0.25 * wanted[k]
            assert math.log(value) == pytest.approx(expected)

    @pytest.mark.parametrize("share", [0.0, math.inf, math.nan])
    def test_a_share_that_says_nothing_changes_nothing(self, share):
        """Where one of the gradients vanishes."""
        assert GradientGain(0.1, value=3.0).step(share) == 3.0

    def test_dual_ascent(self):
        """exp(rate * relative excess); no step is larger than the rate; nan changes nothing."""
        gain = TargetGain(2.0, rate=0.5)
        assert gain.step(3.0) == pytest.approx(math.exp(0.25))
        assert gain.step(100.0) == pytest.approx(math.exp(0.75))
        assert gain.step(0.0) == pytest.approx(math.exp(0.25))
        assert gain.step(math.nan) == pytest.approx(math.exp(0.25))

    def test_the_gain_stays_within_its_bounds(self):
        """8 times the first value and an eighth of it."""
        gain = TargetGain(1.0, 1.0, limit=8.0, value=2.0)
        assert [gain.step(1e9) for _ in range(9)][-1] == 16.0
        assert [gain.step(1e-9) for _ in range(9)][-1] == 0.25

    def test_a_gradients_gain_stays_within_bounds_around_the_first_that_was_measured(self):
        """8 times 500 and an eighth of it, where the first share was .002 at the gain 1."""
        gain = GradientGain(1.0, 1.0, limit=8.0)
        gain.step(0.002)
        again = GradientGain(1.0, 1.0, limit=8.0)
        again.load_state_dict(gain.state_dict())
        assert again.step(1e-9) == pytest.approx(4000.0)
        assert again.step(1e9) == pytest.approx(62.5)

    def test_dual_ascent_finds_the_gain_that_meets_the_target(self):
        """Of a measure 1 / (1 + gain), which is 1/4 at the gain 3."""
        gain = TargetGain(0.25, rate=0.1)
        for _ in range(300):
            gain.step(1.0 / (1.0 + gain.value))
        assert gain.value == pytest.approx(3.0, rel=1e-3)

    @pytest.mark.parametrize(
        "make", [lambda: RampGain(), lambda: GradientGain(0.1), lambda: TargetGain(0.1)]
    )
    def test_a_restored_gain_goes_on_as_the_other(self, make):
        """From its state_dict."""
        gain, again = make(), make()
        gain.step(0.7)
        again.load_state_dict(gain.state_dict())
        assert again.value == gain.value != make().value
        assert again.step(0.9) == gain.step(0.9)

    def test_a_state_of_another_kind_changes_nothing(self):
        """The value is not half of the other's."""
        gain = GradientGain(0.1)
        with pytest.raises(ValueError, match=r"GradientGain has .*another kind"):
            gain.load_state_dict(TargetGain(0.1, value=3.0).state_dict())
        assert gain.value == 1.0

    @pytest.mark.parametrize("make", [lambda: GradientGain(0.1), lambda: TargetGain(0.1)])
    @pytest.mark.parametrize("measured", ["a", None, True])
    def test_what_is_measured_is_a_number(self, make, measured):
        """Which may be NaN, and then says nothing."""
        with pytest.raises(TypeError, match="measured must be a real number, got"):
            make().step(measured)

    @pytest.mark.parametrize(
        ("make", "message"),
        [
            (lambda: ConstantGain(-1.0), "value must be finite and at least 0, got -1"),
            (lambda: RampGain().step(512), r"measured must be in \[0, 2\].* It is a share of tr"),
            (lambda: RampGain(length=0.0), r"length must be in \(0, 1\], got 0"),
            (lambda: GradientGain(0.0), "share must be finite and greater than 0, got 0"),
            (lambda: TargetGain(-0.1), "target must be finite and greater than 0"),
            (lambda: TargetGain(0.1, rate=2.0), r"rate must be in \(0, 1\], got 2"),
            (lambda: GradientGain(0.1, limit=1.0), "limit must be finite and greater than 1"),
        ],
    )
    def test_wrong_settings_are_refused(self, make, message):
        """With what is allowed."""
        with pytest.raises(ValueError, match=message):
            make()


TASK = TaskConfig("pendulum", "Pendulum-v1", episodes=6, max_steps=40)
FEW_UPDATES = dataclasses.replace(ALGORITHMS["ppo_rpe"], replay_ratio=1.0)
KINDS = {
    "ramp": {"gain": "ramp"},
    "gradient": {"gain": "gradient", "gain_target": 0.3},
    "target": {"gain": "target", "gain_target": 0.05, "gain_of": "l2c2_hellinger"},
}


def small(regularizer=None, **settings):
    return ExperimentConfig(
        **{
            "task": TASK,
            "algorithm": FEW_UPDATES,
            "regularizer": regularizer or L2C2Config(),
            "replay": UniformReplayConfig(batch_size=8),
            "optimizer": AdamConfig(),
            "compile": False,
            "checkpoint_interval": 0.0,
            **settings,
        }
    )


def timeless(metrics):
    """What does not depend on the clock, as text: nan is nan."""
    return [str({k: v for k, v in row.items() if "per_second" not in k}) for row in metrics]


def assert_continues(config, folder, parted, episodes):
    """A run that is interrupted after some episodes has the whole one's numbers and gains."""
    whole = Experiment(config, folder / "whole")
    whole.train(episodes)
    first = Experiment(config, folder / "parts")
    first.train(parted)
    first.close()
    second = Experiment(config, folder / "parts")
    assert 0 < len(second.metrics) < episodes
    second.train(episodes)
    assert timeless(second.metrics) == timeless(whole.metrics)
    state, expected = second.agent.loss.state_dict(), whole.agent.loss.state_dict()
    assert all((state[name] == value).all() for name, value in expected.items())
    first, last = whole.metrics[0], whole.metrics[-1]
    assert any(first[name] != last[name] for name in first if name.startswith("gain"))


class TestInARun:
    def test_a_constant_gain_adds_nothing_to_the_log(self):
        """Nor do other settings of the gain count then."""
        rows = Experiment(small()).train(1)
        assert not [name for name in rows[0] if name.startswith("gain")]

    def test_a_ramp_follows_the_training_that_was_asked_for(self):
        """0 in the first of six episodes, 5/6 in the last; and the loss has it."""
        run = Experiment(small(L2C2Config(**KINDS["ramp"])))
        rows = run.train(3) and run.train()
        assert [row["gain"] for row in rows] == pytest.approx([k / 6 for k in range(6)])
        assert rows[0]["loss_l2c2_actor"] == 0.0 < rows[-1]["loss_l2c2_actor"]
        assert run.agent.loss.l2c2_coeff == 1.0

    def test_a_longer_training_has_a_longer_ramp_and_its_own_rates(self):
        """Of twelve episodes instead of six; one that had ended begins at a rate above 0."""
        settings = {"optimizer": AdamConfig(linear=True)}
        run = Experiment(small(L2C2Config(**KINDS["ramp"]), **settings))
        rows = run.train(12)
        assert [row["gain"] for row in rows] == pytest.approx([k / 12 for k in range(12)])
        before = [parameter.clone() for parameter in run.agent.loss.parameters()]
        run.train(13)
        after = run.agent.loss.parameters()
        assert not all(torch.equal(a, b) for a, b in zip(after, before, strict=True))

    def test_a_target_is_approached_from_above(self):
        """An action variation far above it lets the gain rise by its rate in every episode."""
        settings = {"gain": "target", "gain_target": 1e-9, "gain_rate": 0.5}
        run = Experiment(small(L2C2Config(**settings)))
        rows = run.train()
        assert [row["gain"] for row in rows] == pytest.approx([math.exp(k / 2) for k in range(6)])
        assert [row["gain_measured"] for row in rows] == [row["action_variation"] for row in rows]
        assert rows[0]["gain_target"] == 1e-9
        assert run.agent.loss.l2c2_coeff.item() == pytest.approx(math.exp(3.0))
        assert run.agent.loss.l2c2_beta.item() == pytest.approx(0.1)

    def test_each_network_gets_its_share_of_the_gradient(self):
        """With rate 1, the next measurement on the same batch gives it for policy and values."""
        regularizer = L2C2Config(gain="gradient", gain_target=0.3, gain_rate=1.0, gain_limit=1e6)
        run = Experiment(small(regularizer))
        rows = run.train()
        shares = gradient_shares(run.agent.loss, run.learner.update.example())
        assert shares["loss_l2c2_actor"] == pytest.approx(0.3, rel=1e-4)
        assert shares["loss_l2c2_critic"] == pytest.approx(0.3, rel=1e-4)
        assert rows[-1]["gain_policy"] != pytest.approx(rows[-1]["gain_value"])

    def test_shares_are_measured_where_no_gradients_are_kept(self):
        """As between updates; terms that are not single numbers are refused."""
        run = Experiment(small())
        run.train()
        batch = run.learner.example()
        expected = gradient_shares(run.agent.loss, batch)
        with torch.no_grad():
            assert gradient_shares(run.agent.loss, batch) == expected
        run.agent.loss.reduction = "none"
        with pytest.raises(ValueError, match="make the loss with reduction='mean'"):
            gradient_shares(run.agent.loss, batch)

    def test_several_terms_of_a_network_share_their_gain(self):
        """CAPS has two of the policy: the larger counts, and neither changes beside the other."""
        run = Experiment(small(CAPSConfig(gain="gradient", gain_target=0.3, gain_rate=1.0)))
        rows = run.train()
        loss = run.agent.loss
        assert "gain_value" not in rows[0]
        ratio = loss.caps_lambda_spatial / loss.caps_lambda_temporal
        assert ratio.item() == pytest.approx(5.0)
        assert loss.caps_lambda_temporal.item() != pytest.approx(0.01)

    @pytest.mark.parametrize(
        "kind",
        ["target", *(pytest.param(k, marks=pytest.mark.slow) for k in KINDS if k != "target")],
    )
    def test_a_continued_run_is_the_uninterrupted_one(self, tmp_path, kind):
        """Parameters, gains and metrics, to the last bit."""
        assert_continues(small(L2C2Config(**KINDS[kind]), late_share=0.0), tmp_path, 3, 6)

    @pytest.fixture
    def measured_soon(self, monkeypatch):
        """After 20 updates, not 100, it is told which regularizer is faint."""
        monkeypatch.setattr("torchrl_l2c2.experiment.learner.MEASURED_AFTER", 20)

    @pytest.mark.parametrize("kind", ["constant", "ramp", "target"])
    def test_a_gain_that_does_not_rise_by_itself_is_told_to_be_faint(self, kind, measured_soon):
        """Once measured; a ramp by what it ends with, and goes on from where it is."""
        of_kind = {"gain": kind, **({"gain_target": 0.1} if kind == "target" else {})}
        regularizer = L2C2Config(lambda_min=1e-9, lambda_max=1e-8, **of_kind)
        run = Experiment(small(regularizer, algorithm=PPORPEConfig(hidden=(8,), updates=12)))
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            run.train(2)
        told = [w for w in caught if "regularizer's terms are less" in str(w.message)]
        assert len(told) == (kind != "target")
        if kind == "ramp":
            assert run.agent.loss.l2c2_coeff == run.metrics[-1]["gain_measured"] > 0.0

    def test_what_a_ramp_ends_with_is_looked_at_and_left(self):
        """The loss has the gain of now again, before the next update."""
        run = Experiment(small(L2C2Config(gain="ramp")))
        run.train(1)
        before = run.agent.loss.l2c2_coeff.item()
        with run.learner.at_full_gain():
            assert run.agent.loss.l2c2_coeff.item() == 1.0 > before
        assert run.agent.loss.l2c2_coeff.item() == before

    def test_a_ramp_is_told_by_the_gain_that_it_ends_with(self, measured_soon):
        """Its first updates have none."""
        regularizer = L2C2Config(lambda_min=1.0, lambda_max=100.0, gain="ramp")
        run = Experiment(small(regularizer, algorithm=PPORPEConfig(hidden=(8,), updates=24)))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            run.train(1)

    @pytest.mark.slow
    def test_a_compiled_update_follows_the_gain(self):
        """The term is 0 in the first episode of a ramp and grows with it."""
        run = Experiment(small(L2C2Config(gain="ramp"), compile=True))
        rows = run.train()
        gains = [row["loss_l2c2_actor"] / row["l2c2_hellinger"] for row in rows]
        assert gains[0] == 0.0 and gains == sorted(gains) and gains[-1] > 0

    def test_a_loss_without_a_policy_has_the_gain_of_its_values(self):
        """Q-learning."""
        task = dataclasses.replace(TASK, env_id="CartPole-v1")
        regularizer = L2C2Config(gain="gradient", gain_target=0.3, gain_rate=1.0)
        with pytest.warns(UserWarning, match="leaves out the policy term"):
            run = Experiment(
                small(regularizer, task=task, algorithm=DQNConfig(hidden=(8,), random_frames=10))
            )
        row = run.train()[-1]
        assert "gain_policy" not in row and row["gain_value"] != 1.0
        assert run.agent.loss.l2c2_coeff == 1.0

    def test_before_the_first_update_nothing_is_measured(self):
        """Random frames leave the gain at 1."""
        config = small(
            L2C2Config(**KINDS["gradient"]), algorithm=SACConfig(hidden=(8,), random_frames=90)
        )
        rows = Experiment(config).train(3)
        assert [row["gain_policy"] for row in rows] == [1.0, 1.0, 1.0]
        assert [math.isnan(row["gain_measured_policy"]) for row in rows] == [True, True, False]


ROLLOUTS = {
    "episodes": {"frames": 80},
    "simulators": {"frames": 100, "num_envs": 2},
    "normalized": {
        **{"frames": 100, "num_envs": 2, "clip_actions": True},
        **{"normalize_observations": True, "normalize_rewards": True},
    },
}


# What is normalized is played by simulators as well.
KINDS_OF_ROLLOUTS = ["episodes", pytest.param("simulators", marks=pytest.mark.slow), "normalized"]


def small_ppo(kind="episodes", **settings):
    """A rollout is forgotten before the gain is set, and several episodes end in it."""
    regularizer = L2C2Config(**{**KINDS["gradient"], "policy_distance": "mean", **settings})
    return small(
        regularizer,
        algorithm=PPOConfig(hidden=(8,), epochs=1, **ROLLOUTS[kind]),
        replay=RolloutReplayConfig(batch_size=32),
        late_share=0.0,
    )


class TestRollouts:
    @pytest.mark.parametrize("kind", KINDS_OF_ROLLOUTS)
    def test_the_share_is_measured_on_the_rollout_that_was_learned_from(self, kind, monkeypatch):
        """With rate 1 the next measurement there gives the target."""
        run, kept = Experiment(small_ppo(kind, gain_rate=1.0)), []
        extend = run.learner.replay.extend
        monkeypatch.setattr(run.learner.replay, "extend", lambda t: kept.append(t) or extend(t))
        run.train(2)
        rollout, batch = torch.cat(kept), run.learner.example()
        rows = torch.linspace(0, len(rollout) - 1, 32).long()
        assert len(run.learner.replay) == 0 < run.learner.updates
        assert batch["observation"].equal(rollout["observation"][rows])
        assert batch["advantage"].equal(rollout["advantage"][rows])
        shares = gradient_shares(run.agent.loss, batch)
        assert shares["loss_l2c2_actor"] == pytest.approx(0.3, rel=1e-4)
        assert shares["loss_l2c2_critic"] == pytest.approx(0.3, rel=1e-4)

    @pytest.mark.parametrize("kind", KINDS_OF_ROLLOUTS)
    def test_it_is_measured_with_the_gain_that_was_applied(self, kind):
        """Once for a rollout; with rate 1 every gain follows from the one before and its share."""
        run = Experiment(small_ppo(kind, gain_rate=1.0))
        rows = [row for row in run.train(10) if row["updates"]]
        measured = [row for row in rows if not math.isnan(row["gain_measured_policy"])]
        assert 2 <= len(measured) < len(rows)
        for row, after in itertools.pairwise(measured):
            expected = row["gain_policy"] * 0.3 / row["gain_measured_policy"]
            assert after["gain_policy"] == pytest.approx(expected)
            assert row["updates"] < after["updates"]

    @pytest.mark.parametrize("kind", KINDS_OF_ROLLOUTS)
    def test_a_target_is_of_the_rollout_that_was_learned_from(self, kind):
        """Of all its episodes: a single one is noisy, and the first that ends a short one."""
        of_kind = {"gain": "target", "gain_target": 0.1, "gain_rate": 0.5}
        rows = Experiment(small_ppo(kind, **of_kind)).train(16)
        seen, several = [], 0
        for before, row, after in zip([{"updates": 0}, *rows], rows, rows[1:], strict=False):
            seen.append(row["action_variation"])
            assert row["gain_measured"] == pytest.approx(statistics.fmean(seen))
            # Simulators learn before their episodes are handed out, and single episodes after.
            of_rollout = after if kind != "episodes" else before
            if row["updates"] == of_rollout["updates"]:
                assert after["gain"] == row["gain"]
                continue
            excess = min(row["gain_measured"] / 0.1 - 1.0, 1.0)
            assert after["gain"] == pytest.approx(row["gain"] * math.exp(0.5 * excess))
            several += len(seen) > 1
            seen = []
        assert several

    @pytest.mark.parametrize("gain", ["gradient", "target"])
    @pytest.mark.parametrize("kind", KINDS_OF_ROLLOUTS)
    def test_a_continued_run_is_the_uninterrupted_one(self, tmp_path, kind, gain):
        """To the last bit, wherever in the rollouts it was interrupted."""
        assert_continues(small_ppo(kind, gain=gain), tmp_path, 5, 10)

    def test_the_values_have_a_share_of_their_own(self):
        """A fifth of the policy's, by the log and in the gradients."""
        run = Experiment(small_ppo(gain_rate=1.0, gain_target_value=0.06))
        rows = run.train(2)
        shares = gradient_shares(run.agent.loss, run.learner.example())
        assert shares["loss_l2c2_actor"] == pytest.approx(0.3, rel=1e-4)
        assert shares["loss_l2c2_critic"] == pytest.approx(0.06, rel=1e-4)
        assert rows[-1]["gain_target"] == 0.3 and rows[-1]["gain_target_value"] == 0.06

    def test_the_values_may_have_none(self):
        """From the first update on; the policy has its share."""
        run = Experiment(small_ppo(gain_rate=1.0, gain_target_value=0.0))
        rows = run.train(4)
        assert rows[1]["loss_l2c2_critic"] == rows[3]["loss_l2c2_critic"] == 0.0
        assert rows[3]["gain_value"] == 0.0 < rows[3]["loss_l2c2_actor"]
        shares = gradient_shares(run.agent.loss, run.learner.example())
        assert shares["loss_l2c2_actor"] == pytest.approx(0.3, rel=1e-4)
        assert shares["loss_l2c2_critic"] == 0.0


class TestRefusals:
    @pytest.mark.parametrize(
        ("column", "settings"),
        [
            ("jerk", {}),
            ("test_return", {"late_share": 0.0}),
            ("policy_scale", {"algorithm": TD3Config(hidden=(8,), random_frames=10)}),
        ],
    )
    def test_a_column_without_numbers_is_refused(self, column, settings):
        """Before anything is played, with those that have some."""
        regularizer = L2C2Config(gain="target", gain_target=1.0, gain_of=column)
        told = rf"gain_of must be one of .*'action_variation'.*got '{column}' \(test_\* need a"
        with pytest.raises(SettingError, match=told):
            Experiment(small(regularizer, **settings))

    def test_every_column_that_may_be_followed_is_there(self):
        """Those of a refusal are logged, with numbers from the first update on."""
        with pytest.raises(SettingError) as refused:
            Experiment(small(L2C2Config(gain="target", gain_target=1.0, gain_of="jerk")))
        named = set(re.findall(r"'(\w+)'", str(refused.value))) - {"jerk"}
        row = Experiment(small(late_share=1.0)).train(1)[0]
        assert {"return", "test_return", "loss_l2c2_actor", "policy_scale"} <= named
        assert all(math.isfinite(row[name]) for name in named)

    @pytest.mark.parametrize("column", ["test_return", "return"])
    def test_a_column_that_has_no_fitting_number_yet_is_told_once(self, column):
        """NaN before the policies are late, and returns below 0."""
        run = Experiment(small(L2C2Config(gain="target", gain_target=1.0, gain_of=column)))
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            run.train(3)
        told = [str(w.message) for w in caught if f"gain_of={column} is" in str(w.message)]
        assert len(told) == 1 and "numbers of at least 0" in told[0]

    @pytest.mark.parametrize(
        ("settings", "message"),
        [
            ({"gain": "target"}, "gain_target must be given with gain=target, got null"),
            ({"gain": "gradient"}, "gain_target must be given with gain=gradient"),
            (
                {"gain_target": 0.1},
                "gain_target is of gain=gradient and gain=target alone, got 0.1 .* at null",
            ),
            ({"gain_length": 0.5}, "gain_length is of gain=ramp alone, got 0.5 .* at 1.0"),
            ({"gain": "ramp", "gain_rate": 0.5}, "gain_rate is of gain=gradient and gain=target"),
            ({"gain_limit": 10.0}, "gain_limit is of gain=gradient and gain=target alone"),
            (
                {"gain": "gradient", "gain_target": 0.1, "gain_of": "return"},
                "gain_of is of gain=target alone, got return with gain=gradient",
            ),
            ({"gain": "pid"}, "gain must be 'constant', 'ramp', 'gradient' or 'target'"),
        ],
    )
    def test_settings_that_do_not_go_together_are_refused(self, settings, message):
        """With what would."""
        with pytest.raises(SettingError, match=message):
            L2C2Config(**settings)

    @pytest.mark.parametrize("settings", [{}, {"gain": "gradient", "gain_target": 1.0, "beta": 0}])
    def test_a_share_of_the_values_needs_their_gradient(self, settings):
        """Measured, and there at all."""
        with pytest.raises(SettingError, match="gain_target_value needs gain=gradient and a beta"):
            L2C2Config(gain_target_value=0.1, **settings)
