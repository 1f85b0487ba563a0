"""From a scene of your own to a judged mission, in Python and without any training.

Three boxes and four items are written down, checked, put in order, flown by the policy that comes
with the package, by the guidance law and by model predictive control, and judged by the verifier.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import tyro

import mjcollect
from mjcollect.envs.recording import Flight, fly, fly_law
from mjcollect.planners.plan import fly_planner
from mjcollect.scene import detour_bound, mission_bound
from mjcollect.verify import verify


@dataclass
class Args:
    """Flies a scene that is written in this file, and says what each pilot took."""

    out: Path = Path("runs/own_scene")
    """Writes the scene file and a trajectory of each pilot into this folder."""
    v_max: float = 30.0
    """Sets the greatest speed (m/s)."""
    quick: bool = False
    """Leaves out model predictive control, which takes longest."""


def own_scene(v_max: float) -> mjcollect.Scene:
    """Returns a yard of 400 x 300 m with a hall, a tower and a turned shed (metres, seconds)."""
    return mjcollect.Scene.from_json(f"""{{
      "name": "yard", "seed": 0,
      "bounds": {{"min": [0, 0, 0], "max": [400, 300, 120]}},
      "depot": [20, 20, 2],
      "items": [[350, 250, 10], [200, 60, 45], [60, 240, 5], [370, 40, 80]],
      "obstacles": [
        {{"min": [100, 80, 0], "max": [260, 200, 35]}},
        {{"min": [300, 90, 0], "max": [330, 130, 110]}},
        {{"min": [40, 150, 0], "max": [90, 180, 20], "yaw": 30.0}}
      ],
      "v_max": {v_max}, "a_max": 8.0, "epsilon": 2.0, "slot": 0.2, "return_tolerance": 2.0
    }}""")


def main(args: Args) -> dict[str, bool]:
    """Flies, prints a table, and returns for each pilot whether the verifier found nothing."""
    try:
        scene = own_scene(args.v_max)
    except mjcollect.SceneError as error:  # names the field, the value and the fix
        raise SystemExit(f"error: {error}") from None
    args.out.mkdir(parents=True, exist_ok=True)
    scene.save(args.out / "yard.json")  # `mjcollect fly --scene yard.json` would fly it, too

    order = mjcollect.plan_order(scene, "lkh")
    course = mjcollect.Course.mission(scene, order)  # finds the shortest free path to each target
    ways = zip(course.nodes[:-1], course.nodes[1:], course.guidance, strict=True)
    least = sum(detour_bound(scene, a, b, guide.length) for a, b, guide in ways)
    print(f"order {list(order)}; no flight beats {mission_bound(scene)[0]:.1f} s, ", end="")
    print(f"and round the boxes about {least:.1f} s are needed")

    shipped = mjcollect.asset_path("policies", "generalist.safetensors")
    policy = mjcollect.TrainedPolicy.load(shipped)
    pilots: dict[str, Callable[[], Flight]] = {
        "policy": lambda: fly(course, [policy] * len(course.guidance), policy.observation),
        "guidance law": lambda: fly_law(course),
        "MPC": lambda: fly_planner(course, mjcollect.Mpc(course)),
    }
    if args.quick:
        del pilots["MPC"]
    fine = {}
    for name, pilot in pilots.items():
        flight = pilot()
        violations = verify(scene, flight.trajectory, order)
        fine[name] = flight.success and not violations
        flight.trajectory.save(args.out / f"{name.replace(' ', '_')}.csv")
        verdict = "nothing broken" if fine[name] else f"broken: {violations}"
        print(
            f"{name:>12}: {flight.trajectory.duration:5.1f} s, {flight.contacts} contacts, ", end=""
        )
        print(f"shield in {flight.shield_share:.0%} of slots, {verdict}")
    print(f"the scene and the flights are in {args.out}")
    return fine


if __name__ == "__main__":
    raise SystemExit(not all(main(tyro.cli(Args)).values()))
