"""Command line programs: train, fly, evaluate. Each reads top to bottom."""
