"""The formats of the AWS service and its car, read and written without anything else of ours.

`logs.reader.read_recording` reads logs, `models.model_metadata.ModelMetadata` action spaces, `models.archive` trained
models, and `worlds.catalogue` finds the service's tracks. What drives and trains for them is in
`commands.validation` and `commands.export`.
"""
