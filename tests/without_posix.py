"""`python tests/without_posix.py SCRIPT FLAGS` runs a script without what POSIX systems alone have, as on Windows."""

import runpy
import signal
import sys
from pathlib import Path

sys.modules["fcntl"] = None  # `import fcntl` then raises ImportError
for name in ("SIGUSR1", "SIGUSR2", "SIGHUP", "SIGQUIT"):
    delattr(signal, name)
sys.argv = sys.argv[1:]
sys.path[0] = str(Path(sys.argv[0]).parent)
runpy.run_path(sys.argv[0], run_name="__main__")
