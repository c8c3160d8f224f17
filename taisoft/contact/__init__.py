"""Contacts to impulses: the frictional contact problem and its solvers."""

SOLVERS = ("gauss_seidel", "jacobi", "hybrid", "coloured_gauss_seidel")  # a module each
