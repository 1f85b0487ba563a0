"""Lists the formats that a flown mission is written in."""

from __future__ import annotations

import json
from collections.abc import Callable

from mjcollect.export.maps import csv, geojson, kml
from mjcollect.export.mission import FlownMission
from mjcollect.export.plan import plan_text

FORMATS: dict[str, Callable[[FlownMission], str]] = {
    "plan": plan_text,
    "kml": kml,
    "geojson": lambda mission: json.dumps(geojson(mission)) + "\n",
    "csv": csv,
}
