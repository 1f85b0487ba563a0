"""This room holds what several UAVs in one scene need: parts of the scene, flights, environments."""
