"""Studies: one scene over a grid of settings, each run in its own process; speed against error."""
