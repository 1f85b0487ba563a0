"""Films: what is left out cannot be seen, and any number of processes makes the same."""

from __future__ import annotations

import fcntl
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numbered_film import NumberedFilm
from PIL import Image

from mjcollect.render.camera import View, framing
from mjcollect.render.film.inset import Inset, inset_size
from mjcollect.render.film.overview import Overview
from mjcollect.render.film.parallel import PLACES, WorkerError, choose_processes, render_frames
from mjcollect.render.film.track import ALIKE, NEAR, SPACING, Track
from mjcollect.render.fleet import FleetProgress

HERE = Path(__file__).parent

# What is drawn


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6))
def test_pieces_of_path_that_are_left_out_are_out_of_the_picture(seed: int) -> None:
    rng = np.random.default_rng(seed)
    view = View(rng.uniform(-30, 30, 3), rng.uniform(-30, 30, 3), 55.0, (640, 360))
    points, radius = rng.uniform(-60, 60, (40, 3)), rng.uniform(0.05, 0.5, 39)
    may = view.may_see(points, radius)
    shares = np.linspace(0, 1, 100)[:, None, None]
    along = points[:-1] + shares * (points[1:] - points[:-1])
    pixels, depth = view.project(along)
    inside = np.all((pixels >= 0) & (pixels <= (640, 360)), axis=-1) & (depth > 0)
    assert not np.any(inside.any(axis=0) & ~may)
    assert not may.all()  # in all directions, many lie behind


def test_a_piece_of_path_is_seen_as_long_as_its_side_is_in_the_picture() -> None:
    view = View(np.zeros(3), np.array([100.0, 0, 0]), 90.0, (400, 400))
    edge = np.array([[100.0, 100.0, 0.0], [101.0, 101.0, 0.0]])  # along the left edge
    for off, radius, seen in ((1.0, 0.5, False), (1.0, 1.0, True), (-1.0, 0.1, True)):
        for side in (1, -1):
            moved = np.multiply(np.add(edge, (0, off, 0)), (1, side, 1))
            assert view.may_see(moved, np.array([radius]))[0] == seen


def test_a_far_path_is_drawn_in_fewer_pieces_that_look_the_same(failed: FleetProgress) -> None:
    alone = FleetProgress.alone(failed.flights[0])
    t = np.linspace(0.0, alone.duration, 100)
    track = Track(alone, 0, t, t[1])
    last = int(track.point(t[-1]))
    whole = track.trail[: last + 1]
    for away in (10.0, 400.0, 3000.0):
        view = View(whole.mean(axis=0) - [away, 0, 0], whole.mean(axis=0), 55.0, (1280, 720))
        path, colours = track.flown(99, last, view)
        assert len(colours) == len(path) - 1
        kept = [0]
        for point in path[1:-1]:
            kept.append(kept[-1] + 1 + int(np.all(whole[kept[-1] + 1 :] == point, axis=1).argmax()))
        for first, end in pairwise(kept):
            inner = np.arange(first + 1, end)
            shares = (inner - first)[:, None] / (end - first)
            off = np.linalg.norm(
                whole[inner] - whole[first] - shares * (whole[end] - whole[first]), axis=1
            )
            near = np.linalg.norm(whole[first : end + 1] - view.eye, axis=1).min()
            assert np.all(off <= 0.25 * near * 2 * np.tan(np.radians(27.5)) / 720)
            assert np.all(np.ptp(track.colours[first:end], axis=0) <= ALIKE)
            assert end == first + 1 or near > NEAR - SPACING
        assert (len(path) < len(whole)) == (away >= 400)


