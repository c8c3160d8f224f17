"""Tetrahedra of first and second order, all that is known of them: `reference` for the host, `lanes` for kernels."""
