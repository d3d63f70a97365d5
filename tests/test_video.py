"""Videos of test episodes: as long as the episodes, at the simulator's speed."""

import os
from itertools import pairwise
from pathlib import Path
from typing import ClassVar

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


class Drawn(gymnasium.Env):
    """Draws what it is told to."""

    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 30}
    observation_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    picture = staticmethod(lambda step: None)

    def __init__(self, render_mode=None):
        self.render_mode = render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.steps += 1
        return np.zeros(2, np.float32), 0.0, False, False, {}

    def render(self):
        return type(self).picture(self.steps)


gymnasium.register("Canvas-v0", Drawn)


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


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    return trained(tmp_path_factory.mktemp("drawn"), "Canvas-v0")


def frames_of(path):
    frames = imageio_ffmpeg.read_frames(str(path))
    width, height = next(frames)["size"]
    return [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in frames]


def test_every_state_has_its_own_picture(drawn, tmp_path, monkeypatch):
    """Also if the task draws all of them into one array, here with opacity and odd sides."""
    canvas = np.full((31, 41, 4), 255, np.uint8)

    def onto_the_canvas(step):
        canvas[..., :3] = 10 * step
        return canvas

    monkeypatch.setattr(Drawn, "picture", staticmethod(onto_the_canvas))
    seen = frames_of(record_video(drawn, tmp_path / "video.mp4"))
    assert len(seen) == 21 and seen[0].shape == (32, 42, 3)
    for step, frame in enumerate(seen):
        assert abs(frame.astype(float) - 10 * step).max() < 5


@pytest.mark.parametrize(
    ("picture", "message"),
    [
        (lambda step: None, r"return an array \[H, W, 3\] of uint8, got NoneType"),
        (lambda step: [np.zeros((8, 8, 3), np.uint8)], "of uint8, got list"),
        (lambda step: np.zeros((8, 8, 3)), r"got float64 of shape \(8, 8, 3\)"),
        (lambda step: np.zeros((8, 8), np.uint8), r"got uint8 of shape \(8, 8\)"),
        (
            lambda step: np.zeros((8 + step, 8, 3), np.uint8),
            r"have one size, got \(8, 8\) and then \(9, 8\)",
        ),
    ],
)
def test_what_is_no_picture_is_refused(drawn, tmp_path, monkeypatch, capsys, picture, message):
    """The encoder would write other pictures. The page of ``diagnose`` leaves them out."""
    monkeypatch.setattr(Drawn, "picture", staticmethod(picture))
    with pytest.raises(SystemExit, match=f"^error: .* of Canvas-v0 .*{message}"):
        main([str(drawn), "--output", str(tmp_path / "video.mp4")])
    assert not list(tmp_path.iterdir())
    diagnose.main([str(drawn), "--episodes", "1", "--output", str(tmp_path / "page.html")])
    assert "<video" not in (tmp_path / "page.html").read_text()


def test_a_missing_graphics_library_is_one_line_with_its_remedy(drawn, monkeypatch, capsys):
    """Any other error in a user's own drawing has its traceback."""

    def without(step):
        raise RuntimeError("an OpenGL platform library\nhas not been loaded")

    monkeypatch.setattr(Drawn, "picture", staticmethod(without))
    with pytest.raises(SystemExit, match=r"Canvas-v0 could not draw .*loaded\. Set MUJOCO_GL=egl"):
        main([str(drawn)])
    assert "Traceback" not in capsys.readouterr().err
    monkeypatch.setattr(Drawn, "picture", staticmethod(lambda step: {}["canvas"]))
    with pytest.raises(SystemExit, match="Canvas-v0 could not draw its pictures: KeyError"):
        main([str(drawn)])
    assert "Traceback" in capsys.readouterr().err


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
