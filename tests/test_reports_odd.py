"""Reports of records and folders that are not as they should be, or unlike one another."""

import json
import math
from dataclasses import replace

import pytest

from tests.test_reports import make_config, make_run, table_of
from torchrl_l2c2.experiment import L2C2Config, PPOConfig
from torchrl_l2c2.experiment.analysis.reports import (
    comparison_table,
    find_runs,
    finished_run,
    read_runs,
    result_lines,
    write_report,
)
from torchrl_l2c2.experiment.analysis.reports.figures import styles
from torchrl_l2c2.experiment.analysis.reports.groups import baseline_of, group_records
from torchrl_l2c2.experiment.analysis.reports.records import read_records, write_records

METHODS = ("none", "caps", "cats")
GAINS = {gain: L2C2Config(lambda_min=gain, lambda_max=100 * gain) for gain in (0.1, 1.0)}


@pytest.fixture(scope="module")
def field(tmp_path_factory):
    """Records of two tasks, three methods, a weak L2C2 on both and a strong one on the first."""
    folder = tmp_path_factory.mktemp("field")
    for task in ("pendulum", "lunarlander"):
        gains = list(GAINS)[: 2 if task == "pendulum" else 1]
        for m, method in enumerate((*METHODS, *(GAINS[gain] for gain in gains))):
            for seed in range(2):
                config = make_config(
                    task=task, algorithm=PPOConfig(), regularizer=method, seed=seed
                )
                place = folder / task / str(m) / str(seed)
                make_run(place, config, 100.0 + m + seed, 0.1 - 0.01 * m)
                add_sm(place, 0.5 - 0.1 * m + 0.01 * seed)
    return [run.record for run in read_runs(folder)]


def add_sm(folder, sm):
    path = folder / "evaluation.json"
    content = json.loads(path.read_text())
    content["summary"]["sm_asap_mean"] = sm
    path.write_text(json.dumps(content))


def of(records, task, method="l2c2"):
    return [r for r in records if (r.task, r.method) == (task, method)]


class TestNotes:
    def test_untrained_runs_are_told(self, tmp_path):
        """Their policies are as they were made."""
        for seed in range(2):
            make_run(tmp_path / str(seed), make_config(seed=seed), 100.0, 0.1)
        path = tmp_path / "1" / "evaluation.json"
        training = {"episodes": 20, "frames": 2000, "updates": 0, "untrained": "no update"}
        path.write_text(json.dumps({**json.loads(path.read_text()), "training": training}))
        (note,) = find_runs([tmp_path]).notes
        assert note.startswith("1 untrained (") and note.endswith(str(tmp_path / "1"))


class TestPictures:
    def test_a_name_has_one_look_in_all_panels(self, field):
        """There is one legend for them."""
        groups = group_records(table_of(field))
        looks = styles(groups[::-1])
        assert looks.keys() == {group.name for group in groups}
        assert len({tuple(look.items()) for look in looks.values()}) == len(looks)

    @pytest.mark.filterwarnings("ignore:Glyph")
    def test_tasks_of_similar_or_long_names_have_pictures_of_their_own(self, tmp_path):
        """Their letters are left out of the files' names, and long names are cut."""
        names = ("任务一", "任务二", "x" * 500, "x" * 499 + "y")
        for i, name in enumerate(names):
            config = make_config()
            task = replace(config.task, name=name)
            make_run(tmp_path / "runs" / str(i), replace(config, task=task), 1.0, 0.1)
        found = find_runs([tmp_path / "runs"])
        page = write_report(
            tmp_path / "report", table_of([r.record for r in found.runs]), found.runs
        )
        assert len(list(page.parent.glob("learning_curves_*_ppo_rpe.svg"))) == 4
        for text in (page.read_text(), (page.parent / "report.md").read_text()):
            assert all(f"learning curves {name}, ppo_rpe" in text for name in names)


class TestTables:
    def test_runs_of_another_length_are_not_compared(self, field):
        """CATS trained ten times as long has no baseline."""
        longer = [
            replace(r, length="200 episodes", settings=f"x{r.settings}")
            if r.method == "cats"
            else r
            for r in field
        ]
        rows = comparison_table("last_mean", group_records(table_of(longer))).rows
        cats = [row for row in rows if row[2].startswith("CATS")]
        assert len(cats) == 2 and all(row[5] == "" for row in cats)

    def test_methods_of_one_name_are_rows_of_their_own(self, field):
        """As L2C2 with beta=0, and the method that is called so."""
        weak = {task: of(field, task)[:2] for task in ("pendulum", "lunarlander")}
        twins = [
            replace(r, method="l2c2_policy", settings="twin", differences="")
            for records in weak.values()
            for r in records
        ]
        named = [replace(r, differences="regularizer.beta=0", settings="beta") for r in twins]
        named = [replace(r, method="l2c2") for r in named]
        baseline = [r for r in field if r.method == "none"]
        groups = group_records(table_of([*baseline, *twins, *named]))
        names = [group.name for group in groups if group.first.task == "pendulum"]
        assert len(names) == len(set(names)) == 3

    def test_a_row_says_of_how_many_runs_it_is(self, field):
        """Those that were cut to a length have no last policy."""
        chosen = of(field, "pendulum", "none")
        chosen[0] = replace(chosen[0], last_mean_return=math.nan)
        (row,) = comparison_table("last_mean", group_records(table_of(chosen))).rows
        assert row[3:5] == ["1", "121.0"] and row[8].startswith("0.505 [")

    def test_beside_two_baselines_nothing_is_compared(self, field):
        """Their defaults differ, and nothing says which one is the baseline."""
        caps, baseline = of(field, "pendulum", "caps"), of(field, "pendulum", "none")
        then = [replace(r, settings="then") for r in baseline]
        groups = group_records(table_of([*caps, *baseline, *then]))
        assert [baseline_of(group, groups) for group in groups] == [None] * 3
        groups = group_records(table_of([*caps, *baseline]))
        assert {baseline_of(group, groups) is None for group in groups} == {True, False}


