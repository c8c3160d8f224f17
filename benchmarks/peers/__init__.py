"""Other simulators on taisoft's own problems: one adapter a file, each with the settings found best for it."""
