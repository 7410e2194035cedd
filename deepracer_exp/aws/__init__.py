"""Readers and writers of the formats of the AWS service and its car, independent of the other packages.

`logs.reader.read_recording` reads logs, `models.model_metadata.ModelMetadata` action spaces, `models.archive` trained
models, and `worlds.catalogue` finds the service's tracks. Code that drives or trains for them is in
`commands.validation` and `commands.export`.
"""
