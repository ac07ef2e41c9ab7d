"""The rows: blocks, threads, memory maps, Dask."""
