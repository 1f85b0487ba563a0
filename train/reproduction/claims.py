"""The paper's claims against the tables: each verdict is computed from the numbers it quotes.

A claim is what the paper says, a verdict (`holds`, `holds in part`, `does not hold`, `undecided`,
`not tested`), the reason in one paragraph, and those of the reason's numbers that no table holds.
Nothing here knows what the numbers are: with others the verdicts turn (see the tests).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from train.reproduction.ablations import aware_order, learning, safety
from train.reproduction.paper import DDPG, LKH_DDPG, MPC, SCENARIOS, SWEEP, saving
from train.reproduction.tables import Row
from train.reproduction.wording import (
    FAILS,
    FEW,
    HOLDS,
    PARTLY,
    UNTESTED,
    Document,
    Verdict,
    interval,
    percent,
)

RARE = 0.05  # share of cases below which a reported value is called an exception
NEAR = 0.02  # relative difference that still counts as equal
LKH_MPC = ("lkh", "mpc")


def claims(doc: Document) -> list[Row]:
    """All claims with verdict and reason."""
    found = []
    for said, judge in CLAIMS:
        untested: Verdict = (UNTESTED, "The flights that it needs were not flown.", {})
        verdict, text, numbers = judge(doc) or untested
        found.append({"paper": said, "verdict": verdict, "text": text, "numbers": numbers})
    return found


def scheme(rows: Sequence[Row] | None, which: tuple[str, str]) -> Row | None:
    """The row of (order method, planner); None unless it has a time."""
    for row in rows or ():
        if (row["method"], row["planner"]) == which and row["time"]["n"]:
            return row
    return None


def _scenario(doc: Document, scene: str, which: tuple[str, str]) -> Row | None:
    return scheme(doc["tables"]["scenarios"].get(scene), which)


def _sweep(doc: Document, which: tuple[str, str]) -> dict[int, Row]:
    rows = {entry["items"]: scheme(entry["schemes"], which) for entry in doc["tables"]["sweep"]}
    return {items: row for items, row in rows.items() if row is not None}


def _time(row: Row) -> float:
    return float(row["time"]["mean"])


def order_gain(doc: Document) -> Verdict | None:
    """LKH against a random order in the two scenarios."""
    parts, gains = [], []
    numbers: dict[str, float] = {}
    for scene, paper in SCENARIOS.items():
        lkh, drawn = _scenario(doc, scene, LKH_DDPG), _scenario(doc, scene, DDPG)
        if lkh is None or drawn is None:
            return None
        gain, spread = saving(_time(lkh), _time(drawn)), doc["spreads"][scene]
        numbers |= {scene: gain, f"{scene} paper": saving(paper[LKH_DDPG], paper[DDPG])}
        gains.append(gain)
        parts.append(
            f"{scene}: {percent(gain)} with the look-alike's random order (the paper's times: "
            f"{percent(saving(paper[LKH_DDPG], paper[DDPG]))}), whose bound is "
            f"{drawn['order_bound']:.1f} s; over all orders of the scene the bounds average "
            f"{spread['mean']:.1f} s, the worst is {spread['worst']:.1f} s, and "
            f"{percent(spread['share_as_long'])} of them are as long as this one."
        )
    verdict = HOLDS if min(gains) > 0 else PARTLY if max(gains) > 0 else FAILS
    rare = [s for s in SCENARIOS if doc["spreads"][s]["share_as_long"] < RARE]
    if verdict == HOLDS and rare:
        verdict = PARTLY
        parts.append(f"So unlucky an order is an exception in {', '.join(rare)}.")
    return verdict, " ".join(parts), numbers


def gain_at_eight(doc: Document) -> Verdict | None:
    """45.7% at K = 8: one instance against the distribution."""
    orders = doc["orders"]
    if orders is None:
        return None
    share, last = orders["share_paper_saving"], orders["items"][-1]
    text = (
        f"Over {orders['instances']} random instances with straight legs the best order saves "
        f"{percent(last['saving'])} on average at K = 8 (5th to 95th percentile "
        f"{percent(last['p5'])} to {percent(last['p95'])}); {percent(orders['paper_saving'])} or "
        f"more happens in {percent(share, 2)} of them."
    )
    flown = doc["tables"]["order_saving"]["policy"]["saving"]
    if flown["n"]:
        text += (
            f" Flown by learned policies over {flown['n']} random scenes with K = "
            f"{doc['sizes']['items']}, LKH saves {interval(flown)}."
        )
    if "sweep_8" in doc["spreads"]:
        alike = doc["spreads"]["sweep_8"]
        text += (
            f" In the look-alike, which was picked for such times, the bounds of all orders "
            f"average {alike['mean']:.1f} s against {alike['best']:.1f} s for the best, and "
            f"{percent(alike['share_as_long'])} of them are as long as the one flown."
        )
    if share < RARE:
        return PARTLY, text + " The paper's figure is one exceptional instance.", {}
    return HOLDS, text, {}


def mpc_gain(doc: Document) -> Verdict | None:
    """LKH-DDPG against the MPC: is it the order or the flying?"""
    parts, flying = [], []
    numbers: dict[str, float] = {}
    for scene, paper in SCENARIOS.items():
        lkh, given = _scenario(doc, scene, LKH_DDPG), _scenario(doc, scene, MPC)
        same = _scenario(doc, scene, LKH_MPC)
        if lkh is None or given is None or same is None:
            return None
        flying.append(saving(_time(lkh), _time(same)))
        worst = doc["spreads"][scene]["worst"]
        beyond = numbers[scene] = paper[MPC] / worst - 1.0
        why = (
            f"; the paper's {paper[MPC]:.1f} s is {percent(beyond)} above the bound of even the "
            f"worst order ({worst:.1f} s), so its MPC flew badly or its layout differs"
            if beyond > 0
            else ""
        )
        parts.append(
            f"{scene}: LKH-DDPG {_time(lkh):.1f} s, MPC in file order {_time(given):.1f} s, the "
            f"same MPC in LKH order {_time(same):.1f} s{why}."
        )
    eight = [_sweep(doc, which).get(8) for which in (LKH_DDPG, MPC, LKH_MPC)]
    if None not in eight:
        lkh_time, given_time, same_time = (_time(row) for row in eight if row is not None)
        numbers["K = 8"] = saving(lkh_time, given_time)
        parts.append(
            f"K = 8: {lkh_time:.1f} s, {given_time:.1f} s and {same_time:.1f} s, so "
            f"{percent(numbers['K = 8'])} against the MPC in file order."
        )
    paired = doc["tables"]["policy_saving"]["mpc"]["saving"]
    if paired["n"]:
        parts.append(
            f"Over {paired['n']} random scenes in the same LKH order the policies save "
            f"{interval(paired)} of the MPC's time."
        )
    if paired["n"] >= FEW:
        faster, slower = paired["low"] > 0, paired["high"] < 0
    else:
        faster, slower = min(flying) > 0, max(flying) < 0
    if faster:
        parts.append("The policies fly faster than the MPC in the same order.")
        return HOLDS, " ".join(parts), numbers
    parts.append(
        "In the same order the MPC is faster: the paper's gap is the order's, not the learner's."
        if slower
        else "In the same order neither is clearly faster: the gap is the order's."
    )
    return FAILS, " ".join(parts), numbers


def small_sweep(doc: Document) -> Verdict | None:
    """At K = 1 and 2 the order cannot matter."""
    schemes = {name: _sweep(doc, which) for name, which in
               (("LKH-DDPG", LKH_DDPG), ("DDPG without LKH", DDPG), ("MPC", MPC))}  # fmt: skip
    items = [k for k in (1, 2) if all(k in rows for rows in schemes.values())]
    if not items:
        return None
    parts, spreads = [], []
    for k in items:
        times = {name: _time(rows[k]) for name, rows in schemes.items()}
        spreads.append(max(times.values()) / min(times.values()) - 1.0)
        listed = ", ".join(f"{name} {time:.1f} s" for name, time in times.items())
        parts.append(f"K = {k}: {listed}.")
    parts.append(
        "With one or two items there is only one tour, flown in either direction: what differs "
        "there is flying, not order."
    )
    return (HOLDS if max(spreads) <= NEAR else FAILS), " ".join(parts), {}


def plateau(doc: Document) -> Verdict | None:
    """96 to 97 s from K = 6 to 8."""
    orders = doc["orders"]
    if orders is None:
        return None
    low, high = SWEEP[LKH_DDPG][6][0], SWEEP[LKH_DDPG][8][1]
    rise = orders["rise_6_to_8"]
    text = (
        f"The paper's time rises by at most {high - low:.1f} s from K = 6 to 8. Over "
        f"{orders['instances']} random nested item sets the best possible time rises by "
        f"{rise['mean']:.1f} s on average and never by less than {rise['least']:.1f} s: each stop "
        "costs braking and starting even if it lies on the way."
    )
    flown = _sweep(doc, LKH_DDPG)
    if 6 in flown and 8 in flown:
        text += f" Ours on the look-alike: {_time(flown[6]):.1f} s to {_time(flown[8]):.1f} s."
    numbers = {"paper's rise": high - low}
    if rise["least"] <= high - low:
        return HOLDS, text, numbers
    text += " So either the items are not nested, or the shorter missions were not flown optimally."
    return FAILS, text, numbers


def always_shortest(doc: Document) -> Verdict | None:
    """LKH-DDPG is the shortest at every K."""
    ours = _sweep(doc, LKH_DDPG)
    baselines = {"DDPG without LKH": DDPG, "MPC in file order": MPC}
    stronger = {"MPC in LKH order": LKH_MPC, "the guidance law in LKH order": ("lkh", "guidance"),
                "the reference planner": ("lkh", "reference")}  # fmt: skip
    if len(ours) < 2:
        return None

    def beaten(by: dict[str, tuple[str, str]]) -> list[str]:
        found = []
        for name, which in by.items():
            rows = _sweep(doc, which)
            worse = [k for k in ours if k in rows and _time(rows[k]) < _time(ours[k]) - 1e-6]
            if worse:
                found.append(f"{name} at K = {', '.join(map(str, worse))}")
        return found

    weak, strong = beaten(baselines), beaten(stronger)
    text = f"Flown at K = {', '.join(map(str, ours))}."
    text += (
        f" Shorter among the paper's baselines: {'; '.join(weak)}."
        if weak
        else " None of the paper's baselines is shorter at any K."
    )
    if strong:
        text += f" Shorter among stronger ones: {'; '.join(strong)}."
    return (FAILS if weak else PARTLY if strong else HOLDS), text, {}


def knee(doc: Document) -> Verdict | None:
    """The MPC's time grows sharply from K = 5 on."""
    rows = _sweep(doc, MPC)
    small, large = [k for k in rows if k <= 4], [k for k in rows if k >= 5]
    if not small or not large:
        return None

    def over(items: Sequence[int]) -> float:
        return sum(_time(rows[k]) / rows[k]["order_bound"] for k in items) / len(items)

    few, many = over(small), over(large)
    text = (
        f"Our MPC in file order takes {few:.3f} of its own order's bound for K <= 4 and "
        f"{many:.3f} for K >= 5, on average: "
    )
    numbers = {"K <= 4": few, "K >= 5": many}
    if many - few <= NEAR:
        text += "avoidance does not pile up with K, and whatever knee there is is the order's."
        return FAILS, text, numbers
    return HOLDS, text + "it loses more with more items.", numbers


CLAIMS: list[tuple[str, Callable[[Document], Verdict | None]]] = [
    ("LKH-DDPG is 17.9% (scenario 1) and 21.3% (scenario 2) faster than DDPG without LKH.",
     order_gain),
    ("At K = 8 LKH shortens the mission by 45.7%.", gain_at_eight),
    ("LKH-DDPG is 32.0% (scenario 1), 9.2% (scenario 2) and 49.4% (K = 8) faster than MPC.",
     mpc_gain),
    ("At K = 1 all methods take about the same time.", small_sweep),
    ("From K = 6 to 8 LKH-DDPG stays at 96 to 97 s.", plateau),
    ("LKH-DDPG is the fastest at every K.", always_shortest),
    ("The MPC's time grows sharply from K = 5 on, because of myopic avoidance.", knee),
    ("LKH-DDPG flies without collisions.", safety),
    ("Learned trajectories shorten the flight (the paper has no such ablation).", learning),
    ("LKH on straight distances orders well enough (the paper has no such ablation).",
     aware_order),
]  # fmt: skip
