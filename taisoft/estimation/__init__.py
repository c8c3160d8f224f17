"""Error estimates of a run, from twins: other runs of the same scene with another step, tighter tolerances or another mesh."""
