"""Reads footprints and heights of buildings from CityJSON."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import shapely

from mjcollect.geometry.compiled import Array
from mjcollect.scene.file_format import SceneError
from mjcollect.scene.place import WGS84

KINDS = ("Building", "BuildingPart")
NESTING = {"MultiSurface": 0, "CompositeSurface": 0, "Solid": 1, "MultiSolid": 2}
FLAT = 1e-6  # m²; a surface whose footprint is smaller stands upright


def outlines(document: dict[str, Any]) -> Iterator[tuple[str, Any, float | None] | None]:
    """Yields name, outline in degrees and height in m of buildings, None for other city objects.

    The outline is that of all surfaces as seen from above; the height is from the lowest point to
    the highest, since terrain is flat, and None for a flat one. Of several levels of detail the
    least is taken.

    Raises:
        SceneError: the document is no such city; the message names what is wrong with it.
    """
    turn = _to_degrees(document)
    vertices = _vertices(document)
    objects = document.get("CityObjects")
    if not isinstance(objects, dict):
        raise SceneError("map file: CityObjects", objects, "must hold objects by their names")
    for name, thing in objects.items():
        shapes = thing.get("geometry") if isinstance(thing, dict) else None
        shapes = [shape for shape in shapes or [] if isinstance(shape, dict)]
        shapes = [shape for shape in shapes if shape.get("type") in NESTING]
        if not shapes or thing.get("type") not in KINDS:
            yield None
            continue
        shape = min(shapes, key=lambda shape: str(shape.get("lod", "")))
        try:
            rings = list(_rings(shape["boundaries"], NESTING[shape["type"]]))
            corners = vertices[np.concatenate([np.array(ring, dtype=int) for ring in rings])]
            seen = [shapely.Polygon(vertices[ring][:, :2]) for ring in rings]
        except (IndexError, KeyError, TypeError, ValueError, shapely.errors.GEOSException):
            fix = "its boundaries do not fit its vertices; correct or remove it"
            raise SceneError("map file: city object", name, fix) from None
        level = [shapely.make_valid(each) for each in seen if each.area > FLAT]
        if level:
            outline = shapely.transform(shapely.union_all(level), turn.transform, interleaved=False)
            yield name, outline, float(np.ptp(corners[:, 2])) or None
        else:
            yield None


def _rings(boundaries: Any, depth: int) -> Iterator[list[int]]:
    """Yields the outer ring of every surface, `depth` lists of surfaces below."""
    if depth > 0:
        for part in boundaries:
            yield from _rings(part, depth - 1)
    else:
        for surface in boundaries:
            yield surface[0]


def _vertices(document: dict[str, Any]) -> Array:
    """Returns the vertices (V, 3) in the document's own system."""
    try:
        vertices = np.array(document["vertices"], dtype=float).reshape(-1, 3)
        change = document.get("transform", {"scale": [1.0] * 3, "translate": [0.0] * 3})
        return vertices * np.array(change["scale"]) + np.array(change["translate"])
    except (KeyError, TypeError, ValueError):
        fix = "must be a list of [x, y, z], with a transform of three numbers each"
        raise SceneError("map file: vertices", "these", fix) from None


def _to_degrees(document: dict[str, Any]) -> Any:
    """Returns the transformer from the document's system to longitude and latitude."""
    try:
        import pyproj
    except ImportError:
        fix = "needs pyproj to be read; pip install 'mjcollect[geo]'"
        raise SceneError("map file", "CityJSON", fix) from None
    metadata = document.get("metadata")
    system = str(metadata.get("referenceSystem", "")) if isinstance(metadata, dict) else ""
    code = re.search(r"EPSG[:/].*?([0-9]+)$", system)
    if code is None:
        fix = "must name an EPSG code, such as https://www.opengis.net/def/crs/EPSG/0/7415"
        raise SceneError("map file: metadata.referenceSystem", system or "none", fix)
    try:
        crs = pyproj.CRS.from_epsg(int(code[1])).to_2d()
    except pyproj.exceptions.CRSError:
        raise SceneError("map file: metadata.referenceSystem", system, "is not known") from None
    return pyproj.Transformer.from_crs(crs, WGS84, always_xy=True)
