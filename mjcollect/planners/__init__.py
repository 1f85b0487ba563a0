"""Holds the pilots that plan and do not learn: model predictive control and the reference."""
