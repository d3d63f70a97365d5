"""Groups, tables, statistics and pictures of runs: of made-up folders, by numbers known by hand."""

from __future__ import annotations

import csv
import json
import math
import os
import re
import subprocess
import tracemalloc
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.stats import mannwhitneyu, trim_mean

from torchrl_l2c2.experiment import ExperimentConfig, L2C2Config, PPOConfig, PPORPEConfig
from torchrl_l2c2.experiment.analysis.reports import (
    comparison_table,
    draw_learning_curves,
    draw_plane,
    find_runs,
    read_records,
    read_runs,
    records_of,
    sweep_summary,
    write_records,
    write_report,
)
from torchrl_l2c2.experiment.analysis.reports.groups import (
    baseline_of,
    group_records,
    settings_notes,
)
from torchrl_l2c2.experiment.analysis.reports.records import merge
from torchrl_l2c2.experiment.analysis.reports.statistics import (
    bootstrap_interval,
    curve_band,
    interquartile_mean,
    mean,
    probability_of_improvement,
)
from torchrl_l2c2.experiment.analysis.reports.table import known_tests, pipe_table
from torchrl_l2c2.experiment.cli.report import main
from torchrl_l2c2.experiment.errors import UserError
from torchrl_l2c2.experiment.run.finished import TESTS
from torchrl_l2c2.experiment.run.folder import code_commit
from torchrl_l2c2.experiment.settings.identity import differences, fingerprint
from torchrl_l2c2.experiment.settings.regularizers import REGULARIZERS
from torchrl_l2c2.experiment.settings.tasks import TASKS

ROOT = Path(__file__).parents[1]
METHODS = {
    "baseline": REGULARIZERS["none"],
    "CAPS": REGULARIZERS["caps"],
    "L2C2": REGULARIZERS["l2c2"],
    "L2C2, beta=0.5": L2C2Config(beta=0.5),
}


def make_config(*, task="swingup", regularizer="none", episodes=20, seed=0, **settings):
    method = (
        REGULARIZERS.get(regularizer, regularizer) if isinstance(regularizer, str) else regularizer
    )
    return ExperimentConfig(
        task=replace(TASKS[task], episodes=episodes), regularizer=method, seed=seed, **settings
    )