class TestFolders:
    @pytest.mark.parametrize("name", ["nowhere", "file"])
    def test_one_that_is_not_there_is_refused(self, tmp_path, name):
        """A mistyped one would leave its runs out."""
        make_run(tmp_path / "run", make_config(), 1.0, 0.1)
        (tmp_path / "file").touch()
        with pytest.raises(FileNotFoundError, match=f"Expected a folder of runs, got .*{name}'"):
            find_runs([tmp_path, tmp_path / name])

    def test_links_are_followed_and_a_run_is_read_once(self, tmp_path):
        """A link to a run elsewhere, to the same run again, and to the folder that it is in."""
        make_run(tmp_path / "disk" / "run", make_config(seed=1), 1.0, 0.1)
        make_run(tmp_path / "outputs" / "own", make_config(seed=2), 1.0, 0.1)
        for name in ("a", "b"):
            (tmp_path / "outputs" / name).symlink_to(tmp_path / "disk", target_is_directory=True)
        (tmp_path / "outputs" / "own" / "up").symlink_to(tmp_path / "outputs")
        found = find_runs([tmp_path / "outputs"])
        assert sorted(run.seed for run in found.runs) == [1, 2] and found.notes == []

    @pytest.mark.parametrize(
        ("name", "old", "new", "told"),
        [
            ("metrics.csv", "\n3,300,", "\n3,3x,", "line 4: frames must be a finite number"),
            ("metrics.csv", "\n3,300,30,", "\n3,300,inf,", "updates must be a finite number"),
            ("evaluation.json", '"return_mean": 21.0', '"return_mean": 1e400', "finite numbers"),
            ("metrics.csv", None, "episode,frames\n", "has 0 episodes, fewer than the 1"),
            ("evaluation.json", '"return_mean": 21.0', f'"return_mean": {"9" * 400}', "too large"),
            ("versions.json", None, "[" * 99999, "too many nested brackets"),
        ],
    )
    def test_a_damaged_run_is_named_and_left_out(self, tmp_path, name, old, new, told):
        """Whatever is wrong with it, the others are told."""
        for run in ("good", "bad"):
            make_run(tmp_path / run, make_config(seed=len(run)), 1.0, 0.1)
        path = tmp_path / "bad" / name
        text = path.read_text()
        assert old is None or old in text
        path.write_text(new if old is None else text.replace(old, new))
        found = find_runs([tmp_path])
        assert [run.folder.name for run in found.runs] == ["good"]
        (note,) = found.notes
        assert "1 unreadable" in note and str(tmp_path / "bad") in note and told in note

    @pytest.mark.parametrize(
        ("name", "wrong"),
        [
            ("config.json", {"replay": 5}),
            ("evaluation.json", {"summary": {"episodes": 2}}),
            ("evaluation.json", {"training": {"episodes": "two"}}),
        ],
    )
    def test_a_damaged_run_that_is_run_again_is_named(self, tmp_path, name, wrong):
        """What it has is JSON, of another form than it was."""
        config = make_config(test_episodes=2)
        make_run(tmp_path / "bad", config, 1.0, 0.1)
        path = tmp_path / "bad" / name
        path.write_text(json.dumps({**json.loads(path.read_text()), **wrong}))
        with pytest.raises(ValueError, match=r"the run in '.*bad' is damaged \(.*restore it"):
            result_lines(finished_run(tmp_path / "bad", config.to_dict()))


def test_a_mark_that_excel_adds_is_no_part_of_the_header(field, tmp_path):
    """Of a file that is saved as CSV UTF-8."""
    path = tmp_path / "records.csv"
    write_records(path, table_of(of(field, "pendulum", "none")))
    before = read_records(path)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert read_records(path).equals(before)


@pytest.mark.parametrize(
    ("column", "cell", "told"),
    [
        ("length", "abc", "Expected '<N> episodes' or frames, got 'abc'"),
        ("length", "1e6 frames", "Expected '<N> episodes'"),
        ("length", "10 weeks", "Expected '<N> episodes'"),
        ("seed", "9" * 20, "Expected a whole number from 0 to"),
        ("seed", "-1", "Expected a whole number from 0 to"),
        ("last_mean_return", "inf", "Expected a finite number or an empty cell, got 'inf'"),
    ],
)
def test_a_cell_that_cannot_be_is_told_with_its_line(field, tmp_path, column, cell, told):
    """In a file of records."""
    path = tmp_path / "records.csv"
    write_records(path, table_of(of(field, "pendulum", "none")))
    header, first, *rest = path.read_text().splitlines()
    cells = first.split(",")
    cells[header.split(",").index(column)] = cell
    path.write_text("\n".join([header, ",".join(cells), *rest]))
    with pytest.raises(ValueError, match=f"records.csv, line 2: .*{told}"):
        read_records(path)
