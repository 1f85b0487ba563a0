"""Holds what became of a slot."""

from __future__ import annotations

from dataclasses import dataclass

from mjcollect.flight.contact import Slot
from mjcollect.geometry.compiled import Array, Bools


@dataclass(frozen=True)
class Outcome:
    """Holds the result of one slot in N episodes, each (N,).

    Attributes:
        reward: reward of the slot.
        slot: events of the slot.
        terminated: whether the course was finished or a crash ended the episode.
        truncated: whether the step limit ended the episode.
        success: whether the course was finished.
        shielded: whether the shield changed the command.
        room: share of its margin that the shield kept, 1 in calm air.
        struck: whether the body touched a moving box, or came too near to a UAV of its fleet.
    """

    reward: Array
    slot: Slot
    terminated: Bools
    truncated: Bools
    success: Bools
    shielded: Bools
    room: Array
    struck: Bools
