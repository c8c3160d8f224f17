"""Error estimates of a run, from companions: runs of the same scene with another step, tighter tolerances or another mesh."""
