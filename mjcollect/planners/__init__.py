"""Planners that need no training: what the learned policy is compared with."""
