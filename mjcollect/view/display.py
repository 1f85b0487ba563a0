"""Finds out whether a window can be opened here, before the viewer would fail in a thread."""

from __future__ import annotations

import os
import sys
import warnings

ALTERNATIVES = (
    "without a display, open replay.html in the folder of a run, film it by "
    "python -m mjcollect.render --run DIR, or start this program by xvfb-run"
)


class DisplayError(RuntimeError):
    """Says that no window can be opened here; the message says why and what to do."""


def require_display() -> None:
    """Opens and closes a hidden window.

    Raises:
        DisplayError: there is no display, or none with OpenGL.
    """
    named = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if sys.platform == "linux" and not named:
        raise DisplayError(
            f"display: DISPLAY and WAYLAND_DISPLAY are not set: no window can open; {ALTERNATIVES}"
        )
    with warnings.catch_warnings(action="ignore"):  # GLFW's errors become warnings
        import glfw

        if not glfw.init():
            raise DisplayError(f"display: {named}: cannot be opened (GLFW); {ALTERNATIVES}")
        glfw.window_hint(glfw.VISIBLE, glfw.FALSE)
        window = glfw.create_window(64, 64, "mjcollect", None, None)
        glfw.default_window_hints()
        if window:
            # GLFW stays connected: a server without clients, as Xvfb, starts anew for a moment.
            glfw.destroy_window(window)
        else:
            glfw.terminate()
            raise DisplayError(f"display: {named}: opens no window with OpenGL; {ALTERNATIVES}")