def make_run(folder, config, total, variation):
    """A finished run's folder whose figures are simple sums.

    Returns: sampled and late ``total``; mean and late ``total + 12``; of the last policy ``total +
    20`` with its mean and ``total + 30`` with samples. Action variations likewise in thousandths.
    """
    folder.mkdir(parents=True)
    rows = []
    for episode in range(1, config.task.episodes + 1):
        last_but = config.task.episodes - episode
        late = last_but < 2
        rows.append(
            {
                "episode": episode,
                "frames": 100 * episode,
                "updates": 10 * episode,
                # Late, 1 more and 1 less; before, far off.
                "return": total + (1 if last_but else -1) if late else -1e6,
                "action_variation": variation if late else 9.0,
                "policy_scale": 0.5 if late else 7.0,
                "test_return": total + 12 + (2 if last_but else -2) if late else math.nan,
                "test_action_variation": variation + 0.012 if late else math.nan,
                "frames_per_second": 50.0,
            }
        )
    with open(folder / "metrics.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)

    def test(more):
        summary = {
            "episodes": 2,
            "return_mean": total + more,
            "return_std": 0.0,
            "action_variation_mean": variation + more / 1000,
            "action_variation_std": 0.0,
        }
        return {"summary": summary}

    (folder / "config.json").write_text(json.dumps(config.to_dict()))
    (folder / "evaluation.json").write_text(json.dumps({**test(20), "sampled": test(30)}))
    (folder / "versions.json").write_text(json.dumps({"torch": "2.15.0", "commit": "abc"}))


@pytest.fixture(scope="module")
def forty(tmp_path_factory):
    """Two tasks, four methods, five seeds: ``100 m + seed`` of method m, half of it on Reacher."""
    folder = tmp_path_factory.mktemp("forty")
    for task, scale in (("swingup", 1.0), ("reacher", 0.5)):
        for m, (name, method) in enumerate(METHODS.items()):
            for seed in range(5):
                config = make_config(task=task, regularizer=method, seed=seed)
                place = folder / task / name / str(seed)
                make_run(place, config, scale * (100 * m + seed), 0.1 - 0.01 * m + 0.001 * seed)
    return folder


@pytest.fixture(scope="module")
def records(forty):
    return [run.record for run in read_runs(forty)]


def table_of(records):
    """Records as the package has them."""
    return pd.DataFrame([asdict(record) for record in records])


def cells(table, *start):
    """The cells of the only row that starts so."""
    (row,) = (list(row) for row in table.rows if tuple(row[: len(start)]) == start)
    return row[len(start) :]


class TestGroups:
    def test_forty_runs_are_eight_groups_with_the_figures_by_hand(self, records):
        """Seeds are pooled, nothing else; means of 0 to 4: 2."""
        groups = group_records(table_of(records))
        assert [(g.first.task, g.name, g.seeds) for g in groups] == [
            (task, name, [*range(5)]) for task in ("swingup", "reacher") for name in METHODS
        ]
        # L2C2, the third: 200 + 2, and 12 more where the mean acts; 20 and 30 in its last tests.
        for test, total in (("late_mean", 214), ("late_sampled", 202), ("last_mean", 222)):
            table = comparison_table(test, groups)
            assert table.title == TESTS[test].capitalize()
            row = cells(table, "swingup", "ppo_rpe", "L2C2", "5")
            assert row[0].startswith(f"{total}.0 [")
        assert row[2].startswith("0.102 [")
        assert cells(comparison_table("late_mean", groups), "reacher", "ppo_rpe", "baseline", "5")[
            0
        ].startswith("13.00 [")

    def test_one_run_in_one_line(self, records):
        """Everything that is kept of it."""
        (record,) = (r for r in records if (r.task, r.method, r.seed) == ("swingup", "caps", 3))
        assert (record.episodes, record.frames, record.updates) == (20, 2000, 200)
        assert (record.policy_scale, record.seconds) == (0.5, 40.0)
        assert (record.torch, record.commit, record.length) == ("2.15.0", "abc", "20 episodes")
        assert record.differences == "task.episodes=20"
        assert (record.late_sampled_return, record.late_mean_return) == (103.0, 115.0)
        assert (record.last_mean_return, record.last_sampled_return) == (123.0, 133.0)

    def test_without_tests_of_late_policies_their_figures_are_unknown(self, tmp_path):
        """But those of the training's own episodes are there."""
        make_run(tmp_path / "a", make_config(), 5.0, 0.1)
        path = tmp_path / "a" / "metrics.csv"
        lines = [row | {"test_return": "nan"} for row in csv.DictReader(path.open())]
        with open(path, "w", newline="") as file:
            writer = csv.DictWriter(file, list(lines[0]))
            writer.writeheader()
            writer.writerows(lines)
        (run,) = read_runs(tmp_path)
        assert math.isnan(run.record.late_mean_return) and run.record.late_sampled_return == 5.0
        groups = group_records(table_of([run.record]))
        assert known_tests(groups) == [test for test in TESTS if test != "late_mean"]
        assert cells(comparison_table("late_mean", groups), "swingup")[2] == "0"
        assert cells(comparison_table("late_sampled", groups), "swingup")[2:4] == ["1", "5.00"]

    def test_late_policies_are_those_that_training_tested(self, tmp_path):
        """In its last tenth by frames, which here holds 5 of 20 episodes; not an earlier end's."""
        config = make_config(task="pendulum", algorithm=PPOConfig(), late_share=0.1)
        config = replace(config, task=replace(config.task, frames=1000))
        make_run(tmp_path / "a", config, 5.0, 0.1)
        path = tmp_path / "a" / "metrics.csv"
        lines = list(csv.DictReader(path.open()))
        for number, line in enumerate(lines, 1):
            line["frames"] = 60 * number if number <= 15 else 900 + 20 * (number - 15)
            line["test_return"] = {9: 1e9}.get(number, number - 16 if number > 15 else "nan")
        with open(path, "w", newline="") as file:
            writer = csv.DictWriter(file, list(lines[0]))
            writer.writeheader()
            writer.writerows(lines)
        (run,) = read_runs(tmp_path)
        assert run.record.late_mean_return == 2.0

    def test_a_seed_that_comes_twice_is_told_and_not_pooled(self, tmp_path):
        """The newer one stands."""
        for name, total, time in (("new", 7.0, 2000), ("old", 900.0, 1000)):
            make_run(tmp_path / name, make_config(seed=4), total, 0.1)
            os.utime(tmp_path / name / "evaluation.json", (time, time))
        found = find_runs([tmp_path])
        (run,) = found.runs
        assert run.record.late_sampled_return == 7.0
        (note,) = found.notes
        assert note.startswith("1 the same settings and seed as a newer one, left out")
        assert str(tmp_path / "old") in note

    def test_a_folder_that_is_named_twice_is_read_once(self, tmp_path):
        """Also where one lies within the other."""
        make_run(tmp_path / "a" / "b", make_config(), 1.0, 0.1)
        found = find_runs([tmp_path, tmp_path / "a"])
        assert len(found.runs) == 1 and not found.notes

    def test_runs_of_other_lengths_are_not_pooled(self, tmp_path):
        """Each is a row of its own, named by its length."""
        for seed, episodes in enumerate((20, 20, 10)):
            make_run(tmp_path / str(seed), make_config(seed=seed, episodes=episodes), 1.0, 0.1)
        groups = group_records(records_of(read_runs(tmp_path)))
        assert {(group.name, *group.seeds) for group in groups} == {
            ("baseline, 20 episodes", 0, 1),
            ("baseline, 10 episodes", 2),
        }

    def test_vanilla_of_as_many_frames_is_compared(self, records):
        """Whatever their numbers of episodes, which are defaults of then and now."""
        vanilla, caps = (next(r for r in records if r.method == name) for name in ("none", "caps"))
        before, frames = "task.episodes=400 ", "task.frames=500"
        vanilla = replace(vanilla, differences=before + frames, length="500 frames")
        caps = replace(caps, differences=frames, length="500 frames")
        baseline, group = group_records(table_of([vanilla, caps]))
        assert baseline_of(group, [baseline, group]) == baseline

    def test_settings_that_no_name_tells_are_told_below(self, tmp_path):
        """Those of every row, and those of all rows of a method."""
        algorithm = PPORPEConfig(replay_ratio=5)
        for name, method in (("baseline", "none"), ("ramp", L2C2Config(gain="ramp"))):
            config = make_config(regularizer=method, algorithm=algorithm)
            make_run(tmp_path / name, config, 1.0, 0.1)
        groups = group_records(records_of(read_runs(tmp_path)))
        assert [group.name for group in groups] == ["baseline", "L2C2"]
        notes = settings_notes(groups)
        assert [note.removeprefix("swingup, ppo_rpe: ") for note in notes] == [
            "in every row, other than the defaults without a preset: `algorithm.replay_ratio=5`, "
            "`task.episodes=20`.",
            "L2C2, other than the defaults without a preset: `regularizer.gain=ramp`.",
        ]

    def test_runs_of_several_versions_are_pooled_and_told(self, records):
        """Their numbers may differ for no other reason."""
        ours = [r for r in records if (r.task, r.method) == ("swingup", "caps")]
        groups = group_records(table_of([*ours[:-1], replace(ours[-1], commit="")]))
        (group,) = groups
        assert group.seeds == [0, 1, 2, 3, 4]
        told = "swingup, ppo_rpe, CAPS: runs of more than one commit (abc, unknown) are pooled."
        assert told in settings_notes(groups)

    def test_unfinished_and_damaged_folders_are_counted_and_named(self, tmp_path):
        """None is passed over in silence, and none stops the others from being read."""
        make_run(tmp_path / "good", make_config(), 1.0, 0.1)
        make_run(tmp_path / "cut", make_config(seed=1), 1.0, 0.1)
        (tmp_path / "cut" / "evaluation.json").write_text('{"run"')
        make_run(tmp_path / "going", make_config(seed=2), 1.0, 0.1)
        (tmp_path / "going" / "evaluation.json").unlink()
        found = find_runs([tmp_path])
        assert [run.folder.name for run in found.runs] == ["good"]
        for start, name in (
            ("1 without test results", "going"),
            ("1 unreadable", "cut"),
        ):
            assert sum(n.startswith(start) and str(tmp_path / name) in n for n in found.notes) == 1
        summary = sweep_summary([tmp_path])
        assert "| baseline | 1 |" in summary and all(note in summary for note in found.notes)
        with pytest.raises(FileNotFoundError) as error:
            find_runs([tmp_path / "going"], required=True)
        assert str(error.value).endswith(
            f"{tmp_path / 'going'}. The command that began a run continues it."
        )
        (tmp_path / "empty").mkdir()
        with pytest.raises(
            FileNotFoundError, match=r"got none\. Name an output folder of train\.py"
        ):
            find_runs([tmp_path / "empty"], required=True)

    @pytest.mark.parametrize(
        ("name", "content"),
        [
            ("config.json", b"[]"),
            ("config.json", b"{}"),
            ("config.json", b'{"task": 3, "algorithm": {}, "regularizer": {}}'),
            ("versions.json", b"[]"),
            ("evaluation.json", b"null"),
            ("evaluation.json", b"[1]"),
            ("evaluation.json", b""),
            ("evaluation.json", b'{"summary": {"return_mean": "much"}}'),
            ("evaluation.json", b'{"sampled": 3}'),
            ("evaluation.json", b'{"training": 3}'),
            ("evaluation.json", b'{"training": {"episodes": 21}}'),
            ("metrics.csv", b""),
            ("metrics.csv", b"\xff"),
            ("metrics.csv", b"episode,frames,updates,return\n1,100,10\n"),
        ],
    )
    def test_whatever_a_damaged_file_holds_is_told_with_its_name(self, tmp_path, name, content):
        """Twenty episodes were trained; and another run is read all the same."""
        for seed, folder in enumerate(("good", "bad")):
            make_run(tmp_path / folder, make_config(seed=seed), 1.0, 0.1)
        (tmp_path / "bad" / name).write_bytes(content)
        found = find_runs([tmp_path])
        assert [run.folder.name for run in found.runs] == ["good"]
        named = "metrics.csv" if b"episodes" in content else name
        (note,) = found.notes
        assert note.startswith("1 unreadable: ") and str(tmp_path / "bad" / named) in note

    def test_a_finished_run_without_its_settings_is_told(self, tmp_path):
        make_run(tmp_path / "run", make_config(), 1.0, 0.1)
        (tmp_path / "run" / "config.json").unlink()
        (note,) = find_runs([tmp_path]).notes
        assert note.startswith("1 unreadable: ") and "config.json" in note

    def test_without_a_commit_the_packages_version_tells_runs_apart(self, tmp_path):
        """Of an installed package, which is in no git checkout."""
        for seed, version in enumerate(("0.1.0", "0.2.0")):
            make_run(tmp_path / version, make_config(seed=seed), 1.0, 0.1)
            known = {"torchrl-l2c2": version, "commit": ""}
            (tmp_path / version / "versions.json").write_text(json.dumps(known))
        assert "runs of more than one commit (0.1.0, 0.2.0) are pooled" in sweep_summary([tmp_path])

    def test_a_measure_that_could_not_be_taken_is_no_number(self, tmp_path):
        """Of test episodes that are too short, where evaluation.json has null."""
        make_run(tmp_path / "run", make_config(), 1.0, 0.1)
        path = tmp_path / "run" / "evaluation.json"
        content = json.loads(path.read_text())
        content["summary"]["sm_asap_mean"] = None
        path.write_text(json.dumps(content))
        (run,) = read_runs(tmp_path)
        assert math.isnan(run.record.last_mean_sm_asap) and run.record.last_mean_return == 21.0

    def test_names_tell_what_differs_and_only_that(self, tmp_path):
        """What all have in common is a note; what CAPS does not have does not name it."""
        chosen = {"algorithm": PPORPEConfig(replay_ratio=10, critic_weighting="ratio")}
        for name, config in {
            "a": make_config(**chosen),
            "b": make_config(algorithm=PPORPEConfig(replay_ratio=5, critic_weighting="ratio")),
            "c": make_config(regularizer="caps", **chosen),
            "d": make_config(regularizer=L2C2Config(beta=0.0), **chosen),
            "e": make_config(regularizer=L2C2Config(), **chosen),
        }.items():
            make_run(tmp_path / name, config, 1.0, 0.1)
        groups = group_records(records_of(read_runs(tmp_path)))
        assert {group.name for group in groups} == {
            "baseline",
            "baseline, replay_ratio=5",
            "CAPS",
            "L2C2, beta=0",
            "L2C2",
        }
        assert any("`algorithm.critic_weighting=ratio`" in each for each in settings_notes(groups))


class TestSettings:
    def test_the_commit_is_the_checkouts(self):
        """As git names it; empty where the code lies in none."""
        head = ["git", "rev-parse", "--short=12", "HEAD"]
        found = subprocess.run(head, cwd=ROOT, capture_output=True, text=True, check=False)
        expected = found.stdout.strip() if (ROOT / ".git").exists() else ""
        assert code_commit().removesuffix("-dirty") == expected

    def test_the_fingerprint_of_the_papers_baseline_is_that_of_its_records(self):
        """Also after a setting was removed."""
        recorded = pd.read_csv(ROOT / "results" / "runs.csv").iloc[0]
        baseline = {"regularizer": {"name": "none"}}
        assert (recorded["task"], recorded["method"]) == ("swingup", "none")
        assert fingerprint(baseline) == recorded["settings"]

    def test_what_changes_no_number_leaves_the_fingerprint(self):
        """Nor do the seed and the length; every other setting changes it."""
        plain = fingerprint(make_config().to_dict())
        free = make_config(seed=9, episodes=7, threads=2, test_episodes=3, late_share=0.5)
        assert fingerprint(free.to_dict()) == plain
        assert fingerprint(make_config(compile=False).to_dict()) != plain
        ratio = make_config(algorithm=PPORPEConfig(replay_ratio=5))
        assert fingerprint(ratio.to_dict()) != plain
        assert fingerprint(make_config(regularizer="caps").to_dict()) != plain

    def test_a_setting_that_is_off_leaves_the_fingerprint(self, monkeypatch):
        """So the codes of older runs stay when it is added."""
        config = make_config().to_dict()
        older = {k: v for k, v in config["task"].items() if v is not None and v is not False}
        newer = {**config["task"], "added": False, "also_added": None}
        codes = []
        for task in (older, newer):
            monkeypatch.setattr(
                ExperimentConfig, "to_dict", lambda _, t=task: {**config, "task": t}
            )
            codes.append(fingerprint(config))
        assert codes[0] == codes[1]

    def test_a_setting_that_is_as_older_runs_had_it_leaves_the_fingerprint(self, monkeypatch):
        """So that runs of before pool with those of now."""
        plain = make_config(regularizer="l2c2").to_dict()
        code = fingerprint(plain)
        monkeypatch.setattr("torchrl_l2c2.experiment.settings.identity._metadata", dict)
        assert fingerprint(plain) != code
        monkeypatch.undo()
        plain["regularizer"]["policy_distance"] = "mean"
        assert fingerprint(plain) != code

    def test_differences_are_from_the_defaults_of_what_is_chosen_by_name(self):
        """Another replay's own defaults are none; a task of one's own is its id."""
        config = ExperimentConfig.from_dict(
            {
                "task": {"name": "Pendulum-v1", "env_id": "Pendulum-v1", "noise_scale": 0.05},
                "algorithm": {"name": "sac"},
                "regularizer": {"name": "l2c2"},
                "replay": {"name": "prioritized", "alpha": 0.5},
            }
        )
        assert differences(config.to_dict()) == {
            "replay.alpha": "0.5",
            "replay.name": "prioritized",
            "task.noise_scale": "0.05",
        }

    def test_a_task_of_ones_own_name_differs_by_its_environment(self):
        """Else runs of two environments would be compared."""
        task = {"name": "mine", "env_id": "Pendulum-v1"}
        chosen = {"algorithm": {"name": "sac"}, "regularizer": {"name": "none"}}
        config = ExperimentConfig.from_dict({"task": task, **chosen})
        assert differences(config.to_dict()) == {"task.env_id": '"Pendulum-v1"'}


def test_names_of_runs_are_no_markup():
    """A run's name may be anything: it cannot write into the page, nor break a row."""
    table = pipe_table([["task"], ["<img src=x>\n\n# heading | b"]])
    assert table.splitlines()[2:] == [r"| &lt;img src=x>  # heading \| b |"]


def test_records_without_results_are_one_line(tmp_path):
    make_run(tmp_path / "run", make_config(), 10.0, 0.1)
    records = records_of(read_runs(tmp_path))
    tested = [column for column in records if column.startswith(("late_", "last_"))]
    write_records(tmp_path / "empty.csv", records.assign(**dict.fromkeys(tested, math.nan)))
    with pytest.raises(SystemExit, match="no run among these has the results of a test"):
        main(["--from", str(tmp_path / "empty.csv")])


class TestStatistics:
    def test_the_interquartile_mean_leaves_out_a_quarter_on_either_side(self):
        """Over runs and tasks together: of 0 to 7 it is the mean of 2 to 5; like SciPy's."""
        assert interquartile_mean(np.arange(8.0).reshape(2, 4)).item() == 3.5
        scores = np.random.default_rng(0).normal(size=(18, 3))
        expected = trim_mean(scores, 0.25, axis=None)
        assert interquartile_mean(scores).item() == pytest.approx(expected)

    def test_the_probability_of_improvement_counts_pairs(self):
        """Of 1, 3 over 1, 2: a tie, a loss and two wins; like SciPy's Mann-Whitney statistic."""
        ours, theirs = np.array([[1.0], [3.0]]), np.array([[1.0], [2.0]])
        assert probability_of_improvement(ours, theirs).item() == 2.5 / 4
        generator = np.random.default_rng(0)
        ours, theirs = generator.normal(0.5, size=(7, 2)), generator.normal(size=(5, 2))
        pairs = zip(ours.T, theirs.T, strict=True)
        expected = np.mean([mannwhitneyu(*pair).statistic / 35 for pair in pairs])
        assert probability_of_improvement(ours, theirs).item() == pytest.approx(expected)

    def test_they_give_what_rliables_own_tests_say(self):
        """Its metrics' tests (Agarwal et al. 2021): 1.5, 2 and 1/3 of these scores."""
        ours = np.array([[1.0, 2.0], [2.0, 2.0], [1.0, 1.0], [2.0, 1.0]])
        theirs = np.array([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]])
        assert interquartile_mean(ours).item() == 1.5
        assert interquartile_mean(theirs).item() == 2.0
        improvement = probability_of_improvement(ours, theirs).item()
        assert improvement == pytest.approx(1 / 3)

    def test_a_task_counts_with_all_of_its_runs(self):
        """However many others have: 1, 3 over 2 win a half, 1 over 0 wins; 3/4 is their mean."""
        ours, theirs = np.array([[1.0, 1.0], [3.0, math.nan]]), np.array([[2.0, 0.0]])
        assert probability_of_improvement(ours, theirs).item() == 0.75
        # Drawn anew, the first task has 0, 1/2 or 1 of them, the second always its one run.
        for confidence, ends in ((0.4, (0.75, 0.75)), (0.95, (0.5, 1.0))):
            generator = np.random.default_rng(0)
            interval = bootstrap_interval(
                probability_of_improvement,
                *(ours, theirs),
                generator=generator,
                confidence=confidence,
            )
            assert interval == ends

    def test_the_bootstrap_of_two_runs_by_hand(self):
        """Means of 0 and 1 drawn anew: 0, 1/2 and 1, with probabilities 1/4, 1/2 and 1/4."""

        def interval(confidence):
            generator = np.random.default_rng(0)
            scores = np.array([[0.0], [1.0]])
            return bootstrap_interval(mean, scores, generator=generator, confidence=confidence)

        assert interval(0.4) == (0.5, 0.5)
        assert interval(0.95) == (0.0, 1.0)

    def test_the_bootstrap_draws_for_every_task_by_itself(self):
        """Then all runs are 0 in 1 of 16; drawn together, in 1 of 4."""
        scores = np.array([[0.0, 0.0], [1.0, 1.0]])
        generator = np.random.default_rng(0)
        interval = bootstrap_interval(mean, scores, generator=generator, confidence=0.8)
        assert interval == (0.25, 0.75)

    def test_the_bootstrap_draws_as_many_runs_as_a_task_has(self):
        """Also where another task has more of them."""

        def runs(scores):
            return (~np.isnan(scores)).sum((-2, -1)).astype(float)

        scores = np.array([[1.0, 5.0], [2.0, np.nan], [3.0, np.nan]])
        assert bootstrap_interval(runs, scores, generator=np.random.default_rng(0)) == (4.0, 4.0)

    def test_the_bootstrap_of_many_pairs_fits_into_memory(self):
        """All resamples of 200 runs beside 200 at once would be 40 million pairs."""
        scores, generator = np.arange(200.0)[:, None], np.random.default_rng(0)
        tracemalloc.start()
        try:
            bootstrap_interval(
                probability_of_improvement, scores, scores, generator=generator, resamples=1000
            )
            peak = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
        assert peak < 100e6

    def test_the_bootstraps_settings_have_ranges(self):
        """Said with what was given."""
        for name, value in (("confidence", 1.0), ("resamples", 0)):
            with pytest.raises(ValueError, match=f"{name} must be .*got {value}"):
                bootstrap_interval(
                    mean, np.ones((2, 1)), generator=np.random.default_rng(0), **{name: value}
                )

    def test_a_band_is_of_whole_curves(self):
        """Of (0, 1) and (1, 0) the mean of a resample is a run's own or 1/2 everywhere."""
        curves = np.array([[0.0, 1.0], [1.0, 0.0]])
        lower, upper = curve_band(curves, generator=np.random.default_rng(0))
        assert lower.tolist() == [0.0, 0.0] and upper.tolist() == [1.0, 1.0]
        lower, upper = curve_band(curves, generator=np.random.default_rng(0), confidence=0.4)
        assert lower.tolist() == upper.tolist() == [0.5, 0.5]

    def test_a_band_of_symmetric_runs_is_symmetric(self):
        curves = np.linspace(-1.0, 1.0, 40)[:, None]
        generator = np.random.default_rng(0)
        lower, upper = curve_band(curves, generator=generator, resamples=20_000)
        assert upper[0] == pytest.approx(-lower[0], rel=0.05)

    def test_the_table_by_hand(self, records):
        """Interquartile means of 0 to 4 are those of 1 to 3; 100 more always beats the baseline."""
        groups = group_records(table_of(records))
        for center in (mean, interquartile_mean):
            table = comparison_table("late_sampled", groups, center)
            assert [*table.columns[3:]] == [
                *("runs", "return", "P(returns more)", "action variation", "P(smoother)")
            ]
            row = cells(table, "swingup", "ppo_rpe", "CAPS", "5")
            assert row[0].startswith("102.0 [") and row[1] == "1.00 [1.00, 1.00]"
            # Of .09 to .094 against .1 to .104 every pair is smoother.
            assert row[2].startswith("0.092 [") and row[3] == "1.00 [1.00, 1.00]"
            assert cells(table, "swingup", "ppo_rpe", "baseline", "5")[1::2] == ["", ""]

    def test_pairs_are_counted_and_ties_are_halves(self, records):
        """Of returns 15 and 25 with a baseline of 10 and 20 three of four are larger."""
        found = {"none": ((10.0, 0.5), (20.0, 0.5)), "l2c2": ((15.0, 0.4), (25.0, 0.6))}
        names = ("late_mean_return", "late_mean_action_variation")
        runs = [
            replace(records[0], method=method, seed=seed, **dict(zip(names, values, strict=True)))
            for method, each in found.items()
            for seed, values in enumerate(each)
        ]
        table = comparison_table("late_mean", group_records(table_of(runs)))
        row = cells(table, "swingup", "ppo_rpe", "L2C2")
        assert [cell.split()[0] for cell in row[1:]] == ["20.00", "0.75", "0.500", "0.50"]

    def test_sm_is_in_the_table_where_it_was_measured(self, records):
        """Only in tests of the last policy's mean actions."""
        rough = [replace(r, last_mean_sm_asap=1.0 - 0.1 * (r.method == "caps")) for r in records]
        table = comparison_table("last_mean", group_records(table_of(rough)))
        found = cells(table, "swingup", "ppo_rpe", "CAPS", "5")
        row = dict(zip(table.columns[4:], found, strict=True))
        assert row["Sm"] == "0.900 [0.900, 0.900]" and row["P(smaller Sm)"].startswith("1.00")
        without = comparison_table("last_sampled", group_records(table_of(rough)))
        assert "Sm" not in without.columns

    def test_only_runs_with_a_test_are_counted(self, records):
        """Four of five runs, which return less than every run of the baseline."""
        caps = [r for r in records if (r.task, r.method) == ("swingup", "caps")]
        lost = [replace(r, last_mean_return=-9.0) for r in caps[1:]]
        untested = replace(caps[0], last_mean_return=math.nan)
        baseline = [r for r in records if r.method == "none"]
        table = comparison_table("last_mean", group_records(table_of([untested, *lost, *baseline])))
        found = cells(table, "swingup", "ppo_rpe", "CAPS")
        assert found[:3] == ["4", "-9.00 [-9.00, -9.00]", "0.00 [0.00, 0.00]"]
        table = comparison_table("last_mean", group_records(table_of([untested, *baseline])))
        assert cells(table, "swingup", "ppo_rpe", "CAPS")[:3] == ["0", "-", ""]


