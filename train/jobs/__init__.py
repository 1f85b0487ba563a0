"""Processes side by side, on this machine or a Ray cluster."""
