"""Command line programs: train a segment, train a mission, fly. Each reads top to bottom."""

import os
import sys
import warnings
from types import TracebackType

# One thread per process for the linear algebra: parallelism comes from MuJoCo's threads and from
# processes. Must be set before NumPy and torch are imported.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # TorchRL's notes on storages
# dm_control looks for a display when it is imported and warns if there is none.
warnings.filterwarnings("ignore", message=".*DISPLAY environment variable is missing.*")
# Who flies needs no GL, but MuJoCo refuses to be imported with a backend that it does not know.
BACKENDS = (
    "", "glfw", "glx", "egl", "osmesa", "enable", "enabled", "on", "true", "1",
    "disable", "disabled", "off", "false", "0",
)  # fmt: skip
if os.environ.get("MUJOCO_GL", "").lower().strip() not in BACKENDS:
    print(
        f"error: MUJOCO_GL: {os.environ['MUJOCO_GL']}: must be egl, osmesa, glfw or disable; or "
        "unset it",
        file=sys.stderr,
    )
    raise SystemExit(2)


def _say(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Prints no traceback for Ctrl-C while a program is still loading; it ends by that signal."""
    if issubclass(kind, KeyboardInterrupt):
        print("interrupted", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


sys.excepthook = _say
