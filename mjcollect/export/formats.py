"""Lists the formats that a flown mission is written in."""

from __future__ import annotations

import json
from collections.abc import Callable

from mjcollect.export.maps import csv, geojson, kml
from mjcollect.export.mission import FlownMission
from mjcollect.export.plan import plan

FORMATS: dict[str, Callable[[FlownMission], str]] = {
    "plan": lambda mission: json.dumps(plan(mission), indent=1) + "\n",
    "kml": kml,
    "geojson": lambda mission: json.dumps(geojson(mission)) + "\n",
    "csv": csv,
}
