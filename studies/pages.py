"""Writes the generated parts of the README and of the pages of results, and their pictures.

``python -m studies.pages`` makes them from the records in ``results/*.csv``. A page has each part
between ``<!-- NAME: start -->`` and ``<!-- NAME: end -->``. A picture is drawn again if its records
have changed; to draw it in another way, delete it first.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from studies import field, front_door, half_cheetah, paper, relative, rsl_rl, summary, td3
from studies.cells import (
    digest,
    improvements_over_tasks,
    regrouped,
)
from studies.field import BETTER, TEST, field_groups, field_table
from studies.files import ROOT, records, write_parts
from studies.methods import against_table, choice_table, pairwise_tables
from studies.paper import (
    TAU,
    deployed_table,
    faster_targets_table,
    is_as_usual,
    paper_table,
    shown_groups,
    statistics_table,
)
from studies.summary import OURS, RSL_RL
from studies.targets import gain_targets_table
from torchrl_l2c2.experiment.analysis.reports.figures import draw_plane
from torchrl_l2c2.experiment.analysis.reports.groups import (
    Group,
    group_records,
    settings_notes,
)
from torchrl_l2c2.experiment.analysis.reports.records import merge
from torchrl_l2c2.experiment.analysis.reports.table import (
    COMPARED,
    comparison_table,
    pipe_table,
)

FRONT_DOOR = ROOT / "results" / "front_door.csv"
FIELD_PAGES = ("field", "hopper", "sac_hopper", "sac_lunarlander", "sac_pendulum", "walker2d")
# The methods that one page compares PPO's preset of L2C2 with.
RIVALS = ("baseline", "CAPS", "CAPS, lambda_spatial=0.005", "CATS")
# Methods of the pictures, each with more than two runs: more than six cannot be told apart.
PICTURED = (*RIVALS, OURS, "L2C2 as in the paper", "L2C2, means 10", "L2C2, means 10, ramp")
TARGETS = ("targets", "runs", "sac_pendulum", "field", "walker2d", "hopper")
# Names of the rows in results/parts.md, by their names in other tables.
PARTS = {
    "baseline": "baseline",
    f"{OURS}, beta=0, neighbors=line": "`regularizer=l2c2`",
    "L2C2, mse 0.01, ramp, beta=0, neighbors=line": "with the paper's gain",
    "L2C2, Hellinger 1, ramp, beta=0, neighbors=line": "with the Hellinger distance",
    "L2C2, Hellinger 4, ramp, beta=0, neighbors=line": (
        "with the Hellinger distance, as strong (`lambda_min=4`)"
    ),
    "L2C2, Hellinger 0.5, ramp, beta=0, neighbors=line": (
        "with the Hellinger distance, as strong (`lambda_min=0.5`)"
    ),
    f"{OURS}, beta=0": "with neighbors in the box",
    f"{OURS}, neighbors=line": "with the value term",
    "L2C2 as in the paper": "the paper's L2C2",
    "L2C2, Hellinger 1": "the paper's L2C2, at a hundred times its gain",
}


class Page(NamedTuple):
    """The generated parts of a page, and its picture.

    Attributes:
        parts (dict): Texts by the names of their marks.
        shown (sequence of Group): The groups of the picture.
        draw (callable): Draws the picture into a file; ``None`` if the page has none.
    """

    parts: dict[str, str]
    shown: Sequence[Group] = ()
    draw: Callable[[Path], None] | None = None


def pages() -> dict[str, Page]:
    """Every page with generated parts, by its path from the root."""
    runs, one, caps = records("runs"), records("one_gain"), records("caps_gains")
    with_mean = runs["differences"].str.contains("algorithm.reduction=mean", regex=False)
    short = runs[~with_mean & (runs["task"] == "reacher") & (runs["length"] == "3000 episodes")]
    averaged, short = group_records(runs[with_mean]), group_records(short)
    caps = merge(caps, one[(one["method"] == "none") & (one["task"] != "walker2d_v5")])
    chosen = [choice_table(each).markdown() for each in (records("field_gains"), one, caps)]
    targets = [
        gain_targets_table(records(*names)).markdown()
        for names in (TARGETS, ["swingup_targets"], ["hopper_targets"])
    ]
    # Only the first one has its title and legend.
    targets[1:] = [text.split("\n\n")[1] for text in targets[1:]]
    return {
        "README.md": Page({"summary": summary.short_table()}),
        "docs/results.md": Page(
            {
                "summary": summary.long_table(),
                "cats": summary.cats_table(),
                "sm": summary.sm_table(),
            }
        ),
        "results/paper.md": _paper_page(runs),
        **{f"results/{name}.md": _field_page(name, records(name)) for name in FIELD_PAGES},
        "results/one_setting.md": _field_page("one_setting", one_setting()),
        "results/other_methods.md": _comparison_page(
            other_methods(),
            "![Return against Sm of Grad-CAPS, ASAP, SR2L and LCP](other_methods.svg)",
            "sm_asap",
        ),
        "results/new_tasks.md": _new_tasks_page(),
        "results/batch_mean.md": Page({"results": paper_table(averaged).markdown()}),
        "results/reacher_3000.md": Page({"results": paper_table(short).markdown()}),
        "results/parts.md": Page({"parts": parts()}),
        "results/front_door.md": Page(
            {
                "results": front_door.table(FRONT_DOOR),
                "gamma": front_door.table(
                    ROOT / "results" / "front_door_gamma.csv", ["TD3", "SAC"]
                ),
                "strengths": front_door.strengths_table(ROOT / "results" / "td3_strength.csv"),
                "sac": front_door.strengths_table(ROOT / "results" / "sac_strength.csv"),
            }
        ),
        "results/rsl_rl.md": Page({"results": front_door.table(RSL_RL, rsl_rl.ITERATIONS)}),
        "results/td3.md": Page(
            {
                "test": td3.test_table(),
                "last": td3.last_policy_table(),
                "choice": td3.first_choice_table(),
            }
        ),
        "results/td3_mujoco.md": _td3_mujoco_page(),
        "results/relative.md": Page({"results": relative.table()}),
        "results/field_gains.md": Page(dict(zip(("rivals", "one", "caps"), chosen, strict=True))),
        "results/targets.md": Page(dict(zip(("all", "swingup", "hopper"), targets, strict=True))),
        "studies/protocol.md": Page({"reacher": reacher_by_seed(runs)}),
    }


def one_setting() -> pd.DataFrame:
    """The records of PPO's one setting and of its rivals."""
    groups = group_records(records("field", "walker2d", "hopper"))
    return regrouped(group for group in groups if group.name in (OURS, *RIVALS))


