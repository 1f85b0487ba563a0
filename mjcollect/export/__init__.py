"""Writes flown missions for ground stations and maps."""
