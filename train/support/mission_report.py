"""Writes what a flown mission leaves behind: mission.json, plots, video, report."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mjcollect.envs.course import Course
from mjcollect.envs.recording import Flight
from mjcollect.export.formats import FORMATS
from mjcollect.export.mission import FlownMission
from mjcollect.render.arrivals import REST_SPEED, progress
from mjcollect.render.path_figures import plot_path_3d, plot_path_top
from mjcollect.render.time_figures import plot_learning, plot_speed
from mjcollect.render.video import render_in_child
from mjcollect.replay import REPLAY_FILE, replay_in
from mjcollect.scene.air import Air
from mjcollect.scene.bounds import detour_bound, mission_bound, segment_bound
from mjcollect.scene.order import node_name, tour_segments
from mjcollect.scene.scene import Scene
from mjcollect.scene.trajectory import SHIELD_FILE, save_shield, shield_intervals
from mjcollect.verify import DISTURBED_REST, verify
from train.support.command_line import say
from train.support.markdown import markdown_table
from train.support.run_folder import PLANS, RunFolder, versions

TRAINED = ("success_rate", "train_seconds", "env_steps", "updates")
COLUMNS = (
    "segment", "from", "to", "time (s)", "bound (s)", "ratio", "detour (s)", "of detour", "shield",
    "success rate", "training (s)", "updates",
)  # fmt: skip


def mission_result(
    course: Course,
    order: tuple[int, ...],
    order_method: str,
    flight: Flight,
    trained: Sequence[dict[str, Any] | None],
    seed: int,
    air: Air | None = None,
) -> dict[str, Any]:
    """Returns the document of mission.json.

    `trained` holds the segment.json of each segment, None where nothing was trained. `air` is what
    disturbed the flight, if it was disturbed.
    """
    scene = course.scene
    moving = None if air is None else air.moving
    found = verify(scene, flight.trajectory, order, disturbed=air is not None, moving=moving)
    violations = [entry.to_dict() for entry in found]
    success = flight.success and not violations
    bound, method = mission_bound(scene)
    segments, begun, shares = [], 0.0, flight.shield_shares
    for index, (start, end) in enumerate(tour_segments(order)):
        reached = index < len(flight.arrivals)
        training = trained[index] or {}
        segments.append(
            {
                "from": start,
                "to": end,
                "time": flight.arrivals[index] - begun if reached else None,
                "lower_bound": segment_bound(scene, start, end),
                "detour_time": detour_bound(scene, start, end, course.guidance[index].length),
                "success": reached and not any(v["segment"] == index for v in violations),
                "shield_share": shares[index] if index < len(shares) else None,
                **{key: training.get(key) for key in TRAINED},
            }
        )
        begun = flight.arrivals[index] if reached else begun
    time = flight.trajectory.duration if success else None
    spent = [entry["train_seconds"] for entry in segments if entry["train_seconds"] is not None]
    return {
        "scene": scene.name,
        "order": list(order),
        "order_method": order_method,
        "success": success,
        "mission_time": time,
        "lower_bound": bound,
        "bound_method": method,
        "ratio": time / bound if time is not None and bound > 0 else None,
        "detour_time": sum(entry["detour_time"] for entry in segments),
        "contacts": flight.contacts,
        "violations": violations,
        "shield_share": flight.shield_share,
        "segments": segments,
        "train_seconds": sum(spent) if spent else None,
        "seed": seed,
        "versions": versions(),
    }


def write_mission(
    folder: RunFolder, scene: Scene, result: dict[str, Any], flight: Flight, *, plots: bool,
    air: Air | None = None,
) -> None:  # fmt: skip
    """Writes trajectory.csv, shield.csv, the plots if they are wanted, and last mission.json.

    A successful calm flight of a scene with an origin is also written for ground stations and maps.
    """
    write_record(folder, flight)
    if plots:
        rest = REST_SPEED if air is None else DISTURBED_REST
        flown = progress(scene, flight.trajectory, result["order"], rest_speed=rest)
        moving = () if air is None else air.moving
        folder.write("path_3d.png", lambda part: plot_path_3d(part, flown, moving=moving))
        folder.write("path_top.png", lambda part: plot_path_top(part, flown, moving=moving))
        folder.write("speed.png", lambda part: plot_speed(part, flown))
        rows = [
            {"segment": float(index), **row}
            for index in range(len(result["segments"]))
            for row in read_metrics(folder.segment(index).path / "metrics.csv")
        ]
        if rows:
            folder.write("learning.png", lambda part: plot_learning(part, rows))
    if scene.origin is not None and air is None and result["success"]:
        mission = FlownMission.of(scene, flight.trajectory, result)
        for kind in PLANS:
            folder.write_text(f"mission.{kind}", FORMATS[kind](mission))
    folder.write_json("mission.json", result)


def write_record(folder: RunFolder, flight: Flight) -> None:
    """Writes trajectory.csv, and shield.csv, which says when the shield acted."""
    folder.write("trajectory.csv", flight.trajectory.save)
    when = shield_intervals(flight.shielded, flight.slot)
    folder.write(SHIELD_FILE, lambda part: save_shield(part, when))


def read_metrics(path: Path) -> list[dict[str, float]]:
    """Returns the rows of a metrics.csv, NaN for empty cells; none if there is no file."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return [
            {name: float(cell) if cell else float("nan") for name, cell in row.items()}
            for row in csv.DictReader(file)
        ]


