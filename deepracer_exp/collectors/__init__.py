"""Batches of control steps from cars in this process or in several.

`collector.Collector` starts the cars; `forking.start_workers_early` starts its processes while a
command imports.
"""
