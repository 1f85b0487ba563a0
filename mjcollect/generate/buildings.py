"""Reads footprints and heights of buildings from map files: GeoJSON, CityJSON, OpenStreetMap."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import shapely

from mjcollect.generate.cityjson import outlines
from mjcollect.scene.file_format import SceneError

LEVEL = 3.0  # metres of a storey
MOST_BYTES = 64_000_000  # A larger text takes gigabytes to read; extracts of OSM may be larger.
OSM_ENDINGS = (".osm", ".pbf", ".osm.bz2", ".osm.gz")
CRS84 = re.compile(r"(CRS:?84|EPSG:{1,2}4326|WGS ?84)$", re.IGNORECASE)


@dataclass(frozen=True)
class Building:
    """Holds one building as it stands in a file.

    Attributes:
        name: id of its feature. outline: Polygon or MultiPolygon of longitudes and latitudes.
        height: metres of its top above ground; None if the file does not say. base: of its floor.
    """

    name: str
    outline: Any
    height: float | None
    base: float = 0.0


def read_buildings(path: Path) -> Iterator[Building | None]:
    """Yields the buildings of a file, and None for features that are no areas.

    Raises:
        SceneError: the file is no map of buildings in degrees; the message names the fix.
    """
    if not path.exists():
        raise SceneError("map file", str(path), "does not exist; check the path")
    if path.is_dir():
        raise SceneError("map file", str(path), "is a folder; name the file in it")
    if path.stat().st_size == 0:
        raise SceneError("map file", str(path), "is empty; download it again")
    if path.name.lower().endswith(OSM_ENDINGS):
        yield from _from_osm(path)
    else:
        yield from _from_json(path)


def _from_json(path: Path) -> Iterator[Building | None]:
    size = path.stat().st_size
    if size > MOST_BYTES:
        fix = f"is larger than {MOST_BYTES // 1_000_000} MB; cut the place out first"
        raise SceneError("map file", f"{path.name}: {size // 1_000_000} MB", fix)
    try:
        document = json.loads(path.read_text(encoding="utf-8-sig"))
    except UnicodeDecodeError:
        raise SceneError("map file", str(path), "is not UTF-8 text; give GeoJSON or OSM") from None
    except (json.JSONDecodeError, RecursionError) as error:
        where = f" at line {error.lineno}" if isinstance(error, json.JSONDecodeError) else ""
        fix = f"is not valid JSON{where}; it may be cut off: download it again"
        raise SceneError("map file", str(path), fix) from None
    if isinstance(document, dict) and document.get("type") == "CityJSON":
        for found in outlines(document):
            yield None if found is None else Building(*found)
        return
    if not isinstance(document, dict) or document.get("type") != "FeatureCollection":
        fix = "is neither a GeoJSON FeatureCollection nor CityJSON; export buildings as one"
        raise SceneError("map file", str(path), fix)
    crs = document.get("crs")
    name = crs.get("properties", {}).get("name", "") if isinstance(crs, dict) else ""
    if name and not CRS84.search(str(name)):
        fix = "must be WGS 84 in degrees; convert it, e.g. ogr2ogr -t_srs EPSG:4326"
        raise SceneError("map file: crs", name, fix)
    features = document.get("features")
    if not isinstance(features, list):
        raise SceneError("map file: features", features, "must be a list")
    for index, feature in enumerate(features):
        yield _feature(index, feature)


def _feature(index: int, feature: Any) -> Building | None:
    """Returns the building of a feature; None if it is no area."""
    about = feature.get("properties") or {} if isinstance(feature, dict) else {}
    geometry = feature.get("geometry") if isinstance(feature, dict) else None
    name = str(feature.get("id", f"number {index}") if isinstance(feature, dict) else index)
    if not isinstance(geometry, dict) or geometry.get("type") not in ("Polygon", "MultiPolygon"):
        return None
    try:
        outline = shapely.force_2d(shapely.from_geojson(json.dumps(geometry)))
    except (shapely.errors.GEOSException, ValueError, TypeError) as error:
        fix = f"its coordinates are no polygon ({error}); correct or remove it"
        raise SceneError("map file: feature", name, fix) from None
    return Building(name, outline, *heights(about if isinstance(about, Mapping) else {}, name))


def heights(about: Mapping[str, Any], name: str) -> tuple[float | None, float]:
    """Returns top and floor above ground in m, as OpenStreetMap's tags say.

    Raises:
        SceneError: one of them is no number, or the floor is above the top.
    """
    found = {
        key: _metres(about[key], key, name)
        for key in ("height", "building:height", "min_height", "building:levels", "Floor")
        if about.get(key) not in (None, "")
    }
    levels = found.get("building:levels", found.get("Floor"))
    height = found.get("height", found.get("building:height"))
    if height is None and levels is not None:
        height = LEVEL * levels
    base = found.get("min_height", 0.0)
    if height is not None and not 0.0 <= base < height:
        fix = f"of feature {name} must lie between 0 and its height of {height:g} m"
        raise SceneError("map file: min_height", base, fix)
    return height, base


def _metres(value: Any, key: str, name: str) -> float:
    text = str(value).strip().lower()
    match = re.fullmatch(r"([0-9]+(?:[.,][0-9]+)?)\s*(m|ft|')?", text)
    if match is None:
        fix = f"of feature {name} must be a number of metres; correct or remove it"
        raise SceneError(f"map file: {key}", value, fix)
    number = float(match[1].replace(",", "."))
    return number * 0.3048 if match[2] in ("ft", "'") else number


def _from_osm(path: Path) -> Iterator[Building]:
    try:
        import osmium
    except ImportError:
        fix = "needs osmium to be read; pip install 'mjcollect[geo]'"
        raise SceneError("map file", str(path), fix) from None
    reader = osmium.FileProcessor(str(path)).with_areas(osmium.filter.KeyFilter("building"))
    write = osmium.geom.WKBFactory()
    try:
        for area in reader.with_filter(osmium.filter.KeyFilter("building")):
            if not area.is_area():
                continue
            name = f"{'way' if area.from_way() else 'relation'} {area.orig_id()}"
            outline = shapely.from_wkb(write.create_multipolygon(area))
            yield Building(name, outline, *heights(dict(area.tags), name))
    except RuntimeError as error:
        fix = f"is no OpenStreetMap extract ({error}); download it again"
        raise SceneError("map file", str(path), fix) from None
