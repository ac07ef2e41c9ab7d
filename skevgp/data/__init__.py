"""Rows of data: blocks, threads, memory maps, Dask arrays."""
