"""Changes scene files and command lines at random, as users and disks do."""

from __future__ import annotations

import contextlib
import copy
import json
import signal
from collections.abc import Iterator
from typing import Any

import numpy as np

ODD: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 0.0, -0.0, 1e-9, 1e-300, 1e9, 1e300, -1e300, 10**30, 2**63,
    2**63 - 1, float("nan"), float("inf"), float("-inf"), "", "x", "1", "nan", "\u0000", "\ud800",
    "é" * 200, [], [[]], {}, {"min": 0}, [1, 2],
    [1, 2, 3], [1, 2, 3, 4], ["a", "b", "c"], [0, 0, None],
    [[0, 0, 0]], [1e308, 1e308, 1e308], {"x": {"y": {"z": []}}},
)  # fmt: skip
FACTORS = (0.0, -1.0, 1e-12, 1e-6, 1e-3, 0.5, 0.999999, 1.000001, 2.0, 10.0, 1e3, 1e6, 1e12)

HANG = 10.0  # seconds of work after which something counts as hanging


@contextlib.contextmanager
def no_hang() -> Iterator[None]:
    """Ends by an error what works for `HANG` seconds, or waits, on however busy a machine."""

    def late(number: int, frame: Any) -> None:
        raise TimeoutError(f"hangs for {HANG} s")

    timers = ((signal.SIGPROF, signal.ITIMER_PROF, HANG), (signal.SIGALRM, signal.ITIMER_REAL, 120))
    before = [signal.signal(number, late) for number, _, _ in timers]
    for _, timer, seconds in timers:
        signal.setitimer(timer, seconds)
    try:
        yield
    finally:
        for (number, timer, _), handler in zip(timers, before, strict=True):
            signal.setitimer(timer, 0)
            signal.signal(number, handler)


def places(document: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The paths of all values in a JSON document but the document itself."""
    found = [path] if path else []
    pairs: Any = document.items() if isinstance(document, dict) else ()
    if isinstance(document, list):
        pairs = enumerate(document)
    for key, value in pairs:
        found += places(value, (*path, key))
    return found


def at(document: Any, path: tuple[Any, ...]) -> Any:
    for key in path:
        document = document[key]
    return document


class SceneFiles:
    """Draws scene files, each a change of one of some documents."""

    def __init__(self, documents: list[dict[str, Any]], seed: int) -> None:
        self.documents, self.rng = documents, np.random.default_rng(seed)
        self.kinds = (
            self.odd_value, self.odd_value, self.no_value, self.more, self.scaled, self.scaled,
            self.swapped, self.flat_box, self.item_in_box, self.moved, self.moved, self.copied,
        )  # fmt: skip
        self.texts = (self.cut, self.flipped, self.inserted, self.twice, self.deep, self.encoded)

    def draw(self) -> bytes:
        document = copy.deepcopy(self.documents[self.rng.integers(len(self.documents))])
        if self.rng.random() < 0.25:
            return self.pick(self.texts)(json.dumps(document, indent=1))
        for _ in range(int(self.rng.choice([1, 1, 1, 2, 4]))):
            self.pick(self.kinds)(document)
        return json.dumps(document).encode()

    def pick(self, choices: Any) -> Any:
        return choices[self.rng.integers(len(choices))]

    def place(self, document: Any) -> tuple[Any, Any]:
        """A container in the document, and a key in it."""
        found = places(document)
        path = self.pick(found) if found else ("name",)
        return at(document, path[:-1]), path[-1]

    def odd_value(self, document: Any) -> None:
        inside, key = self.place(document)
        inside[key] = copy.deepcopy(self.pick(ODD))

    def no_value(self, document: Any) -> None:
        inside, key = self.place(document)
        inside.pop(key, None) if isinstance(inside, dict) else inside.pop(key)

    def more(self, document: Any) -> None:
        inside, key = self.place(document)
        if isinstance(inside, dict):
            inside[self.pick(["", "Name", "obstacle", "x" * 300, "é\n", str(key) + " "])] = 1
        else:
            inside.extend(copy.deepcopy([inside[key]]) * int(self.rng.integers(1, 40)))

    def scaled(self, document: Any) -> None:
        inside, key = self.place(document)
        if isinstance(inside[key], int | float):
            inside[key] = inside[key] * self.pick(FACTORS)

    def swapped(self, document: Any) -> None:
        box = self.pick([document.get("bounds"), *self.list(document, "obstacles")])
        if isinstance(box, dict) and {"min", "max"} <= set(box):
            box["min"], box["max"] = box["max"], box["min"]

    def flat_box(self, document: Any) -> None:
        for box in self.list(document, "obstacles"):
            if isinstance(box, dict) and "min" in box:
                box["max"] = copy.deepcopy(box["min"])

    def item_in_box(self, document: Any) -> None:
        boxes, items = self.list(document, "obstacles"), self.list(document, "items")
        if boxes and items and isinstance(boxes[0], dict):
            items[0] = copy.deepcopy(boxes[0].get("min"))

    def moved(self, document: Any) -> None:
        """Moves a point or a corner by a few metres: such a scene is often accepted."""
        points = [p for p in places(document) if self.point(at(document, p))]
        if points:
            point = at(document, self.pick(points))
            point[:] = [float(value + self.rng.normal(0.0, 4.0)) for value in point]

    def copied(self, document: Any) -> None:
        """Puts one value of the document in the place of another."""
        inside, key = self.place(document)
        value = copy.deepcopy(at(document, self.pick([(), *places(document)])))
        inside[key] = value

    @staticmethod
    def point(value: Any) -> bool:
        return (
            isinstance(value, list) and len(value) == 3
            and all(type(x) in (int, float) and abs(x) < 1e9 for x in value)
        )  # fmt: skip

    @staticmethod
    def list(document: Any, key: str) -> list[Any]:
        value = document.get(key)
        return value if isinstance(value, list) else []

    def cut(self, text: str) -> bytes:
        return text.encode()[: int(self.rng.integers(len(text)))]

    def flipped(self, text: str) -> bytes:
        data = bytearray(text.encode())
        for _ in range(int(self.rng.integers(1, 4))):
            data[self.rng.integers(len(data))] ^= int(self.rng.integers(1, 256))
        return bytes(data)

    def inserted(self, text: str) -> bytes:
        where = int(self.rng.integers(len(text)))
        new = self.pick(
            [b"\x00", b"\xff", b",", b"}", b"[", b'"', b"NaN", b"//", b"\r\n", b"9" * 400]
        )
        return text.encode()[:where] + new + text.encode()[where:]

    def twice(self, text: str) -> bytes:
        lines = text.split("\n")
        where = int(self.rng.integers(1, len(lines) - 1))
        return "\n".join([*lines[:where], lines[where], *lines[where:]]).encode()

    def deep(self, text: str) -> bytes:
        depth = int(self.rng.integers(1, 200_000))
        shape = self.pick(["[%s]", '{"a":%s}'])
        before, after = shape.split("%s")
        value = before * depth + after * (depth if self.rng.random() < 0.5 else 0)
        return text.replace('"name": ', f'"name": {value}, "other": ', 1).encode()

    def encoded(self, text: str) -> bytes:
        name = self.pick(["utf-16", "utf-32", "utf-8-sig", "utf-7", "cp500"])
        return text.encode(name)
