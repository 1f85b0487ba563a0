"""Writes replays of finished runs: pages that show their flights in any browser, offline."""

from mjcollect.replay.page import replay_in, write_replay
from mjcollect.replay.payload import ReplayError

__all__ = ["ReplayError", "replay_in", "write_replay"]
