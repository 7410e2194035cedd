"""MLflow and other trackers: a projection of run folders, made by a process of its own.

`tracker.open_tracker` records a training, `delivery` what was left undelivered, `registry` promotes checkpoints, and
`resolve.resolve` says which run a name, an id or an alias means.
"""
