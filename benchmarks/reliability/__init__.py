"""Measures what happens to runs that are killed, files that are damaged, and input at random."""
