"""Rows against other libraries: ratios of what the processes say, or why there are none."""

import pytest

from benchmarks.peers import Peer, against

SETTINGS = {
    "env_id": "Pendulum-v1",
    "frames": 20,
    "turn": 40,
    "layers": [8],
    "batch": 8,
    "compile": False,
}


@pytest.mark.slow
def test_rows_are_seconds_here_by_seconds_there():
    """Two of the same kind, of which none is a hundred times as fast as the other."""
    rows = list(against("here / there", "sac", "sac", SETTINGS, rounds=1, at_most=0.9))
    assert [row.name.split(", ")[1] for row in rows] == [
        "wall time per frame",
        "CPU time per frame",
    ]
    for row in rows:
        assert row.value == pytest.approx(row.parts["ours us"] / row.parts["theirs us"])
        assert 0.01 < row.value < 100.0


@pytest.mark.slow
def test_a_library_that_is_not_installed_is_named(tmp_path):
    """In its place: a module that cannot be imported."""
    python = tmp_path / "python"
    python.write_text("#!/bin/sh\necho \"not measured: No module named 'sbx'\"\n")
    python.chmod(0o755)
    assert "sbx" in Peer("sbx sac", SETTINGS, str(python)).note
    rows = list(against("a", "sac", "sbx sac", SETTINGS, rounds=1, at_most=0.9, python=str(python)))
    assert all(row.value is None and row.met is None and "sbx" in row.note for row in rows)
