"""The rules of one simulation, compiled by numba, and loops over all simulations.

What is called for every slot of every simulation is written here once, for a single one: rows are
arrays (3,), booleans or numbers. The loops give one simulation and many the same bits, since each
row is computed by the same code in the same order; fast-math stays off. The modules that the
rules belong to (`flight`, `guidance`, `observation`, `reward`, `geometry`) wrap the loops and say
shapes and units. Constants that are tuned live there and come in as arguments.

A kernel may call kernels of this folder and of its own file, no others: a change of what it calls
elsewhere would go unnoticed in the cache, see `compiled`.
"""

from mjcollect.kernels.boxes import segment_gaps, segments_clear
from mjcollect.kernels.flight import command, events, project, try_starts
from mjcollect.kernels.law import law
from mjcollect.kernels.observation import frames, guided, look
from mjcollect.kernels.reward import time_to_go
from mjcollect.kernels.shield import shield
from mjcollect.kernels.way import interpolate, query

__all__ = [
    "command", "events", "frames", "guided", "interpolate", "law", "look", "project", "query",
    "segment_gaps", "segments_clear", "shield", "time_to_go", "try_starts",
]  # fmt: skip
