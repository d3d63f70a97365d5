"""One method against each other one, by hand and on the command line."""

import json
import math
from dataclasses import replace

import pytest

from tests.test_reports import make_config, make_run
from torchrl_l2c2.experiment import CATSConfig, PPOConfig
from torchrl_l2c2.experiment.reports import read_runs, write_records
from torchrl_l2c2.experiment.reports.__main__ import main
from torchrl_l2c2.experiment.reports.against import against_table
from torchrl_l2c2.experiment.reports.pairwise import pairwise_tables

# Return, action variation and Sm of seeds 0 and 1.
RUNS = {
    "none": ((10.0, 0.1, 0.4), (20.0, 0.2, 0.1)),
    "l2c2": ((15.0, 0.1, 0.2), (25.0, 0.2, 0.2)),
    "cats": ((25.0, 0.3, 0.3), (25.0, 0.3, 0.3)),
}


@pytest.fixture
def records(tmp_path):
    def add(folder, returned, varied, sm, **settings):
        make_run(folder, make_config(task="pendulum", **settings), 0.0, varied)
        path = folder / "evaluation.json"
        content = json.loads(path.read_text())
        content["summary"] |= {"return_mean": returned, "sm_asap_mean": sm}
        content["summary"] |= {"action_variation_mean": varied}
        path.write_text(json.dumps(content))

    for method, seeds in RUNS.items():
        for seed, figures in enumerate(seeds):
            chosen = CATSConfig() if method == "cats" else method
            settings = {"algorithm": PPOConfig(), "regularizer": chosen, "seed": seed}
            add(tmp_path / method / str(seed), *figures, **settings)
    other = PPOConfig(gamma=0.5)
    add(tmp_path / "other", 99.0, 0.0, 0.0, algorithm=other, regularizer="none")
    return [run.record for run in read_runs(tmp_path)]


def test_a_row_has_both_means_and_how_probable_a_better_run_is(records):
    """Of four pairs three return more, a half is smoother by Sm; a tie counts half."""
    table = against_table(records, "L2C2")
    # The run with another discount is no row.
    assert [row[:4] for row in table.rows] == [
        ["pendulum", "ppo", name, "0, 1"] for name in ("vanilla", "CATS")
    ]
    vanilla, cats = ([cell.split()[0] for cell in row[4:]] for row in table.rows)
    assert vanilla == ["20.00", "15.00", "0.75", "0.200", "0.250", "0.50", "0.150", "0.150", "0.50"]
    assert cats == ["20.00", "25.00", "0.25", "0.200", "0.300", "1.00", "0.150", "0.300", "1.00"]


def test_seeds_without_a_measure_are_told(records):
    """As of a policy whose only test episode had two frames; they are in no mean and in no pair."""
    lacking = [
        replace(r, last_mean_sm_asap=math.nan) if (r.method, r.seed) == ("l2c2", 1) else r
        for r in records
    ]
    row = against_table(lacking, "L2C2").rows[0]
    assert row[4] == "20.00" and row[7].endswith(", of 1 runs")
    notes = [table.notes for table in pairwise_tables(lacking)]
    assert [len(each) for each in notes] == [1, 2]
    assert notes[1][1] == "Not all runs have it: pendulum, L2C2, of 1 runs."


def test_the_command_prints_it_and_has_it_on_a_page_and_in_a_report(records, tmp_path, capsys):
    """The same table in all three."""
    file, page = tmp_path / "records.csv", tmp_path / "page.md"
    write_records(file, records)
    page.write_text("<!-- results: start -->\n<!-- results: end -->\n")
    table = against_table(records, "L2C2").markdown()
    main(["--from", str(file), "--against", "L2C2", "--page", str(page)])
    assert table in capsys.readouterr().out and table in page.read_text()
    main(["--from", str(file), "--against", "L2C2", "--output", str(tmp_path / "report")])
    assert table in (tmp_path / "report" / "report.md").read_text()


def test_what_has_nothing_beside_it_is_refused_with_what_there_is(records, tmp_path, capsys):
    """An unknown name, a method alone; scores have no such table."""
    file = tmp_path / "records.csv"
    write_records(file, records)
    page = tmp_path / "page.md"
    page.write_text(marks := "<!-- results: start -->\n<!-- results: end -->\n")
    with pytest.raises(SystemExit, match=r"error: --against .* got 'L2'; here there are vanilla; "):
        main(["--from", str(file), "--against", "L2", "--page", str(page)])
    assert page.read_text() == marks
    with pytest.raises(ValueError, match="here there are CATS"):
        against_table([record for record in records if record.method == "cats"], "CATS")
    with pytest.raises(SystemExit):
        main(["--from", str(file), "--against", "L2C2", "--score"])
    assert "leave it or --against out" in capsys.readouterr().err
