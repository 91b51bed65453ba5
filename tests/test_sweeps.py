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
from pathlib import Path

import gymnasium as gym
import pytest
import tyro
from conftest import ROOT
from resume_helpers import differences, outcome
from test_commands import TASKS

import ppo_continuous
import refineppo_continuous
from sweeps.toy_env import phi, psi

MUJOCO = TASKS[:9]
TINY = "--no-compile --num-steps 32 --num-minibatches 2 --update-epochs 1 --actor-hidden 16 --critic-hidden 16"
TINY += " --eval-interval 640 --eval-episodes 1 --final-eval-episodes 1 --checkpoint-interval 32"


def environment(folder: Path, **settings) -> dict:
    """What the shell scripts see: this Python first in PATH, and nothing of the caller's own sweeps."""
    bin_folder = str(Path(sys.executable).parent)
    clean = {k: v for k, v in os.environ.items() if k not in ("SEEDS", "STEPS", "RUNS_DIR", "SETTINGS")}
    paths = os.pathsep.join([str(ROOT / "tests"), os.environ.get("PYTHONPATH", "")])
    return clean | {"PATH": f"{folder / 'bin'}:{bin_folder}:{os.environ['PATH']}", "PYTHONPATH": paths} | settings


def shell(folder: Path, script: str, *words, stdin: str = "", **settings) -> subprocess.CompletedProcess:
    """sweeps/SCRIPT, with these environment variables."""
    return subprocess.run([ROOT / "sweeps" / script, *map(str, words)], cwd=folder, input=stdin, text=True,
                          capture_output=True, timeout=600, env=environment(folder, **settings))  # fmt: skip


def generate(folder: Path, script: str, *tasks, **settings) -> list[str]:
    done = shell(folder, script, *tasks, **settings)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.splitlines()


def parse(line: str):
    """The Args of a printed line, read by the script that it calls."""
    python, script, *words = shlex.split(line)
    module = {"ppo_continuous.py": ppo_continuous, "refineppo_continuous.py": refineppo_continuous}[Path(script).name]
    assert python == "python" and (Path(script) == Path(module.__file__) or not Path(script).is_absolute())
    return tyro.cli(module.Args, args=words)


# --- Generators -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("script, tasks, per_task", [
    ("benchmark.sh", TASKS, {("ppo", None, None), ("refineppo", 4, "average")}),
    ("depth.sh", TASKS, {("refineppo", k, "average") for k in (1, 2, 4, 8)}),
    ("schedule.sh", MUJOCO, {("refineppo", 4, schedule) for schedule in ("average", "uniform", "inverse")}),
    ("toy.sh", ["sweeps.toy_env:Coordination-v0"],
     {("ppo", None, None)} | {("refineppo", k, s) for k in (1, 2, 4) for s in ("uniform", "average")}),
])  # fmt: skip
def test_a_sweep_is_complete(script, tasks, per_task, tmp_path):
    lines = generate(tmp_path, script)
    assert len(lines) == len(tasks) * len(per_task) * 5 == len(set(lines))
    runs, folders = set(), set()
    for line in lines:
        args = parse(line)
        refinement = getattr(args, "refinement_depth", None), getattr(args, "refinement_schedule", None)
        runs.add((args.env_id, args.seed, args.exp_name.removesuffix("_continuous"), *refinement))
        folders.add(args.run_dir)
        assert args.resume and args.total_timesteps == (50_000 if script == "toy.sh" else 6_000_000)
    assert runs == {(task, seed, *run) for task in tasks for seed in range(1, 6) for run in per_task}
    assert len(folders) == len(lines)
    assert not any(tmp_path.iterdir())


def test_a_run_has_one_command_in_all_sweeps(tmp_path):
    sweeps = [set(generate(tmp_path, f"{name}.sh")) for name in ("benchmark", "depth", "schedule")]
    runs = {line: parse(line) for line in set.union(*sweeps)}
    assert len({args.run_dir for args in runs.values()}) == len(runs) == 440  # of 140 + 280 + 135 lines
    shared = {(runs[line].env_id, runs[line].seed) for line in set.intersection(*sweeps)}
    assert shared == {(task, seed) for task in MUJOCO for seed in range(1, 6)}


