"""The sweeps' job generators, and their executors on real engines: GNU parallel, xargs and Slurm."""

import csv
import json
import os
import pty
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from functools import cache
from pathlib import Path

import gymnasium as gym
import jobs
import pytest
import tyro
from conftest import ROOT, wait_until
from resume_helpers import TASKS, differences, outcome

import ppo_continuous
import refineppo_continuous
from sweeps.toy_env import phi, psi

MUJOCO = [task for task in TASKS if task.endswith("-v5")]
GENERATORS = "benchmark.sh depth.sh schedule.sh controls.sh learning_rates.sh toy.sh".split()
OWN = "SEEDS STEPS RUNS_DIR SETTINGS FLAGS DONE".split()
TINY = "--no-compile --num-steps 32 --num-minibatches 2 --update-epochs 1 --actor-hidden 16 --critic-hidden 16"
TINY += " --eval-interval 640 --eval-episodes 1 --final-eval-episodes 1 --checkpoint-interval 32"


def environment(folder: Path, **settings) -> dict:
    """What the shell scripts see: this Python first in PATH, and nothing of the caller's own sweeps."""
    clean = {name: value for name, value in os.environ.items() if name not in OWN}
    path = f"{folder / 'bin'}:{Path(sys.executable).parent}:{os.environ['PATH']}"
    return clean | {"PATH": path, "PYTHONPATH": str(ROOT / "tests")} | settings


def shell(folder: Path, script: str, *words, stdin: str = "", **settings) -> subprocess.CompletedProcess:
    """sweeps/SCRIPT, with these environment variables."""
    command, env = [ROOT / "sweeps" / script, *map(str, words)], environment(folder, **settings)
    return subprocess.run(command, cwd=folder, input=stdin, text=True, capture_output=True, timeout=600, env=env)


@cache
def generate(script: str, *tasks, folder: Path = ROOT, **settings) -> list[str]:
    done = shell(folder, script, *tasks, **settings)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.splitlines()


def parse(line: str):
    """The Args of a printed line, read by the script that it calls."""
    python, script, *words = shlex.split(line)
    module = {"ppo_continuous.py": ppo_continuous, "refineppo_continuous.py": refineppo_continuous}[Path(script).name]
    assert python == "python" and (Path(script) == Path(module.__file__) or not Path(script).is_absolute())
    return tyro.cli(module.Args, args=words)


def folders(lines: list[str]) -> list[str]:
    return [Path(parse(line).run_dir).name for line in lines]


def method(args) -> str:
    """K4-average of RefinePPO, ppo-2x128 of PPO with two layers of 128."""
    (width,) = set(args.actor_hidden)
    if args.exp_name == "ppo_continuous":
        return f"ppo-{len(args.actor_hidden)}x{width}"
    assert args.actor_hidden == (128, 128)
    return f"K{args.refinement_depth}-{args.refinement_schedule}"


# --- Generators -------------------------------------------------------------------------------------------------------

TOY = "sweeps.toy_env:Coordination-v0"
CONTROLS = "HalfCheetah-v5 Pusher-v5 Hopper-v5 HumanoidStandup-v5 Swimmer-v5".split()
SWEEPS = [  # steps, tasks, methods
    ("benchmark.sh", 6_000_000, TASKS, "ppo-2x128 K4-average"),
    ("depth.sh", 6_000_000, TASKS, "K1-average K2-average K4-average K8-average"),
    ("schedule.sh", 6_000_000, MUJOCO, "K4-average K4-uniform K4-inverse"),
    ("controls.sh", 1_000_000, CONTROLS, "K1-average K2-average K8-average K4-uniform K4-inverse ppo-5x128 ppo-2x256"),
    ("toy.sh", 50_000, [TOY], "ppo-2x128 K1-average K1-uniform K2-average K2-uniform K4-average K4-uniform"),
]


