"""Many nights of the simulated telescope, and whether what the estimators say of them is true."""
