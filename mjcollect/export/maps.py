"""Writes a mission for maps: GeoJSON (RFC 7946), KML 2.2 with a track in time, and CSV."""

from __future__ import annotations

import io
from datetime import UTC, datetime, timedelta
from typing import Any
from xml.etree import ElementTree

import numpy as np

from mjcollect.export.mission import FlownMission
from mjcollect.geometry.compiled import Array

BEGIN = datetime(2000, 1, 1, 12, tzinfo=UTC)  # A flight has no date; its track begins at this one.
KML, GX = "http://www.opengis.net/kml/2.2", "http://www.google.com/kml/ext/2.2"
CSV_HEADER = "t,latitude,longitude,altitude,speed"


def geojson(mission: FlownMission) -> dict[str, Any]:
    """Returns the document: the flight, the depot, the items in their order, and the obstacles."""
    scene, flown, rows = mission.scene, mission.trajectory, mission.rows
    line = {"type": "LineString", "coordinates": _coordinates(mission, flown.x[rows])}
    about = {"kind": "flight", "scene": scene.name, "seconds": flown.duration}
    features = [_feature(line, about | {"times": np.round(flown.t[rows], 6).tolist()})]
    depot = {"type": "Point", "coordinates": _coordinates(mission, scene.depot)}
    features.append(_feature(depot, {"kind": "depot"}))
    for visit, (node, row) in enumerate(zip(mission.order, mission.stops, strict=False)):
        item = {"type": "Point", "coordinates": _coordinates(mission, scene.items[node])}
        seconds = round(float(flown.t[row]), 6)
        about = {"kind": "item", "item": node, "visit": visit, "collected": seconds}
        features.append(_feature(item, about))
    for index, box in enumerate(scene.boxes):
        ring = [[place[1], place[0]] for place in mission.floor(box).tolist()]
        polygon = {"type": "Polygon", "coordinates": [[*ring, ring[0]]]}
        kind = "no-fly zone" if index in scene.no_fly else "obstacle"
        about = {"kind": kind, "obstacle": index}
        heights = {"base": float(box[0, 2]), "height": float(box[1, 2])}  # as in OpenStreetMap
        features.append(_feature(polygon, about | heights))
    return {"type": "FeatureCollection", "features": features}


def kml(mission: FlownMission, buildings: bool = True) -> str:
    """Returns the KML file: the track in time, depot, items and, if asked, obstacles."""
    ElementTree.register_namespace("", KML)
    ElementTree.register_namespace("gx", GX)
    root = ElementTree.Element(f"{{{KML}}}kml")
    document = _add(root, "Document")
    _add(document, "name", mission.scene.name)
    _add(_add(_add(document, "Style", id="flight"), "LineStyle"), "width", "3")
    for kind, colour in (("obstacle", "b0a0a0a0"), ("no-fly", "602e40d5")):
        box_style = _add(_add(document, "Style", id=kind), "PolyStyle")
        _add(box_style, "color", colour)  # alpha, blue, green, red
    flight = _add(document, "Placemark")
    _add(flight, "name", "flight")
    _add(flight, "styleUrl", "#flight")
    track = ElementTree.SubElement(flight, f"{{{GX}}}Track")
    _add(track, "altitudeMode", "absolute")
    rows = mission.rows
    for seconds in mission.trajectory.t[rows].tolist():
        moment = BEGIN + timedelta(seconds=seconds)
        _add(track, "when", moment.strftime("%Y-%m-%dT%H:%M:%S.%f")[:-3] + "Z")
    for place in _coordinates(mission, mission.trajectory.x[rows]):
        coordinate = ElementTree.SubElement(track, f"{{{GX}}}coord")
        coordinate.text = " ".join(f"{number:.9g}" for number in place)
    points = [("depot", mission.scene.depot)]
    points += [(f"item {node}", mission.scene.items[node]) for node in mission.order]
    for name, point in points:
        mark = _add(document, "Placemark")
        _add(mark, "name", name)
        at = _add(mark, "Point")
        _add(at, "altitudeMode", "absolute")
        _add(at, "coordinates", _text(_coordinates(mission, point)))
    for index, box in enumerate(mission.scene.boxes if buildings else ()):
        mark = _add(document, "Placemark")
        kind = "no-fly" if index in mission.scene.no_fly else "obstacle"
        _add(mark, "name", f"{kind} {index}")
        _add(mark, "styleUrl", f"#{kind}")
        polygon = _add(mark, "Polygon")
        _add(polygon, "extrude", "1")  # down to the ground
        _add(polygon, "altitudeMode", "absolute")
        roof = mission.floor(box)
        roof[:, 2] += box[1, 2] - box[0, 2]
        ring = [[p[1], p[0], p[2]] for p in [*roof.tolist(), roof[0].tolist()]]
        outer = _add(_add(polygon, "outerBoundaryIs"), "LinearRing")
        _add(outer, "coordinates", " ".join(map(_text, ring)))
    ElementTree.indent(root, " ")
    with io.BytesIO() as out:
        ElementTree.ElementTree(root).write(out, encoding="utf-8", xml_declaration=True)
        return out.getvalue().decode() + "\n"


def csv(mission: FlownMission) -> str:
    """Returns the flight as rows of CSV_HEADER, one at each slot's end: s, degrees, m, m/s."""
    flown, rows = mission.trajectory, mission.rows
    places = mission.frame.geographic(flown.x[rows])
    speed = np.linalg.norm(flown.v[rows], axis=1)
    lines = [CSV_HEADER]
    for t, place, fast in zip(flown.t[rows], places, speed, strict=True):
        lines.append(f"{t:.6g},{place[0]:.9f},{place[1]:.9f},{place[2]:.4f},{fast:.4f}")
    return "\n".join(lines) + "\n"


def _coordinates(mission: FlownMission, points: Array) -> list[Any]:
    """Returns points (..., 3) as longitude, latitude and altitude."""
    listed: list[Any] = mission.frame.geographic(points)[..., [1, 0, 2]].tolist()
    return listed


def _feature(geometry: dict[str, Any], properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def _add(
    parent: ElementTree.Element, tag: str, text: str = "", **attributes: str
) -> ElementTree.Element:
    """Adds an element to a KML element and returns it."""
    child = ElementTree.SubElement(parent, f"{{{KML}}}{tag}", attributes)
    child.text = text or None
    return child


def _text(place: list[float]) -> str:
    return ",".join(f"{number:.9f}" for number in place)
