"""This room holds what several UAVs in one scene need: parts of it, flights, environments."""