class TestRecords:
    def test_the_file_gives_the_same_tables_as_the_folders(self, records, tmp_path):
        """To the character, with sorted lines that do not depend on the order they came in."""
        write_records(tmp_path / "a.csv", table_of(records))
        write_records(tmp_path / "b.csv", table_of(reversed(records)))
        assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()
        both = (table_of(records), read_records(tmp_path / "a.csv"))
        groups = [group_records(each) for each in both]
        for test in TESTS:
            ours, theirs = (comparison_table(test, each).markdown() for each in groups)
            assert ours == theirs

    def test_a_run_is_replaced_by_its_newer_self(self, records):
        """Others stay as they are."""
        newer = replace(records[7], late_mean_return=-1.0)
        merged = merge(table_of(records), table_of([newer]))
        assert len(merged) == len(records)
        changed = merged[merged["late_mean_return"] == -1.0]
        assert (changed["seed"].item(), changed["method"].item()) == (newer.seed, newer.method)
        # A run that was cut to a length has no test of its last policy.
        cut = replace(newer, last_mean_return=math.nan, last_sampled_return=math.nan)
        assert merge(merged, table_of([cut])).equals(merged)

    def test_an_unknown_number_is_an_empty_cell(self, records, tmp_path):
        """And comes back as unknown."""
        unknown = table_of([replace(records[0], policy_scale=math.nan)])
        write_records(tmp_path / "runs.csv", unknown)
        (back,) = read_records(tmp_path / "runs.csv").itertuples()
        assert math.isnan(back.policy_scale) and back.seconds == records[0].seconds

    def test_a_file_of_something_else_is_refused(self, records, tmp_path):
        """With its name, and the line where there is one."""
        path = tmp_path / "runs.csv"
        path.write_text("a,b\n1,2\n")
        with pytest.raises(
            ValueError, match=r"^Expected the columns of records in .*runs\.csv, got"
        ):
            read_records(path)
        write_records(path, table_of(records[:1]))
        path.write_text(path.read_text().replace(",2000,", ",many,"))
        with pytest.raises(ValueError, match=r"runs\.csv, line 2: .*many"):
            read_records(path)
        write_records(path, table_of(records[:2]))
        whole = path.read_text()
        for cut in (whole.rpartition(",")[0] + "\n", whole.rstrip("\n") + ",more\n"):
            path.write_text(cut)
            with pytest.raises(ValueError, match=r"runs\.csv, line 3: 2[35] cells, .* has 24"):
                read_records(path)
        path.write_text(whole.rstrip("\n") + " algorithm.repl\n")
        with pytest.raises(ValueError, match=r"runs\.csv, line 3: .* got 'algorithm.repl'"):
            read_records(path)


