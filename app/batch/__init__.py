"""Many recordings, reconstructed by many workers into one store; only `workers` knows Dask."""