def test_insets_are_the_same_whichever_frames_are_left_out(fleet: FleetProgress) -> None:
    t = np.linspace(0.0, fleet.duration, 60)
    tracks = [Track(fleet, m, t, t[1]) for m in range(len(fleet.flights))]
    view = framing(fleet.scene.bounds, np.array([1.0, 0.8, -0.7]), 30.0, (640, 360))
    last = np.stack([track.point(t) for track in tracks], axis=1)
    reached = np.stack([track.reached for track in tracks], axis=1)
    assert len(np.unique(reached, axis=0)) > 3
    trails = [(track.trail, track.colours) for track in tracks]

    def still(_: View, counts: tuple[int, ...]) -> np.ndarray:
        return np.full((360, 640, 3), 40 + sum(counts), dtype=np.uint8)

    def pictures(part: int, parts: int) -> dict[int, np.ndarray]:
        inset = Inset(fleet, view, trails, last, reached)
        made = {}
        for frame in range(part, 60, parts):
            xs = np.array([track.x[frame] for track in tracks])
            middle = xs[0] + [40 * np.cos(frame), 40 * np.sin(frame), 10]
            moving = [np.stack([middle - 5, middle + 5]), np.stack([xs[1] + 20, xs[1] + 30])]
            made[frame] = np.array(inset.picture(frame, still, xs, moving[: frame % 3]))
        return made

    every = pictures(0, 1)
    assert every[0].shape == (*inset_size((640, 360))[::-1], 3)
    assert np.abs(every[30].astype(int) - every[0]).max() > 100
    for parts in (2, 7, 60):  # the last draws each picture whole
        for part in range(parts):
            for frame, picture in pictures(part, parts).items():
                np.testing.assert_array_equal(picture, every[frame])


def test_a_path_begins_at_its_first_point_however_long_the_rest_there(fleet: FleetProgress) -> None:
    """Points before the first would be those at the end, to which the inset would draw a line."""
    t = np.linspace(0.0, fleet.duration, 60)
    for m in range(len(fleet.flights)):
        track = Track(fleet, m, t, t[1])
        assert track.point(t[0] - 1.0) == track.point(t)[0] == 0
        assert np.all(np.diff(track.point(t)) >= 0)