@pytest.mark.slow
@pytest.mark.parametrize("script, steps, tasks, methods", SWEEPS, ids=[script for script, *_ in SWEEPS])
def test_a_sweep_is_complete(script, steps, tasks, methods):
    args = [parse(line) for line in generate(script)]
    assert [a.seed for a in args] == sorted(a.seed for a in args)  # all tasks of seed 1 first
    assert all(a.resume and a.total_timesteps == steps for a in args)
    expected = [(task, seed, name) for task in tasks for seed in range(1, 6) for name in methods.split()]
    if script == "controls.sh":  # where the observation is long, as many multiplications ask for a narrower actor
        narrow = "HumanoidStandup-v5", "ppo-2x256"
        expected = [(task, seed, "ppo-2x216" if (task, name) == narrow else name) for task, seed, name in expected]
    assert sorted((a.env_id, a.seed, method(a)) for a in args) == sorted(expected)
    assert len({a.run_dir for a in args}) == len(args)


def test_learning_rates_are_a_third_and_three_times_the_tasks(tmp_path):
    (tmp_path / "tuned" / "ppo").mkdir(parents=True)
    (tmp_path / "tuned" / "ppo" / "Swimmer-v5.args").write_text("--learning-rate 6e-4")
    args = [parse(line) for line in generate("learning_rates.sh", folder=tmp_path, SETTINGS="tuned")]
    runs = [(task, name) for task in CONTROLS for name in ("ppo-2x128", "K4-average", "K4-uniform")]
    rates = {run: (1e-4, 9e-4) for run in runs if run[0] in ("HalfCheetah-v5", "Hopper-v5", "Swimmer-v5")}
    rates["Swimmer-v5", "ppo-2x128"] = 2e-4, 1.8e-3
    expected = [(*run, seed, rate) for run in rates for seed in (1, 2, 3) for rate in rates[run]]
    assert sorted((a.env_id, method(a), a.seed, a.learning_rate) for a in args) == sorted(expected)
    assert {a.total_timesteps for a in args} == {1_000_000}


def test_a_run_has_one_command_in_all_sweeps():
    benchmark, depth, schedule = (set(generate(f"{name}.sh")) for name in ("benchmark", "depth", "schedule"))
    lines = benchmark | depth | schedule
    assert len({re.search(r"--run-dir (\S+)", line)[1] for line in lines}) == len(lines) == 440  # of 140 + 280 + 135
    shared = [(args.env_id, args.seed) for args in map(parse, benchmark & depth & schedule)]
    assert sorted(shared) == sorted((task, seed) for task in MUJOCO for seed in range(1, 6))


@pytest.mark.slow
@pytest.mark.parametrize(
    "flags, name",
    [
        ("", "ppo__50k__1"),
        ("--actor-hidden 256 256", "ppo__256x256__50k__1"),
        ("--actor-hidden=128 128 --gamma=0.99 --save-every 5000 --no-progress", "ppo__50k__1"),
        ("--learning_rate .001 --no-anneal-lr", "ppo__no-anneal-lr,learning-rate=0.001__50k__1"),
        ("--critic-hidden 8 8 --actor-hidden 8", "ppo__8__critic-hidden=8x8__50k__1"),
        (f"{TINY} --gamma 0.9 --gae-lambda 0.8", "ppo__16__10-flags-[0-9a-f]{8}__50k__1"),
    ],
)
def test_a_folder_says_what_distinguishes_a_run(flags, name):
    ppo, refineppo = generate("benchmark.sh", "Maze:Hard/A-v1", FLAGS=flags, SEEDS="1", SETTINGS="none", STEPS="50000")
    assert re.fullmatch(f"Maze_Hard_A-v1__{name}", *folders([ppo]))
    assert re.fullmatch(f"Maze_Hard_A-v1__{name.replace('ppo', 'refineppo-K4-average')}", *folders([refineppo]))
    given, own = vars(tyro.cli(ppo_continuous.Args, args=shlex.split(flags))), vars(parse(ppo))
    assert {name for name in own if own[name] != given[name]} == {"env_id", "total_timesteps", "run_dir", "resume"}


