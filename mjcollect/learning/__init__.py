"""Holds Algorithm 1: networks, replay buffer, DDPG, the training loop, and trained policies."""
