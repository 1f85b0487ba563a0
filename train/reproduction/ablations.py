"""Verdicts on safety, and on what the paper does not ask: is the learning, or LKH, needed?"""

from __future__ import annotations

from train.reproduction.figures import PLANNER_NAMES
from train.reproduction.wording import (
    FAILS,
    FEW,
    HOLDS,
    PARTLY,
    UNDECIDED,
    Document,
    Verdict,
    interval,
    percent,
)

NEGLIGIBLE = 0.01  # share of the time; a smaller gain is called none
TOO_FEW = " The scenes are too few to tell."


def safety(doc: Document) -> Verdict | None:
    """Collision-free flights."""
    rows = doc["tables"]["policies"]
    if not rows["n"]:
        return None
    text = (
        f"{rows['successes']} of {rows['n']} missions flown by learned policies pass every check "
        f"(success rate {percent(rows['share'])}, 95% interval {percent(rows['low'])} to "
        f"{percent(rows['high'])}), with {rows['contacts']} physics steps in contact."
    )
    good = rows["successes"] == rows["n"]
    return (HOLDS if good else PARTLY if rows["share"] >= 0.5 else FAILS), text, {}


def learning(doc: Document) -> Verdict | None:
    """What the learned trajectories are worth beside planners without learning."""
    table = doc["tables"]["policy_saving"]
    law, reference = table["guidance"]["saving"], table["reference"]["saving"]
    if not law["n"]:
        return None
    text = (
        f"Over {law['n']} random scenes in LKH order the policies save {interval(law, digits=2)} "
        "of the time of the guidance law that they correct."
    )
    if reference["n"]:
        text += (
            f" Against the reference planner, which knows everything and is near the limit, they "
            f"save {interval(reference, digits=2)} (negative: they are longer)."
        )
    if law["n"] < FEW:
        return UNDECIDED, text + TOO_FEW, {}
    return (HOLDS if law["low"] > 0 else FAILS if law["high"] < 0 else UNDECIDED), text, {}


def aware_order(doc: Document) -> Verdict | None:
    """Does an order that knows the obstacles beat LKH on straight distances?"""
    rows = doc["tables"]["time_order_saving"]
    parts, gains = [], []
    differ = 0
    for planner, row in rows.items():
        if row["saving"]["n"]:
            gains.append(row["saving"])
            differ = max(differ, row["changed"])
            parts.append(
                f"{PLANNER_NAMES[planner]}: {interval(row['saving'], digits=2)} over "
                f"{row['saving']['n']} scenes, in {row['changed']} of which the order differs"
            )
    if not parts:
        return None
    text = "Time saved by ordering at obstacle-aware cost instead: " + "; ".join(parts) + "."
    if not differ or min(gain["n"] for gain in gains) < FEW:
        return UNDECIDED, text + TOO_FEW, {}
    if any(gain["low"] > 0 for gain in gains):
        return FAILS, text + " The obstacle-aware order is better.", {}
    if all(gain["high"] < NEGLIGIBLE for gain in gains):
        return (
            HOLDS,
            text + f" No interval reaches {percent(NEGLIGIBLE, 0)}.",
            {"negligible": NEGLIGIBLE},
        )
    return UNDECIDED, text + TOO_FEW, {}