class TestPictures:
    def test_the_same_runs_give_the_same_bytes_without_a_date(self, forty, records, tmp_path):
        """So that a picture in a repository changes only with its numbers."""
        runs = [run for run in read_runs(forty) if run.task == "swingup"]
        for name in ("a.svg", "b.svg"):
            draw_learning_curves(runs, tmp_path / f"curves_{name}")
            draw_plane(
                group_records(table_of(records[:20])), "late_mean", tmp_path / f"plane_{name}"
            )
        for kind in ("curves", "plane"):
            first, second = ((tmp_path / f"{kind}_{n}.svg").read_text() for n in "ab")
            assert first == second and "<dc:date>" not in first
            assert all(name in first for name in METHODS)

    @pytest.mark.filterwarnings("error:constrained_layout not applied")
    def test_a_long_legend_leaves_room_for_the_axes(self, records, tmp_path):
        """Of many settings with long names; it was a warning, and an empty picture."""
        (group, *_) = group_records(table_of(records))
        many = [replace(group, name=f"L2C2, gain_target={i}, " + "long " * 8) for i in range(20)]
        draw_plane(many, "late_mean", tmp_path / "plane.svg")

    def test_a_tasks_name_is_no_formula(self, records, tmp_path):
        """Of one's own; dollars in it were read as LaTeX's, which it is not."""
        own = [replace(record, task="$^$") for record in records if record.task == "swingup"]
        draw_plane(group_records(table_of(own)), "late_mean", tmp_path / "plane.svg")
        config = make_config()
        make_run(tmp_path / "run", replace(config, task=replace(config.task, name="$^$")), 1.0, 0.1)
        draw_learning_curves(read_runs(tmp_path / "run"), tmp_path / "curves.svg")
        for picture in ("plane.svg", "curves.svg"):
            assert "$^$" in (tmp_path / picture).read_text()

    def test_curves_of_different_tasks_are_refused(self, forty, tmp_path):
        """Their frames and returns have no common scale."""
        with pytest.raises(UserError, match=r"^Expected runs of one task .* got reacher, p"):
            draw_learning_curves(read_runs(forty), tmp_path / "curves.svg")

    def test_a_single_run_is_drawn_as_png(self, forty, tmp_path):
        """As every run's folder has it."""
        draw_learning_curves(read_runs(forty)[:1], tmp_path / "curves.png")
        assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")


