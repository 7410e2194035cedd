"""Batches of control steps from cars in this process or in several.

`collector.open_collector` gives a `Collector`; `forking.start_workers_early` starts its processes while a
command imports.
"""
