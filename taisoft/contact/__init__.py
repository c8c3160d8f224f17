"""The frictional contact problem and its solvers: impulses from contacts."""

SOLVERS = ("gauss_seidel", "jacobi", "hybrid", "coloured_gauss_seidel")  # methods of `sweeps`