def other_methods() -> pd.DataFrame:
    """The records of four more methods, and of the same seeds of three methods of the table."""
    own = records("other_methods")
    known = [g for g in group_records(records("field")) if g.name in ("baseline", OURS, "CATS")]
    shown = regrouped(known)
    return merge(own, shown[shown["seed"].isin(own["seed"])])


def parts() -> str:
    """The table of PPO's setting with one part changed at a time, on common seeds."""
    own, others = records("parts"), records("field")
    others = others[
        others["seed"].isin(own["seed"])
        & (others["method"].isin(["none", "l2c2_paper"]) | others["commit"].str.match("e01476b"))
    ]
    table = field_table(merge(own, others))
    kept = ["seeds", *(name for name, _ in COMPARED.values()), *BETTER.values()]
    found = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
    shown = {(row["task"], row["method"]): row for row in found if row["seeds"]}
    columns = ["task", "setting", *kept]
    rows = [columns]
    for task in ("lunarlander", "pendulum"):
        for method, setting in PARTS.items():
            if row := shown.get((task, method)):
                rows.append([task, setting, *(row[column] for column in kept)])
    return pipe_table(rows)


def reacher_by_seed(runs: pd.DataFrame) -> str:
    """Return and action variation of Reacher's late policies with sampled actions."""
    groups = shown_groups(runs[runs["task"] == "reacher"])
    groups = [group for group in groups if group.first.method != "caps"]
    rows = [["seed", *(group.name for group in groups)]]
    runs_of = [{run.seed: run for run in group.runs.itertuples()} for group in groups]
    for seed in sorted({seed for runs in runs_of for seed in runs}):
        found = (runs.get(seed) for runs in runs_of)
        cells = (
            f"{r.late_sampled_return:.1f} / {r.late_sampled_action_variation:.3f}" if r else ""
            for r in found
        )
        rows.append([str(seed), *cells])
    return pipe_table(rows)


def draw_published(
    point: Callable[[Group], Sequence[float] | None], note: str, axis: Any, group: Group, color: str
) -> str | None:
    """Draws a hollow diamond for a group's published results, and dotted bars for deviations."""
    found = point(group)
    if found is None:
        return None
    x, y, *deviations = found
    shape = {"fmt": "D", "markersize": 5, "markerfacecolor": "white", "alpha": 0.8}
    bars = dict(zip(("xerr", "yerr"), deviations, strict=False))
    shape |= {"elinewidth": 0.9} if bars else {}
    for line in axis.errorbar([x], [y], color=color, **bars, **shape)[2]:
        line.set_linestyle(":")
    return note


