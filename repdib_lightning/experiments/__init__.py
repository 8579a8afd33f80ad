"""Grids of runs over seeds: run them, see how they stand, and report them with their spread."""
