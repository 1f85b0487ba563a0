"""Says where on Earth a scene lies: x east, y north, z up, in metres from an origin.

The plane of x and y is a map projection, by default the azimuthal equidistant one about the origin,
in which distances from it are true. Terrain is flat: z = 0 is the origin's altitude everywhere.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mjcollect.geometry.compiled import Array
from mjcollect.scene.file_format import SceneError

WGS84 = "EPSG:4326"


@dataclass(frozen=True)
class Origin:
    """Holds the place of a scene's point [0, 0, 0].

    Attributes:
        latitude, longitude: degrees on WGS 84. altitude: metres above mean sea level.
        crs: projected system, in metres, of x and y, as pyproj reads it, such as "EPSG:32651"; only
            differences to the origin count. Empty for azimuthal equidistant about the origin.
    """

    latitude: float
    longitude: float
    altitude: float = 0.0
    crs: str = ""

    def __post_init__(self) -> None:
        """Raises a SceneError for a place that is not on Earth."""
        for field, most in (("latitude", 90.0), ("longitude", 180.0), ("altitude", 1e4)):
            value = getattr(self, field)
            if not -most <= value <= most:
                raise SceneError(
                    f"origin.{field}", value, f"must lie between -{most:g} and {most:g}"
                )

    def to_dict(self) -> dict[str, Any]:
        """Returns the document of the scene file."""
        document: dict[str, Any] = {"latitude": self.latitude, "longitude": self.longitude}
        document["altitude"] = self.altitude
        return document | ({"crs": self.crs} if self.crs else {})

    @classmethod
    def of(cls, value: object) -> Origin | None:
        """Returns the origin that a document or None stands for.

        Raises:
            SceneError: it is neither, or not on Earth.
        """
        if value is None or isinstance(value, Origin):
            return value
        if isinstance(value, Mapping):
            try:
                return cls(**{str(key): entry for key, entry in value.items()})
            except TypeError:
                pass
        raise SceneError("origin", value, "needs latitude and longitude, in degrees")


class Frame:
    """Turns metres of a scene into latitude, longitude and altitude, and back."""

    def __init__(self, origin: Origin) -> None:
        """Prepares the projection.

        Raises:
            SceneError: pyproj is missing, or the origin's crs is unknown or not a plane in metres.
        """
        try:
            import pyproj
        except ImportError:
            fix = "needs pyproj to be turned into metres; pip install 'mjcollect[geo]'"
            raise SceneError("origin", origin.to_dict(), fix) from None
        self.origin = origin
        name = origin.crs or (
            f"+proj=aeqd +lat_0={origin.latitude!r} +lon_0={origin.longitude!r} +datum=WGS84"
        )
        try:
            crs = pyproj.CRS.from_user_input(name)
        except pyproj.exceptions.CRSError as error:
            reason = str(error).split(":")[0]
            raise SceneError("origin.crs", origin.crs, f"is not known ({reason})") from None
        if not crs.is_projected or any(
            axis.unit_conversion_factor != 1.0 for axis in crs.axis_info
        ):
            raise SceneError("origin.crs", origin.crs, "must be a projected system in metres")
        self._project = pyproj.Transformer.from_crs(WGS84, crs, always_xy=True)
        self._east, self._north = self._project.transform(origin.longitude, origin.latitude)
        if not np.all(np.isfinite([self._east, self._north])):
            raise SceneError("origin.crs", origin.crs, "does not reach the origin")

    def local(self, places: ArrayLike) -> Array:
        """Returns the points (..., 3) in m of places (..., 3): latitude, longitude, altitude."""
        latitude, longitude, altitude = np.moveaxis(np.asarray(places, float), -1, 0)
        x, y = self._project.transform(longitude, latitude)
        rows = [x - self._east, y - self._north, altitude - self.origin.altitude]
        return np.stack(rows, axis=-1)

    def geographic(self, points: ArrayLike) -> Array:
        """Returns places (..., 3), latitude, longitude and altitude, of points (..., 3) in m."""
        x, y, z = np.moveaxis(np.asarray(points, float), -1, 0)
        east, north = x + self._east, y + self._north
        longitude, latitude = self._project.transform(east, north, direction="INVERSE")
        return np.stack([latitude, longitude, z + self.origin.altitude], axis=-1)


def check_place(origin: Origin | None) -> None:
    """Raises a SceneError if there is an origin that cannot be turned into metres and back."""
    if origin is not None:
        Frame(origin)
