"""The parts of `python -m train.reproduce`: what to fly, what to count, what to draw and say."""
