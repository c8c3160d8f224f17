"""Adapters of simulators for the works, one per file, each with its best settings."""
