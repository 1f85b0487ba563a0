"""The shortest free path to a target from anywhere, and the guidance law that flies it."""
