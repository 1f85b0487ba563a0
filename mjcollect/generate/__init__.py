"""Makes scenes: drawn from a seed, or of real buildings."""

from mjcollect.generate.layouts import LAYOUTS, GenerateError, generate

__all__ = ["LAYOUTS", "GenerateError", "generate"]
