"""The viewer: its clock, what it refuses, and that it shows something on a display in memory."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageGrab

from mjcollect.view.__main__ import main
from mjcollect.view.playback import DOWN, ENTER, FASTEST, LEFT, RIGHT, SLOWEST, SPACE, UP, Playback


def test_the_clock_runs_at_its_speed_and_stops_at_the_end() -> None:
    clock = Playback(20.0)
    clock.advance(3.0)
    assert clock.time == 3.0
    clock.press(UP)
    clock.advance(3.0)
    assert (clock.speed, clock.time) == (2.0, 9.0)
    clock.press(SPACE)
    clock.advance(3.0)
    assert clock.time == 9.0
    clock.press(RIGHT)  # also while it stands
    assert clock.time == 14.0
    clock.press(SPACE)
    clock.advance(100.0)
    assert clock.time == 20.0
    clock.press(LEFT)
    assert clock.time == 15.0
    clock.press(ENTER)
    assert clock.time == 0.0
    clock.press(LEFT)
    assert clock.time == 0.0
    for key, limit in ((UP, FASTEST), (DOWN, SLOWEST)):
        for _ in range(20):
            clock.press(key)
        assert clock.speed == limit


def test_space_at_the_end_starts_again() -> None:
    clock = Playback(2.0)
    clock.advance(5.0)
    clock.press(SPACE)
    clock.advance(1.0)
    assert (clock.time, clock.paused) == (1.0, False)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "--scene: is missing"),
        (["--scene", "nowhere"], "nowhere: does not exist"),
        (["--run", "/nowhere"], "--run: /nowhere: holds neither"),
        (["--scene", "scenario_1", "--speed", "0"], "--speed: 0.0: must lie in 0.0625..16"),
        (["--scene", "scenario_1", "--seconds", "-1"], "--seconds: -1.0: must be positive"),
    ],
)
def test_bad_input_is_refused_before_any_window(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    message = capsys.readouterr().err
    assert said in message
    assert message.startswith("error: ")
    assert message.count("\n") == 1


def test_a_run_of_another_scene_is_refused(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--run", str(folder), "--scene", "scenario_1"]) == 2
    assert "--scene: " in capsys.readouterr().err


@pytest.mark.parametrize("display", [None, ":987"])
def test_without_a_display_it_says_what_else_there_is(display: str | None) -> None:
    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    environment |= {} if display is None else {"DISPLAY": display}
    ran = subprocess.run(
        [sys.executable, "-m", "mjcollect.view", "--scene", "scenario_1"],
        env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ran.returncode == 2
    assert ran.stderr.count("\n") == 1
    assert (display or "DISPLAY and WAYLAND_DISPLAY are not set") in ran.stderr
    for way in ("replay.html", "python -m mjcollect.render", "xvfb-run"):
        assert way in ran.stderr


@pytest.fixture(scope="module")
def display() -> Iterator[str]:
    """A display in memory, whose number it chooses itself."""
    if shutil.which("Xvfb") is None:
        pytest.skip("no Xvfb here: apt-get install xvfb")
    with subprocess.Popen(
        ["Xvfb", "-displayfd", "1", "-screen", "0", "800x600x24", "-nolisten", "tcp", "-noreset"],
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
    ) as server:  # fmt: skip
        assert server.stdout is not None
        yield f":{int(server.stdout.readline())}"
        server.terminate()


def watch(display: str, arguments: list[str], seconds: float = 90.0) -> tuple[Image.Image, int]:
    """Starts the viewer; returns what is on the display soon after a window is, and the code."""
    environment = {**os.environ, "DISPLAY": display}
    environment.pop("WAYLAND_DISPLAY", None)
    with subprocess.Popen(
        [sys.executable, "-m", "mjcollect.view", *arguments], env=environment
    ) as program:
        deadline = time.monotonic() + seconds
        try:
            return _seen(display, arguments, program, deadline)
        finally:
            program.kill()


def _seen(
    display: str, arguments: list[str], program: subprocess.Popen[bytes], deadline: float
) -> tuple[Image.Image, int]:
    while np.asarray(ImageGrab.grab(xdisplay=display)).std() < 10:
        assert program.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.2)
    time.sleep(1.0)
    seen = ImageGrab.grab(xdisplay=display)
    if "--seconds" not in arguments:
        program.send_signal(signal.SIGINT)
    return seen, program.wait(60)


def test_it_plays_a_fleet_and_ends_by_itself(display: str, folder: Path) -> None:
    seen, code = watch(display, ["--run", str(folder), "--speed", "16", "--seconds", "12"])
    assert code == 0
    picture = np.asarray(seen).astype(int)
    # Sky, and the paths of two UAVs in their colours, which nothing else has.
    assert np.sum(picture[:, :, 2] - picture[:, :, 0] > 30) > 1000
    for colour in ((0, 114, 178), (213, 94, 0)):
        assert np.sum(np.abs(picture - colour).max(axis=2) < 30) > 30


def test_it_shows_a_scene_until_ctrl_c(display: str) -> None:
    seen, code = watch(display, ["--scene", "scenario_1"])
    assert code == 130
    assert np.asarray(seen).std() > 20
