"""The rules of one slot, each in a file of its own, vectorised over N simulations."""
