"""studies.filters: low-pass filters, noise and delay at deployment; and the action-rate penalty."""

import csv

import gymnasium
import numpy as np
import pytest

from studies import deployments
from studies.files import ROOT
from studies.filters import COLUMNS, CONDITIONS, main, play
from torchrl_l2c2.experiment import Experiment, ExperimentConfig, PPORPEConfig, TaskConfig
from torchrl_l2c2.experiment.analysis.reports import FinishedRun
from torchrl_l2c2.experiment.envs.environments import ActionRatePenalty
from torchrl_l2c2.experiment.errors import UserError
from torchrl_l2c2.experiment.settings.regularizers import REGULARIZERS


def flipping():
    """A policy that flips from 2 to -2 and back."""
    sign = -1.0

    def act(observation):
        nonlocal sign
        sign = -sign
        return np.array([2.0 * sign], np.float32)

    return act


def played(**options):
    env = gymnasium.make("Pendulum-v1", max_episode_steps=4)
    return play(env, flipping(), 0, **options)


def test_the_filter_moves_towards_the_action_by_its_weight():
    """By hand: 2, then half of the way to -2, 2, -2."""
    assert played(weight=0.5)[1].flatten().tolist() == [2.0, 0.0, 1.0, -0.5]
    assert played()[1].flatten().tolist() == [2.0, -2.0, 2.0, -2.0]


def test_a_delay_applies_the_action_of_the_step_before():
    assert played(delay=True)[1].flatten().tolist() == [2.0, 2.0, -2.0, 2.0]


def test_noise_reaches_the_policy_and_not_the_state():
    """The policy observes other numbers; the episode of a policy that ignores them is the same."""
    env, seen = gymnasium.make("Pendulum-v1", max_episode_steps=4), []

    def act(observation):
        seen.append(observation)
        return np.zeros(1, np.float32)

    _, _, states = play(env, act, 0)
    _, _, same = play(env, act, 0, noise=np.array([0.0, 0.0, 1.0]))
    assert np.array_equal(states, same)
    clean, noisy = np.stack(seen[:4]), np.stack(seen[4:])
    assert np.array_equal(clean[:, :2], noisy[:, :2]) and (clean[:, 2] != noisy[:, 2]).all()


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A baseline, one with an action-rate penalty, and L2C2; without updates to speak of."""
    folder = tmp_path_factory.mktemp("runs")
    for name, action_rate in (("none", 0.0), ("none", 5.0), ("l2c2", 0.0)):
        task = TaskConfig(
            "pendulum", "Pendulum-v1", episodes=1, max_steps=20, action_rate=action_rate
        )
        config = ExperimentConfig(
            task=task,
            algorithm=PPORPEConfig(replay_ratio=1.0),
            regularizer=REGULARIZERS[name],
            compile=False,
            test_episodes=1,
        )
        experiment = Experiment(config, folder / f"{name}_{action_rate:g}")
        experiment.train()
        experiment.finish(experiment.test())
        experiment.close()
    return folder


def test_every_deployment_of_every_run_is_a_line_once(runs, tmp_path, monkeypatch):
    """The baseline has three filters, L2C2 one; started again, nothing is played twice."""
    monkeypatch.setattr("studies.filters.EPISODES", 1)
    main(runs, tmp_path / "filters.csv")
    with (tmp_path / "filters.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == COLUMNS and len(rows) == (4 + 1 + 2) * len(CONDITIONS)
    assert all(np.isfinite(float(row["return"])) for row in rows)
    main(runs, tmp_path / "filters.csv")
    assert len((tmp_path / "filters.csv").read_text().splitlines()) == len(rows) + 1


def test_only_training_has_the_action_rate_penalty(runs):
    """Without updates, both policies are the same: their tests agree, their training does not."""
    first, other = (FinishedRun.read(runs / name) for name in ("none_0", "none_5"))
    assert first.evaluation["episodes"] == other.evaluation["episodes"]
    assert first.column("return")[0] > other.column("return")[0] + 0.01
    free = gymnasium.make("Pendulum-v1")
    free.action_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    with pytest.raises(UserError, match=r"Expected bounded actions with task\.action_rate=1"):
        ActionRatePenalty(free, 1.0)


@pytest.fixture
def recorded(tmp_path):
    """Two seeds of the baseline, of it with a filter, and of L2C2, in every condition."""
    lines = [",".join(COLUMNS)]
    for condition in CONDITIONS:
        for seed in (0, 1):
            for name, total in (("none,0,{},", -100), ("none,0,{},0.1", -300), ("l2c2,0,{},", -90)):
                values = f"{total - 10 * seed},{0.04 + 0.02 * seed},0.01,abc"
                lines.append(f"pendulum,{name.format(seed)},{condition},{values}")
    path = tmp_path / "filters.csv"
    path.write_text("\n".join(lines))
    return deployments.read(path)


def test_the_table_compares_each_deployment_with_the_baseline(recorded):
    """Means by hand; L2C2's returns -90 and -100 win 3.5 of 4 pairs."""
    shown = recorded[recorded["condition"] == "noise"]
    rows = [
        [cell.strip() for cell in line.split("|")[1:-1]]
        for line in deployments.table(shown).splitlines()[2:]
    ]
    assert [row[:2] for row in rows] == [
        ["baseline", "0, 1"],
        ["baseline, filter 0.1", "0, 1"],
        ["L2C2", "0, 1"],
    ]
    assert [row[2].split()[0] for row in rows] == ["-105.0", "-305.0", "-95.0"]
    assert [row[3].split(" ")[0] for row in rows] == ["", "0.00", "0.88"]
    assert [row[5].split(" ")[0] for row in rows] == ["", "0.50", "0.50"]
    assert deployments.tables(recorded).count("## pendulum, ") == len(CONDITIONS)


