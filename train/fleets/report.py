"""Writes what a flown fleet leaves behind: each UAV's mission, fleet.json, plots, report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mjcollect.envs.course import Course
from mjcollect.fleet.flight import FleetFlight
from mjcollect.planners.assignment import Tours
from mjcollect.planners.fleet_bound import fleet_bound
from mjcollect.render.fleet import FlownPart, fleet_progress
from mjcollect.render.fleet_figures import (
    plot_fleet_path_3d,
    plot_fleet_path_top,
    plot_schedule,
)
from mjcollect.scene.scene import Scene
from mjcollect.scene.shortest_tour import MAX_EXACT, lkh_installed
from mjcollect.scene.trajectory import shield_intervals
from mjcollect.verify import least_gaps, verify_separation
from train.support.markdown import markdown_table
from train.support.mission_report import (
    film,
    links,
    mission_result,
    write_mission,
    write_replay,
)
from train.support.run_folder import RunFolder, versions

COLUMNS = ("UAV", "items in order", "time (s)", "bound (s)", "shield", "made room", "ended")


@dataclass(frozen=True)
class Sharing:
    """Says who flies what.

    Attributes:
        scene: the whole scene. uavs: how many there are.
        tours: items of those that have any, in the order of visit. courses: their courses.
        depots: the numbers of their depots, which places in `tours` do not tell where UAVs without
            items are left out; none if all are at the first.
    """

    scene: Scene
    uavs: int
    tours: Tours
    courses: tuple[Course, ...]
    depots: tuple[int, ...] = ()

    @property
    def method(self) -> str:
        """Returns how the items were shared and ordered."""
        if len(self.scene.items) <= MAX_EXACT:
            return "exact"
        return "pyvrp, lkh" if lkh_installed() else "pyvrp"

    def folder(self, folder: RunFolder, index: int) -> RunFolder:
        """Returns the folder of a UAV's mission in the fleet's."""
        return RunFolder(folder.path / "uavs" / str(index))


def write_fleet(
    folder: RunFolder, sharing: Sharing, flown: FleetFlight, planner: str, seed: int,
    trained: Sequence[Sequence[dict[str, Any] | None]], *, plots: bool,
) -> None:  # fmt: skip
    """Writes each UAV's mission, the plots if they are wanted, and last fleet.json.

    Args:
        trained: the segment.json of each UAV's segments, None where nothing was trained.
    """
    scene, missions, violations = sharing.scene, [], []
    for index, (course, flight) in enumerate(zip(sharing.courses, flown.flights, strict=True)):
        own = sharing.folder(folder, index)
        own.path.mkdir(parents=True, exist_ok=True)
        own.write("scene.json", course.scene.save)
        order = tuple(range(len(course.scene.items)))
        result = mission_result(course, order, sharing.method, flight, trained[index], seed)
        result["planner"] = planner
        write_mission(own, course.scene, result, flight, plots=plots)
        violations += [{"uav": index, **entry} for entry in result["violations"]]
        missions.append(
            {
                "uav": index,
                "folder": f"uavs/{index}",
                "items": list(sharing.tours[index]),
                "success": result["success"],
                "mission_time": result["mission_time"],
                "lower_bound": result["lower_bound"],
                "shield_share": result["shield_share"],
                "made_room_share": flown.made_room[index],
                "ended": flown.ended[index],
            }
            | ({"depot": sharing.depots[index]} if len(scene.depots) > 1 else {})
        )
    tracks = [flight.trajectory for flight in flown.flights]
    violations.sort(key=lambda entry: entry["t"])
    violations += [encounter.to_dict() for encounter in verify_separation(scene, tracks)]
    pairs = [least_gaps(one, two).min() for k, two in enumerate(tracks) for one in tracks[:k]]
    success = flown.success and not violations
    bound, method = fleet_bound(scene, sharing.uavs)
    document = {
        "scene": scene.name,
        "uavs": sharing.uavs,
        "order_method": sharing.method,
        "success": success,
        "makespan": flown.makespan if success else None,
        "lower_bound": bound,
        "bound_method": method,
        "ratio": flown.makespan / bound if success and bound > 0 else None,
        "separation": float(min(pairs)) if pairs else None,
        "separation_limit": scene.apart,
        "violations": violations,
        "planner": planner,
        "missions": missions,
        "seed": seed,
        "versions": versions(),
    }
    if plots:
        shown = [
            FlownPart(
                course.scene, flight.trajectory, shield_intervals(flight.shielded, flight.slot)
            )
            for course, flight in zip(sharing.courses, flown.flights, strict=True)
        ]
        fleet = fleet_progress(scene, document, shown)
        folder.write("path_3d.png", lambda part: plot_fleet_path_3d(part, fleet))
        folder.write("path_top.png", lambda part: plot_fleet_path_top(part, fleet))
        folder.write("schedule.png", lambda part: plot_schedule(part, fleet))
    folder.write_json("fleet.json", document)


def finish_fleet(
    folder: RunFolder, *, video: bool, replay: bool, plots: bool, notes: Sequence[str] = ()
) -> int:  # fmt: skip
    """Makes report.md, replay and video if asked for; returns 0 for success, else 1."""
    result = folder.read_json("fleet.json")
    assert result is not None
    if replay:
        write_replay(folder)
    folder.write_text("report.md", fleet_report(folder.path, result, plots, notes))
    if video:
        film(folder.path / "fleet.mp4")
        folder.write_text("report.md", fleet_report(folder.path, result, plots, notes))
    print(fleet_outcome(result, folder.path))
    return 0 if result["success"] else 1


def fleet_report(folder: Path, result: dict[str, Any], plots: bool, notes: Sequence[str]) -> str:
    """Returns a page in Markdown: verdict, table of UAVs, pictures that the folder holds."""
    items = sum(len(mission["items"]) for mission in result["missions"])
    lines = [f"# {result['uavs']} UAVs in {result['scene']}", ""]
    if result["success"]:
        lines.append(
            f"**Success**: {items} items, the last UAV home after **{result['makespan']:.1f} s**, "
            f"{ratio(result)} of the lower bound of {result['lower_bound']:.1f} s "
            f"({result['bound_method']})."
        )
    else:
        lines += ["**No success.**", "", *(f"- {describe(each)}" for each in result["violations"])]
        lines += [
            f"- UAV {mission['uav']}: {mission['ended']}"
            for mission in result["missions"]
            if mission["ended"] != "home"
        ]
    if result["separation"] is not None:
        lines += [
            "",
            f"The centres of two UAVs came as near as {result['separation']:.2f} m; they keep "
            f"{result['separation_limit']:g} m apart.",
        ]
    lines += ["", f"Planner: {result['planner']}. Items shared by: {result['order_method']}."]
    if notes:
        lines += ["", *(f"- {note}" for note in notes)]
    rows = [
        [
            f"[{mission['uav']}]({mission['folder']}/mission.json)",
            " ".join(map(str, mission["items"])),
            "-" if mission["mission_time"] is None else f"{mission['mission_time']:.1f}",
            f"{mission['lower_bound']:.1f}",
            f"{mission['shield_share']:.1%}",
            f"{mission['made_room_share']:.1%}",
            mission["ended"],
            *([str(mission["depot"])] if "depot" in mission else []),
        ]
        for mission in result["missions"]
    ]
    columns = [*COLUMNS, *(["depot"] if "depot" in result["missions"][0] else [])]
    lines += ["", *markdown_table(columns, rows), ""]
    lines += [
        "Shield: share of the slots in which it changed the command, before boxes or other UAVs. "
        "Made room: share in which the UAV left the way to another one.",
        "",
    ]
    lines += links(folder, "fleet.mp4")
    if plots:
        lines += [
            "![Flown paths](path_3d.png)",
            "![Top view](path_top.png)",
            "![Schedule](schedule.png)",
        ]
    return "\n".join(lines) + "\n"


def describe(violation: dict[str, Any]) -> str:
    """Says in words what was violated, by whom and when."""
    who = violation["uavs"] if violation["kind"] == "separation" else [violation["uav"]]
    value = "" if violation["value"] is None else f": {violation['value']:.4g}"
    names = " and ".join(f"UAV {number}" for number in who)
    limit = f"against a limit of {violation['limit']:.4g}"
    return f"{violation['kind']} of {names} at {violation['t']:.2f} s{value} {limit}"


def ratio(result: dict[str, Any]) -> str:
    """Returns the makespan over the lower bound, as 1.042; a dash where the bound is 0."""
    return "-" if result["ratio"] is None else f"{result['ratio']:.3f}"


def fleet_outcome(result: dict[str, Any], folder: Path) -> str:
    """Says the result in one line, for the user."""
    if not result["success"]:
        lost = [m for m in result["missions"] if m["ended"] != "home"]
        why = f"UAV {lost[0]['uav']}: {lost[0]['ended']}" if lost else "refused by the verifier"
        return f"no success ({why}): {folder}"
    items = sum(len(mission["items"]) for mission in result["missions"])
    return (
        f"success: {items} items by {len(result['missions'])} UAVs in {result['makespan']:.1f} s, "
        f"{ratio(result)} of the lower bound: {folder}"
    )
