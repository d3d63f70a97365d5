"""Videos of test episodes: as long as the episodes, at the simulator's speed."""

import os
from itertools import pairwise
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from torchrl_l2c2.experiment import Experiment, ExperimentConfig, PPORPEConfig, TaskConfig
from torchrl_l2c2.experiment.analysis.video import play_pictures, record_video, write_video
from torchrl_l2c2.experiment.cli import diagnose
from torchrl_l2c2.experiment.cli.video import main
from torchrl_l2c2.experiment.envs.pictures import Drawing, PictureRecorder
from torchrl_l2c2.experiment.run.policies import load_policy

imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
pytest.importorskip("pygame")
ROOT = Path(__file__).parents[1]


class Bare(gymnasium.Env):
    """Draws nothing."""

    observation_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        return np.zeros(2, np.float32), 0.0, False, False, {}


gymnasium.register("Bare-v0", Bare)


def trained(folder, env_id="Pendulum-v1"):
    config = ExperimentConfig(
        task=TaskConfig("task", env_id, episodes=1, max_steps=20),
        algorithm=PPORPEConfig(hidden=(8,)),
        compile=False,
        late_share=0.0,
    )
    run = Experiment(config, folder)
    run.train()
    run.save()
    run.close()
    return folder


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory):
    return trained(tmp_path_factory.mktemp("run"))


def test_a_video_has_every_state_at_the_simulators_speed(pendulum, tmp_path):
    """Two episodes of 20 steps are 42 pictures, at 20 a second; nothing else stays behind."""
    path = record_video(pendulum, tmp_path / "video.mp4", episodes=2)
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(path))
    assert frames == 42 and seconds == pytest.approx(42 / 20, abs=0.01)
    assert list(tmp_path.iterdir()) == [path]


def test_a_drawing_leaves_states_out(pendulum):
    """Five pictures a second are every fourth step; half a second is ten steps."""
    ((_, whole, *_),) = play_pictures(pendulum, 1)
    ((_, some, rate, every),) = play_pictures(pendulum, 1, drawing=Drawing(rate=5.0, seconds=0.5))
    assert (len(some), rate, every) == (3, 20.0, 4)
    for number, picture in enumerate(some):
        assert np.array_equal(picture, whole[4 * number])


def test_an_untold_rate_is_30_steps_a_second():
    """Half a second is 15 steps, at 15 pictures a second every second one."""

    class Blank(gymnasium.Env):
        observation_space = action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

        def reset(self, **options):
            return np.zeros(1), {}

        def step(self, action):
            return np.zeros(1), 0.0, False, False, {}

        def render(self):
            return np.zeros((2, 2, 3), np.uint8)

    recorder = PictureRecorder(Blank(), Drawing(rate=15.0, seconds=0.5))
    recorder.reset()
    for _ in range(40):
        recorder.step(np.zeros(1))
    assert recorder.every == 2 and len(recorder.pictures()) == 1 + 7


def test_the_pictures_are_those_of_the_test_episode(pendulum):
    """They change as it moves; drawing changes none of its numbers, nor the environment's."""
    before = dict(os.environ)
    ((episode, pictures, rate, every),) = play_pictures(pendulum, 1)
    assert len(pictures) == len(episode) + 1 and (rate, every) == (20.0, 1)
    assert all((a != b).any() for a, b in pairwise(pictures))
    first = load_policy(pendulum)[1].reset()["observation"]
    assert np.array_equal(first.numpy(), episode["observation"][0].numpy())
    assert dict(os.environ) == before


def test_an_encoder_that_cannot_write_is_one_line(tmp_path, monkeypatch):
    """As on a full disk: the encoder's own message is many lines."""

    def full(*_, **__):
        raise OSError("Broken pipe\n\nFFMPEG COMMAND:")
        yield

    monkeypatch.setattr("imageio_ffmpeg.write_frames", full)
    pictures = [np.zeros((4, 4, 3), np.uint8)]
    with pytest.raises(OSError, match=r"^the video could not be written: .*a\.mp4\. Is the disk"):
        write_video(tmp_path / "a.mp4", pictures, 30.0)


def test_a_folder_that_cannot_be_written_to_is_told_before_anything_is_played(
    pendulum, monkeypatch
):
    """Also that of the run itself, by ``video`` and by ``diagnose``."""

    def full(**_):
        raise OSError(30, "Read-only file system")

    def played(*_, **__):
        raise AssertionError

    monkeypatch.setattr("tempfile.TemporaryFile", full)
    monkeypatch.setattr("torchrl_l2c2.experiment.analysis.video.play_pictures", played)
    monkeypatch.setattr("torchrl_l2c2.experiment.analysis.diagnosis.diagnose_run", played)
    for command in (main, diagnose.main):
        with pytest.raises(SystemExit, match=r"cannot be written to \(Read-only file system\)"):
            command([str(pendulum)])


def test_a_task_that_draws_nothing_is_refused(tmp_path):
    """In one line; by the command as well."""
    folder = trained(tmp_path, "Bare-v0")
    with pytest.raises(ValueError, match=r"Bare-v0.*rgb_array"):
        record_video(folder)
    with pytest.raises(SystemExit, match=r"error: .*Bare-v0"):
        main([str(folder)])
    assert not list(folder.glob("*video*"))
