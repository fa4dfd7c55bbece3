"""Many recordings: jobs, who runs them, and what came of them.

`manifest` reads the jobs, `folder` has their states and results, `engines` runs them side by side.
What a job does is handed to these as a function; `carts_core.cli.batch_job` has it.
"""
