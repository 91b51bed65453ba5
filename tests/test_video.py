"""--capture-video and --render: pictures, returns as without them, and machines that cannot draw."""

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

SCRIPT = "refineppo_continuous.py"  # the other has the same lines, which a test on their difference holds equal
FLAGS = (*QUICK, "--env-id", "Hopper-v5", "--max-episode-steps", 30, "--final-eval-episodes", 2)


def printed(done) -> list[tuple[str, str]]:
    assert done.returncode == 0, done.stderr
    return re.findall(r"return (\S+), length (\d+)\n", done.stdout)


def check_videos(folder: Path, lengths: list[str]):
    """A picture of the reset and one of every step (moviepy may round the last one off), of things that move."""
    videos = sorted((iio.imread(path, plugin="FFMPEG") for path in folder.iterdir()), key=len)
    assert all(video.std() > 10 and (video[0] != video[-1]).any() for video in videos)
    for video, length in zip(videos, sorted(map(int, lengths)), strict=True):
        assert len(video) in (length, length + 1)


@needs_osmesa
def test_videos_of_mujoco(tmp_path):
    done = run(SCRIPT, *FLAGS, "--run-dir", tmp_path / "run", "--capture-video", MUJOCO_GL="osmesa")
    assert done.returncode == 0 and done.stderr == "", done.stderr
    evaluate = ("--evaluate", tmp_path / "run" / "best.pt", "--final-eval-episodes", 2)
    plain = printed(run(SCRIPT, *evaluate))
    recorded = run(SCRIPT, *evaluate, "--capture-video", MUJOCO_GL="osmesa")
    assert printed(recorded) == plain and recorded.stderr == ""
    returns = read_json(tmp_path / "run" / "result.json")["best"]["returns"]
    assert [f"{value:.3f}" for value in returns] == [value for value, _ in plain]
    for folder in ("videos", "best.videos"):
        check_videos(tmp_path / "run" / folder, [length for _, length in plain])


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
    assert all(int(pixels) > 1000 for pixels in done.stdout.split()) and len(done.stdout.split()) == 2, done.stderr


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "BipedalWalker-v3"])
def test_window_and_videos_of_pygame(env_id, tmp_path):
    flags = (*FLAGS, "--env-id", env_id, "--run-dir", tmp_path / "run")
    assert run(SCRIPT, *flags).returncode == 0
    evaluate = ("--evaluate", tmp_path / "run" / "best.pt", "--final-eval-episodes", 2)
    plain = printed(run(SCRIPT, *evaluate))
    assert len(plain) == 2 and plain[0] != plain[1]
    assert printed(run(SCRIPT, *evaluate, "--render", SDL_VIDEODRIVER="dummy")) == plain
    assert printed(run(SCRIPT, *evaluate, "--capture-video")) == plain
    check_videos(tmp_path / "run" / "best.videos", ["30", "30"])


@pytest.mark.parametrize(
    "env_id, platform",
    [
        ("Hopper-v5", {"DISPLAY": "", "WAYLAND_DISPLAY": "", "MUJOCO_GL": "glfw"}),  # no screen
        ("Hopper-v5", {"MUJOCO_GL": "nonsense"}),  # MuJoCo cannot even be imported
        ("probe_envs:Counter-v0", {}),  # the task cannot be drawn
        ("toy_env:Coordination-v0", {"PYTHONPATH": str(ROOT / "sweeps")}),  # it does not know the keyword render_mode
    ],
)
def test_what_cannot_be_drawn_is_refused_before_training(env_id, platform, tmp_path):
    done = run(SCRIPT, *FLAGS, "--env-id", env_id, "--run-dir", tmp_path / "run", "--capture-video", **platform)
    assert done.returncode == 2 and done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert "MUJOCO_GL=egl" in line and "Traceback" not in line
    assert list(tmp_path.iterdir()) == []


def test_window_of_mujoco_without_a_screen(tmp_path):
    """GLFW ends the whole process there."""
    assert run(SCRIPT, *FLAGS, "--run-dir", tmp_path / "run").returncode == 0
    evaluate = ("--evaluate", tmp_path / "run" / "best.pt", "--render")
    done = run(SCRIPT, *evaluate, DISPLAY="", WAYLAND_DISPLAY="", MUJOCO_GL="glfw")
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "a window needs a screen" in done.stderr.splitlines()[-1]