def test_tasks_seeds_steps_and_folders_can_be_chosen(tmp_path):
    chosen = {"SEEDS": "7 11", "STEPS": "4096", "RUNS_DIR": "my runs"}
    lines = generate(tmp_path, "benchmark.sh", "Hopper-v5", "Pendulum-v1", **chosen)
    args = [parse(line) for line in lines]
    assert [(a.env_id, a.seed) for a in args[::2]] == [(t, s) for t in ("Hopper-v5", "Pendulum-v1") for s in (7, 11)]
    assert {a.total_timesteps for a in args} == {4096}
    assert {Path(a.run_dir).parent for a in args} == {Path("my runs")}


def test_commands_are_short_in_the_repository_and_complete_elsewhere(tmp_path):
    here, elsewhere = (generate(folder, "depth.sh", "Hopper-v5")[0] for folder in (ROOT, tmp_path))
    assert here.startswith("python refineppo_continuous.py ")
    assert elsewhere == here.replace("refineppo_continuous.py", shlex.quote(str(ROOT / "refineppo_continuous.py")), 1)


def test_settings_files(tmp_path):
    for algorithm, text in (
        ("ppo", "--gamma 0.999  # published for this task\n\n--num-envs 4\n--num-steps 512\n"),
        ("refineppo", "# found by the search\n--refinement-depth 2 --refinement-schedule uniform --gamma 0.9\n"),
    ):
        file = tmp_path / "tuned" / algorithm / "Swimmer-v5.args"
        file.parent.mkdir(parents=True)
        file.write_text(text)
        (file.parent / "Hopper-v5.args").write_text("# the defaults do\n")
    chosen = {"SETTINGS": "tuned", "SEEDS": "1"}
    ppo, refined, *hopper = generate(tmp_path, "benchmark.sh", "Swimmer-v5", "Hopper-v5", **chosen)
    assert (parse(ppo).gamma, parse(ppo).num_envs, parse(ppo).num_steps) == (0.999, 4, 512)
    assert (parse(refined).refinement_depth, parse(refined).refinement_schedule) == (2, "uniform")
    assert parse(refined).gamma == 0.9
    defaults = generate(tmp_path, "benchmark.sh", "Swimmer-v5", "Hopper-v5", SETTINGS="none", SEEDS="1")
    assert hopper == defaults[2:]  # an empty file and none are the same settings, and so the same runs
    assert not {parse(ppo).run_dir, parse(refined).run_dir} & {parse(line).run_dir for line in defaults}

    depths = [parse(line) for line in generate(tmp_path, "depth.sh", "Swimmer-v5", **chosen)]
    assert [a.refinement_depth for a in depths] == [1, 2, 4, 8]  # a sweep's own choice wins over the settings
    assert {(a.refinement_schedule, a.gamma) for a in depths} == {("uniform", 0.9)}
    assert refined in generate(tmp_path, "depth.sh", "Swimmer-v5", **chosen)
    file.write_text("--gamma 0.8")
    assert parse(generate(tmp_path, "benchmark.sh", "Swimmer-v5", **chosen)[1]).run_dir != parse(refined).run_dir


def test_settings_that_come_with_the_repository_are_understood(tmp_path):
    lines = generate(tmp_path, "benchmark.sh", SEEDS="1")
    for line in lines:
        assert parse(line).env_id in TASKS


@pytest.mark.parametrize("text, names", [
    ("--num-envs=4", "--num-envs=4"),
    ("--gamma 0.9 --refinement_depth 2", "--refinement_depth"),
    ("--refinement-schedule uniform\n--refinement-depth # 2", "--refinement-depth"),
    ("--seed 7", "--seed"),
    ("--total-timesteps 1000", "--total-timesteps"),
])  # fmt: skip
def test_settings_that_would_mislead_are_refused(text, names, tmp_path):
    (tmp_path / "tuned" / "refineppo").mkdir(parents=True)
    (tmp_path / "tuned" / "refineppo" / "Hopper-v5.args").write_text(text)
    done = shell(tmp_path, "benchmark.sh", "Ant-v5", "Hopper-v5", SETTINGS="tuned")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert names in done.stderr and "refineppo/Hopper-v5.args" in done.stderr


