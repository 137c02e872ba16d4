"""Our own solvers of design problems, one file each, and the reference by CVXPY with Clarabel."""