class TestReport:
    def test_the_page_needs_nothing_else(self, forty, tmp_path):
        """Every picture is within it, every table, and no address."""
        found = find_runs([forty])
        page = write_report(tmp_path, records_of(found.runs), found.runs)
        text = page.read_text()
        pictures = sorted(path.stem for path in tmp_path.glob("*.svg"))
        assert pictures == [
            "learning_curves_reacher_ppo_rpe",
            "learning_curves_swingup_ppo_rpe",
            "plane",
        ]
        assert text.count('src="data:image/svg+xml;base64,') == len(pictures)
        assert not re.search(r'(?:src|href)="(?!data:)', text) and "http" not in text
        markdown = (tmp_path / "report.md").read_text()
        title = "Last policy, mean actions"
        assert f"<h2>{title}</h2>" in text and f"**{title}**" in markdown

    def test_the_command_prints_the_same_from_folders_and_from_their_records(
        self, forty, tmp_path, capsys
    ):
        """And no report, unless it is asked for."""
        file = str(tmp_path / "runs.csv")
        main([str(forty), "--csv", file])
        tables, _, _ = capsys.readouterr().out.partition("\n\nrecords: ")
        # A line of names, one below it, and eight groups.
        assert tables.count("\n| ") == 10
        main(["--from", file])
        assert capsys.readouterr().out.strip() == tables
        assert not (forty / "report").exists()
        parts = [str(tmp_path / f"{task}.csv") for task in ("swingup", "reacher")]
        for part in parts:
            main([str(forty / Path(part).stem), "--csv", part])
        capsys.readouterr()
        main(["--from", *parts])
        assert capsys.readouterr().out.strip() == tables

    def test_the_report_lies_in_the_runs_folder(self, tmp_path, capsys):
        """Where no other is named; the same command reads past it."""
        make_run(tmp_path / "run", make_config(), 1.0, 0.1)
        main([str(tmp_path)])
        assert str(tmp_path / "report" / "report.html") in capsys.readouterr().out
        assert (tmp_path / "report" / "report.html").exists()
        assert len(read_runs(tmp_path)) == 1

    def test_what_cannot_be_done_is_one_line(self, tmp_path, capsys):
        """An empty folder, no folder, a file that is not there."""
        with pytest.raises(SystemExit, match="error: Expected finished runs"):
            main([str(tmp_path)])
        with pytest.raises(SystemExit, match=r"error: Expected a file of records"):
            main(["--from", str(tmp_path / "runs.csv")])
        write_records(tmp_path / "none.csv", records_of([]))
        with pytest.raises(SystemExit, match=r"error: Expected records of runs in '.*none\.csv'"):
            main(["--from", str(tmp_path / "none.csv"), "--output", str(tmp_path / "rep")])
        with pytest.raises(SystemExit):
            main([])
        assert "expected either folders of runs" in capsys.readouterr().err


def test_a_report_that_cannot_be_drawn_leaves_none(tmp_path, monkeypatch):
    """Nor a half of one: a picture without its page would pass for all there is."""
    make_run(tmp_path / "run", make_config(), 10.0, 0.05)
    records = [run.record for run in read_runs(tmp_path)]

    def fail(*_):
        raise ValueError("no picture")

    monkeypatch.setattr("torchrl_l2c2.experiment.analysis.reports.report.draw_plane", fail)
    with pytest.raises(ValueError, match="no picture"):
        write_report(tmp_path / "report", table_of(records))
    assert not (tmp_path / "report").exists()