def test_what_a_node_lies_in_holds_all_that_is_drawn_of_it(
    fleet: FleetProgress, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Numbers of three digits stand out of their discs."""
    monkeypatch.setattr("mjcollect.render.film.overview._label", lambda node: str(100 + node))
    view = framing(fleet.scene.bounds, np.array([1.0, 0.8, -0.7]), 30.0, (640, 360))
    trails = [(flown.trajectory.x, np.zeros((len(flown.trajectory), 3))) for flown in fleet.flights]
    overview, reached = Overview(fleet, view, trails), [0] * len(fleet.flights)
    for radius in (2.0, 9.0):
        for node, place in overview.node_places(reached, radius).items():
            for ground in ("black", "white"):
                image = Image.new("RGB", view.size, ground)
                blank = np.asarray(image).copy()
                overview.nodes(image, reached, radius, {node})
                v, u = np.nonzero((np.asarray(image) != blank).any(axis=2))
                assert len(u) > 0
                assert place[0] <= u.min() <= u.max() < place[2]
                assert place[1] <= v.min() <= v.max() < place[3]


# Processes


def test_frames_of_several_processes_come_in_order() -> None:
    film = NumberedFilm(count := 3 * PLACES * 2 + 1)
    for processes in (1, 2):
        numbers = [int(frame[0, 0, 0]) for frame in render_frames(film, processes)]  # type: ignore[arg-type]
        assert numbers == list(range(count))
    assert not multiprocessing.active_children()


def test_a_failure_in_a_process_is_told_and_ends_the_others() -> None:
    for film, said in (
        (NumberedFilm(40, fails=21), "ValueError: no frame 21"),
        (NumberedFilm(40, dies=20), "ended with code -9"),
    ):
        frames = render_frames(film, 2)  # type: ignore[arg-type]
        for number in range(max(film.fails, film.dies)):
            assert np.all(next(frames) == number)
        with pytest.raises(WorkerError, match=said):
            next(frames)
        assert not multiprocessing.active_children()


def test_who_wants_no_more_frames_ends_the_processes() -> None:
    frames = render_frames(NumberedFilm(10**6), 2)  # type: ignore[arg-type]
    next(frames)
    assert len(multiprocessing.active_children()) == 2
    frames.close()
    assert not multiprocessing.active_children()


ORPHANS = """
import multiprocessing, time
from numbered_film import NumberedFilm
from PIL import Image
from mjcollect.render.film.parallel import render_frames
frames = render_frames(NumberedFilm(10**6), 2)
next(frames)
print(*(child.pid for child in multiprocessing.active_children()), flush=True)
for _ in frames:
    time.sleep(0.01)
"""


@pytest.mark.parametrize("blow", [signal.SIGKILL, signal.SIGINT])
def test_processes_end_with_the_one_that_started_them(blow: signal.Signals) -> None:
    """This script has no guard for its main module, which processes must not run again."""
    path = os.pathsep.join([str(HERE), os.environ.get("PYTHONPATH", "")])
    with subprocess.Popen(
        [sys.executable, "-c", ORPHANS], env={**os.environ, "PYTHONPATH": path}, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True,
    ) as program:  # fmt: skip
        assert program.stdout is not None
        workers = [int(word) for word in program.stdout.readline().split()]
        assert len(workers) == 2
        if blow == signal.SIGINT:  # as Ctrl-C does, to the whole group
            os.killpg(program.pid, blow)
        else:
            program.kill()
        program.wait(60)
        assert program.stderr is not None
        assert "SpawnProcess" not in program.stderr.read()
    deadline = time.monotonic() + 60
    while any(Path(f"/proc/{pid}").exists() for pid in workers):
        assert time.monotonic() < deadline
        time.sleep(0.1)


def test_short_films_are_made_by_one_process() -> None:
    assert choose_processes(1) == choose_processes(150) == 1
    assert 1 <= choose_processes(10**6) <= 8


# The video


CLIP = """
import sys
from mjcollect.render import VideoSettings, render_run
for processes in (1, 2):
    film = render_run(sys.argv[1], VideoSettings(fps=1, size=(320, 180)), processes)
    film.rename(film.with_name(f"{processes}.mp4"))
"""


def test_a_video_is_the_same_from_any_number_of_processes(
    folder: Path, egl: dict[str, str]
) -> None:
    subprocess.run([sys.executable, "-c", CLIP, str(folder)], env=egl, check=True)
    films = [(folder / f"{processes}.mp4").read_bytes() for processes in (1, 2)]
    assert len(films[0]) > 10_000
    assert films[0] == films[1]
    assert not list(folder.glob(".*"))


def command(folder: Path) -> list[str]:
    return [sys.executable, "-m", "mjcollect.render", "--run", str(folder), "--processes", "2"]


def test_of_two_programs_that_film_one_run_the_second_is_told(
    folder: Path, egl: dict[str, str]
) -> None:
    with (folder / ".part-fleet.mp4").open("wb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        ran = subprocess.run(
            command(folder), env=egl, text=True, capture_output=True, check=False
        )  # fmt: skip
    (folder / ".part-fleet.mp4").unlink()
    assert ran.returncode == 1
    assert "another process is filming it" in ran.stderr


def test_ctrl_c_which_all_processes_get_ends_them_in_peace(
    folder: Path, egl: dict[str, str]
) -> None:
    with subprocess.Popen(
        command(folder), env=egl, text=True, stderr=subprocess.PIPE, start_new_session=True
    ) as program:
        assert program.stderr is not None
        said = ""
        while " 1/" not in said:
            said += program.stderr.read(1)
        os.killpg(program.pid, signal.SIGINT)
        said += program.stderr.read()
    assert program.returncode == 130, said
    assert "Traceback" not in said
    assert not list(folder.glob(".*"))
