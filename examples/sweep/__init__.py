"""Searches settings of the learner with Optuna: `python -m examples.sweep`."""
