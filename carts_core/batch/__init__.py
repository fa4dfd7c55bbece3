"""Batches of jobs for many recordings: manifest, engines, states and results.

`manifest` reads the jobs, `folder` stores their states and results, `engines` runs them in parallel.
The function that runs a job is in `carts_core.cli.batch_job`.
"""
