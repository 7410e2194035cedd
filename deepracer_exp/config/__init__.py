"""Options and overrides, composed into an `experiment.Experiment`: frozen, every value checked.

`compose.compose_experiment` composes, `stored.with_overrides` changes what a run has stored, `overrides` reads single
overrides. `custom_files` turns the files of a DeepRacer model into overrides. Nothing else speaks Hydra.
"""