def finish(
    folder: RunFolder, videos: Sequence[Path], plots: bool, notes: Sequence[str] = (), *,
    replay: bool,
) -> int:  # fmt: skip
    """Makes what is asked for, report.md too, prints the result; returns 0 for success, else 1.

    Args:
        videos: the videos that there are to be, `mission.mp4` or those of segments.
        plots, notes: as in `report`.
        replay: whether there is to be a replay.
    """
    result, scene = folder.read_json("mission.json"), Scene.load(folder.path / "scene.json")
    assert result is not None
    if replay:
        write_replay(folder)
    # The first comes before the videos, which take long and may be stopped; the last links to them.
    folder.write_text("report.md", report(folder, scene, result, plots, notes))
    film(*videos)
    folder.write_text("report.md", report(folder, scene, result, plots, notes))
    print(outcome(result, folder.path))
    return 0 if result["success"] else 1


def film(*videos: Path) -> None:
    """Renders those videos of run folders that are missing, unless none can be made here."""
    for video in videos:
        if not video.is_file() and (reason := render_in_child(video.parent)):
            say(f"no video: {reason}")
            return


def write_replay(folder: RunFolder) -> None:
    """Writes the replay of a finished run if there is none yet."""
    if not (folder.path / REPLAY_FILE).is_file():
        replay_in(folder.path)


def links(folder: Path, video: str) -> list[str]:
    """Returns the lines of a report that link to the replay and the video that a folder holds."""
    shown = {"Replay": REPLAY_FILE, "Video": video}
    found = [f"[{name}]({file})" for name, file in shown.items() if (folder / file).is_file()]
    return [" · ".join(found), ""] if found else []


def report(
    folder: RunFolder, scene: Scene, result: dict[str, Any], plots: bool, notes: Sequence[str]
) -> str:
    """Returns a page in Markdown: verdict, table of segments, pictures that the folder holds."""
    lines = [f"# Mission in {scene.name}", ""]
    if result["success"]:
        lines.append(
            f"**Success**: {len(result['order'])} items in **{result['mission_time']:.1f} s**, "
            f"{_ratio(result['mission_time'], result['lower_bound'])} of the lower bound of "
            f"{result['lower_bound']:.1f} s ({result['bound_method']}), "
            f"{_ratio(result['mission_time'], result['detour_time'])} of the detour estimate of "
            f"{result['detour_time']:.1f} s in this order."
        )
    else:
        lines += ["**No success.**", ""]
        lines += [f"- {describe(violation)}" for violation in result["violations"]]
    if (share := result.get("shield_share")) is not None:
        lines += ["", f"The shield changed the command in {share:.1%} of the slots."]
    if "flights" in result:
        lines += _of_all_flights(result)
    if "planner" in result:
        lines += ["", f"Planner: {result['planner']}."]
    if notes:
        lines += ["", *(f"- {note}" for note in notes)]
    lines += [
        "",
        f"Order ({result['order_method']}): depot, {', '.join(map(str, result['order']))}, depot. "
        f"Seed {result['seed']}.",
        "",
        *markdown_table(COLUMNS, [_cells(*each) for each in enumerate(result["segments"])]),
        "",
        "Success rate: share of starts all over the segment's start ball from which the policy "
        "arrives, in the evaluation that chose it. Bound: no flight can be shorter. Detour: "
        "estimate of the least time along the shortest free path. Shield: share of the slots in "
        "which the command left no way to stop without touching anything, and was bent.",
        "",
    ]
    lines += links(folder.path, "mission.mp4")
    if plots:
        lines += [
            "![Flown path](path_3d.png)",
            "![Top view](path_top.png)",
            "![Speed and acceleration](speed.png)",
        ]
    if (folder.path / "tracks.png").is_file():
        lines.append("![Tracks of all flights](tracks.png)")
    if (folder.path / "learning.png").is_file():
        lines.append("![Learning curves](learning.png)")
    return "\n".join(lines) + "\n"


