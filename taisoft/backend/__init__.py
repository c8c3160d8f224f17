"""Taichi's runtime, its arrays and how kernels are launched: what touches Taichi's own state or private parts."""