def test_a_line_of_another_comparison_is_refused(recorded, tmp_path):
    """One that no row of the table would show."""
    recorded.assign(method="caps")[COLUMNS].to_csv(tmp_path / "other.csv")
    with pytest.raises(KeyError, match="caps"):
        deployments.read(tmp_path / "other.csv")


def test_the_picture_has_a_panel_for_each_condition(recorded, tmp_path):
    """And the same bytes every time."""
    for name in ("a.svg", "b.svg"):
        deployments.draw(recorded, tmp_path / name)
    text = (tmp_path / "a.svg").read_text()
    assert text == (tmp_path / "b.svg").read_text()
    assert text.count('id="axes_') == len(CONDITIONS)


def test_page_and_picture_are_of_the_records():
    """The tables, the picture, and the numbers of the first sentences."""
    found = deployments.read(deployments.PAGE.with_suffix(".csv"))
    page = deployments.PAGE.read_text()
    assert deployments.tables(found) in page
    page = " ".join(page.split())
    means = found.groupby(["task", "condition", "deployment"])[
        ["return", "action_variation"]
    ].mean()
    (plain, late, filtered, noisy, rewarded, ours) = (
        means.loc["pendulum", condition, name]
        for condition, name in (
            ("noise", "baseline"),
            ("delay", "baseline"),
            ("delay", "baseline, filter 0.1"),
            ("noise", "baseline, filter 0.1"),
            ("noise", "action-rate reward 0.1"),
            ("noise", "L2C2"),
        )
    )
    assert f"from {late['return']:.0f} to {filtered['return']:.0f}" in page
    assert f"lowers the return by {rewarded['return'] / plain['return'] - 1:.0%}" in page
    assert f"{noisy['return'] / plain['return'] - 1:.0%} below the baseline's" in page
    assert ours["action_variation"] < 0.5 * plain["action_variation"]
    hopper, noisy = means.loc["hopper_v5", "as trained"], means.loc["hopper_v5", "noise"]
    walker, walker_noisy = (means.loc["walker2d_v5", each] for each in ("as trained", "noise"))
    returns = [
        task.loc[name, "return"]
        for task in (hopper, walker)
        for name in ("baseline", "baseline, filter 0.1")
    ]
    said = "most of their return ({:.0f} to {:.0f}, and {:.0f} to {:.0f})"
    assert said.format(*returns) in page

    def lowered(condition, name):
        variation = means.loc["walker2d_v5", condition]["action_variation"]
        return f"{1 - variation[name] / variation['baseline']:.0%}"

    ours = lowered("as trained", "L2C2"), lowered("noise", "L2C2")
    said = "on Walker2d the actions vary {} less than the baseline's, and with sensor noise {} less"
    assert said.format(*ours) in page
    rewarded = [lowered(each, "action-rate reward 0.1") for each in ("as trained", "delay")]
    assert f"Walker2d by only {rewarded[0]}, where L2C2 reaches {ours[0]}, and" in page
    assert "as trained and with a delay, by {} and {}, and".format(*rewarded) in page
    plain, large, smooth = (walker.loc[n] for n in ("baseline", "action-rate reward 1", "L2C2"))
    said = "(action variation {:.3f} and {:.3f}), at {:.0%} less return"
    lost = 1 - large["return"] / plain["return"]
    assert said.format(large["action_variation"], smooth["action_variation"], lost) in page
    returns = means.loc[:, "as trained", :]["return"].unstack("deployment")
    lost = returns["baseline"] - returns["action-rate reward 1"]
    assert (lost > 0.5 * returns["baseline"].abs()).all()
    weak = walker_noisy.loc["baseline, filter 0.3"] / walker_noisy.loc["L2C2"]
    assert f"on Hopper, and {weak['action_variation']:.1f} times on Walker2d" in page
    less, noisy_less = (1 - each.loc["L2C2"] / each.loc["baseline"] for each in (hopper, noisy))
    variation = "vary {:.0%} less than the baseline's, and with sensor noise {:.0%} less"
    assert variation.format(less["action_variation"], noisy_less["action_variation"]) in page
    assert f"at {less['return']:.0%} and {noisy_less['return']:.0%} lower returns" in page
    rough = [noisy.loc[n, "action_variation"] for n in ("L2C2", "CATS", "action-rate reward 0.1")]
    assert "(means {:.3f}, {:.3f} and {:.3f})".format(*rough) in page
    weak = noisy.loc["baseline, filter 0.3", "action_variation"]
    assert weak / rough[0] == pytest.approx(2.0, abs=0.1)
    robots = " ".join((ROOT / "docs" / "robots.md").read_text().split())
    assert f"by {less['action_variation']:.0%} and {ours[0]} at a return" in robots
    lander = means.loc["lunarlander", "as trained"]
    filtered, baseline = lander.loc["baseline, filter 0.1"], lander.loc["baseline"]
    assert 0.6 < filtered["action_variation"] / baseline["action_variation"] < 0.7
    assert filtered["return"] > baseline["return"]
    for rougher in ("L2C2", "action-rate reward 0.1", "action-rate reward 1"):
        assert lander.loc[rougher, "action_variation"] > baseline["action_variation"]


def test_the_readmes_picture_is_of_the_median_baseline():
    """Of Walker2d as trained, by action variation; its caption has the recorded returns."""
    found = deployments.read(deployments.PAGE.with_suffix(".csv"))
    found = found[(found["task"] == "walker2d_v5") & (found["condition"] == "as trained")]
    runs = {
        name: found[found["deployment"] == name].set_index("seed") for name in ("baseline", "L2C2")
    }
    variation = runs["baseline"]["action_variation"]
    (seed,) = variation.index[variation == variation.median()]
    own, means = ([run["return"][each] for run in runs.values()] for each in (seed, range(5)))
    readme = " ".join((ROOT / "README.md").read_text().split())
    assert "Over ten episodes PPO returns {:.0f}, and with L2C2 {:.0f}".format(*own) in readme
    assert "the mean returns are {:.0f} and {:.0f}".format(*(m.mean() for m in means)) in readme
    page = " ".join((ROOT / "docs" / "results.md").read_text().split())
    assert f"Walker2d with PPO, seed {seed}, commit" in page
    smooth = runs["L2C2"]["action_variation"][seed]
    assert f"{variation[seed]:.3f} over 10 test episodes. L2C2 has {smooth:.3f} with" in page
