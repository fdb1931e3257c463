"""Many recordings: a plan, its items on local processes or on a Dask scheduler, a table of outcomes."""
