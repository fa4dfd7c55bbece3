"""Many recordings: jobs, who runs them, and what came of them.

`manifest` says which jobs there are, `state` what is known of each, `pool` and `cluster` have them run side by side.
What a job does is handed to these as a function; `carts_core.cli.batch_job` has it.
"""
