"""Which labels are of one physical thing."""