@pytest.mark.slow
def test_what_can_be_chosen(tmp_path):
    """Tasks, seeds, steps and the folder; and the table of runs that are done."""
    chosen = {"SEEDS": "7 11", "STEPS": "4096", "HOME": str(tmp_path), "RUNS_DIR": "~/my runs"}
    args = [parse(line) for line in generate("benchmark.sh", "Hopper-v5", "Pendulum-v1", **chosen)]
    assert [(a.seed, a.env_id) for a in args[::2]] == [(s, t) for s in (7, 11) for t in ("Hopper-v5", "Pendulum-v1")]
    assert {(a.total_timesteps, Path(a.run_dir).parent) for a in args} == {(4096, tmp_path / "my runs")}
    here, elsewhere = (generate("depth.sh", "Hopper-v5", folder=folder)[0] for folder in (ROOT, tmp_path))
    assert here.startswith("python refineppo_continuous.py ")
    assert elsewhere == here.replace("refineppo_continuous.py", shlex.quote(str(ROOT / "refineppo_continuous.py")), 1)
    assert not any(tmp_path.iterdir())  # a generator prints and does nothing else
    lines = generate("benchmark.sh", "Hopper-v5", "Ant-v5")
    (tmp_path / "runs.csv").write_text(f"task,run,failure\nx,{folders(lines)[2]},\nx,Maze-v0__ppo__6M__1,\n")
    for table in (str(tmp_path / "runs.csv"), "~/runs.csv"):
        left = generate("benchmark.sh", "Hopper-v5", "Ant-v5", DONE=table, HOME=str(tmp_path))
        assert left == lines[:2] + lines[3:]


@pytest.mark.slow
def test_settings_files(tmp_path):
    for file, text in {
        "ppo/Swimmer-v5.args": "--gamma 0.999  # published for this task\n\n--num_envs 4\n--num-steps=512\n",
        "refineppo/Swimmer-v5.args": "--refinement-depth 2 --refinement-schedule uniform --gamma 0.9\n",
        "refineppo/Hopper-v5.args": "# the defaults do\n",
    }.items():
        (tmp_path / "tuned" / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "tuned" / file).write_text(text)
    chosen = {"folder": tmp_path, "SETTINGS": "tuned", "SEEDS": "1"}
    lines = generate("benchmark.sh", "Swimmer-v5", "Hopper-v5", **chosen)
    ppo, refined = map(parse, lines[:2])
    assert (ppo.gamma, ppo.num_envs, ppo.num_steps) == (0.999, 4, 512)
    assert (refined.refinement_depth, refined.refinement_schedule, refined.gamma) == (2, "uniform", 0.9)
    defaults = generate("benchmark.sh", "Swimmer-v5", "Hopper-v5", folder=tmp_path, SETTINGS="none", SEEDS="1")
    assert lines[2:] == defaults[2:]  # an empty file and none are the same settings, and so the same runs
    assert not set(folders(lines[:2])) & set(folders(defaults))

    depths = generate("depth.sh", "Swimmer-v5", **chosen)
    found = [(a.refinement_depth, a.refinement_schedule, a.gamma) for a in map(parse, depths)]
    assert found == [(depth, "uniform", 0.9) for depth in (1, 2, 4, 8)]  # a sweep's own choice wins over the settings
    assert lines[1] in depths
    over = parse(generate("benchmark.sh", "Swimmer-v5", FLAGS="--gamma 0.5", **chosen)[0])
    assert (over.gamma, over.num_envs) == (0.5, 4)


REFUSED = {
    "depth.sh --depth": "--depth",
    "depth.sh 'a task'": "a task",
    "SEEDS='1 two' depth.sh": "SEEDS",
    "SEEDS='1 01' depth.sh": "SEEDS",
    "STEPS=6e6 depth.sh": "STEPS",
    "SETTINGS=no/such depth.sh": "no/such",
    "DONE=no/such.csv depth.sh": "no/such.csv",
    "FLAGS=--no-such-flag depth.sh": "FLAGS: Unrecognized options: --no-such-flag",
    "FLAGS='--refinement-depth 2' depth.sh": "FLAGS: --refinement-depth is the sweep's own",
    "SETTINGS=tuned depth.sh Ant-v5": "refineppo/Ant-v5.args: --seed is the sweep's own",
    "SETTINGS=tuned depth.sh Hopper-v5": "refineppo/Hopper-v5.args: Missing value for argument '--refinement-depth",
    "SETTINGS=tuned depth.sh Pusher-v5": "refineppo/Pusher-v5.args: No closing quotation",
    "toy.sh Hopper-v5": "one task",
    "run_local.sh -j 0": "-j",
    "run_local.sh --dryrun": "--dryrun",
    "run_local.sh no_such_file": "no_such_file",
    "run_local.sh": "no jobs",
    "run_slurm.sh --dry-run --max-running none": "--max-running",
    "run_slurm.sh --dry-run --steps-per-task x": "--steps-per-task",
    "run_slurm.sh --dry-run --time=1:00": "--time",
    "run_slurm.sh --dry-run": "no jobs",
}