@pytest.mark.parametrize("words, settings, names", [
    (["--depth"], {}, "--depth"),
    ([], {"SEEDS": "1 two"}, "SEEDS"),
    ([], {"SEEDS": "1,2"}, "SEEDS"),
    ([], {"SEEDS": " "}, "SEEDS"),
    ([], {"SEEDS": "1 01"}, "SEEDS"),
    ([], {"STEPS": "6e6"}, "STEPS"),
    ([], {"SETTINGS": "no/such"}, "no/such"),
])  # fmt: skip
@pytest.mark.parametrize("script", ["benchmark.sh", "depth.sh", "schedule.sh", "toy.sh"])
def test_generators_refuse_in_one_sentence(script, words, settings, names, tmp_path):
    done = shell(tmp_path, script, *words, **settings)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert names in done.stderr


@pytest.mark.parametrize("script", "benchmark.sh depth.sh schedule.sh toy.sh run_local.sh run_slurm.sh".split())
def test_help(script, tmp_path):
    done = shell(tmp_path, script, "--help")
    assert done.returncode == 0 and f"sweeps/{script}" in done.stdout and "#" not in done.stdout


def test_shellcheck(tmp_path):
    scripts = [*(ROOT / "sweeps").glob("*.sh"), ROOT / ".ci" / "run", ROOT / ".ci" / "engines.sh"]
    checked = subprocess.run(["shellcheck", "-x", "-P", "SCRIPTDIR", *scripts], capture_output=True, text=True,
                             env=environment(tmp_path))  # fmt: skip
    assert (checked.returncode, checked.stdout) == (0, "")


def test_toy_environment():
    env = gym.make("sweeps.toy_env:Coordination-v0")
    s, _ = env.reset(seed=3)
    best = [phi(s[0]), psi(s[0], phi(s[0]))]
    assert env.step(best)[1:4] == (pytest.approx(0, abs=1e-12), True, False)
    env.reset(seed=3)
    _, reward, *_ = env.step([best[0] + 0.3, best[1] - 0.4])
    assert reward == pytest.approx(-0.25)
    assert all(env.action_space.contains([phi(x), psi(x, phi(x))]) or max(abs(phi(x)), abs(psi(x, phi(x)))) <= 1
               for x in (-1, -0.5, 0, 0.5, 1))  # fmt: skip


# --- run_local.sh -----------------------------------------------------------------------------------------------------


@pytest.fixture(params=["parallel", "xargs"])
def engine(request, tmp_path):
    """GNU parallel; or a PATH in which `parallel` is another program, so that xargs is used."""
    (tmp_path / "bin").mkdir()
    if request.param == "xargs":
        other = tmp_path / "bin" / "parallel"
        other.write_text("#!/bin/sh\necho another program\n")
        other.chmod(0o755)
    elif "GNU" not in subprocess.getoutput("parallel --version"):
        pytest.skip("GNU parallel is not installed")
    return request.param


def joblog(folder: Path) -> dict[str, list[int]]:
    """The exit codes of every job's attempts, in their order."""
    codes = {}
    with open(folder / "runs" / "joblog.tsv") as file:
        for row in csv.DictReader(file, delimiter="\t", quoting=csv.QUOTE_NONE):
            codes.setdefault(row["command"], []).append(int(row["exit"]))
    return codes


def test_exit_codes_decide(engine, tmp_path):
    """0, 2 and 3 end a job; everything else is tried three times in all; a job that recovers is done."""
    codes = {f"sh -c 'echo says {code}; exit {code}'": code for code in (0, 1, 2, 3, 75, 137)}
    recovers = "test -e crashed || { touch crashed; exit 1; }"
    lines = [*codes, "# a comment", "", recovers, *list(codes)[:2]]
    done = shell(tmp_path, "run_local.sh", "-j", 2, stdin="\n".join(lines))
    assert done.returncode == 1
    attempts = {command: [code] * (1 if code in (0, 2, 3) else 3) for command, code in codes.items()}
    assert joblog(tmp_path) == attempts | {recovers: [1, 0]}
    assert "2 done, 4 failed, 1 left" in done.stdout
    failures = re.findall(r"failed \(exit (\d+)\): runs/job-\w+.log\n    says (\d+)", done.stdout)
    assert sorted(failures) == [("1", "1"), ("137", "137"), ("2", "2"), ("3", "3")]


