"""This room registers segments and missions as Gymnasium environments, single and vectorised.

Gymnasium 1 loads no plug-ins: either import this package before `gymnasium.make`, or name it there,
`gymnasium.make("mjcollect.gym:mjcollect/Segment-v0")`. It needs Gymnasium; neither dm-control's
simulator nor GL is loaded by it.
"""

from __future__ import annotations

try:
    import gymnasium
except ImportError as error:
    raise ImportError("mjcollect.gym needs Gymnasium: pip install 'mjcollect[gym]'") from error

IDS = {"mjcollect/Segment-v0": "segment", "mjcollect/Mission-v0": "mission"}

for _id, _task in IDS.items():
    if _id not in gymnasium.registry:
        gymnasium.register(
            _id,
            entry_point="mjcollect.gym.env:FlightEnv",
            vector_entry_point="mjcollect.gym.vector_env:FlightVectorEnv",
            kwargs={"task": _task},
        )
