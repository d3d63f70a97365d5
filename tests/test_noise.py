"""How runs bear noise: by a policy whose actions are known, and by a run's own test."""

from __future__ import annotations

import json

import pytest
import torch
from torchrl.envs import ExplorationType, GymEnv, TransformedEnv, set_exploration_type

from studies.noise import UniformNoise, main, noise_table, play_with_noise
from torchrl_l2c2.experiment import (
    AdamConfig,
    Experiment,
    ExperimentConfig,
    L2C2Config,
    PPOConfig,
    RolloutReplayConfig,
    TaskConfig,
)
from torchrl_l2c2.experiment.analysis.reports import read_runs
from torchrl_l2c2.experiment.run.evaluation import evaluate_policy
from torchrl_l2c2.experiment.run.policies import load_policy


class TestUniformNoise:
    def test_it_fills_a_box_of_half_the_width(self):
        """Bounds and standard deviation, .2 / sqrt(3), of each feature."""
        scale = torch.tensor([0.2, 0.0, 0.4])
        noise = UniformNoise(scale, generator=torch.Generator().manual_seed(0))
        drawn = noise._apply_transform(torch.ones(100_000, 3)) - 1.0
        assert (drawn.abs() <= scale + 1e-6).all() and (drawn.abs().amax(0) >= 0.99 * scale).all()
        torch.testing.assert_close(drawn.std(0), scale / 3**0.5, rtol=0.01, atol=1e-7)

    def test_the_successor_has_the_noise_of_the_next_state(self):
        """As a sensor's."""
        env = TransformedEnv(GymEnv("Pendulum-v1"), UniformNoise(0.3))
        played = env.rollout(5)
        assert played["next", "observation"][:-1].equal(played["observation"][1:])


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two seeds of two methods, hardly trained, on a task with noise of its own."""
    folder = tmp_path_factory.mktemp("runs")
    for beta in (0.0, 0.1):
        for seed in (0, 1):
            make_run(folder / f"{beta}_{seed}", beta, seed)
    return folder


def make_run(folder, beta=0.1, seed=0, max_steps=40):
    config = ExperimentConfig(
        task=TaskConfig("p", "Pendulum-v1", episodes=2, max_steps=max_steps, noise_scale=0.1),
        algorithm=PPOConfig(hidden=(8,), frames=40, epochs=1),
        regularizer=L2C2Config(beta=beta),
        replay=RolloutReplayConfig(batch_size=20),
        optimizer=AdamConfig(),
        compile=False,
        seed=seed,
        late_share=0.0,
    )
    run = Experiment(config, folder)
    run.train()
    run.finish(run.test(3))
    run.close()


@pytest.fixture(scope="module")
def played(runs):
    return play_with_noise(read_runs(runs), [0.0, 0.5, 2.0], episodes=3)


class TestLevels:
    def test_without_noise_a_run_plays_as_in_a_test_of_its_own(self, runs, played):
        """Of a task without noise."""
        for run, summaries in played:
            policy, env, max_steps = load_policy(run.folder, noise_scale=0.0)
            expected = evaluate_policy(policy, env, 3, max_steps=max_steps).summary()
            assert summaries[0.0]["return_mean"] == expected["return_mean"]
            assert summaries[0.0]["sm_asap_mean"] == expected["sm_asap_mean"]

    def test_noise_makes_actions_rougher(self, played):
        """The more, the rougher, in every run."""
        for _, summaries in played:
            roughness = [summaries[level]["sm_asap_mean"] for level in (0.0, 0.5, 2.0)]
            assert roughness == sorted(roughness) and roughness[2] > 2 * roughness[0]

    def test_noise_is_in_deviations_of_what_all_runs_visit(self, runs, monkeypatch):
        """By another computation, over the states of all four."""
        scales = []
        make = UniformNoise.__init__
        monkeypatch.setattr(
            UniformNoise, "__init__", lambda self, s, **k: scales.append(s) or make(self, s, **k)
        )
        found = read_runs(runs)
        play_with_noise(found, [0.5], episodes=2)
        states = []
        for run in found:
            policy, env, max_steps = load_policy(run.folder, noise_scale=0.0)
            with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
                states += [env.rollout(max_steps, policy)["observation"] for _ in range(2)]
        expected = 0.5 * torch.cat(states).std(0)
        assert len(scales) == 4
        for scale in scales:
            torch.testing.assert_close(scale, expected)


class TestCommand:
    def test_it_writes_a_table_and_a_picture(self, runs, tmp_path, capsys):
        """A row for every method and measure; and the same numbers as JSON."""
        output = tmp_path / "noise"
        main([str(runs), "--levels", "0,1", "--episodes", "1", "--output", str(output)])
        printed = capsys.readouterr().out
        assert "| p | ppo | L2C2, beta=0 | 0, 1 | return |" in printed
        assert (output / "noise_p_ppo.svg").read_text().count("<svg") == 1
        assert (output / "noise.md").read_text().split("\n\n![")[0] in printed
        tests = json.loads((output / "noise.json").read_text())["runs"]
        assert len(tests) == 4 and list(tests[0]["levels"]) == ["0", "1"]

    def test_what_is_too_short_to_be_measured_is_unknown(self, tmp_path):
        """Sm of three steps: the table and the picture are of what is known."""
        make_run(tmp_path / "run", max_steps=3)
        output = tmp_path / "noise"
        main([str(tmp_path), "--levels", "0,0.1", "--episodes", "1", "--output", str(output)])
        table = (output / "noise.md").read_text()
        assert "| Sm | - | - |" in table and "| return | -" in table
        levels = json.loads((output / "noise.json").read_text())["runs"][0]["levels"]
        assert levels["0"]["sm_asap_mean"] is None and levels["0.1"]["return_mean"] < 0.0
        assert (output / "noise_p_ppo.svg").exists()

    def test_a_single_state_has_no_deviation(self, tmp_path):
        """Which is told before anything is played with noise."""
        make_run(tmp_path / "run", max_steps=1)
        with pytest.raises(SystemExit, match=r"error: noise is in .* one in 1 episodes: play more"):
            main([str(tmp_path), "--episodes", "1"])

    def test_the_cells_are_means_over_seeds(self, played):
        """Of the two runs of a method."""
        table = noise_table(played)
        assert table.columns[-3:] == ["0", "0.5", "2"] and len(table.rows) == 6
        rough = next(row for row in table.rows if row[2:5] == ["L2C2", "0, 1", "Sm"])
        own = [each for each in played if each.run.config["regularizer"]["beta"] == 0.1]
        expected = sum(each.summaries[2.0]["sm_asap_mean"] for each in own) / 2
        assert rough[-1].startswith(f"{expected:.3f} [")

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (["--levels=-0.1"], "levels must be finite and at least 0, got -0.1"),
            (["--episodes=0"], "episodes must be at least 1, got 0"),
        ],
    )
    def test_wrong_arguments_are_refused(self, runs, arguments, message):
        """In one line."""
        with pytest.raises(SystemExit, match=message):
            main([str(runs), *arguments])

    def test_levels_that_are_no_numbers_are_refused(self, capsys):
        """Not by the name of a function."""
        with pytest.raises(SystemExit):
            main(["runs", "--levels", "0,a"])
        assert "--levels: must be numbers with commas between them" in capsys.readouterr().err

    def test_a_folder_without_runs_is_named(self, tmp_path):
        """With what is looked for."""
        with pytest.raises(SystemExit, match=r"Expected finished runs \(evaluation.json\) below"):
            main([str(tmp_path)])
