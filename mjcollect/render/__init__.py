"""Every picture: videos of recorded flights, figures of paths, speeds and learning."""

from mjcollect.render.video import RenderError, render_in_child, render_run, render_video

__all__ = ["RenderError", "render_in_child", "render_run", "render_video"]
