"""Holds what an agent sees and is paid: courses, episodes, and the two environments.

Importing the package imports nothing, because processes that build guidance must not load torch.
"""
