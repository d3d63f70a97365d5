"""How long a sweep takes on so many cores, on paper."""

import math
import re
from pathlib import Path

import pytest

from benchmarks.cores import RECORDS, makespan, recorded, report, sweep
from torchrl_l2c2.experiment.analysis.reports.records import merge, read_records

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(("cores", "hours"), [(1, 15.0), (2, 10.0), (3, 8.0), (4, 7.0), (9, 6.0)])
def test_a_free_core_takes_the_next_run(cores, hours):
    """By hand: 1, 2, 3, 3 and 6 hours in this order."""
    assert makespan([1.0, 2.0, 3.0, 3.0, 6.0], cores) == hours


def test_the_table_has_all_of_the_papers_runs():
    """A seed's runs before the next seed's."""
    runs = sweep()
    assert len(runs) == 288 and len(set(runs)) == 16 and runs[:16] == runs[16:32]


def test_a_run_takes_what_those_of_the_tables_settings_took():
    """Neither other lengths, nor other settings of the algorithm, nor what no run says."""
    run = read_records(RECORDS).iloc[:1].assign(task="swingup", algorithm="ppo_rpe", method="l2c2")
    run = run.assign(length="350 episodes", differences="", seconds=120.0)
    others = [
        run.assign(length="300 episodes", seconds=60.0),
        run.assign(settings="x", differences="algorithm.tau=0.5", seconds=90.0),
        run.assign(seed=1, seconds=math.nan),
    ]
    ours = merge(*others, run, run.assign(seed=2, seconds=130.0))
    assert recorded(ours, "swingup", "l2c2") == [120, 130]
    assert recorded(merge(*others), "swingup", "l2c2") == recorded(run, "swingup", "caps") == []


def test_the_page_says_where_it_stops_scaling():
    """Four runs of an hour and one of three: with three cores they end with the longest."""
    where = {"commit": "abc", "cpu": "a processor", "cores": 2, "load": 1.0}
    page = report([3600.0] * 4 + [3 * 3600.0], [], where)
    assert "| 1 | 7.0 | 100% |" in page and "| 2 | 5.0 | 70% |" in page
    assert "The longest takes 3.0 hours" in page and "from 5 cores on" in page


def test_the_guide_has_the_hours_of_the_page():
    """Hours of one core."""
    guide, page = ((ROOT / name).read_text() for name in ("docs/experiment.md", "results/cores.md"))
    (told,) = re.findall(r"\[(\d+) hours of one core\]", guide)
    assert f"one core each, {told} hours in all" in page
