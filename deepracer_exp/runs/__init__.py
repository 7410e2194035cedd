"""The run folder, which needs nothing else to be read.

`stored_run.StoredRun` is a run with a chosen checkpoint, `run_files` names and reads its files,
`run_result.read_result` says how it ended, `recording.read_log` reads its steps, `best_run.best_of` finds the best of
an experiment. A training writes by `folder.RunFolder`, `checkpoints.CheckpointStore` and `trace`.
"""
