"""Draws every picture: films of recorded flights, figures of paths, speeds and learning."""

from mjcollect.render.runs import UnreadableRun
from mjcollect.render.settings import VideoSettings
from mjcollect.render.video import RenderError, render_in_child, render_run

__all__ = ["RenderError", "UnreadableRun", "VideoSettings", "render_in_child", "render_run"]
