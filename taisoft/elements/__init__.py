"""Linear and quadratic tetrahedra: `reference` for the host, `lanes` for kernels."""
