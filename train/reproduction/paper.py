"""What the paper reports (Zhai et al., section V), and what its schemes are called.

The layouts behind its times are unpublished. The bundled look-alikes were drawn so that the bounds
of their best and of one other order lie just below the paper's times with and without LKH.
"""

from __future__ import annotations

Scheme = tuple[str, str]  # order method and planner
# The paper's schemes. Its MPC flies "a fixed pre-defined visiting sequence".
LKH_DDPG, DDPG, MPC = ("lkh", "policy"), ("random", "policy"), ("given", "mpc")
SCHEMES: dict[Scheme, str] = {LKH_DDPG: "LKH-DDPG", DDPG: "DDPG without LKH", MPC: "MPC"}
ORDER_NAMES = {"random": "random order", "lkh": "LKH", "lkh-time": "LKH, obstacle-aware cost",
               "given": "file order"}  # fmt: skip
PLANNER_NAMES = {"policy": "DDPG", "mpc": "MPC", "guidance": "guidance law",
                 "reference": "reference"}  # fmt: skip
# Mission times in seconds.
SCENARIOS: dict[str, dict[Scheme, float]] = {
    "scenario_1": {LKH_DDPG: 71.8, DDPG: 87.4, MPC: 105.6},
    "scenario_2": {LKH_DDPG: 74.8, DDPG: 95.0, MPC: 82.4},
}
# Least and greatest time against K (its figure of the sweep, where the text gives the number).
# 130.0 to 191.8 s are given for K = 5 to 8, 96 to 97 s for K = 6 to 8.
SWEEP: dict[Scheme, dict[int, tuple[float, float]]] = {
    LKH_DDPG: {1: (25.6, 25.6), 4: (74.8, 74.8), 6: (96.0, 97.0), 7: (96.0, 97.0), 8: (97.0, 97.0)},
    DDPG: {1: (26.0, 26.0), 2: (58.0, 58.0), 4: (95.0, 95.0), 8: (178.8, 178.8)},
    MPC: {1: (27.0, 27.0), 4: (82.4, 82.4), 5: (130.0, 130.0), 6: (130.0, 191.8),
          7: (130.0, 191.8), 8: (191.8, 191.8)},
}  # fmt: skip
SWEEP_SAVING = 1.0 - SWEEP[LKH_DDPG][8][0] / SWEEP[DDPG][8][0]  # by LKH, at K = 8
# The orders of the look-alikes whose bounds come near the paper's times without LKH.
RANDOM_ORDERS: dict[str, tuple[int, ...]] = {
    "scenario_1": (2, 3, 0, 1),
    "scenario_2": (1, 3, 2, 0),
    "sweep_8": (7, 3, 1, 0, 4, 2, 6, 5),
}


def reported(scene: str, scheme: Scheme) -> list[float] | None:
    """Return the paper's time for a scheme as [low, high], or None if it gives none.

    Args:
        scene: label in the tables, such as scenario_1 or sweep_4.
    """
    if scene in SCENARIOS and scheme in SCENARIOS[scene]:
        return [SCENARIOS[scene][scheme]] * 2
    for items, times in SWEEP.get(scheme, {}).items():
        if scene == f"sweep_{items}":
            return list(times)
    return None


def scheme_name(method: str, planner: str) -> str:
    """Return the paper's name of a scheme, such as 'LKH-DDPG', or else one such as 'MPC, LKH'."""
    if (method, planner) in (LKH_DDPG, DDPG):
        return SCHEMES[method, planner]
    return f"{PLANNER_NAMES[planner]}, {ORDER_NAMES[method]}"
