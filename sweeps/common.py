"""What the programs of this folder share. They are run as `python sweeps/NAME.py`: `from common import ...` finds this.

python sweeps/common.py PARENT COMMAND...    becomes COMMAND, which is told to stop when the process PARENT ends
"""

import ctypes
import io
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import BinaryIO, NoReturn

ROOT = Path(__file__).resolve().parent.parent
EXIT_BAD_ARGUMENTS, EXIT_FAILURE, EXIT_STOPPED = 2, 3, 75  # the training scripts' own
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


def refuse(sentence: str) -> NoReturn:
    """End the program with one sentence about its input."""
    print(f"{Path(sys.argv[0]).name}: error: {sentence}", file=sys.stderr)
    raise SystemExit(EXIT_BAD_ARGUMENTS)


def first_line(error: Exception) -> str:
    """What an error says, in one line."""
    return next(iter(str(error).strip().splitlines()), type(error).__name__)


def duration(seconds: float) -> str:
    """Seconds as people say them: 12 s, 3.5 min, 27.0 h."""
    for unit, length in (("h", 3600), ("min", 60)):
        if seconds >= length:
            return f"{seconds / length:,.1f} {unit}"
    return f"{seconds:.0f} s"


def steps_text(steps: int) -> str:
    """1M, 50k, 8192."""
    for unit, size in (("M", 10**6), ("k", 10**3)):
        if steps % size == 0:
            return f"{steps // size}{unit}"
    return str(steps)


def palette_png(image: BinaryIO) -> bytes:
    """A figure's PNG in 256 colours, a third of the bytes."""
    from PIL import Image  # here, since only the report draws

    small = io.BytesIO()
    Image.open(image).convert("RGB").quantize(method=Image.Quantize.MAXCOVERAGE).save(small, "png")
    return small.getvalue()


def write_atomically(path: Path, text: str):
    """Replace a file in one step, whatever other processes write at the same time."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{socket.gethostname()}.{os.getpid()}")
    temporary.write_text(text)
    os.replace(temporary, path)


def start(command: list, log: BinaryIO) -> subprocess.Popen:
    """Start a command with one thread whose output goes to `log`.

    It has a process group of its own, since the terminal's Ctrl-C must not reach it twice, and gets SIGTERM if this
    process is killed (on Linux), so that a training saves and stops. Python's own hook for what a child does first is
    not safe beside other threads: so another Python does it, and then becomes the command.
    """
    launcher = [sys.executable, "-IS", __file__, str(os.getpid())]
    return subprocess.Popen(
        [*launcher, *map(str, command)],
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=log,
        env=os.environ | ONE_THREAD,
        process_group=0,
    )


if __name__ == "__main__":
    parent, *command = sys.argv[1:]
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG
    if os.getppid() == int(parent):  # else it has ended before it could be watched
        os.execvp(command[0], command)