def _paper_page(runs: pd.DataFrame) -> Page:
    groups = shown_groups(runs)
    usual = [group for group in group_records(runs) if is_as_usual(group, TAU)]
    faster = faster_targets_table(regrouped(usual))
    tables = [deployed_table(groups), statistics_table(groups), faster]
    texts = [
        "![Return against action variation of every method](paper.svg)",
        paper_table(groups).markdown(),
        *settings_notes(groups),
        *(table.markdown() for table in tables),
    ]
    more = partial(draw_published, paper.point, "hollow: the paper")
    draw = partial(draw_plane, groups, "late_sampled", more=more, description=description(groups))
    hopper = paper_table(group_records(records("hopper_terminated")))
    hopper = replace(
        hopper, title="Hopper with another time limit, next to the paper's table", notes=[]
    )
    parts = {"results": "\n\n".join(texts), "hopper": hopper.markdown()}
    return Page(parts, groups, draw)


def _comparison_page(found: pd.DataFrame, picture: str, measure: str) -> Page:
    """A picture, and a table with every measure next to the baseline."""
    groups = group_records(found)
    table = comparison_table(TEST, groups).markdown()
    draw = partial(draw_plane, groups, TEST, measure=measure, description=description(groups))
    return Page({"results": f"{picture}\n\n{table}"}, groups, draw)


def _td3_mujoco_page() -> Page:
    page = _comparison_page(
        records("td3_mujoco"),
        "![Return against action variation of TD3 on InvertedDoublePendulum](td3_mujoco.svg)",
        "action_variation",
    )
    return page._replace(parts={**page.parts, "strength": td3.mujoco_strengths_table()})


def _new_tasks_page() -> Page:
    groups = group_records(records("new_tasks"))
    table, across = comparison_table(TEST, groups), []
    for algorithm, name, ours, better in improvements_over_tasks(groups, TEST, COMPARED):
        runs = str(sum(len(group.runs) for group in ours))
        cells = [cell for each in better for cell in ("", each)]
        across.append([f"{len(ours)} tasks", algorithm, name, runs, *cells])
    table = replace(table, rows=[*table.rows, *across])
    picture = "![Return against action variation on each task](new_tasks.svg)"
    draw = partial(draw_plane, groups, TEST, description=description(groups))
    parts = {
        "results": f"{picture}\n\n{table.markdown()}",
        "half_cheetah": half_cheetah.table(ROOT / "results" / "half_cheetah.csv"),
    }
    return Page(parts, groups, draw)


def _field_page(name: str, shown: pd.DataFrame) -> Page:
    first = [against_table(shown, OURS)] if name in ("hopper", "one_setting") else []
    tables = [field_table(shown), choice_table(shown), *pairwise_tables(shown)]
    groups = [g for g in field_groups(shown) if g.name in PICTURED and len(g.runs) > 2]
    if len({group.name for group in groups}) < 2:
        groups = []  # A picture of one method compares nothing.
    picture = f"![Return against Sm of the main settings, and the published results]({name}.svg)"
    texts = [
        *(table.markdown() for table in first),
        *([picture] if groups else []),
        *(table.markdown() for table in tables),
    ]
    if not groups:
        return Page({"results": "\n\n".join(texts)})
    more = partial(draw_published, field.point, "hollow: published")
    about = description(groups)
    draw = partial(draw_plane, groups, TEST, measure="sm_asap", more=more, description=about)
    return Page({"results": "\n\n".join(texts)}, groups, draw)


def description(shown: Sequence[Group]) -> str:
    """The description of a picture of these groups: a code of their records."""
    return f"records {digest(shown)}"


def is_drawn(path: Path, shown: Sequence[Group]) -> bool:
    """Tells if a picture shows the records of these groups, by its description."""
    return path.exists() and f"{description(shown)}<" in path.read_text()


def main() -> None:
    """Writes the pages and pictures that are not as their records have them, and names them."""
    for name, page in pages().items():
        path = ROOT / name
        write_parts(path, page.parts)
        picture = path.with_suffix(".svg")
        if page.draw is not None and not is_drawn(picture, page.shown):
            page.draw(picture)
            print(f"drawn: {picture.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