def test_each_job_has_one_thread_and_its_own_log(engine, tmp_path):
    line = "echo $OMP_NUM_THREADS$MKL_NUM_THREADS$OPENBLAS_NUM_THREADS '--run-dir'; : --run-dir 'runs/a b'"
    assert shell(tmp_path, "run_local.sh", stdin=line, OMP_NUM_THREADS="8").returncode == 0
    assert (tmp_path / "runs" / "a b.log").read_text() == "111 --run-dir\n"


def test_paths_with_blanks(engine, tmp_path):
    """A repository in a folder with a blank, a list with = in its name, and a log that cannot be written."""
    (tmp_path / "my repository").symlink_to(ROOT)
    (tmp_path / "K=4").write_text("echo fine --run-dir runs/fine/\ntrue --run-dir /dev/null/x\n")
    done = subprocess.run([tmp_path / "my repository" / "sweeps" / "run_local.sh", "K=4"], cwd=tmp_path, text=True,
                          capture_output=True, env=environment(tmp_path))  # fmt: skip
    assert done.returncode == 1 and "1 done, 1 failed, 0 left" in done.stdout and "/dev/null" in done.stderr
    assert (tmp_path / "runs" / "fine.log").read_text() == "fine --run-dir runs/fine/\n"


def test_a_killed_executor_takes_its_trainings_along(engine, tmp_path):
    """kill -9 of all that runs the jobs: the training saves and stops, and the same command continues."""
    lines, long = tiny_sweep(tmp_path)
    command = [ROOT / "sweeps" / "run_local.sh", "jobs"]
    (tmp_path / "jobs").write_text(lines[0])
    executor = subprocess.Popen(command, cwd=tmp_path, env=environment(tmp_path), start_new_session=True)
    wait_until(lambda: saves(tmp_path / long))
    training = training_of(tmp_path / long)
    parent = int(re.search(r"PPid:\t(\d+)", Path(f"/proc/{training}/status").read_text())[1])
    executor.kill()
    os.kill(parent, signal.SIGKILL)
    done = subprocess.run(command, cwd=tmp_path, env=environment(tmp_path), text=True, capture_output=True)
    assert done.returncode == 0 and "1 done, 0 failed, 0 left" in done.stdout
    assert joblog(tmp_path)[lines[0]][-1] == 0
    assert "stopped by SIGTERM" in (tmp_path / "runs" / f"{long.name}.log").read_text()


def test_dry_run_runs_nothing(tmp_path):
    (tmp_path / "jobs").write_text("touch ran\n# no\ntouch ran\ntouch too\n")
    done = shell(tmp_path, "run_local.sh", "--dry-run", "jobs")
    assert (done.returncode, done.stdout) == (0, "touch ran\ntouch too\n")
    assert [path.name for path in tmp_path.iterdir()] == ["jobs"]


@pytest.mark.parametrize("script, words, stdin, names", [
    ("run_local.sh", ["-j", "0"], "true", "-j"),
    ("run_local.sh", ["-j", "many"], "true", "-j"),
    ("run_local.sh", ["-j"], "true", "-j"),
    ("run_local.sh", ["--dryrun"], "true", "--dryrun"),
    ("run_local.sh", ["no_such_file"], "", "no_such_file"),
    ("run_local.sh", [], "# nothing\n\n", "no jobs"),
    ("run_slurm.sh", ["--dry-run", "--max-running", "none"], "true", "--max-running"),
    ("run_slurm.sh", ["--dry-run", "--max-running"], "true", "--max-running"),
    ("run_slurm.sh", ["--dry-run", "--steps-per-task", "x"], "true", "--steps-per-task"),
    ("run_slurm.sh", ["--dry-run", "--time=1:00"], "true", "--time"),
    ("run_slurm.sh", ["--dry-run", "no_such_file"], "", "no_such_file"),
    ("run_slurm.sh", ["--dry-run"], "", "no jobs"),
])  # fmt: skip
def test_executors_refuse_in_one_sentence(script, words, stdin, names, tmp_path):
    done = shell(tmp_path, script, *words, stdin=stdin)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert names in done.stderr
    assert not any(tmp_path.iterdir())


