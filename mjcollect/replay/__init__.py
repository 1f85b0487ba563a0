"""Writes replays of finished runs: pages that show their flights in any browser, offline."""

from mjcollect.replay.page import FILE as REPLAY_FILE
from mjcollect.replay.page import replay_in, write_replay
from mjcollect.replay.payload import ReplayError

__all__ = ["REPLAY_FILE", "ReplayError", "replay_in", "write_replay"]
