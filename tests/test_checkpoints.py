"""Checkpoint files: whole or refused, the newest whole one first, and no code inside."""

import io
import json
import pickle
import struct

import pytest
import torch

from torchrl_l2c2.experiment.run import checkpoints
from torchrl_l2c2.experiment.run.checkpoints import (
    FORMAT_VERSION,
    HEADER,
    MAGIC,
    CheckpointError,
    list_checkpoints,
    load_checkpoint,
    load_newest,
    save_checkpoint,
)
from torchrl_l2c2.experiment.run.files import append_line
from torchrl_l2c2.experiment.run.folder import prepare_folder
from torchrl_l2c2.experiment.settings.config import ExperimentConfig

STATE = {"weights": torch.arange(100.0), "episode": 7, "names": ["a", "b"]}


def test_what_reads_back_otherwise_leaves_the_older_one(tmp_path, monkeypatch):
    """On a disk that loses a byte, the last good checkpoint is not removed for a bad one."""
    older, write = save_checkpoint(tmp_path, 1, {"a": 1}, keep=1), checkpoints.write_atomically
    monkeypatch.setattr(checkpoints, "write_atomically", lambda path, c: write(path, c[:-1]))
    with pytest.raises(OSError, match="was damaged while it was written"):
        save_checkpoint(tmp_path, 2, {"a": 2}, keep=1)
    assert list_checkpoints(tmp_path) == [older]


def truncated(path):
    path.write_bytes(path.read_bytes()[:-10])


def bit_flipped(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def emptied(path):
    path.write_bytes(b"")


def of_another_version(path):
    content = bytearray(path.read_bytes())
    struct.pack_into("<I", content, len(MAGIC), FORMAT_VERSION + 1)
    path.write_bytes(content)


def of_something_else(path):
    path.write_bytes(b"\x89PNG" + bytes(HEADER.size))


def test_what_is_saved_comes_back(tmp_path):
    """Tensors and plain values, unchanged."""
    loaded = load_checkpoint(save_checkpoint(tmp_path, 7, STATE, keep=2))
    assert torch.equal(loaded["weights"], STATE["weights"])
    assert (loaded["episode"], loaded["names"]) == (7, ["a", "b"])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (truncated, "damaged, its checksum differs"),
        (bit_flipped, "damaged, its checksum differs"),
        (emptied, "is incomplete, with only 0 bytes"),
        (
            of_another_version,
            f"version {FORMAT_VERSION + 1}, .* only version {FORMAT_VERSION}",
        ),
        (of_something_else, "not a checkpoint of torchrl_l2c2"),
    ],
)
def test_damage_is_told_and_the_one_before_is_used(tmp_path, damage, message):
    """Never wrong numbers: the previous checkpoint, with the reason."""
    older = save_checkpoint(tmp_path, 1, {"episode": 1}, keep=2)
    newer = save_checkpoint(tmp_path, 2, {"episode": 2}, keep=2)
    damage(newer)
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint(newer)
    path, state, damaged = load_newest(tmp_path)
    assert path == older and state["episode"] == 1
    assert len(damaged) == 1 and newer.name in damaged[0]
    damage(older)
    with pytest.raises(CheckpointError, match="all checkpoints are damaged"):
        load_newest(tmp_path)


def test_a_missing_file_is_named(tmp_path):
    """The path and the system's reason."""
    with pytest.raises(CheckpointError, match=r"gone\.pt: cannot be read \(No such file"):
        load_checkpoint(tmp_path / "gone.pt")
    assert load_newest(tmp_path) is None


def test_old_ones_are_removed_by_count_newest_first(tmp_path):
    """`keep` of them stay."""
    (tmp_path / "checkpoint_mine.pt").touch()  # A user's own is none of them.
    for episode in (5, 40, 300):
        save_checkpoint(tmp_path, episode, STATE, keep=2)
    assert [path.name for path in list_checkpoints(tmp_path)] == [
        "checkpoint_00000300.pt",
        "checkpoint_00000040.pt",
    ]