@pytest.mark.parametrize("command, sentence", REFUSED.items(), ids=REFUSED)
def test_bad_input_is_refused(command, sentence, tmp_path):
    """Exit 2, and one sentence, before anything was printed or made."""
    (tmp_path / "tuned/refineppo").mkdir(parents=True)
    (tmp_path / "tuned/refineppo/Ant-v5.args").write_text("--seed 1")
    (tmp_path / "tuned/refineppo/Hopper-v5.args").write_text("--refinement-schedule uniform\n--refinement-depth # 2")
    (tmp_path / "tuned/refineppo/Pusher-v5.args").write_text("--gamma 'x")
    words = shlex.split(command)
    settings = dict(word.split("=", 1) for word in words if word.split("=")[0] in OWN)
    script, *flags = words[len(settings) :]
    done = shell(tmp_path, script, *flags, stdin="# nothing\n\n", **settings)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1), done.stderr
    assert done.stderr.startswith(f"{script}: error: ") and sentence in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["tuned"]


@pytest.mark.parametrize("script", [*GENERATORS, "run_local.sh", "run_slurm.sh"])
def test_help(script, tmp_path):
    done = shell(tmp_path, script, "--help")
    assert done.returncode == 0 and f"sweeps/{script}" in done.stdout and "#" not in done.stdout
    assert script not in GENERATORS or all(name in done.stdout for name in OWN)


def test_shellcheck(tmp_path):
    scripts = [*(ROOT / "sweeps").glob("*.sh"), ROOT / ".ci" / "run", ROOT / ".ci" / "engines.sh"]
    checked = subprocess.run(["shellcheck", *scripts], capture_output=True, text=True, env=environment(tmp_path))
    assert (checked.returncode, checked.stdout) == (0, "")


def test_toy_environment():
    env = gym.make(TOY)
    for off, reward in ((0, 0), (0.3, -0.18)):  # both components are off
        (s,), _ = env.reset(seed=3)
        action = [phi(s) + off, psi(s, phi(s)) - off]
        assert env.step(action)[1:4] == (pytest.approx(reward, rel=1e-6, abs=1e-12), True, False)


# --- run_local.sh -----------------------------------------------------------------------------------------------------


@pytest.fixture(params=["parallel", "xargs"])
def engine(request, tmp_path):
    """GNU parallel; or a PATH in which `parallel` is another program, so that xargs is used."""
    if request.param == "xargs":
        other = tmp_path / "bin" / "parallel"
        other.parent.mkdir()
        other.write_text("#!/bin/sh\necho another program\n")
        other.chmod(0o755)
    elif "GNU" not in subprocess.getoutput("parallel --version"):
        pytest.skip("GNU parallel is not installed")


def joblog(folder: Path) -> dict[str, list[int]]:
    """The exit codes of every job's attempts, in their order."""
    codes = {}
    with open(folder / "runs" / "joblog.tsv") as file:
        for row in csv.DictReader(file, delimiter="\t", quoting=csv.QUOTE_NONE):
            codes.setdefault(row["command"], []).append(int(row["exit"]))
    return codes


