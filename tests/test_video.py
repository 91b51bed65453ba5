"""--capture-video and --render: pictures, returns as without them, and machines that cannot draw.

Of one script: the other has the same lines, which a test on their difference holds equal.
"""

import re
from ctypes.util import find_library
from pathlib import Path

import pytest
from conftest import ROOT, python, run
from test_commands import QUICK, read_json

pytest.importorskip("moviepy")
iio = pytest.importorskip("imageio.v3")
pytestmark = pytest.mark.slow
needs_osmesa = pytest.mark.skipif(not find_library("OSMesa"), reason="OSMesa, package libosmesa6, is missing")

SCRIPT = "refineppo_continuous.py"
FLAGS = (*QUICK, "--env-id", "Hopper-v5", "--max-episode-steps", 30, "--final-eval-episodes", 2)


def check_evaluation(run_dir: Path, *flags, **env) -> list[int]:
    """The returns that --evaluate prints are the run's own; their episodes' lengths."""
    done = run(SCRIPT, "--evaluate", run_dir / "best.pt", "--final-eval-episodes", 2, *flags, **env)
    assert done.returncode == 0 and "Warning" not in done.stderr, done.stderr  # SDL may say something there
    printed = re.findall(r"return (\S+), length (\d+)\n", done.stdout)
    returns = read_json(run_dir / "result.json")["best"]["returns"]
    assert [value for value, _ in printed] == [f"{value:.3f}" for value in returns] and returns[0] != returns[1]
    return [int(length) for _, length in printed]


def check_videos(folder: Path, lengths: list[int]):
    """A picture of the reset and one of every step (moviepy may round the last one off), of things that move."""
    videos = sorted((iio.imread(path, plugin="FFMPEG") for path in folder.iterdir()), key=len)
    assert all(video.std() > 10 and (video[0] != video[-1]).any() for video in videos)
    for video, length in zip(videos, sorted(lengths), strict=True):
        assert len(video) in (length, length + 1)


@needs_osmesa
def test_videos_of_mujoco(tmp_path):
    done = run(SCRIPT, *FLAGS, "--run-dir", tmp_path, "--capture-video", MUJOCO_GL="osmesa")
    assert done.returncode == 0 and done.stderr == "", done.stderr
    lengths = check_evaluation(tmp_path)
    assert check_evaluation(tmp_path, "--capture-video", MUJOCO_GL="osmesa") == lengths
    check_videos(tmp_path / "videos", lengths)
    check_videos(tmp_path / "best.videos", lengths)


FAR_AWAY = """
from refineppo_continuous import Args, make_env

task = make_env(Args(env_id="HalfCheetah-v5"), "rgb_array")
task.reset(seed=0)
for x in (0.0, 100.0):
    task.unwrapped.data.qpos[0] = x
    task.step(task.action_space.low)
    red, green, blue = task.render().astype(int).T
    print((red > blue + 40).sum())  # of the robot, which alone is orange
task.close()
"""


@needs_osmesa
def test_the_camera_follows_the_robot():
    done = python("-c", FAR_AWAY, MUJOCO_GL="osmesa")
    near, far = map(int, done.stdout.split())
    assert near > 1000 and far > 1000, done.stderr


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "BipedalWalker-v3"])
def test_window_and_videos_of_pygame(env_id, tmp_path):
    assert run(SCRIPT, *FLAGS, "--env-id", env_id, "--run-dir", tmp_path).returncode == 0
    assert check_evaluation(tmp_path, "--render", SDL_VIDEODRIVER="dummy") == [30, 30]
    assert check_evaluation(tmp_path, "--capture-video") == [30, 30]
    check_videos(tmp_path / "best.videos", [30, 30])


@pytest.mark.parametrize(
    "env_id, platform",
    [
        ("Hopper-v5", {"DISPLAY": "", "WAYLAND_DISPLAY": "", "MUJOCO_GL": "glfw"}),  # no screen
        ("Hopper-v5", {"MUJOCO_GL": "nonsense"}),  # MuJoCo cannot even be imported
        ("probe_envs:Counter-v0", {}),  # the task cannot be drawn
        ("toy_env:Coordination-v0", {}),  # it does not know the keyword render_mode
    ],
)
def test_what_cannot_be_drawn_is_refused_before_training(env_id, platform, tmp_path):
    done = run(SCRIPT, *FLAGS, "--env-id", env_id, "--run-dir", tmp_path / "run", "--capture-video", **platform)
    assert done.returncode == 2 and done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert "MUJOCO_GL=egl" in line and "Traceback" not in line
    assert list(tmp_path.iterdir()) == []


def test_window_of_mujoco_without_a_screen():
    """GLFW ends the whole process there."""
    policy = ROOT / "sweeps/results/policies/Hopper-v5.pt"
    done = run(SCRIPT, "--evaluate", policy, "--render", DISPLAY="", WAYLAND_DISPLAY="", MUJOCO_GL="glfw")
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "a window needs a screen" in done.stderr.splitlines()[-1]
