"""What the programs share: command line, run folders, presets, reports."""