@pytest.mark.slow
def test_exit_codes_decide(engine, tmp_path):
    """0, 2 and 3 end a job; everything else is tried three times in all; a job that recovers is done."""
    codes = {f"sh -c 'echo says {code}; exit {code}'": code for code in (0, 1, 2, 3, 75, 137)}
    recovers = "test -e crashed || { touch crashed; exit 1; }"
    lines = [*codes, "# a comment", "", recovers, *list(codes)[:2]]
    dry_run = shell(tmp_path, "run_local.sh", "--dry-run", stdin="\n".join(lines))
    assert dry_run.stdout.splitlines() == [*codes, recovers] and not (tmp_path / "runs").exists()
    done = shell(tmp_path, "run_local.sh", "-j", 2, stdin="\n".join(lines))
    assert done.returncode == 1
    attempts = {command: [code] * (1 if code in (0, 2, 3) else 3) for command, code in codes.items()}
    assert joblog(tmp_path) == attempts | {recovers: [1, 0]}
    assert "\n2 done, 4 failed, 1 left\n" in done.stdout
    failures = re.findall(r"^failed \(exit (\d+)\): runs/job-\w+.log\n    says (\d+)", done.stdout, re.M)
    assert sorted(failures) == [("1", "1"), ("137", "137"), ("2", "2"), ("3", "3")]
    assert re.search(r"failed, \d left.* \| failed after \d s \(exit 3: says 3\): runs/job-\w+.log\n", done.stdout)


def training(name: str, steps: int) -> str:
    folder = f"runs/{name}"
    return f"mkdir -p {folder}; touch {folder}/result.json; : --total-timesteps {steps} --run-dir {folder}"


def test_a_run_is_done_when_its_result_is_there(engine, tmp_path):
    """A task that ends the program with exit code 0 has failed."""
    exits = "sh -c 'echo the task says goodbye' x --run-dir=runs/exits --total-timesteps 1000"
    jobs = "\n".join([training("a", 1000), exits, training("b", 3000)])
    first, again = (shell(tmp_path, "run_local.sh", "-j", 1, stdin=jobs) for _ in range(2))
    assert first.returncode == again.returncode == 1
    for said in (first.stdout, again.stdout):
        assert "| failed after 0 s (it ended without a result.json: the task says goodbye): runs/exits.log\n" in said
        assert "\n2 done, 1 failed, 0 left\nfailed (it ended without a result.json): runs/exits.log\n" in said
    assert re.match(r"1 done, 0 failed, 2 left \(about \d s\) \| done after 0 s: runs/a.log\n", first.stdout)
    assert again.stdout.startswith("1 done, 0 failed, 2 left | done before: runs/a.log\n")


def test_what_is_left_is_told_by_the_steps(tmp_path, monkeypatch):
    """1000 steps took 2 s; 2000 and 3000 are left, for two workers, of which one has begun 4 s ago."""
    lines = [training(str(i), 1000 * (i + 1)) for i in range(3)]
    ended = [(lines[0], "done", 2), (training("before", 10**6), "done", 0), ("sh fails", "failed", 50)]
    rows = [json.dumps(dict(zip(("line", "outcome", "seconds"), row))) for row in ended]
    (tmp_path / "jobs").write_text("\n".join([*lines, ended[1][0], "sh fails"]))
    (tmp_path / "outcomes").write_text("\n".join(rows))
    (tmp_path / "running").mkdir()
    (tmp_path / "running" / "1").touch()
    os.utime(tmp_path / "running" / "1", (time.time() - 4,) * 2)
    for workers in ("2", "16"):  # more than are left
        monkeypatch.setenv("SWEEP_JOBS", workers)
        assert jobs.time_left(tmp_path) == pytest.approx((2 * 5000 / 1000 - 4) / 2, abs=0.5)


def test_each_job_has_one_thread_and_its_own_log(engine, tmp_path):
    """Also in folders with a blank, from a list with = in its name; a log that cannot be written fails its job."""
    (tmp_path / "my repository").symlink_to(ROOT)
    line = "echo $OMP_NUM_THREADS$MKL_NUM_THREADS$OPENBLAS_NUM_THREADS '--run-dir'; mkdir 'runs/a b'; "
    line += "touch 'runs/a b/result.json' && : --run-dir 'runs/a b/'"
    (tmp_path / "K=4").write_text(f"{line}\ntrue --run-dir /dev/null/x\n")
    command, env = tmp_path / "my repository/sweeps/run_local.sh", environment(tmp_path, OMP_NUM_THREADS="8")
    done = subprocess.run([command, "K=4"], cwd=tmp_path, text=True, capture_output=True, env=env)
    assert done.returncode == 1 and "1 done, 1 failed, 0 left" in done.stdout and "/dev/null" in done.stderr
    assert (tmp_path / "runs" / "a b.log").read_text() == "111 --run-dir\n"


