"""Shows scenes and recorded flights in MuJoCo's own viewer."""
