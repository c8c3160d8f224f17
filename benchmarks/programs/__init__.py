"""Simulators on the same works: one adapter a file, each with the settings found best for it."""