def tiny_sweep(folder: Path) -> tuple[list[str], Path]:
    """Ten tiny runs, of which one is longer, and one that always fails; and the longer one's folder."""
    lines = generate("benchmark.sh", "Pendulum-v1", folder=folder, SETTINGS="none", FLAGS=TINY, STEPS="64")
    long = lines[0].replace("--total-timesteps 64", "--total-timesteps 24000")
    return [long, *lines[1:], "python no_such_script.py --run-dir runs/broken"], Path(parse(long).run_dir)


def training_of(run_dir: Path) -> int | None:
    """The process that trains in the folder."""
    for process in Path("/proc").glob("[0-9]*"):
        try:
            words, cwd = (process / "cmdline").read_text().split("\0"), (process / "cwd").readlink()
        except OSError:  # it has just ended
            continue
        if "python" in Path(words[0]).name and run_dir in [cwd / word for word in words]:
            return int(process.name)


def parent(process: int) -> int:
    return int(re.search(r"PPid:\t(\d+)", Path(f"/proc/{process}/status").read_text())[1])


def saves(run_dir: Path) -> int:
    """When the run's checkpoint was last written, 0 before."""
    return (run_dir / "last.pt").stat().st_mtime_ns if (run_dir / "last.pt").exists() else 0


def check_tiny_sweep(folder: Path, lines: list[str], long: Path):
    """Every run is complete, and the interrupted one is what it would have been without."""
    for line in lines[:-1]:
        result = json.loads((folder / parse(line).run_dir / "result.json").read_text())
        assert (result["seed"], result["total_timesteps"]) == (parse(line).seed, parse(line).total_timesteps)
    alone = lines[0].replace("--run-dir runs", "--run-dir alone")
    subprocess.run(shlex.split(alone), cwd=folder, env=environment(folder), check=True, capture_output=True)
    assert differences(outcome(folder / long), outcome(folder / "alone" / long.name)) == []


@pytest.mark.slow
def test_a_local_sweep_is_killed_stopped_and_continued(engine, tmp_path):
    """kill -9 of one training is repaired by a new attempt; Ctrl-C in a terminal, and the same command goes on.

    So it does after kill -9 of all that runs the jobs, whose training saves and stops.
    """
    lines, long = tiny_sweep(tmp_path)
    (tmp_path / "jobs").write_text("\n".join(lines))
    command = [str(ROOT / "sweeps" / "run_local.sh"), "-j", "2", "jobs"]
    pid, terminal = pty.fork()
    if not pid:
        os.chdir(tmp_path)
        os.execve(command[0], command, environment(tmp_path))
    run_dir = tmp_path / long
    wait_until(lambda: saves(run_dir))
    os.kill(training_of(run_dir), signal.SIGKILL)
    killed = saves(run_dir)
    wait_until(lambda: saves(run_dir) > killed)
    os.write(terminal, b"\x03")
    wait_until(lambda: os.waitpid(pid, os.WNOHANG)[0])
    os.close(terminal)
    assert not training_of(run_dir) and not (run_dir / "result.json").exists()
    assert joblog(tmp_path)[lines[0]] == [137, 75]

    stopped = saves(run_dir)
    executor = subprocess.Popen(command, cwd=tmp_path, env=environment(tmp_path), start_new_session=True)
    wait_until(lambda: saves(run_dir) > stopped)
    runner = parent(training_of(run_dir))
    executor.kill()
    os.kill(runner, signal.SIGKILL)
    wait_until(lambda: not training_of(run_dir))
    log = (tmp_path / "runs" / f"{long.name}.log").read_text()
    assert log.count("stopped by SIGTERM") == 2 and not (run_dir / "result.json").exists()

    done = shell(tmp_path, "run_local.sh", *command[1:])
    assert done.returncode == 1 and "10 done, 1 failed, 0 left" in done.stdout
    assert "failed (exit 2): runs/broken.log" in done.stdout and "no_such_script.py" in done.stdout
    assert joblog(tmp_path)[lines[0]] == [137, 75, 0]
    check_tiny_sweep(tmp_path, lines, long)


