"""Programs forked from a server behave as if started by `python -m`."""

import os
import subprocess
import sys
import time

import pytest

from train.jobs.processes import Program, ended


@pytest.fixture
def module(tmp_path, monkeypatch):
    """Writes a module that can be run by its name."""
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])

    def write(code):
        (tmp_path / "forked_module.py").write_text(code)
        return "forked_module"

    return write


@pytest.mark.parametrize(
    ("code", "expected"),
    [("import sys; sys.exit(7)", 7), ("1 / 0", 1), ("import sys; sys.exit('text')", 1), ("", 0)],
)
def test_ends_with_the_code_of_the_program(module, code, expected):
    assert Program(module(code), ()).result()[0] == expected


def test_sees_arguments_environment_and_itself_as_main(module, monkeypatch):
    monkeypatch.setenv("NEW", "there")
    code = "import os, sys; print(__name__, sys.argv[1:], sys.orig_argv[1:3], os.environ['NEW'])"
    _, output = Program(module(code), ("a", "-b")).result()
    assert output == "__main__ ['a', '-b'] ['-m', 'forked_module'] there\n"


def test_only_what_has_ended_is_ended(module):
    running = Program(module("import time; time.sleep(600)"), ())
    done = Program("platform", ())
    assert ended([running, done], timeout=60) == [done]
    running.interrupt()
    code, output = running.result()
    assert code == 1
    assert "KeyboardInterrupt" in output


def test_ends_with_its_parent(tmp_path):
    """Even if that is killed with SIGKILL."""
    (tmp_path / "waits.py").write_text(
        "import os, pathlib, time\n"
        f"pathlib.Path({str(tmp_path / 'pid')!r}).write_text(str(os.getpid()))\n"
        "time.sleep(600)\n"
    )
    parent = f"""
import os, pathlib, signal, sys, time
sys.path[:0] = [{str(tmp_path)!r}, {os.getcwd()!r}]
from train.jobs.processes import Program
Program("waits", ())
while not pathlib.Path({str(tmp_path / "pid")!r}).exists():
    time.sleep(0.05)
os.kill(os.getpid(), signal.SIGKILL)
"""
    subprocess.run([sys.executable, "-c", parent], check=False, timeout=120)
    child = int((tmp_path / "pid").read_text())
    for _ in range(600):
        try:
            os.kill(child, 0)
        except ProcessLookupError:
            return
        time.sleep(0.05)
    pytest.fail(f"{child} lives on")