def tiny_sweep(folder: Path) -> tuple[list[str], Path]:
    """Ten tiny runs, of which one is longer, and one that always fails; and the longer one's folder."""
    for algorithm in ("ppo", "refineppo"):
        file = folder / "tiny" / algorithm / "Pendulum-v1.args"
        file.parent.mkdir(parents=True)
        file.write_text(TINY)
    lines = generate(folder, "benchmark.sh", "Pendulum-v1", SETTINGS="tiny", STEPS="64", RUNS_DIR="runs")
    long = lines[0].replace("--total-timesteps 64", "--total-timesteps 24000")
    return [long, *lines[1:], "python no_such_script.py --run-dir runs/broken"], Path(parse(long).run_dir)


def wait_until(condition, timeout=300, pause=0.05):
    end = time.time() + timeout
    while not condition():
        assert time.time() < end, "it did not happen in time"
        time.sleep(pause)


def training_of(run_dir: Path) -> int | None:
    """The process that trains in the folder."""
    for process in Path("/proc").glob("[0-9]*"):
        try:
            words, cwd = (process / "cmdline").read_text().split("\0"), (process / "cwd").readlink()
        except OSError:  # it has just ended
            continue
        if "python" in Path(words[0]).name and run_dir in [cwd / word for word in words]:
            return int(process.name)


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


def test_a_local_sweep_is_killed_stopped_and_continued(engine, tmp_path):
    """kill -9 of one training is repaired by a new attempt; Ctrl-C in a terminal, and the same command goes on."""
    lines, long = tiny_sweep(tmp_path)
    (tmp_path / "jobs").write_text("\n".join(lines))
    command = [str(ROOT / "sweeps" / "run_local.sh"), "-j", "2", "jobs"]
    pid, terminal = pty.fork()
    if not pid:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # ignored where the tests run in the background
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

    done = shell(tmp_path, *command[0].split("/")[-1:], *command[1:])
    assert done.returncode == 1 and "10 done, 1 failed, 0 left" in done.stdout
    assert "failed (exit 2): runs/broken.log" in done.stdout and "no_such_script.py" in done.stdout
    assert joblog(tmp_path)[lines[0]] == [137, 75, 0]
    check_tiny_sweep(tmp_path, lines, long)


# --- run_slurm.sh -----------------------------------------------------------------------------------------------------


def test_slurm_jobs_are_packed_by_their_steps(tmp_path):
    lines = [f"job{i} --total-timesteps {steps}" for i, steps in enumerate((400, 400, 400, 1000, 100, 2000, 100))]
    done = shell(tmp_path, "run_slurm.sh", "--dry-run", "--max-running", 2, "--steps-per-task", 1000, "-",
                 "--", "--time=2:00:00", stdin="\n".join([*lines, "job7", lines[0]]))  # fmt: skip
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
        return subprocess.run(words, cwd=tmp_path, env=environment(tmp_path), check=True, text=True,
                              capture_output=True).stdout  # fmt: skip

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

    # Preempted by a job of the partition `high` that wants the whole machine
    wait_until(lambda: saves(run_dir))
    high = slurm("sbatch", "--parsable", "--partition=high", "--exclusive", "--wrap=true").strip()
    wait_until(lambda: state(high) == "COMPLETED")
    wait_until(lambda: state(task) == "PENDING")
    assert int(state(task, "Restarts")) >= 1

    # Signalled, as before the time limit
    before = saves(run_dir)
    wait_until(lambda: hurry() and saves(run_dir) > before, pause=0.5)
    slurm("scancel", "--batch", "--signal=USR1", task)
    wait_until(lambda: state(task) == "PENDING")
    assert int(state(task, "Restarts")) >= 2 and not (run_dir / "result.json").exists()

    wait_until(lambda: hurry() and not queued(), pause=1)
    assert [state(f"{job}_{i}") for i in range(1, 8)] == ["COMPLETED"] * 6 + ["FAILED"]
    assert joblog(tmp_path)[lines[0]][-1] == 0 and joblog(tmp_path)[lines[-1]] == [2]
    assert "failed (exit 2): runs/broken.log" in (tmp_path / "runs" / "slurm" / f"{job}_7.log").read_text()
    check_tiny_sweep(tmp_path, lines, long)