# --- run_slurm.sh -----------------------------------------------------------------------------------------------------


def test_slurm_jobs_are_packed_by_their_steps(tmp_path):
    lines = [f"job{i} --total-timesteps {steps}" for i, steps in enumerate((400, 400, 400, 1000, 100, 2000, 100))]
    words = "--dry-run --max-running 2 --steps-per-task 1000 - -- --time=2:00:00".split()
    done = shell(tmp_path, "run_slurm.sh", *words, stdin="\n".join([*lines, "job7", lines[0]]))
    submission, *rows = done.stdout.splitlines()
    assert done.returncode == 0 and not any(tmp_path.iterdir())
    assert [tuple(row.split("\t")) for row in rows] == list(zip("11234567", [*lines, "job7"]))
    words = shlex.split(submission)
    assert {"--array=1-7%2", "--requeue", "--signal=B:USR1@300", "--open-mode=append", "--time=2:00:00"} <= set(words)


@pytest.mark.skipif(not shutil.which("sbatch"), reason="Slurm is not installed")
def test_a_slurm_sweep_is_preempted_requeued_and_finished(tmp_path):
    """A preempted task is sent back by Slurm, one that was signalled before its time limit by itself."""
    if subprocess.run(["sinfo"], capture_output=True).returncode:
        pytest.skip("Slurm is not running")
    lines, long = tiny_sweep(tmp_path)
    run_dir = tmp_path / long

    def slurm(*words) -> str:
        return subprocess.check_output(words, cwd=tmp_path, env=environment(tmp_path), text=True)

    def state(task: str, name="JobState") -> str:
        return re.search(rf"{name}=(\w+)", slurm("scontrol", "show", "job", task))[1]

    def queued(*flags) -> list[str]:
        return slurm("squeue", "--noheader", "--array", "--format=%i", f"--job={job}", *flags).split()

    def hurry() -> bool:
        """Slurm lets a requeued job wait for two minutes, and holds it if the node was not ready for it."""
        for waiting in queued("--states=PD"):
            subprocess.run(["scontrol", "release", waiting], capture_output=True)
            subprocess.run(["scontrol", "update", f"JobId={waiting}", "StartTime=now"], capture_output=True)
        return True

    submitted = shell(tmp_path, "run_slurm.sh", "--steps-per-task", 128, "--max-running", 3, stdin="\n".join(lines))
    job = re.match(r"submitted job (\d+): 11 jobs in 7 tasks", submitted.stdout)[1]
    task = f"{job}_1"
    wait_until(lambda: saves(run_dir))
    high = slurm("sbatch", "--parsable", "--partition=high", "--exclusive", "--wrap=true").strip()  # the whole machine
    wait_until(lambda: state(high) == "COMPLETED")
    wait_until(lambda: state(task) == "PENDING")
    before = saves(run_dir)
    wait_until(lambda: hurry() and saves(run_dir) > before, pause=0.5)
    slurm("scancel", "--batch", "--signal=USR1", task)
    wait_until(lambda: state(task) == "PENDING")
    assert int(state(task, "Restarts")) >= 2 and not (run_dir / "result.json").exists()
    wait_until(lambda: hurry() and not queued(), pause=1)
    assert [state(f"{job}_{i}") for i in range(1, 8)] == ["COMPLETED"] * 6 + ["FAILED"]
    assert joblog(tmp_path)[lines[0]][-1] == 0 and joblog(tmp_path)[lines[-1]] == [2]
    first, last = ((tmp_path / "runs" / "slurm" / f"{job}_{i}.log").read_text() for i in (1, 7))
    assert "DUE TO JOB REQUEUE" in first  # it waits for that, since Slurm takes a job that ends before for failed
    assert "failed (exit 2): runs/broken.log" in last
    check_tiny_sweep(tmp_path, lines, long)
