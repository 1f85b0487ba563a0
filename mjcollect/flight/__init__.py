"""This room holds the rules of one slot, one in each file, vectorised over N simulations."""