def test_a_failed_write_leaves_what_was_there(tmp_path, monkeypatch):
    """A full disk: an error, the older checkpoint untouched, no partial file."""
    older = save_checkpoint(tmp_path, 1, STATE, keep=1)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        save_checkpoint(tmp_path, 2, STATE, keep=1)
    assert [path.name for path in tmp_path.iterdir()] == [older.name]
    assert load_checkpoint(older)["episode"] == 7


def test_code_in_a_checkpoint_does_not_run(tmp_path):
    """A pickled call is refused even under a right checksum."""
    import hashlib
    import io

    class Harm:
        def __reduce__(self):
            return (open, (str(tmp_path / "harm"), "w"))

    content = io.BytesIO()
    torch.save({"harm": Harm()}, content, pickle_module=pickle)
    payload = content.getvalue()
    path = tmp_path / "checkpoint_00000001.pt"
    header = HEADER.pack(MAGIC, FORMAT_VERSION, hashlib.sha256(payload).digest())
    path.write_bytes(header + payload)
    with pytest.raises(CheckpointError, match="content cannot be read"):
        load_checkpoint(path)
    assert not (tmp_path / "harm").exists()


def test_a_damaged_newer_one_does_not_take_the_place_of_what_is_written(tmp_path):
    """A run that went on from an older one has its own checkpoint, whatever the number."""
    save_checkpoint(tmp_path, 90, STATE, keep=1)
    emptied(save_checkpoint(tmp_path, 100, STATE, keep=2))
    save_checkpoint(tmp_path, 95, STATE, keep=1)
    path, state, damaged = load_newest(tmp_path)
    assert path.name == "checkpoint_00000095.pt" and state["episode"] == 7 and len(damaged) == 1


def test_a_line_that_the_disk_has_no_room_for_is_taken_back(tmp_path, monkeypatch):
    """The system may write a part of it, and say how much."""
    path = tmp_path / "metrics.csv"
    append_line(path, "whole\n")

    class Full(io.FileIO):
        def write(self, content):
            return super().write(content[:2])

    monkeypatch.setattr(
        "torchrl_l2c2.experiment.run.files.open",
        lambda path, *_, **__: Full(path, "ab"),
        raising=False,
    )
    with pytest.raises(OSError, match="No space left on device: the file could not be written"):
        append_line(path, "another\n")
    assert path.read_text() == "whole\n"


def test_after_training_its_settings_and_versions_stay(tmp_path, monkeypatch):
    """A test of another day does not change what the training was made with."""
    before = ExperimentConfig(late_share=1.0, evaluate_every=5)
    monkeypatch.setattr("torchrl_l2c2.experiment.run.folder.code_commit", lambda: "first")
    prepare_folder(tmp_path, before.to_dict(), resumed=False, ended=False)
    monkeypatch.setattr("torchrl_l2c2.experiment.run.folder.code_commit", lambda: "second")
    again = ExperimentConfig(late_share=0.1, test_episodes=3)
    prepare_folder(tmp_path, again.to_dict(), resumed=True, ended=True)
    written = json.loads((tmp_path / "config.json").read_text())
    assert (written["late_share"], written["evaluate_every"]) == (1.0, 5)
    assert written["test_episodes"] == 3
    versions = tmp_path / "versions.json"
    assert json.loads(versions.read_text())["commit"] == "first"
    for commit in ("first+second", "first+second"):  # It is continued there, twice.
        prepare_folder(tmp_path, before.to_dict(), resumed=True, ended=False)
        assert json.loads(versions.read_text())["commit"] == commit
    versions.write_text("{")  # Damaged: the run goes on, and writes it anew.
    prepare_folder(tmp_path, before.to_dict(), resumed=True, ended=False)
    assert json.loads(versions.read_text())["commit"] == "second"


def test_a_run_that_begins_anew_keeps_nothing_of_the_one_before(tmp_path):
    """One that goes on from a checkpoint does."""
    of_the_way = [tmp_path / name for name in ("metrics.csv", "policy_best.pt", "evaluations.json")]
    for resumed in (True, False):
        for path in of_the_way:
            path.touch()
        prepare_folder(tmp_path, ExperimentConfig().to_dict(), resumed=resumed, ended=False)
        assert [path.exists() for path in of_the_way] == [resumed] * 3
