"""Algorithm 1: networks, replay buffer, DDPG, the training loop, and the policy that it leaves."""
