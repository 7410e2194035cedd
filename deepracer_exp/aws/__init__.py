"""All that the AWS service and its car read and write, on two floors.

Formats, below everything else: `logs.reader.read_recording`, `models.model_metadata.ModelMetadata`,
`models.archive`, `worlds.catalogue`. What drives and trains for them, above: `validation.validate`, `export.export`.
"""
