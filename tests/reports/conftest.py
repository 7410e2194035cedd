from tests.evaluation.conftest import circle, driver, experiment, protocol, run_dir  # noqa: F401 - fixtures
