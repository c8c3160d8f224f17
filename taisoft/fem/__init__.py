"""Finite elements: forces, one module per term."""
