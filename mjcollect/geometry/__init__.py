"""Points, segments, boxes, polylines and grids. Arrays in, arrays out; knows no scene."""
