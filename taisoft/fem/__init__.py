"""Finite elements: forces as terms."""