def _of_all_flights(result: dict[str, Any]) -> list[str]:
    """Returns the lines about all flights, of which the rest of the page shows one."""
    shown = {key: value for key, value in result["disturbance"].items() if value}
    air = ", ".join(f"{key} {value:g}" for key, value in shown.items() if key != "boxes")
    head = (f"{result['flights']} flights", "measured [95% interval]")
    return [
        "",
        f"This is flight {result['shown_flight']} of {result['flights']}, numbered from 0: the "
        f"first that came home, or the first of all. Disturbance: {air or 'none drawn'}.",
        "",
        *markdown_table(head, rows_of_flights(result)),
    ]


def rows_of_flights(result: dict[str, Any]) -> list[list[str]]:
    """Returns the rows of report.md's table of all flights."""
    ended = ", ".join(f"{count} {end}" for end, count in result["ended"].items() if count)
    return [
        ["came home with everything", measured(result["success_rate"], ".1%")],
        ["touched a box", measured(result["contact_rate"], ".1%")],
        ["mean time of those at home (s)", measured(result["mean_time"], ".1f")],
        ["ended", ended],
    ]


def measured(measure: dict[str, float | None], form: str) -> str:
    """Returns a measured value with its interval, as '93.0% [86.3%, 96.6%]'; a dash for none."""
    value, low, high = measure["value"], measure["low"], measure["high"]
    if value is None:
        return "-"
    if low is None or high is None:
        return format(value, form)
    return f"{value:{form}} [{low:{form}}, {high:{form}}]"


def _cells(index: int, entry: dict[str, Any]) -> list[str]:
    time = entry["time"]
    return [
        str(index),
        node_name(entry["from"]),
        node_name(entry["to"]),
        _shown(time, ".1f"),
        _shown(entry["lower_bound"], ".2f"),
        _ratio(time, entry["lower_bound"]),
        _shown(entry["detour_time"], ".2f"),
        _ratio(time, entry["detour_time"]),
        _shown(entry.get("shield_share"), ".1%"),
        _shown(entry["success_rate"], ".2f"),
        _shown(entry["train_seconds"], ".0f"),
        _shown(entry["updates"], ".0f"),
    ]


def describe(violation: dict[str, Any]) -> str:
    """Says in words what was violated, where, when and by how much."""
    where = "" if violation["segment"] is None else f" in segment {violation['segment']}"
    when = "" if violation["t"] is None else f" at {violation['t']:.2f} s"
    value = "" if violation["value"] is None else f": {violation['value']:.4g}"
    limit = "" if violation["limit"] is None else f" against a limit of {violation['limit']:.4g}"
    return f"{violation['kind']}{where}{when}{value}{limit}"


def outcome(result: dict[str, Any], folder: Path) -> str:
    """Says the result in one line, for the user."""
    if "flights" in result:
        time = measured(result["mean_time"], ".1f")
        others = {end: count for end, count in result["ended"].items() if count and end != "home"}
        ended = "".join(f", {count} {end}" for end, count in others.items())
        return (
            f"{result['ended']['home']} of {result['flights']} flights came home: "
            f"{measured(result['success_rate'], '.1%')}, in {time} s; contact "
            f"{measured(result['contact_rate'], '.1%')}{ended}: {folder}"
        )
    if not result["success"]:
        return f"no success ({cause(result)}): {folder}"
    ratio = "" if result["ratio"] is None else f", {result['ratio']:.3f} of the lower bound"
    time = f"{result['mission_time']:.1f} s"
    return f"success: {len(result['order'])} items in {time}{ratio}: {folder}"


def cause(result: dict[str, Any]) -> str:
    """Says why a mission is no success: what ended it rather than what it missed."""
    causes = ("contact", "bounds", "speed", "acceleration", "timestep", "start")
    violations = sorted(result["violations"], key=lambda v: v["kind"] not in causes)
    return describe(violations[0]) if violations else "not finished"


def _shown(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def _ratio(value: float | None, of: float) -> str:
    return "-" if value is None or of <= 0 else f"{value / of:.3f}"
