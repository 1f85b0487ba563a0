"""This room finds the shortest free path to a target, and holds the guidance law that flies it."""
